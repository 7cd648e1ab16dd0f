"""Whether photographs tell the scale of light: fits of photographs that are told to be brighter.

    python benchmarks/light_scale.py --data DATA --runs FOLDER --out FILE.json
        [--factors 0.64 0.8 1 1.25 1.56] [--seeds 0 1] [--steps 1200]

The exposures that a rendered data set tells are multiplied by a factor, which divides all light by
it; the lights of the scene stay as they are. Where photographs tell the scale of light, the loss is
least with a factor of 1. `loss_epsilon` is divided by the squared factor, so that losses of all
fits are relative to the same. `photometric` and `lhs` are means over the last steps of the log,
`held_aside` is of pixels that no step draws, without the noise of the rendering.

What FOLDER has already is not made again.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from statistics import mean

import here

from poses import SCORES, fit  # which activates a variant

from unbake.config import preset
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.run_folder import RunFolder

#: Lines of the log, each of so many steps, that losses are means over.
LINES = 10
LOSSES = ("photometric", "lhs", "held_aside")


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--runs", type=Path, required=True, help="folder for data sets and runs")
    parser.add_argument("--factors", type=float, nargs="+", default=[0.64, 0.8, 1, 1.25, 1.56])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    dataset, rows = Dataset.load(args.data), []
    for factor in args.factors:
        data = told_brighter(args.data, args.runs / f"data-{factor:g}", factor)
        settings = args.runs / f"{factor:g}.toml"
        epsilon = preset("cpu").loss_epsilon / factor**2
        settings.write_text(f"loss_epsilon = {epsilon:.8g}\n", encoding="utf-8")
        found = []
        for seed in args.seeds:
            run = args.runs / f"run-{factor:g}-{seed}"
            words = ["--settings", settings, "--steps", args.steps, "--seed", seed]
            fit(data, run, words)
            found.append(scores(run))
        rows.append({"factor": factor} | across_seeds(found, found[0]))
        told = ", ".join(f"{k} {v:.5f}" for k, v in rows[-1].items())
        print(told, flush=True)
    camera = dataset.train[0].camera
    about = {
        "machine": machine(),
        "data": args.data.name,
        "seeds": args.seeds,
        "steps": args.steps,
        "train": len(dataset.train),
        "heldout": len(dataset.heldout),
        "width": camera.width,
        "height": camera.height,
    }
    write_json(args.out, about | {"rows": rows})


def told_brighter(data: Path, out: Path, factor: float) -> Path:
    """Make the copy of a data set whose photographs are told to be so many times as bright."""
    if not out.is_dir():
        shutil.copytree(data, out, ignore=shutil.ignore_patterns(DataFolder(data).cache.name))
        file = DataFolder(out).transforms_file
        content = json.loads(file.read_text(encoding="utf-8"))
        for frame in content["frames"]:
            frame["exposure"] = factor * frame.get("exposure", 1.0)
        file.write_text(json.dumps(content), encoding="utf-8")
    return out


def scores(run: Path) -> dict[str, float]:
    """Held-out scores of a run, and the losses that it ended with."""
    folder = RunFolder(run)
    metrics, log = folder.metrics(), folder.log()
    found = {key: metrics["heldout"][key] for key in SCORES}
    for name in LOSSES:
        values = [line[name] for line in log if name in line]
        found[name] = values[-1] if name == "held_aside" else mean(values[-LINES:])
    return found


if __name__ == "__main__":
    main()
