"""The step time of several methods, side by side in one run."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
from rich.console import Console
from rich.table import Table

from ..config import FitConfig
from ..data.jsonfile import write_json
from ..data.views import Dataset
from ..fit.rates import learning_rates
from .bench import begin, machine
from .contender import Contender
from .evaluate import description

#: Steps of a method before anything is measured.
WARM_UP = 6
#: A machine that gets slower meets all methods, not the last ones alone.
TURNS = 2


def bench_methods(
    data: Path,
    contenders: Sequence[Contender],
    shared: FitConfig,
    steps: int,
    out: Path | None,
    console: Console,
) -> dict:
    """Measure steps of several methods, in two turns, so that all meet the same machine.

    Args:
        data: a data set's folder.
        contenders: what to measure; times are compared with the first one's.
        shared: settings of all.
        steps: steps of each, to take the median of.
        out: JSON file to write.

    Returns:
        All that is printed.

    Paper: Sec. 6.2, Fig. 3.
    """
    dataset = Dataset.load(data)
    configs = [contender.settings(shared) for contender in contenders]
    seconds: list[list[float]] = [[] for _ in configs]
    for turn in range(TURNS):
        for contender, config, times in zip(contenders, configs, seconds, strict=True):
            times += _timed(dataset, config, -(-steps // TURNS))
            told = 1e3 * statistics.median(times)
            console.print(f"turn {turn + 1}, {contender.name}: {told:.1f} ms", highlight=False)
    medians = [statistics.median(times) for times in seconds]
    rows = [
        {
            **description(config),
            "pixels": config.pixels,
            "spp": config.spp,
            "milliseconds_per_step": 1e3 * median,
            "samples_per_second": config.samples_per_step / median,
            "times_the_first": median / medians[0],
        }
        for config, median in zip(configs, medians, strict=True)
    ]
    result = {"machine": machine(), "steps": steps, "data": dataset.folder.name, "rows": rows}
    table = Table("method", "materials", "radiance", "estimator")
    for title in ("ms a step", "k samples/s", "times the first"):
        table.add_column(title, justify="right")
    for row in rows:
        table.add_row(
            row["method"],
            row["representation"] or "known",
            row["radiance"] or "none",
            row["estimator"],
            f"{row['milliseconds_per_step']:.1f}",
            f"{row['samples_per_second'] / 1e3:.0f}",
            f"{row['times_the_first']:.2f}",
        )
    console.print(table)
    if out is not None:
        write_json(out, result)
    return result


def _timed(dataset: Dataset, config: FitConfig, steps: int) -> list[float]:
    """Seconds of steps after warm-up, of a fit that is then forgotten."""
    fit, times = begin(dataset, config), []
    for i in range(WARM_UP + steps):
        start = time.perf_counter()
        fit.step(fit.state, i, learning_rates(config, i, 0.0))
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return times[WARM_UP:]
