"""Step times of several methods, measured in turn."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
from rich.console import Console

from ..config import FitConfig
from ..dataset.views import Dataset
from ..errors import UserError
from ..evaluation.evaluate import description
from ..io import write_json
from ..machine import machine
from ..training.defaults import with_defaults
from ..training.fresh_fit import begin_fit
from ..training.schedule import learning_rates
from ..version import VERSION
from .method_variant import MethodVariant
from .tables import print_step_times

#: Steps of a method before the measurement.
WARM_UP = 6
#: How often each method is measured: a machine whose speed changes then affects all of them.
TURNS = 4


def bench_methods(
    data: Path,
    variants: Sequence[MethodVariant],
    shared: FitConfig,
    steps: int,
    out: Path | None,
    console: Console,
    *,
    clip_negative: bool = False,
    allow_outside: bool = False,
) -> dict:
    """Measure the step times of several methods, in turns.

    Args:
        data: folder of the data set.
        variants: the methods. Times are relative to the first one.
        shared: settings of all methods.
        steps: number of measured steps of each method.
        out: JSON file to write.
        console: shows progress and a table.
        clip_negative: set negative pixels to zero.
        allow_outside: read files of the data set and its scene that lie outside of its folder.

    Returns:
        The content of the file. The row of a method that failed has its `error` instead of times.

    Raises:
        UserError: the data set cannot be used, or every method failed.

    Paper: Sec. 6.2, Fig. 3.
    """
    dataset = Dataset.load(data, allow_outside=allow_outside)
    configs = [with_defaults(variant.settings(shared), dataset) for variant in variants]
    seconds: list[list[float]] = [[] for _ in configs]
    errors: dict[int, UserError] = {}
    for turn in range(TURNS):
        for i, (variant, config) in enumerate(zip(variants, configs, strict=True)):
            if i in errors:
                continue
            try:
                timed = _timed(dataset, config, -(-steps // TURNS), clip_negative)
                seconds[i] += timed
                text = f"{1e3 * statistics.median(seconds[i]):.1f} ms"
            except UserError as error:
                errors[i], text = error, f"error: {error}"
            line = f"turn {turn + 1}, {variant.name}: {text}"
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    if len(errors) == len(configs):
        raise errors[0]
    rows = []
    for i, (config, times) in enumerate(zip(configs, seconds, strict=True)):
        row: dict = {**description(config), "pixels": config.pixels, "spp": config.spp}
        if i in errors:
            rows.append(row | {"error": str(errors[i])})
            continue
        median = statistics.median(times)
        row["milliseconds_per_step"] = 1e3 * median
        row["samples_per_second"] = config.samples_per_step / median
        row["times_the_first"] = None if 0 in errors else median / statistics.median(seconds[0])
        rows.append(row)
    result = {"unbake": VERSION, "machine": machine(), "steps": steps}
    result |= {"data": dataset.folder.name, "rows": rows}
    print_step_times(rows, console)
    if out is not None:
        write_json(out, result)
    return result


def _timed(dataset: Dataset, config: FitConfig, steps: int, clip_negative: bool) -> list[float]:
    """Seconds of each step of a new fit, after warm-up."""
    fit, times = begin_fit(dataset, config, clip_negative=clip_negative), []
    for i in range(WARM_UP + steps):
        start = time.perf_counter()
        fit.step(fit.state, i, learning_rates(config, i, 0.0))
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return times[WARM_UP:]
