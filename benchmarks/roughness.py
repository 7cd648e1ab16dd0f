"""What holds roughness back: where it starts, the radiance field, or the objective.

    python benchmarks/roughness.py --data DATA --work FOLDER --out FILE.json
        [--initial 0.2 0.3 0.51 0.7] [--steps 1200] [--solve-steps 2400] [--batches 200]

Fits of one seed start with the roughness of each number, or with the true maps (`true`), and learn
L_θ or keep one that was solved for the true materials. Scores are PSNRs in dB of linear RGB, mean
over held-out views. Then the way from a fit with the solved L_θ and the usual start to the true
roughness: at each part of it albedo adapts while roughness stays, and the photometric loss of
the same batches is compared with that at the start of the way. Rows that the file has already are
kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import here

import numpy as np

from unbake import backend

backend.activate()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402

from unbake import quantities  # noqa: E402
from unbake.config import FitConfig  # noqa: E402
from unbake.dataset.pixels import PixelSource  # noqa: E402
from unbake.dataset.views import Dataset  # noqa: E402
from unbake.experiments.commands import unbake  # noqa: E402
from unbake.fields.arrays import from_numpy  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.profiling.towards_truth import WAY, towards_truth  # noqa: E402
from unbake.training.checkpoint import Progress  # noqa: E402
from unbake.training.fresh_fit import begin_fit  # noqa: E402
from unbake.training.recovered import Recovered  # noqa: E402
from unbake.training.schedule import learning_rates  # noqa: E402
from unbake.training.solved import read_solved  # noqa: E402
from unbake.training.state import State, initial_state  # noqa: E402
from unbake.training.step import TrainingStep  # noqa: E402
from unbake.training.truth_fit import TruthFit  # noqa: E402
from unbake.training.validation import Score  # noqa: E402
from unbake.training.warm_start import start_radiance, with_solved_field  # noqa: E402

#: Camera samples a pixel of scores, steps on the true maps, and parts of the way to the truth.
SAMPLES, TRUTH_STEPS, PARTS = 16, 800, (0.0, 0.25, 0.5, 0.75, 1.0)
#: Steps in which albedo adapts on the way, and the fractions of a fit whose rates these have.
ADAPTING, FROM, TO = 300, 0.3, 0.9
#: Batches of the way have numbers that no fit has.
_ADAPTING_BATCHES, _BATCHES = 1 << 20, 1 << 21


@dataclass
class Fitted:
    """A fit that has ended."""

    config: FitConfig
    recovered: Recovered
    pixels: PixelSource
    state: State


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set with true maps")
    usual = quantities.QUANTITIES["roughness"].initial
    parser.add_argument("--initial", type=float, nargs="+", default=[0.2, 0.3, usual, 0.7])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--solve-steps", type=int, default=2400)
    parser.add_argument("--batches", type=int, default=200)
    parser.add_argument("--work", type=Path, required=True, help="folder for the solved field")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    solved = args.work / "solved"
    if not solved.exists():
        scene = Dataset.load(args.data).scene
        words = ("--steps", args.solve_steps, "--views", 1, "--reference-spp", 0)
        unbake("solve", scene, "--out", solved, *words, log=args.work / "solve.log")
    starts: list[float | None] = [*args.initial, None]
    about = {"machine": machine(), "data": args.data.name, "steps": args.steps, "usual": usual}
    before: list[dict] = json.loads(args.out.read_text())["rows"] if args.out.exists() else []
    rows = []
    for field, start in product((None, solved), starts):
        row = {"start": "true" if start is None else start, "solved": field is not None}
        known = [old for old in before if old.items() >= row.items()]
        if not known:
            known = [row | scores(fit(args.data, args.steps, start, field))]
        rows += known
        print(rows[-1], flush=True)
        write_json(args.out, about | {"rows": rows})
    walked = way(fit(args.data, args.steps, usual, solved), args.batches)
    write_json(args.out, about | {"rows": rows, "way": walked})


def fit(data: Path, steps: int, start: float | None, solved: Path | None) -> Fitted:
    """A fit of default settings.

    Args:
        start: roughness of the untrained field; None: the fields start at the true roughness.
        solved: folder of an L_θ to keep; None: it is learned.
    """
    dataset, config = Dataset.load(data), FitConfig(steps=steps)
    field = None if solved is None else read_solved(solved)
    if field is not None:
        config = with_solved_field(config, field)
    row, usual = quantities.QUANTITIES["roughness"], quantities.QUANTITIES["roughness"].initial
    object.__setattr__(row, "initial", usual if start is None else start)
    try:
        begun = begin_fit(dataset, config)
    finally:
        object.__setattr__(row, "initial", usual)
    problem, state = begun.problem, begun.state
    if field is not None:
        assert problem.radiance is not None
        problem.radiance.scale = field.radiance.scale
        start_radiance(problem, field)
        state = initial_state(problem)
    if start is None:
        true = TruthFit(dataset, begun.config)
        true.train(TRUTH_STEPS)
        parameters = true.problem.parameters()
        take(state, {k: v.numpy() for k, v in parameters.items() if k.startswith("roughness.")})
    for number in range(steps):
        rates = learning_rates(begun.config, number, number / steps)
        begun.step(state, number, rates | ({} if field is None else {"radiance": 0.0}))
        if number % 20 == 0:
            dr.sync_thread()
    state.publish(problem)
    recovered = Recovered(problem, dataset, begun.config, Progress(steps), False)
    return Fitted(begun.config, recovered, begun.pixels, state)


def take(state: State, arrays: Mapping[str, np.ndarray]) -> None:
    """Put arrays in the place of unknowns of the same shapes."""
    for name, array in arrays.items():
        flat = from_numpy(mi.Float, array.ravel())
        tensor = dr.is_tensor_v(state.phi[name])
        state.phi[name] = mi.TensorXf(flat, array.shape) if tensor else flat


def scores(fitted: Fitted) -> dict[str, float]:
    """Held-out scores."""
    found = Score(fitted.recovered.problem, fitted.recovered.dataset.heldout).measure(SAMPLES)
    return {key: value for key, value in found.items() if key.endswith("_psnr") and value}


def way(fitted: Fitted, batches: int) -> list[dict[str, float]]:
    """The photometric loss along the way of roughness to the truth, where albedo adapts to it.

    Args:
        batches: to compare losses in, the same at each part of the way.
    """
    config, names = fitted.config, fitted.state.phi.keys()
    problem = towards_truth(fitted.recovered)
    step = TrainingStep(problem, fitted.pixels, config)
    state = initial_state(problem)
    take(state, {name: fitted.state.phi[name].numpy() for name in names})
    start, found, first = state.snapshot(), [], np.zeros(batches)
    still = dict.fromkeys(learning_rates(config, config.steps, 1.0), 0.0)
    for part in PARTS:
        state.restore(start)
        state.phi[f"roughness.{WAY}"] = dr.opaque(mi.Float, part)
        for number in range(ADAPTING):
            done = FROM + (TO - FROM) * number / ADAPTING
            rates = still | {"albedo": learning_rates(config, config.steps, done)["albedo"]}
            step(state, _ADAPTING_BATCHES + number, rates)
            if number % 20 == 0:
                dr.sync_thread()
        terms = [step(state, _BATCHES + number, still) for number in range(batches)]
        losses = np.array([float(term["photometric"][0]) for term in terms])
        first = losses if part == 0 else first
        difference = losses - first
        error = float(difference.std(ddof=1) / batches**0.5)
        found.append({"part": part, "loss": float(losses.mean())})
        found[-1] |= {"difference": float(difference.mean()), "standard_error": error}
        print(found[-1], flush=True)
    return found


if __name__ == "__main__":
    main()
