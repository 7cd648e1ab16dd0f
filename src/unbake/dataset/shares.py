"""How the photographs of a fit are dealt to its processes: each holds some views, and whole ones.

Views stay in their order, and each process has some that follow each other. So what is numbered
over all views, pixels and those of them to train on, is numbered in one stretch on each process.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from ..ranks import Ranks


def dealt(sizes: Sequence[int], ranks: int) -> np.ndarray:
    """The number of the first view of each process, and of all views, shape (ranks + 1,).

    Processes have about as many pixels each as whole views allow.

    Args:
        sizes: pixels of each view.
        ranks: processes, no more than there are views.
    """
    ends = np.cumsum([0, *sizes])
    first = [0]
    for rank in range(1, ranks):
        nearest = int(np.abs(ends - ends[-1] * rank / ranks).argmin())
        # No process without a view: neither this one nor one of those to come.
        first.append(min(max(nearest, first[-1] + 1), len(sizes) - (ranks - rank)))
    return np.array([*first, len(sizes)])


@final
@dataclass(frozen=True, eq=False)
class Share:
    """What this process holds of the photographs, and what the others do.

    Args:
        ranks: the processes.
        first_views: as `dealt` gives them.
        sizes: pixels of each view of all, shape (views,).
        counts: of these those to train on, shape (views,).
    """

    ranks: Ranks
    first_views: np.ndarray
    sizes: np.ndarray
    counts: np.ndarray

    @cached_property
    def first_pixels(self) -> np.ndarray:
        """Number of the first pixel of each process, and of all pixels."""
        return np.cumsum([0, *self.sizes])[self.first_views]

    @cached_property
    def first_places(self) -> np.ndarray:
        """The same among the pixels to train on."""
        return np.cumsum([0, *self.counts])[self.first_views]

    def own(self, first: np.ndarray) -> range:
        """The numbers that this process holds, by those that each begins with."""
        rank = self.ranks.rank
        return range(int(first[rank]), int(first[rank + 1]))

    def weight(self, held: np.ndarray, *, crops: bool) -> float:
        """What the mean over a batch of this process is multiplied by, 1 on the average.

        The mean over processes then is one over all pixels, each as likely as any other: a process
        with as many pixels as the others has 1, one with twice as many has 2.

        Args:
            held: places among all pixels to train on that are never drawn, in rising order.
            crops: whether it is views that are as likely as any other.
        """
        each = np.diff(self.first_places) - np.diff(np.searchsorted(held, self.first_places))
        if crops:
            each = np.diff(np.cumsum([0, *(self.counts > 0)])[self.first_views])
        return float(self.ranks.size * each[self.ranks.rank] / each.sum())

    def looked_up(
        self, numbers: np.ndarray, first: np.ndarray, look: Callable[[np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """What the processes that hold them know of some numbers, on all.

        Args:
            numbers: the same ones on each process, in any order.
            first: the number that each process begins with.
            look: tells rows of numbers that this process holds.

        Raises:
            Agreed: it failed on some process, or they ask for others.
        """
        holder = np.searchsorted(first[1:], numbers, "right")
        rows = self.ranks.joined(lambda: look(numbers[holder == self.ranks.rank]))
        asked = hashlib.sha256(np.ascontiguousarray(numbers).tobytes()).hexdigest()
        self.ranks.require_same({"pixels to look at": asked})
        found = np.empty_like(rows)
        found[np.argsort(holder, kind="stable")] = rows
        return found
