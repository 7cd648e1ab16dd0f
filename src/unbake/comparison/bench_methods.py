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
from ..dataset.views import Dataset
from ..errors import UserError
from ..evaluation.evaluate import description
from ..io import write_json
from ..machine import machine
from ..training.fresh_fit import begin_fit
from ..training.schedule import learning_rates
from .method_variant import MethodVariant

#: Steps of a method before anything is measured.
WARM_UP = 6
#: A machine that gets slower meets all methods, not the last ones alone.
TURNS = 2


def bench_methods(
    data: Path,
    variants: Sequence[MethodVariant],
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
        All that is printed. The row of a method that failed has its `error` instead of times.

    Raises:
        UserError: the data set cannot be used, or every method failed.

    Paper: Sec. 6.2, Fig. 3.
    """
    dataset = Dataset.load(data)
    configs = [variant.settings(shared) for variant in variants]
    seconds: list[list[float]] = [[] for _ in configs]
    errors: dict[int, UserError] = {}
    for turn in range(TURNS):
        for i, (variant, config) in enumerate(zip(variants, configs, strict=True)):
            if i in errors:
                continue
            try:
                seconds[i] += _timed(dataset, config, -(-steps // TURNS))
                told = f"{1e3 * statistics.median(seconds[i]):.1f} ms"
            except UserError as error:
                errors[i], told = error, f"error: {error}"
            line = f"turn {turn + 1}, {variant.name}: {told}"
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
    result = {"machine": machine(), "steps": steps, "data": dataset.folder.name, "rows": rows}
    table = Table("method", "materials", "radiance", "estimator")
    for title in ("ms a step", "k samples/s", "times the first"):
        table.add_column(title, justify="right")
    for row in rows:
        known = (row["method"], row["representation"] or "known", row["radiance"] or "none")
        if "error" in row:
            table.add_row(*known, row["estimator"], "failed")
            continue
        ratio = row["times_the_first"]
        table.add_row(
            *known,
            row["estimator"],
            f"{row['milliseconds_per_step']:.1f}",
            f"{row['samples_per_second'] / 1e3:.0f}",
            "—" if ratio is None else f"{ratio:.2f}",
        )
    console.print(table)
    if out is not None:
        write_json(out, result)
    return result


def _timed(dataset: Dataset, config: FitConfig, steps: int) -> list[float]:
    """Seconds of steps after warm-up, of a fit that is then forgotten."""
    fit, times = begin_fit(dataset, config), []
    for i in range(WARM_UP + steps):
        start = time.perf_counter()
        fit.step(fit.state, i, learning_rates(config, i, 0.0))
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return times[WARM_UP:]
