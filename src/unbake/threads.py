"""Work that libraries do in native code, in several threads of this process."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Any, TypeVar

Result = TypeVar("Result")


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_order(
    work: Callable[..., Result], arguments: Iterable[tuple[Any, ...]], at_once: int
) -> Iterator[Result]:
    """Results of a function for each of some arguments, in their order.

    Args:
        work: must not use Dr.Jit, which is not to be called from several threads.
        arguments: of each call; they are taken by the caller's thread, as late as possible.
        at_once: calls that run at the same time, at most. No more results wait to be taken, either.

    Raises:
        Exception: what a call raises, in its turn; calls that have not begun are left out.
    """
    if at_once == 1:
        yield from (work(*each) for each in arguments)
        return
    pool, waiting = ThreadPoolExecutor(at_once), iter(arguments)
    try:
        running = [pool.submit(work, *each) for each in islice(waiting, at_once)]
        while running:
            result = running.pop(0).result()
            running += [pool.submit(work, *each) for each in islice(waiting, 1)]
            yield result
    finally:
        pool.shutdown(cancel_futures=True)
