"""Where L_θ stops learning: activations with and without a slope below zero.

    python benchmarks/leak.py --data DATA [DATA ...] --out FILE.json [--leaks 0 0.01]
        [--seeds 0 1 2] [--steps 1200]

Each data set is fitted with each slope. `silent` is the share of what training views see where no
neuron of the last hidden layer of L_θ is above zero: with a slope of 0 the output is a constant
there, and no gradient moves it. Scores are PSNRs in dB of linear RGB by `unbake evaluate`, mean
over held-out views. `prior` is the mean relative squared residual in the last quarter of steps.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from pathlib import Path
from typing import Any

import here

import numpy as np
from variants import SCORES, described

from unbake import backend
from unbake.errors import UserError
from unbake.experiments.commands import unbake
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.run_folder import RunFolder

#: Points that are looked at.
POINTS = 20_000


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--leaks", type=float, nargs="+", default=[0.0, 0.01])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    about = {"machine": machine(), "steps": args.steps, "seeds": args.seeds}
    about["data"] = {data.name: described(data) for data in args.data}
    rows: list[dict[str, Any]] = []
    for data in args.data:
        for leak in args.leaks:
            runs = []
            for seed in args.seeds:
                runs.append(fitted(data, leak, seed, args.steps))
                told = ", ".join(f"{key} {value:.3f}" for key, value in runs[-1].items())
                print(f"{data.name}, slope {leak}, seed {seed}: {told}", flush=True)
            row = {"data": data.name, "leak": leak} | across_seeds(runs, runs[0])
            rows.append(row | {"runs": runs})
            write_json(args.out, about | {"rows": rows})


def fitted(data: Path, leak: float, seed: int, steps: int) -> dict[str, float]:
    """Scores of a fit, and how much of what it sees is silent."""
    with tempfile.TemporaryDirectory() as folder:
        run, log = RunFolder(Path(folder) / "run"), Path(folder) / "log.txt"
        settings = Path(folder) / "settings.toml"
        settings.write_text(f"[radiance.neural]\nleak = {leak}\n", encoding="utf-8")
        words = ("--settings", settings, "--steps", steps, "--seed", seed)
        with contextlib.suppress(UserError):
            unbake("fit", data, "--out", run.path, *words, log=log)
        unbake("evaluate", run.path, "--train-views", 0, "--spp", 4, log=log)
        metrics = json.loads(run.metrics_file.read_text(encoding="utf-8"))
        lines = run.log_file.read_text(encoding="utf-8").splitlines()
        told = [row for row in map(json.loads, lines) if "prior" in row]
        late = [row["prior"] for row in told if row["step"] > 0.75 * steps]
        scores = {key: metrics["heldout"][key] for key in SCORES}
        return scores | {"prior": float(np.mean(late)), "silent": silent(run.path)}


def silent(folder: Path) -> float:
    """The share of points that training views see where no last neuron is above zero."""
    import drjit as dr  # these need the variant
    import mitsuba as mi

    from unbake.fields.arrays import from_numpy
    from unbake.fields.network import Network
    from unbake.training.problem import pixels_of
    from unbake.training.recovered import load_run

    run = load_run(folder)
    problem, field = run.problem, run.problem.radiance
    assert field is not None and isinstance(field.function, Network)
    pixels = pixels_of(run.dataset, run.config, clip_negative=False)
    rng = np.random.default_rng(0)
    numbers = rng.integers(0, pixels.photographs.count, POINTS)
    numbers = pixels.photographs.numbers(numbers).astype(np.uint32)
    ray = pixels.rays.through(from_numpy(mi.UInt32, numbers), mi.Point2f(0.5))
    si = problem.scene_view.scene.ray_intersect(ray)
    unit = field.domain.to_unit(si.p, si.is_valid())
    towards = -ray.d
    normal = dr.select(dr.dot(si.n, towards) < 0, -si.n, si.n)
    inputs = [*field.function.grid(list(unit)), *(2 * unit - 1), *towards, *normal]
    values = np.stack([np.array(mi.Float(x)) for x in inputs] + [np.full(POINTS, 0.5)] * 3)
    values = values[:, np.array(si.is_valid())]
    perceptron = field.function.perceptron
    for weights, bias in perceptron.layers[:-1]:
        values = np.array(weights) @ values + np.array(bias)
        values = np.maximum(values, perceptron.leak * values)
    return float((values.max(0) <= 0).mean())


if __name__ == "__main__":
    main()
