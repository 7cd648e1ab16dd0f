"""Which part of a training step its time goes to."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from ..dataset.pixels import PixelBatch
from ..transport import operator, path_sample, samplers

#: What is done outside of all calls below counts as this.
OPTIMISER = "optimiser"
#: What a step calls, and the part that the work of it belongs to. What is called inside of another
#: one counts for itself alone.
_CALLS = (
    (PixelBatch, "batch", "batch"),
    (path_sample, "find_vertex", "ray tracing"),
    (operator, "find_vertex", "ray tracing"),
    (path_sample, "attach_material", "material nets"),
    (path_sample, "attach_albedo", "material nets"),
    (path_sample, "bounce", "BSDFs and lights"),
    (path_sample, "reflected_radiance", "radiance net"),
    (samplers, "path_radiance", "paths"),
    (samplers, "objective", "losses"),
    (dr, "backward", "gradients"),
)


@contextmanager
def kernel_history() -> Iterator[list[dict]]:
    """A list that is filled at the end with the kernels launched meanwhile."""
    kernels: list[dict] = []
    dr.sync_thread()
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        yield kernels
        dr.sync_thread()
        kernels.extend(dr.kernel_history())
    dr.kernel_history_clear()


def milliseconds(kernels: Iterable[dict]) -> float:
    """Time in kernels."""
    return sum(k["execution_time"] for k in kernels)


class Phases:
    """Kernels of a step by the part that they belong to.

    Everything that a part returns is computed before the next one begins. So kernels of several
    parts, which a step would run as one, are taken apart, and all take a little longer.
    """

    def __init__(self) -> None:
        self.kernels: dict[str, list[dict]] = {}
        self._stack = [OPTIMISER]

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Record the steps taken meanwhile; they must not be frozen."""
        calls = (*_CALLS, (mi.ad.Adam, "step", OPTIMISER))
        before = [getattr(owner, name) for owner, name, _ in calls]
        for (owner, name, part), function in zip(calls, before, strict=True):
            setattr(owner, name, self._told(function, part))
        dr.kernel_history_clear()
        try:
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                yield
                self._collect()
        finally:
            for (owner, name, _), function in zip(calls, before, strict=True):
                setattr(owner, name, function)

    def _told(self, function: Callable, part: str) -> Callable:
        @functools.wraps(function)
        def told(*args, **kwargs):
            self._collect()
            self._stack.append(part)
            try:
                result = function(*args, **kwargs)
                dr.eval(result)
                self._collect()
            finally:
                self._stack.pop()
            return result

        return told

    def _collect(self) -> None:
        """Give the kernels since the last call to the part that is at work."""
        dr.sync_thread()
        self.kernels.setdefault(self._stack[-1], []).extend(dr.kernel_history())
        dr.kernel_history_clear()
