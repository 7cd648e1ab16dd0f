"""What things cost that photographs show and the mesh lacks, and what finding them gives back.

    python benchmarks/outliers.py --data DATA --runs FOLDER --out FILE.json [--seed 0] [--steps 600]

A rectangle is painted into every third training photograph of a data set, each at another place,
in one colour. Fits follow: of the data set as it was, of the painted one with all pixels counted
alike, and of the painted one with `--outliers found`. Scores are by `unbake evaluate`. `found` is
the share of the painted pixels that the fit took for outliers, `wrong` that of all other pixels.

What FOLDER has already is not made again.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

import here

import numpy as np
from poses import SCORES, fit  # which activates a variant

from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset
from unbake.imaging.pictures import read_exr, write_exr
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder

#: Every so many views are painted; edges of a rectangle, as shares of the picture's.
EVERY, SMALLEST, LARGEST = 3, 0.2, 0.4
#: Radiance of the paint, in means of all photographs.
COLOUR = np.array([2.0, 0.3, 1.5])
FITS = {"clean": "kept", "painted": "kept", "found": "found"}


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--runs", type=Path, required=True, help="folder for data sets and runs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    dataset, rows = Dataset.load(args.data), []
    masks = painted(args.data, args.runs / "painted-data", args.seed)
    for name, outliers in FITS.items():
        data = args.data if name == "clean" else args.runs / "painted-data"
        words = ["--seed", args.seed, "--steps", args.steps, "--outliers", outliers]
        fit(data, args.runs / name, words)
        rows.append({"fit": name} | scores(args.runs / name, masks))
        told = ", ".join(f"{k} {v:.3f}" for k, v in rows[-1].items() if isinstance(v, float))
        print(f"{name}: {told}", flush=True)
    camera = dataset.train[0].camera
    about = {
        "machine": machine(),
        "data": args.data.name,
        "seed": args.seed,
        "steps": args.steps,
        "train": len(dataset.train),
        "heldout": len(dataset.heldout),
        "width": camera.width,
        "height": camera.height,
        "painted": float(np.mean(list(masks.values()))),
    }
    write_json(args.out, about | {"rows": rows})


def painted(data: Path, out: Path, seed: int) -> dict[str, np.ndarray]:
    """Make the painted copy of a data set, and tell which pixels of training views were painted."""
    if not out.is_dir():
        shutil.copytree(data, out, ignore=shutil.ignore_patterns(DataFolder(data).cache.name))
    dataset = Dataset.load(data)
    mean = np.mean([read_exr(view.image)[..., :3].mean() for view in dataset.train])
    rng, masks = np.random.default_rng(seed), {}
    for number, view in enumerate(dataset.train):
        mask = np.zeros((view.camera.height, view.camera.width), bool)
        if number % EVERY == 0:
            height, width = (rng.uniform(SMALLEST, LARGEST, 2) * mask.shape).astype(int)
            top, left = (
                int(rng.integers(n - m)) for n, m in zip(mask.shape, (height, width), strict=True)
            )
            mask[top : top + height, left : left + width] = True
            pixels = read_exr(view.image)
            pixels[mask, :3] = COLOUR * mean
            write_exr(out / view.image.relative_to(data), pixels)
        masks[view.name] = mask
    return masks


def scores(run: Path, masks: dict[str, np.ndarray]) -> dict[str, Any]:
    """The scores of a run, and which pixels it took for outliers."""
    metrics, recovered = RunFolder(run).metrics(), load_run(run)
    found = {key: metrics["heldout"][key] for key in SCORES} | {"seconds": metrics["seconds"]}
    model = recovered.problem.outliers
    if model is not None:
        taken = np.concatenate([x.ravel() for x in model.masks()])
        paint = np.concatenate([masks[view.name].ravel() for view in recovered.dataset.train])
        found |= {"found": float(taken[paint].mean()), "wrong": float(taken[~paint].mean())}
    return found


if __name__ == "__main__":
    main()
