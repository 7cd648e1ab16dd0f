"""Which part of a training step its time goes to."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from ..data.batches import Drawn
from ..fit import step as steps
from ..transport import image, operator

RAYS, MATERIALS, BSDFS = "ray tracing", "material nets", "BSDFs and lights"
RADIANCE, GRADIENTS, OPTIMISER = "radiance net", "gradients", "optimiser"
BATCH, LOSSES = "batch", "losses"

#: What a step calls, and the part that the work of it belongs to. What is called inside of another
#: one counts for itself alone.
_CALLS = (
    (Drawn, "batch", BATCH),
    (image, "find_vertex", RAYS),
    (operator, "find_vertex", RAYS),
    (image, "attach_material", MATERIALS),
    (image, "attach_albedo", MATERIALS),
    (image, "bounce", BSDFS),
    (image, "reflected_radiance", RADIANCE),
    (steps, "path_radiance", "paths"),
    (steps, "objective", LOSSES),
    (dr, "backward", GRADIENTS),
)


class Parts:
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
