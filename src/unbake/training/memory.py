"""Memory that a step takes."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import psutil

from ..backend import CUDA_VARIANT

_PROCESS = Path("/proc/self")


def peak_bytes(work: Callable[[], None]) -> int | None:
    """How far memory rises at most while `work` runs; None where it cannot be measured.

    On a CPU this is resident memory (Linux only), on a GPU what Dr.Jit has allocated there.
    """
    dr.sync_thread()
    dr.flush_malloc_cache()
    if mi.variant() == CUDA_VARIANT:
        return _peak_on_device(work)
    try:
        # Freed memory goes back to the system, else `work` would reuse it unmeasured.
        ctypes.CDLL(None).malloc_trim(0)
        # psutil 7 can neither reset nor read the peak of a process. Writing 5 resets it.
        (_PROCESS / "clear_refs").write_text("5")
        before = _peak_resident()
        work()
        dr.sync_thread()
        return max(0, _peak_resident() - before)
    except (OSError, AttributeError, ValueError, StopIteration):
        return None


def _peak_on_device(work: Callable[[], None]) -> int:
    dr.detail.malloc_clear_statistics()
    before = dr.detail.malloc_watermark(dr.JitBackend.CUDA)
    work()
    dr.sync_thread()
    return max(0, dr.detail.malloc_watermark(dr.JitBackend.CUDA) - before)


def memory_mb() -> float:
    """Resident memory of this process now, in MB."""
    return psutil.Process().memory_info().rss / 1e6


def _peak_resident() -> int:
    lines = (_PROCESS / "status").read_text().splitlines()
    return 1024 * int(next(x for x in lines if x.startswith("VmHWM:")).split()[1])


#: Paths of the smaller of the two batches that a forecast measures.
_PROBED_PATHS = 4096
#: More than a camera sample takes in a step, with any field in any method that does not keep paths:
#: batches that fit the memory at that rate need no forecast.
MOST_BYTES_A_SAMPLE = 1 << 16


@dataclass(frozen=True)
class Forecast:
    """Memory that batches will take: a line through two that were measured."""

    fixed: float
    a_pixel: float

    def bytes(self, pixels: int) -> float:
        """Memory of a batch."""
        return self.fixed + self.a_pixel * pixels

    def pixels(self, free: float) -> int:
        """The largest batch that takes no more; 1 if none does."""
        return max(1, math.floor((free - self.fixed) / max(self.a_pixel, 1e-9)))


def forecast(probe: Callable[[int], None], pixels: int, spp: int) -> Forecast | None:
    """Memory of batches, from two smaller ones; None where it cannot be measured.

    Args:
        probe: computes a batch of this number of pixels, and drops the results.
        pixels: of the batch that is wanted.
        spp: samples a pixel.
    """
    few = max(1, min(pixels // 4, _PROBED_PATHS // spp))
    probe(few)  # compiles, which takes memory as well
    fewer, more = (peak_bytes(lambda n=n: probe(n)) for n in (few, 2 * few))
    if fewer is None or more is None:
        return None
    a_pixel = max(0, more - fewer) / few
    return Forecast(more - 2 * few * a_pixel, a_pixel)
