"""Where Russian roulette pays: time and noise of gradients by the depth at which it begins.

    python benchmarks/rr_depth.py --data DATA [--settings FILE] [--out FILE]

The methods follow paths with `path.rr_depth` = 1, 2, 3, 5, 8, and without roulette. All compute the
gradient of the loss on the same pixels, at the fields of a short fit, again and again with other
random numbers, in turns: this gives both the time of a batch (median, without the optimiser) and
the variance of its gradient (trace of the covariance over all parameters of an unknown). The
efficiency is 1 / (variance x time).
"""

from __future__ import annotations

import argparse
import gc
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import here

import numpy as np
from rich.console import Console
from rich.table import Table

import unbake

unbake.activate()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from unbake.dataset.views import Dataset  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.profiling.bench_step import small_data  # noqa: E402
from unbake.training.fresh_fit import FreshFit, begin_fit  # noqa: E402

#: What efficiencies are relative to: the default.
REFERENCE = unbake.FitConfig().path.rr_depth
NEVER = "never"
#: Calls of a recorded function that trace and compile.
WARM_UP = 3


@dataclass
class Contestant:
    """A method with roulette from some depth on, and what was measured of it."""

    config: unbake.FitConfig
    rr_depth: int | None
    fit: FreshFit
    gradient: Callable[..., dict]
    seconds: list[float] = field(default_factory=list)
    gradients: dict[str, list[np.ndarray]] = field(default_factory=dict)

    @staticmethod
    def of(dataset: Dataset, config: unbake.FitConfig, rr_depth: int | None, phi: dict) -> Any:
        """A contestant at trained fields."""
        depth = config.path.max_depth if rr_depth is None else rr_depth
        fit = begin_fit(dataset, replace(config, path=replace(config.path, rr_depth=depth)))
        for name, value in phi.items():
            fit.state.phi[name] = type(value)(value)
        fit.step.plan(fit.state)
        return Contestant(config, rr_depth, fit, dr.freeze(fit.step.gradients))

    def call(self, seed: int, *, measured: bool) -> None:
        """Compute the gradient of the batch once."""
        step, state = self.fit.step, self.fit.state
        inputs = step.prepare(state, 0, unbake.learning_rates(self.fit.config, 0, 0.0))
        inputs.seed = dr.opaque(mi.UInt32, seed)
        dr.sync_thread()
        start = time.perf_counter()
        gradients = self.gradient(inputs, state)
        dr.sync_thread()
        seconds = time.perf_counter() - start
        if not measured:
            return
        self.seconds.append(seconds)
        parts: dict[str, list[np.ndarray]] = {}
        for name, value in gradients.items():
            parts.setdefault(name.partition(".")[0], []).append(np.array(value, np.float64).ravel())
        for unknown, part in parts.items():
            self.gradients.setdefault(unknown, []).append(np.concatenate(part))

    def row(self) -> dict[str, Any]:
        """Median time, variance of the gradients, and their efficiency, by unknown."""
        seconds = statistics.median(self.seconds)
        variance = {
            unknown: float(np.stack(samples).var(0, ddof=1).sum())
            for unknown, samples in self.gradients.items()
        }
        return {
            "method": self.config.method,
            "rr_depth": self.rr_depth,
            "milliseconds": 1e3 * seconds,
            "variance": variance,
            "efficiency": {unknown: 1 / (v * seconds) for unknown, v in variance.items()},
        }


def squared_means(contestants: Sequence[Contestant]) -> dict[str, float | None]:
    """The squared length of the expected gradient, which all have in common, by unknown.

    None where the samples are too noisy to tell.
    """
    found = {}
    for unknown in contestants[0].gradients:
        means = [np.mean(c.gradients[unknown], 0) for c in contestants]
        variances = [np.var(c.gradients[unknown], 0, ddof=1).sum() for c in contestants]
        # Each mean of n samples exceeds the expectation, in squared length, by variance / n.
        excess = sum(v / len(c.seconds) for v, c in zip(variances, contestants, strict=True))
        square = (np.mean(means, 0) ** 2).sum() - excess / len(contestants) ** 2
        found[unknown] = float(square) if square > 0 else None
    return found


