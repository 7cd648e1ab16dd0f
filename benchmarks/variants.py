"""Held-out scores of fits with several settings files, over seeds, one fit after the other.

    python benchmarks/variants.py --data DATA [DATA ...] --settings A.toml B.toml --out FILE.json
        [--seeds 0 1 2] [--steps 2400 | --seconds 120] [--methods ours]

The fits of a seed follow each other, and the file is written after each seed. Scores are PSNRs in
dB of linear RGB by `unbake evaluate`, mean over held-out views; seconds are those of training.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from itertools import product
from pathlib import Path

ROOT = Path(__file__).parents[1]
SRC = str(ROOT / "src")
sys.path.insert(0, SRC)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (SRC, os.environ.get("PYTHONPATH"))))

from unbake import backend  # noqa: E402
from unbake.dataset.views import Dataset  # noqa: E402
from unbake.errors import UserError  # noqa: E402
from unbake.experiments.commands import unbake  # noqa: E402
from unbake.experiments.seeds import across_seeds  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

#: What is kept of a fit's scores.
SCORES = ("albedo_psnr", "roughness_psnr", "render_psnr")
LENGTH = ("steps", "samples", "seconds")


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--settings", type=Path, nargs="+", required=True, help="settings files")
    parser.add_argument("--methods", nargs="+", default=["ours"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, default=2400)
    length.add_argument("--seconds", type=float, help="of training, instead of steps")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    stop = ["--steps", args.steps]
    if args.seconds is not None:
        stop = ["--seconds", args.seconds]
    found: dict[tuple[str, str, str], list[dict[str, float]]] = defaultdict(list)
    described_data = {data.name: described(data) for data in args.data}
    for number, seed in enumerate(args.seeds, 1):
        for data, method, settings in product(args.data, args.methods, args.settings):
            scores = fit(data, settings, method, ["--seed", seed, *stop])
            found[data.name, method, settings.stem].append(scores)
            told = ", ".join(f"{key} {value:.2f}" for key, value in scores.items())
            print(f"{data.name}, {method}, {settings.stem}, seed {seed}: {told}", flush=True)
        rows = [
            {"data": data, "method": method, "settings": settings} | across_seeds(runs, runs[0])
            for (data, method, settings), runs in found.items()
        ]
        result = {"machine": machine(), "seeds": args.seeds[:number]}
        write_json(args.out, result | {"data": described_data, "rows": rows})


def described(data: Path) -> dict[str, int]:
    """The photographs of a data set: how many there are, their pixels and their samples."""
    dataset = Dataset.load(data)
    width, height = dataset.train[0].camera.width, dataset.train[0].camera.height
    views = {"train": len(dataset.train), "heldout": len(dataset.heldout)}
    return views | {"width": width, "height": height, "spp": dataset.render.get("spp", 0)}


def fit(data: Path, settings: Path, method: str, options: Sequence[object]) -> dict[str, float]:
    """Scores, steps, samples and seconds of a fit."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        log = Path(folder) / "log.txt"
        words = ("fit", data, "--out", run, "--settings", settings, "--method", method, *options)
        # A fit that learned nothing fails, and is judged as it is: one that left no run is told by
        # the evaluation.
        with contextlib.suppress(UserError):
            unbake(*words, log=log)
        unbake("evaluate", run, "--train-views", 0, log=log)
        metrics = json.loads(RunFolder(run).metrics_file.read_text(encoding="utf-8"))
    scores = {key: metrics["heldout"][key] for key in SCORES}
    return scores | {key: metrics[key] for key in LENGTH}


if __name__ == "__main__":
    main()
