"""Phases of a training step: which kernels belong to which."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from ..dataset.pixels import PixelBatch
from ..fields.guide import LightGuide
from ..training import batch_loss
from ..transport import operator, path_sample, samplers, wavefront

#: Kernels outside of the calls below belong to this phase.
OPTIMISER = "optimiser"
#: Functions that a step calls, and their phase. Kernels of a nested call belong to its own phase.
_CALLS = (
    (PixelBatch, "batch", "batch"),
    (path_sample, "find_vertex", "ray tracing"),
    (operator, "find_vertex", "ray tracing"),
    (path_sample, "attach_material", "material nets"),
    (path_sample, "attach_albedo", "material nets"),
    (path_sample, "bounce", "BSDFs and lights"),
    (wavefront, "find_vertex", "ray tracing"),
    (wavefront, "attach_material", "material nets"),
    (wavefront, "bounce", "BSDFs and lights"),
    (path_sample, "reflected_radiance", "radiance net"),
    (samplers, "path_light", "paths"),
    (samplers, "path_radiance", "paths"),
    (samplers, "objective", "losses"),
    (batch_loss, "regularization_terms", "regularizers"),
    (LightGuide, "prepare", "BSDFs and lights"),
    (LightGuide, "loss", "losses"),
    (dr, "backward", "gradients"),
)


@contextmanager
def kernel_history() -> Iterator[list[dict]]:
    """Yield a list; at the end it has the kernels that were launched meanwhile."""
    kernels: list[dict] = []
    dr.sync_thread()
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        yield kernels
        dr.sync_thread()
        kernels.extend(dr.kernel_history())
    dr.kernel_history_clear()


def milliseconds(kernels: Iterable[dict]) -> float:
    """Execution time of kernels."""
    return sum(k["execution_time"] for k in kernels)


class Phases:
    """Kernels of training steps by phase.

    Everything that a phase returns is evaluated before the next one begins. This splits kernels
    that belong to several phases, so that the phases together take longer than the step.
    """

    def __init__(self) -> None:
        self.kernels: dict[str, list[dict]] = {}
        self._stack = [OPTIMISER]

    @contextmanager
    def recorded(self) -> Iterator[None]:
        """Record the steps that run meanwhile. They must not be frozen."""
        calls = (*_CALLS, (mi.ad.Adam, "step", OPTIMISER))
        before = [getattr(owner, name) for owner, name, _ in calls]
        for (owner, name, phase), function in zip(calls, before, strict=True):
            setattr(owner, name, self._recorded_call(function, phase))
        dr.kernel_history_clear()
        try:
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                yield
                self._collect()
        finally:
            for (owner, name, _), function in zip(calls, before, strict=True):
                setattr(owner, name, function)

    def _recorded_call(self, function: Callable, phase: str) -> Callable:
        @functools.wraps(function)
        def call(*args, **kwargs):
            self._collect()
            self._stack.append(phase)
            try:
                result = function(*args, **kwargs)
                dr.eval(result)
                self._collect()
            finally:
                self._stack.pop()
            return result

        return call

    def _collect(self) -> None:
        """Add the kernels since the last call to the current phase."""
        dr.sync_thread()
        self.kernels.setdefault(self._stack[-1], []).extend(dr.kernel_history())
        dr.kernel_history_clear()
