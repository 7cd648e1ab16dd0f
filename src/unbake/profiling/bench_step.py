"""Time, memory and phases of a training step."""

from __future__ import annotations

import resource
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import drjit as dr
from rich.console import Console
from rich.table import Table

from ..acquisition.capture import capture
from ..acquisition.settings import CaptureSettings
from ..config import FitConfig
from ..dataset.pixels import PixelSource
from ..dataset.views import Dataset
from ..io import write_json
from ..machine import machine, today
from ..signals import cleaned_up
from ..training.fresh_fit import begin_fit
from ..training.memory import memory_mb
from ..training.schedule import learning_rates
from ..training.state import State
from ..training.step import TrainingStep
from ..version import VERSION
from .phases import Phases, kernel_history, milliseconds
from .roofline import roofline

#: Steps before the measurement.
WARM_UP = 20
#: Steps that are split into phases; the median counts.
SPLIT = 7


@contextmanager
def small_data(data: Path | None, scene: str, *, allow_outside: bool = False) -> Iterator[Path]:
    """The folder of a data set, or of a temporary one that is rendered here.

    Args:
        data: folder of a data set; None renders a scene.
        scene: a built-in scene's name, or a Mitsuba XML file.
        allow_outside: read files that the scene names outside of its folder.
    """
    if data is not None:
        yield data
        return
    folder = tempfile.mkdtemp()
    with cleaned_up(lambda: shutil.rmtree(folder, ignore_errors=True)):
        small = CaptureSettings(views=4, held_out=0, resolution=64, spp=8)
        made = Path(folder) / Path(scene).stem
        capture(scene, made, small, allow_outside=allow_outside, tell=lambda line: None)
        yield made


def bench_step(
    data: Path,
    config: FitConfig,
    steps: int,
    out: Path | None,
    console: Console,
    *,
    clip_negative: bool = False,
    allow_outside: bool = False,
) -> dict:
    """Measure the training step of a method on a data set, and its phases.

    Times are medians after warm-up. A camera sample is one path from the camera with its RHS and
    all gradients; of an estimator with two passes, those of both count. Samples that train L_θ also
    have an LHS and residuals.

    Args:
        data: folder of the data set.
        config: settings of the step.
        steps: number of measured steps.
        out: JSON file to write.
        console: shows the results.
        clip_negative: set negative pixels to zero.
        allow_outside: read files of the data set and its scene that lie outside of its folder.

    Returns:
        The content of the file.
    """
    dataset = Dataset.load(data, allow_outside=allow_outside)
    fit = begin_fit(dataset, config, clip_negative=clip_negative)
    config = fit.config
    result = {"unbake": VERSION, "made": today(), "machine": machine(), "data": dataset.folder.name}
    result |= {"method": config.method, "settings": _settings(config)}
    result |= _replayed(fit.step, fit.state, config, steps)
    result["phases"] = _phases(fit.step, fit.state)
    result["memory_mb"] = _memory(fit.pixels, fit.state)
    result["roofline"] = roofline(fit.problem, fit.pixels, fit.state, config)
    _print(result, console)
    if out is not None:
        write_json(out, result)
    return result


def _replayed(step: TrainingStep, state: State, config: FitConfig, steps: int) -> dict:
    """The step of a fit: wall time, time in kernels and time in Python."""
    rates = learning_rates(config, config.warm_up or 0, 0.0)
    for i in range(WARM_UP):
        step(state, i, rates)
    dr.sync_thread()
    wall, python = [], []
    for i in range(WARM_UP, WARM_UP + steps):
        start = time.perf_counter()
        step(state, i, rates)
        dr.sync_thread()
        wall.append(time.perf_counter() - start)
    for i in range(steps):
        start = time.perf_counter()
        step.prepare(state, i, rates)
        python.append(time.perf_counter() - start)
        dr.sync_thread()
    in_kernels, last = [], []
    for i in range(WARM_UP + steps, WARM_UP + steps + SPLIT):
        with kernel_history() as kernels:
            step(state, i, rates)
        in_kernels.append(milliseconds(kernels))
        last = kernels
    seconds = statistics.median(wall)
    return {
        "milliseconds_per_step": 1e3 * seconds,
        "milliseconds_in_python": 1e3 * statistics.median(python),
        "milliseconds_in_kernels": statistics.median(in_kernels),
        "samples_per_second": config.samples_per_step / seconds,
        "launches": len(last),
        "compiled": sum(k["cache_hit"] is False for k in last if "cache_hit" in k),
        "recordings": step.recordings(),
    }


