"""What unknown exposures cost, and what fitting them gives back.

    python benchmarks/cameras.py --data DATA --out FILE.json [--stops 1.5] [--seeds 0]
        [--steps 2400] [--settings FILE]

The photographs of a data set of known exposures are multiplied by random ones, uniform in stops up
to ±`--stops`, each view by its own, but for the first training view: it is the anchor. Three fits
follow: of the photographs as they were, of the new ones taken for known, and of the new ones with
`--exposures per-image`. Scores are PSNRs in dB of linear RGB by `unbake evaluate`, mean over
held-out views; errors of exposures are of the other training views, in stops.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
SRC = str(ROOT / "src")
sys.path.insert(0, SRC)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (SRC, os.environ.get("PYTHONPATH"))))

from unbake import backend  # noqa: E402
from unbake.dataset.data_folder import DataFolder  # noqa: E402
from unbake.dataset.views import Dataset  # noqa: E402
from unbake.experiments.commands import unbake  # noqa: E402
from unbake.experiments.seeds import across_seeds  # noqa: E402
from unbake.imaging.pictures import read_exr, write_exr  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

SCORES = ("albedo_psnr", "roughness_psnr", "render_psnr")
LENGTH = ("steps", "samples", "seconds")
FITS = {"clean": "known", "taken for known": "known", "fitted": "per-image"}


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--stops", type=float, default=1.5, help="the most that exposures differ")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--settings", type=Path, help="settings file")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    found: dict[str, list[dict[str, float]]] = {name: [] for name in FITS}
    options = [] if args.settings is None else ["--settings", args.settings]
    for number, seed in enumerate(args.seeds, 1):
        with tempfile.TemporaryDirectory() as folder:
            exposed, stops = with_exposures(args.data, Path(folder) / "data", args.stops, seed)
            for name, exposures in FITS.items():
                data = args.data if name == "clean" else exposed
                words = ["--seed", seed, "--steps", args.steps, "--exposures", exposures, *options]
                scores = fit(data, Path(folder) / name.replace(" ", "-"), words, stops)
                found[name].append(scores)
                told = ", ".join(f"{key} {value:.3f}" for key, value in scores.items())
                print(f"{name}, seed {seed}: {told}", flush=True)
        rows = [{"exposures": name} | across_seeds(runs, runs[0]) for name, runs in found.items()]
        dataset = Dataset.load(args.data)
        camera = dataset.train[0].camera
        about = {
            "train": len(dataset.train),
            "heldout": len(dataset.heldout),
            "width": camera.width,
            "height": camera.height,
            "spp": dataset.render.get("spp", 0),
            "stops": args.stops,
        }
        result = {"machine": machine(), "seeds": args.seeds[:number], "data": args.data.name}
        write_json(args.out, result | about | {"rows": rows})


def with_exposures(data: Path, out: Path, most: float, seed: int) -> tuple[Path, dict[str, float]]:
    """A copy of a data set that does not tell its new exposures, and these, in stops by view."""
    shutil.copytree(data, out, ignore=shutil.ignore_patterns(DataFolder(data).cache.name))
    rng, found, dataset = np.random.default_rng(seed), {}, Dataset.load(out)
    for view in dataset.views:
        found[view.name] = 0.0 if view is dataset.train[0] else float(rng.uniform(-most, most))
        pixels = read_exr(view.image)
        pixels[..., :3] *= 2.0 ** found[view.name]
        write_exr(view.image, pixels)
    return out, found


def fit(
    data: Path, run: Path, words: Sequence[object], stops: dict[str, float]
) -> dict[str, float]:
    """Scores of a fit, and errors of its exposures where it has any."""
    log = run.with_suffix(".log")
    unbake("fit", data, "--out", run, *words, log=log)
    unbake("evaluate", run, log=log)
    metrics: dict[str, Any] = json.loads(RunFolder(run).metrics_file.read_text(encoding="utf-8"))
    scores = {key: metrics["heldout"][key] for key in SCORES}
    camera = metrics.get("camera")
    if camera is not None:
        errors = [
            row["stops"] - stops[row["name"]]
            for row in camera["images"]
            if row["split"] == "train" and row["name"] != camera["anchor"]
        ]
        scores["stops_error_rms"] = float(np.sqrt(np.mean(np.square(errors))))
        scores["stops_error_mean"] = float(np.mean(errors))
        scores["stops_error_most"] = float(np.abs(errors).max())
    return scores | {key: metrics[key] for key in LENGTH}


if __name__ == "__main__":
    main()
