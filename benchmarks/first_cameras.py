"""What fits begin with of unknown cameras, against the truth: exposures, response and the rest.

    python benchmarks/first_cameras.py --data DATA [DATA ...] --out FILE.json [--faults NAME ...]
        [--seeds 0]

A rendered data set gets the faults of `cameras.py`. A fit of one step follows, with what is unknown
of the cameras: what it leaves is what photographs of the same points have told before any material
was learned. Errors are those of `cameras.py`. `ratios` are light that the green curve reads over
the true light, at even places of code values: a curve that noise has made too flat (regression
dilution) reads too much in the dark and too little above the middle.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import here

import numpy as np
from cameras import FAULTS, GAMMA, about_data, errors, true_light

from unbake import backend
from unbake.acquisition.degrade import degrade
from unbake.acquisition.settings import DegradeSettings
from unbake.dataset.data_folder import DataFolder
from unbake.experiments.commands import unbake
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine

WANTED = (
    "response, exposures told",
    "response off centre, exposures told",
    "response and exposure",
    "all but mesh, exposures told",
    "all but mesh",
)


def main() -> None:
    """Begin fits, print every error, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(WANTED))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    rows: list[dict[str, Any]] = []
    for data in args.data:
        for fault in args.faults:
            found = [begun(data, fault, seed) for seed in args.seeds]
            row = {"data": data.name, "fault": fault} | across_seeds(found, found[0])
            rows.append(row)
            told = ", ".join(f"{k} {v:.3f}" for k, v in row.items() if isinstance(v, float))
            print(f"{data.name}, {fault}: {told}", flush=True)
    sets = [about_data(data) for data in args.data]
    write_json(args.out, {"machine": machine(), "data": sets, "seeds": args.seeds, "rows": rows})


def begun(data: Path, fault: str, seed: int) -> dict[str, float]:
    """Errors of what a fit begins with."""
    from unbake.training.cameras import Cameras  # these need the variant
    from unbake.training.recovered import load_run

    with tempfile.TemporaryDirectory() as folder:
        worse, run = Path(folder) / "data", Path(folder) / "run"
        settings = DegradeSettings(**FAULTS[fault].settings, seed=seed)
        degrade(data, worse, settings, tell=lambda line: None)
        words = (*FAULTS[fault].words, "--steps", 1, "--seed", seed)
        unbake("fit", worse, "--out", run, *words, log=Path(folder) / "log.txt")
        recovered = load_run(run)
        model, train = recovered.problem.camera, recovered.dataset.train
        assert model is not None
        cameras = Cameras(model, train)
        images = [
            cameras.told_of(view, gain) | {"split": "train", "name": view.name}
            for view, gain in zip(train, model.gains(), strict=True)
        ]
        truth = json.loads(DataFolder(worse).degraded_file.read_text(encoding="utf-8"))
        told = cameras.told() | {"images": images, "anchor": train[0].name}
        found = errors(told, truth)
        if curves := told.get("response"):
            curve = np.array(curves["green"])
            ratios = curve[1:] ** GAMMA / true_light(truth, len(curve))[1:]
            found |= {f"ratio_{i + 1:02d}": float(ratio) for i, ratio in enumerate(ratios)}
    return found


if __name__ == "__main__":
    main()