def _phases(step: TrainingStep, state: State) -> dict:
    """Milliseconds and launches of each phase of a step: medians over steps traced anew."""
    recorded = []
    for i in range(SPLIT + 1):
        phases = Phases()
        with phases.recorded():
            step.unfrozen(state, i)
        recorded.append(phases.kernels)
    return {
        name: {
            "milliseconds": statistics.median(milliseconds(one[name]) for one in recorded[1:]),
            "launches": len(kernels),
            "products": milliseconds(k for k in kernels if "Gemm" in str(k["type"])),
        }
        for name, kernels in recorded[-1].items()
        if kernels
    }


def _memory(pixels: PixelSource, state: State) -> dict:
    """Megabytes of this process, and of its large arrays by owner."""
    owned = {
        name: 3 * 4 * sum(dr.width(a) for a in adam.values()) for name, adam in state.optimizers()
    }
    owned["photographs"] = pixels.photographs.bytes
    # psutil 7 has no peak of a process.
    unit = 1 if sys.platform == "darwin" else 1024
    now = memory_mb()
    peak = max(now, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6)
    return {"now": now, "peak": peak} | {name: size / 1e6 for name, size in owned.items()}


def _settings(config: FitConfig) -> dict:
    return {
        "preset": config.preset,
        "pixels": config.pixels,
        "spp": config.spp,
        "radiance_spp": config.radiance_samples,
        "radiance": asdict(config.radiance_settings),
        "representation": config.representation,
        "materials": {name: asdict(field) for name, field in config.material_settings.items()},
    }


def _sizes(field: dict) -> str:
    """The sizes of a field, without its learning rate and the details of its hash grid."""
    sizes = {k: v for k, v in field.items() if k != "learning_rate" and not isinstance(v, dict)}
    return " ".join(f"{key} {value}" for key, value in sizes.items())


def _print(result: dict, console: Console) -> None:
    s, wall = result["settings"], result["milliseconds_per_step"]
    console.print(
        f"{result['method']}, {s['pixels']} pixels x {s['spp']} samples; radiance "
        f"{_sizes(s['radiance'])} of {s['radiance_spp']} samples; "
        + "; ".join(f"{name} {_sizes(field)}" for name, field in s["materials"].items())
    )
    console.print(
        f"{wall:.1f} ms a step, [bold]{result['samples_per_second'] / 1e3:.0f} k samples/s[/]; "
        f"{result['milliseconds_in_kernels']:.1f} ms of it in {result['launches']} kernels, "
        f"{result['compiled']} compiled, {result['milliseconds_in_python']:.1f} ms in Python "
        f"({result['milliseconds_in_python'] / wall:.0%}); traced {result['recordings']} times"
    )
    table = Table("phase", "launches", "ms", "of it products", "share")
    total = sum(row["milliseconds"] for row in result["phases"].values())
    for name, row in sorted(result["phases"].items(), key=lambda item: -item[1]["milliseconds"]):
        ms = row["milliseconds"]
        cells = f"{ms:.2f}", f"{row['products']:.2f}", f"{ms / total:.0%}"
        table.add_row(name, str(row["launches"]), *cells)
    console.print(table)
    memory = result["memory_mb"]
    console.print("memory, MB: " + ", ".join(f"{name} {mb:.0f}" for name, mb in memory.items()))
    least = result["roofline"]
    if least is not None:
        ms = least["milliseconds"]
        console.print(
            f"roofline {ms['all']:.1f} ms (rays {ms['rays']:.1f}, products "
            f"{ms['multiply_adds']:.1f}, bytes {ms['bytes']:.1f}); the step takes "
            f"{wall / ms['all']:.1f} times as long"
        )
