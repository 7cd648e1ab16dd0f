"""Lines that tell how far work is that takes long."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar, final

Result = TypeVar("Result")

#: Seconds between two lines on the progress of one piece of work.
EVERY = 10.0


def silent(line: str) -> None:
    """Tell nothing."""


@final
class Paced:
    """Passes lines on, at least some seconds apart.

    Args:
        tell: called with each line that is passed on.
        every: seconds between two of them, and before the first one.
    """

    def __init__(self, tell: Callable[[str], None], every: float = EVERY) -> None:
        self._tell, self._every = tell, every
        self._told = time.monotonic()

    @property
    def is_due(self) -> bool:
        """Whether a line would be passed on now."""
        return time.monotonic() - self._told >= self._every

    def __call__(self, line: str) -> None:
        """Pass a line on if it is due; it is left out otherwise."""
        if self.is_due:
            self.now(line)

    def now(self, line: str) -> None:
        """Pass a line on, however long ago the last one was."""
        self._tell(line)
        self._told = time.monotonic()


def each_told(
    results: Iterable[Result],
    count: int,
    line: Callable[[int], str],
    tell: Callable[[str], None],
    every: float = EVERY,
) -> Iterator[Result]:
    """Results as they come; lines tell how many there are, but for the last one.

    Args:
        results: that take long to make.
        count: of all.
        line: what is told of so many results.
        tell: called with such a line now and then.
        every: seconds between two lines, and before the first one.
    """
    paced = Paced(tell, every)
    for number, result in enumerate(results, 1):
        if number < count and paced.is_due:
            paced.now(line(number))
        yield result


def duration(seconds: float) -> str:
    """A time in a few characters: 59 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 100 else f"{minutes / 60:.1f} h"
