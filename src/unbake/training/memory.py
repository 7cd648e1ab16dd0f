"""Memory that a step takes."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
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
#: The remedy where paths do not fit the memory.
SMALLER = "Lower --batch or --spp or path.max_depth, or use --method prb"


def lacks_memory(error: BaseException | None) -> bool:
    """Whether an error comes from Dr.Jit running out of memory, also while it records."""
    while error is not None and "out of memory" not in str(error):
        error = error.__cause__ or error.__context__
    return error is not None


def forecast_bytes(probe: Callable[[int], None], pixels: int, spp: int) -> float | None:
    """Memory that a batch will take, from two smaller ones; None where it cannot be measured.

    Args:
        probe: computes a batch of this number of pixels, and drops the results.
        pixels: of the batch.
        spp: samples a pixel.
    """
    few = max(1, min(pixels // 4, _PROBED_PATHS // spp))
    probe(few)  # compiles, which takes memory as well
    fewer, more = (peak_bytes(lambda n=n: probe(n)) for n in (few, 2 * few))
    if fewer is None or more is None:
        return None
    return more + max(0, more - fewer) * (pixels / few - 2)
