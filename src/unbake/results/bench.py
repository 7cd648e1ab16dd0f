"""Where the time of a training step goes."""

from __future__ import annotations

import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import mitsuba as mi
from rich.console import Console
from rich.table import Table

from ..config import FitConfig
from ..data.capture import CaptureSettings, capture
from ..data.views import Dataset
from ..fit.monitor import memory_mb
from ..fit.problem import make_problem, training_pixels
from ..fit.rates import learning_rates
from ..fit.step import State, TrainingStep, initial_state

#: Steps before anything is measured.
WARM_UP = 20


@contextmanager
def small_data(data: Path | None) -> Iterator[Path]:
    """A data set's folder: the one given, or a small capture of the demo scene, for a while."""
    if data is not None:
        yield data
        return
    with tempfile.TemporaryDirectory() as folder:
        small = CaptureSettings(views=4, held_out=0, resolution=64, spp=8)
        capture("demo", Path(folder) / "demo", small, tell=lambda line: None)
        yield Path(folder) / "demo"


def bench_step(
    data: Path, config: FitConfig, steps: int, out: Path | None, console: Console
) -> dict:
    """Measure the training step on a data set.

    Times are medians after warm-up. A camera sample is one path from the camera with its RHS, its
    LHS, both residuals and all gradients.

    Args:
        data: a data set's folder.
        config: settings of the step.
        steps: to take the median of.
        out: JSON file to write.

    Returns:
        All that is printed.
    """
    dataset = Dataset.load(data)
    pixels, mean = training_pixels(dataset, clip_negative=False)
    problem = make_problem(dataset.scene, dataset.background, config, mean)
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)

    result = {"machine": machine(), "method": config.method, "settings": _settings(config)}
    result |= _replayed(step, state, config, steps)
    _print(result, console)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(result, indent=1) + "\n")
    return result


def _replayed(step: TrainingStep, state: State, config: FitConfig, steps: int) -> dict:
    """The frozen step: wall time, time inside kernels by kind, and the Python side."""
    rates = learning_rates(config, config.warm_up, 0.0)
    for i in range(WARM_UP):
        step(state, i, rates)
    dr.sync_thread()
    wall, python = [], []
    for i in range(WARM_UP, WARM_UP + steps):
        start = time.perf_counter()
        step(state, i, rates)
        python.append(time.perf_counter() - start)
        dr.sync_thread()
        wall.append(time.perf_counter() - start)
    with _kernel_history() as kernels:
        step(state, WARM_UP + steps, rates)
    kinds: dict[str, list[float]] = {}
    for kernel in kernels:
        kinds.setdefault(_kind(kernel), []).append(kernel["execution_time"])
    seconds = statistics.median(wall)
    return {
        "milliseconds_per_step": 1e3 * seconds,
        "milliseconds_until_call_returns": 1e3 * statistics.median(python),
        "samples_per_second": config.samples_per_step / seconds,
        "launches": len(kernels),
        "compiled": sum(k["cache_hit"] is False for k in kernels if "cache_hit" in k),
        "recordings": step.recordings(),
        "memory_mb": memory_mb(),
        "kernels": {
            kind: {"launches": len(times), "milliseconds": sum(times)}
            for kind, times in sorted(kinds.items(), key=lambda item: -sum(item[1]))
        },
    }


def _kind(kernel: dict) -> str:
    """What a kernel is for, as far as its launch tells."""
    kind = str(kernel["type"]).split(".")[-1]
    if kind != "JIT":
        return {
            "BatchedGemm": "matrix products of the networks",
            "BlockReduce": "sums",
            "Memset": "clearing memory",
            "Aggregate": "call tables",
        }.get(kind, kind)
    if kernel.get("uses_optix"):
        return "ray tracing"
    return "traced code, " + _size_class(kernel.get("operation_count", 0))


def _size_class(operations: int) -> str:
    if operations >= 3000:
        return "long (BSDFs, rays, emitters and their gradients)"
    if operations >= 400:
        return "middle (hash grids, rays)"
    return "short (layers, losses, Adam)"


@contextmanager
def _kernel_history() -> Iterator[list]:
    kernels: list = []
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        yield kernels
        dr.sync_thread()
        kernels.extend(dr.kernel_history())


def _settings(config: FitConfig) -> dict:
    return {
        "preset": config.preset,
        "pixels": config.pixels,
        "spp": config.spp,
        "radiance": f"{config.radiance.width} x {config.radiance.hidden}",
        "albedo": f"{config.albedo.width} x {config.albedo.hidden}",
        "roughness": f"{config.roughness.width} x {config.roughness.hidden}",
    }


def machine() -> dict:
    """What numbers were measured on: processor, variant, versions."""
    model = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(x.split(":", 1)[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "variant": mi.variant(),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
    }


def _print(result: dict, console: Console) -> None:
    s = result["settings"]
    console.print(
        f"{result['method']}, {s['pixels']} pixels x {s['spp']} samples, radiance net "
        f"{s['radiance']}, albedo net {s['albedo']}, roughness net {s['roughness']}"
    )
    console.print(
        f"{result['milliseconds_per_step']:.1f} ms a step, "
        f"[bold]{result['samples_per_second'] / 1e3:.0f} k samples/s[/]; the call returns after "
        f"{result['milliseconds_until_call_returns']:.1f} ms"
    )
    console.print(
        f"{result['launches']} launches, {result['compiled']} kernels compiled, step traced "
        f"{result['recordings']} times, {result['memory_mb']:.0f} MB"
    )
    table = Table("where the time goes", "launches", "ms")
    for kind, row in result["kernels"].items():
        table.add_row(kind, str(row["launches"]), f"{row['milliseconds']:.2f}")
    console.print(table)