def trained(dataset: Dataset, config: unbake.FitConfig, steps: int) -> dict:
    """The parameters of the unknowns after a short fit."""
    fit = begin_fit(dataset, config)
    for number in range(steps):
        fit.step(fit.state, number, unbake.learning_rates(fit.config, number, number / steps))
    dr.sync_thread()
    return dict(fit.state.phi.items())


def measure(
    dataset: Dataset,
    config: unbake.FitConfig,
    *,
    methods: Sequence[str],
    depths: Sequence[int | None],
    steps: int,
    calls: int,
) -> list[dict[str, Any]]:
    """Rows of all methods and depths; efficiencies also relative to the default depth's.

    Args:
        config: settings; their method and `path.rr_depth` are ignored.
        depths: of the first roulette; None: never.
        steps: length of the short fit, by the first method.
        calls: measured calls of each.
    """
    config = unbake.with_path_depth(config, dataset)
    phi = trained(dataset, replace(config, method=methods[0]), steps)
    rows = []
    for method in methods:
        own = replace(config, method=method)
        contestants = [Contestant.of(dataset, own, depth, phi) for depth in depths]
        for number in range(WARM_UP + calls):
            # Turns begin with another contestant each time.
            shift = number % len(contestants)
            for contestant in contestants[shift:] + contestants[:shift]:
                contestant.call(number, measured=number >= WARM_UP)
        found = [contestant.row() for contestant in contestants]
        base = next((row for row in found if row["rr_depth"] == REFERENCE), found[0])
        squares = squared_means(contestants)
        for row in found:
            row["relative_variance"] = {
                unknown: value / square if (square := squares[unknown]) else None
                for unknown, value in row["variance"].items()
            }
            row["relative_efficiency"] = {
                unknown: value / base["efficiency"][unknown]
                for unknown, value in row["efficiency"].items()
            }
        rows += found
        del contestants
        gc.collect()
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the rows as a table."""
    unknowns = list(rows[0]["variance"])
    table = Table("method", "roulette from", "ms")
    for unknown in unknowns:
        table.add_column(f"{unknown}: variance", justify="right")
        table.add_column("efficiency", justify="right")
    for row in rows:
        cells = []
        for unknown in unknowns:
            noise = row["relative_variance"][unknown]
            cells.append("—" if noise is None else f"{noise:.3g}")
            cells.append(f"{row['relative_efficiency'][unknown]:.2f}")
        depth = NEVER if row["rr_depth"] is None else str(row["rr_depth"])
        table.add_row(row["method"], depth, f"{row['milliseconds']:.1f}", *cells)
    Console(highlight=False).print(table)


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="data set (default: a small one of the demo)")
    parser.add_argument("--settings", type=Path, help="TOML file (default: the preset cpu)")
    parser.add_argument("--methods", nargs="+", default=["prb", "ad-pt"])
    parser.add_argument("--depths", nargs="+", default=["1", "2", "3", "5", "8", NEVER])
    parser.add_argument("--steps", type=int, default=150, help="length of the short fit")
    parser.add_argument("--calls", type=int, default=24, help="gradients of each, 2 or more")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    args = parser.parse_args()
    config = unbake.read_toml(args.settings) if args.settings else unbake.preset("cpu")
    depths = [None if depth == NEVER else int(depth) for depth in args.depths]
    # Dr.Jit 1.5 aborts the process if objects of an earlier fit are freed during a recording.
    gc.disable()
    with small_data(args.data, "demo") as folder:
        dataset = Dataset.load(folder)
        rows = measure(
            dataset,
            config,
            methods=args.methods,
            depths=depths,
            steps=args.steps,
            calls=args.calls,
        )
        path_depth = unbake.with_path_depth(config, dataset).path.max_depth
    show(rows)
    if args.out is not None:
        result = {
            "machine": machine(),
            "data": dataset.folder.name,
            "path_depth": path_depth,
            "pixels": config.pixels,
            "spp": config.spp,
            "steps": args.steps,
            "calls": args.calls,
            "rows": rows,
        }
        write_json(args.out, result)


if __name__ == "__main__":
    main()
