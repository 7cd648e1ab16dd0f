"""The expected gradient of the loss by offsets of roughness, for surfaces grouped by roughness.

    python benchmarks/offsets.py DATA --out FILE.json [--settings FILE.toml] [--steps 1200]
        [--true] [--shift -0.2] [--edges 0.38 0.7] [--at 0 0.1] [--batches 48]

It separates what the photographs say from what an optimiser makes of it. Where the gradient is zero
the objective has its optimum; where it is not, a fit that rests there is held back by noise or by
its learning rate. With --true the fields are first trained on the true maps, in which roughness
above the last edge is shifted, and roughness then stays while all else is learned. Without it the
fit is the usual one. Offsets of --at are those of the last group; a positive gradient pulls down.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import here

import numpy as np

from unbake import backend

backend.activate()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from unbake.config import FitConfig, read_toml  # noqa: E402
from unbake.dataset.views import Dataset  # noqa: E402
from unbake.fields.field import Field  # noqa: E402
from unbake.fields.materials import Materials  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.quantities import QUANTITIES, channels_of  # noqa: E402
from unbake.training.defaults import with_defaults  # noqa: E402
from unbake.training.fresh_fit import FreshFit, begin_fit  # noqa: E402
from unbake.training.problem import Problem  # noqa: E402
from unbake.training.schedule import learning_rates  # noqa: E402
from unbake.training.step import TrainingStep  # noqa: E402
from unbake.training.truth_fit import TrueMaps, TruthFit  # noqa: E402
from unbake.training.validation import Score  # noqa: E402

ROUGHNESS = QUANTITIES["roughness"]
#: Steps on the true maps, and a seed that no step of a fit has.
TRUTH_STEPS, FIRST_BATCH = 600, 1 << 20


class Shifted(Field):
    """A field whose values are shifted by an offset that depends on the values."""

    def __init__(self, field: Field, edges: Sequence[float]) -> None:
        self.field = field
        self.offsets: list[mi.Float] = []
        self._edges = [_unit(edge) for edge in edges]

    def parameters(self) -> dict:
        """Those of the field."""
        return self.field.parameters()

    def assign(self, parameters: dict) -> None:
        """Use these arrays from now on."""
        self.field.assign(parameters)

    def set(self, offsets: Sequence[float]) -> None:
        """Set the offsets of the groups, in roughness."""
        self.offsets = [dr.opaque(mi.Float, offset) for offset in offsets]
        dr.enable_grad(self.offsets)

    def evaluate(self, point: Any, extra: Any = (), engine: Any = None) -> list[mi.Float]:
        """The shifted values."""
        (value,) = self.field.evaluate(point, extra, engine)
        offset = self.offsets[-1]
        for edge, other in reversed(list(zip(self._edges, self.offsets, strict=False))):
            offset = dr.select(dr.detach(value) < edge, other, offset)
        return [dr.clip(value + offset / (ROUGHNESS.upper - ROUGHNESS.lower), 0, 1)]


def main() -> None:
    """Fit, measure and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--settings", type=Path)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--true", action="store_true", help="start at the true maps")
    parser.add_argument("--shift", type=float, default=0.0, help="of true roughness above the edge")
    parser.add_argument("--edges", type=float, nargs="+", default=[0.38, 0.7])
    parser.add_argument("--at", type=float, nargs="+", default=[0.0, 0.1])
    parser.add_argument("--pixels", type=int, default=8192)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--batches", type=int, default=48)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    dataset = Dataset.load(args.data)
    config = FitConfig() if args.settings is None else read_toml(args.settings)
    config = with_defaults(replace(config, steps=args.steps), dataset)
    true = true_parameters(dataset, config, args.edges[-1], args.shift) if args.true else {}
    gc.collect()  # Dr.Jit 1.5 aborts if objects of an earlier fit are freed in a recording
    fit = begin_fit(dataset, config)
    train(fit, true)
    score = Score(fit.problem, dataset.heldout).measure()
    rows = [row(fit, args, at) for at in args.at]
    result = {"machine": machine(), "data": dataset.folder.name, "score": score}
    result |= {key: getattr(args, key) for key in ("steps", "true", "shift", "edges", "batches")}
    write_json(args.out, result | {"pixels": args.pixels, "spp": args.spp, "rows": rows})


def true_parameters(
    dataset: Dataset, config: FitConfig, edge: float, shift: float
) -> dict[str, np.ndarray]:
    """Fields trained on the true maps, roughness above an edge shifted."""
    load = TrueMaps.load

    def shifted(dataset: Dataset, quantities: Sequence[str]) -> TrueMaps:
        maps = load(dataset, quantities)
        values = maps.values[:, channels_of(maps.names)["roughness"]]
        values += np.where(values > edge, np.float32(shift), 0)
        return maps

    TrueMaps.load = staticmethod(shifted)  # type: ignore[method-assign]
    fit = TruthFit(dataset, config)
    fit.train(TRUTH_STEPS)
    assert fit.problem.materials is not None
    return {key: np.array(x) for key, x in fit.problem.materials.parameters().items()}


def train(fit: FreshFit, true: dict[str, np.ndarray]) -> None:
    """Take all steps; from true maps roughness stays."""
    fit.step.plan(fit.state)
    # Kept until all is recorded: Dr.Jit 1.5 aborts if an array of NumPy's is freed meanwhile.
    start = {key: type(fit.state.phi[key])(value) for key, value in true.items()}
    for key, value in start.items():
        fit.state.phi[key] = value
    for number in range(fit.config.steps):
        rates = learning_rates(fit.config, number, number / fit.config.steps)
        fit.step(fit.state, number, rates | ({"roughness": 0.0} if true else {}))
    fit.state.publish(fit.problem)


def row(fit: FreshFit, args: argparse.Namespace, at: float) -> dict[str, Any]:
    """Mean gradients and their standard errors by group, at an offset of the last one."""
    problem, shifted = with_offsets(fit.problem, args.edges)
    config = replace(fit.config, pixels=args.pixels, spp=args.spp)
    step = TrainingStep(problem, fit.pixels, config)
    rates = learning_rates(config, 0, 0.0)
    found = []
    for number in range(FIRST_BATCH, FIRST_BATCH + args.batches):
        shifted.set([0.0] * len(args.edges) + [at])
        # Traced anew each time: the offsets are no arguments of the step.
        step.gradients(step.prepare(fit.state, number, rates), fit.state)
        found.append([float(dr.grad(offset)[0]) for offset in shifted.offsets])
    errors = np.std(found, 0, ddof=1) / np.sqrt(len(found))
    told = [f"{m:+.1e} ± {e:.0e}" for m, e in zip(np.mean(found, 0), errors, strict=True)]
    print(f"at {at:+.2f}: {', '.join(told)}", flush=True)
    means = np.mean(found, 0).tolist()
    return {"at": at, "gradients": means, "standard_errors": errors.tolist()}


def with_offsets(problem: Problem, edges: Sequence[float]) -> tuple[Problem, Shifted]:
    """The problem with a shifted roughness, whose arrays are those of the problem."""
    assert problem.materials is not None
    shifted = Shifted(problem.materials["roughness"], edges)
    materials = Materials({**problem.materials, "roughness": shifted})
    materials.domain, materials.numbers = problem.materials.domain, problem.materials.numbers
    view = replace(problem.scene_view, materials=materials)
    return replace(problem, scene_view=view, materials=materials), shifted


def _unit(roughness: float) -> float:
    """A roughness as fields give it, from 0 to 1."""
    return (roughness - ROUGHNESS.lower) / (ROUGHNESS.upper - ROUGHNESS.lower)


if __name__ == "__main__":
    main()
