"""What pairs of views say of each other, and the level of each view that explains it best."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np


@final
@dataclass(frozen=True, eq=False)
class PairRatios:
    """Logs of how much brighter points are in the second view of a pair than in the first.

    Args:
        first, second: numbers of the views, shape (pairs,).
        counts: points that say so, of the same shape.
        logs: medians over these points, shape (pairs, channels).
    """

    first: np.ndarray
    second: np.ndarray
    counts: np.ndarray
    logs: np.ndarray

    @staticmethod
    def of(first: np.ndarray, second: np.ndarray, logs: np.ndarray, fewest: int) -> PairRatios:
        """The ratios of all pairs that share enough points.

        Args:
            first, second: views that see a point, shape (n,).
            logs: of its ratios, shape (n, channels); NaN where they are not known.
            fewest: points that a pair must share, with ratios that are known in all channels.
        """
        views = 1 + max(first.max(initial=0), second.max(initial=0))
        pair = first * views + second
        order = np.argsort(pair, kind="stable")
        numbers, starts = np.unique(pair[order], return_index=True)
        parts = np.split(logs[order], starts[1:]) if len(numbers) else []
        counts = np.array([np.isfinite(part).sum(0).min() for part in parts], int)
        enough = np.flatnonzero(counts >= fewest)
        medians = np.array([np.nanmedian(parts[i], 0) for i in enough])
        pairs = np.divmod(numbers[enough], views)
        return PairRatios(*pairs, counts[enough], medians.reshape(-1, logs.shape[1]))

    def some(self, kept: np.ndarray) -> PairRatios:
        """Some of the pairs."""
        return PairRatios(*(x[kept] for x in (self.first, self.second, self.counts, self.logs)))


def levels(
    first: np.ndarray, second: np.ndarray, logs: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Levels of views whose differences are the logs of pairs, by least squares.

    Args:
        first, second: views of pairs, shape (pairs,). There is a pair; every view is in one, and
            pairs connect all views.
        logs: what the second one has more than the first, shape (pairs, channels).
        weight: of each pair, shape (pairs,).

    Returns:
        Shape (views, channels), with a mean of 0 in each.
    """
    count = 1 + int(max(first.max(), second.max()))
    # The graph's Laplacian is singular: the constant puts the mean at 0.
    matrix = np.full((count, count), weight.mean())
    right = np.zeros((count, logs.shape[1]))
    for one, other, sign in ((first, second, -1.0), (second, first, 1.0)):
        np.add.at(matrix, (one, one), weight)
        np.add.at(matrix, (one, other), -weight)
        np.add.at(right, one, sign * weight[:, None] * logs)
    return np.linalg.solve(matrix, right)
