"""Work on photographs: several at once, and told of where it takes long."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

from ..dataset.decoding import decoded_at_once
from ..progress import each_told
from ..threads import in_order
from .source import Shot

Result = TypeVar("Result")

#: Seconds between two lines.
EVERY = 30.0


def each_photograph(
    work: Callable[..., Result],
    arguments: Iterable[tuple[Any, ...]],
    shots: Sequence[Shot],
    what: str,
    tell: Callable[[str], None],
) -> Iterator[Result]:
    """Results of a function for each photograph, in their order.

    Args:
        work: must not use Dr.Jit.
        arguments: of each call; they are made in this thread, as they are needed.
        shots: the photographs.
        what: was done with them, such as `read`.
        tell: called every half minute.

    Raises:
        Exception: what a call raises, in its turn.
    """
    largest = max((shot.lens.width * shot.lens.height for shot in shots), default=1)
    coded = all(shot.coded for shot in shots)
    at_once = decoded_at_once(len(shots), largest, coded=coded)

    def line(number: int) -> str:
        return f"{what} {number} of {len(shots)} photographs"

    yield from each_told(in_order(work, arguments, at_once), len(shots), line, tell, EVERY)
