"""AD path tracing with Russian roulette beside all bounces in all lanes: time, memory, variance.

    python benchmarks/roulette.py --data DATA [--depth 15] [--albedo 0.5] [--out FILE.json]

Both are measured in turns within one process, with the same settings. What counts is variance of
the gradient times time: with half of it, a fit is as far in half of the time. The variance is that
of the albedo's gradient, summed over its parameters, at the albedo given; grids make it quick to
settle.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from dataclasses import dataclass, field
from pathlib import Path

import here

import numpy as np

import unbake

unbake.activate()

import drjit as dr  # noqa: E402

from unbake.config import FitConfig, PathConfig, update  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.fresh_fit import FreshFit, begin_fit  # noqa: E402
from unbake.training.memory import peak_bytes  # noqa: E402
from unbake.transport.methods import BOUNCES, PHOTOMETRIC  # noqa: E402

UNROLLED = unbake.Method(
    "ad-pt-unrolled",
    "path tracing, differentiated with all bounces of all lanes in memory",
    {PHOTOMETRIC: unbake.Attached(scene=True)},
    sampler=BOUNCES,
    follows_paths=True,
)
#: Steps before the measurement.
WARM_UP = 5


@dataclass
class Contestant:
    """A fit, and what was measured of it."""

    fit: FreshFit
    config: FitConfig
    seconds: list[float] = field(default_factory=list)
    memory: int | None = None
    sums: list[np.ndarray] = field(default_factory=list)  # of gradients, and of their squares
    count: int = 0

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of nothing: the fields stay."""
        return dict.fromkeys(self.config.quantities, 0.0)

    def step(self, number: int) -> None:
        """Take a step that changes nothing, and note how long it takes."""
        start = time.perf_counter()
        self.fit.step(self.fit.state, number, self.rates)
        dr.sync_thread()
        self.seconds.append(time.perf_counter() - start)

    def observe(self, number: int) -> None:
        """Add the albedo's gradient in a step."""
        step, state = self.fit.step, self.fit.state
        found = step.gradients(step.prepare(state, number, self.rates), state)
        parts = [np.ravel(value) for name, value in found.items() if name.startswith("albedo")]
        gradient = np.concatenate(parts).astype(np.float64)
        new = [gradient, gradient**2]
        self.sums = [a + b for a, b in zip(self.sums, new, strict=True)] if self.sums else new
        self.count += 1

    def variance(self) -> float:
        """The variance of the gradient, summed over parameters."""
        total, squares = self.sums
        return float(((squares - total**2 / self.count) / (self.count - 1)).sum())


def contestant(data: Path, method: str, args: argparse.Namespace) -> Contestant:
    """A fit of grids whose albedo is that of the arguments, warmed up."""
    path = PathConfig(max_depth=args.depth, rr_depth=args.rr_depth)
    config = FitConfig(method=method, estimator="split-halves", representation="grid", path=path)
    cells = {"grid": {"cells": 16}}
    config = update(config, {"materials": dict.fromkeys(config.quantities, cells)})
    fit = begin_fit(unbake.Dataset.load(data), config)
    raw = math.log(args.albedo / (1 - args.albedo))
    for name, value in list(fit.state.phi.items()):
        if name.startswith("albedo"):
            fit.state.phi[name] = dr.full(type(value), raw, value.shape)
    made = Contestant(fit, config)
    for number in range(WARM_UP):
        made.step(number)
    made.memory = peak_bytes(lambda: made.step(WARM_UP))
    made.seconds.clear()
    return made


def main() -> None:
    """Measure, print, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--depth", type=int, default=15, help="path.max_depth")
    parser.add_argument("--rr-depth", type=int, default=5, help="path.rr_depth")
    parser.add_argument("--albedo", type=float, default=0.5, help="of all surfaces")
    parser.add_argument("--steps", type=int, default=40, help="timed, and looked at, of each")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    args = parser.parse_args()
    unbake.register_method(UNROLLED)
    names = ("ad-pt", UNROLLED.name)
    both = {name: contestant(args.data, name, args) for name in names}
    for number in range(args.steps):
        for made in both.values():
            made.step(100 + number)
    for number in range(args.steps):
        for made in both.values():
            made.observe(1000 + number)
    rows = {
        name: {
            "milliseconds_per_step": 1e3 * statistics.median(made.seconds),
            "memory_mb": None if made.memory is None else made.memory / 1e6,
            "variance": made.variance(),
            "recordings": made.fit.step.recordings(),
        }
        for name, made in both.items()
    }
    new, old = (rows[name] for name in names)
    ratios = {
        key: new[key] / old[key]
        for key in ("milliseconds_per_step", "memory_mb", "variance")
        if old[key]
    }
    ratios["variance_times_time"] = ratios["variance"] * ratios["milliseconds_per_step"]
    for name, row in (*rows.items(), ("ratios", ratios)):
        print(name, {key: round(value, 7) for key, value in row.items() if value is not None})
    settings = {key: getattr(args, key) for key in ("depth", "rr_depth", "albedo", "steps")}
    result = {"machine": machine(), "data": args.data.name, **settings}
    if args.out is not None:
        write_json(args.out, result | {"methods": rows, "ratios": ratios})


if __name__ == "__main__":
    main()
