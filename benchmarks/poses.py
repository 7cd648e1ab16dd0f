"""What poses that are off cost, and what refining them gives back.

    python benchmarks/poses.py --data DATA --runs FOLDER --out FILE.json [--pixels 0.3 1 3]
        [--seed 0] [--steps 600]

`unbake degrade` moves the cameras of a rendered data set. Fits follow: of the data set as it was,
and for each size of the error, with poses taken as given and refined. Scores `true_*` are at the
true cameras: the recovered materials as the held-out views of the data set as it was see them. The
others are by `unbake evaluate`, at the cameras that are given, or to which held-out views were
moved by their photographs. Errors of poses are distances in the image between a point as the true
camera and as the other one sees it, root mean square over pixels and views.

What FOLDER has already is not made again.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import here

import numpy as np
from variants import SCORES

from unbake import backend

backend.activate()  # before modules with types of Dr.Jit

from unbake.acquisition.degrade import degrade  # noqa: E402
from unbake.acquisition.settings import DegradeSettings  # noqa: E402
from unbake.dataset.views import Dataset, View  # noqa: E402
from unbake.evaluation.placing import told_of_place  # noqa: E402
from unbake.experiments.commands import unbake  # noqa: E402
from unbake.imaging.metrics import mean_psnr  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.recovered import Recovered, load_run  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402
from unbake.training.validation import GroundTruth, MaterialBuffers  # noqa: E402

#: What is made of poses.
POSES = ("given", "refined")
#: What matters here is material: pictures have few samples, which costs all rows the same.
EVALUATION = ("--spp", 16, "--train-views", 0)
#: Samples a pixel of materials at the true cameras.
SAMPLES = 64


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--runs", type=Path, required=True, help="folder for data sets and runs")
    parser.add_argument("--pixels", type=float, nargs="+", default=[0.3, 1.0, 3.0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    clean, rows = Dataset.load(args.data), []
    for pixels, poses in [(0.0, "given"), *((x, p) for x in args.pixels for p in POSES)]:
        data = args.data
        if pixels:
            data = args.runs / f"data-{pixels:g}"
            if not data.is_dir():
                degrade(args.data, data, DegradeSettings(pose_jitter=pixels, seed=args.seed))
        run = args.runs / f"{poses}-{pixels:g}"
        fit(data, run, ["--seed", args.seed, "--steps", args.steps, "--poses", poses])
        rows.append({"pixels": pixels, "poses": poses} | scores(run, clean))
        # What was asked for is of all views; that of training views follows.
        given = rows[-1]["train_pixels"] if poses == "given" else rows[-2]["given_pixels"]
        rows[-1]["given_pixels"] = given
        told = ", ".join(f"{k} {v:.3f}" for k, v in rows[-1].items() if isinstance(v, float))
        print(f"{poses}: {told}", flush=True)
    camera = clean.train[0].camera
    about = {
        "machine": machine(),
        "data": args.data.name,
        "seed": args.seed,
        "steps": args.steps,
        "train": len(clean.train),
        "heldout": len(clean.heldout),
        "width": camera.width,
        "height": camera.height,
    }
    write_json(args.out, about | {"rows": rows})


def fit(data: Path, run: Path, words: Sequence[object]) -> None:
    """A fit and its evaluation, as far as they are not there already."""
    log, folder = run.with_suffix(".log"), RunFolder(run)
    if not run.is_dir():
        unbake("fit", data, "--out", run, *words, log=log)
    if not folder.metrics_file.is_file():
        unbake("evaluate", run, *EVALUATION, log=log)


def scores(run: Path, clean: Dataset) -> dict[str, Any]:
    """The scores of a run, and the errors of its poses in pixels."""
    metrics = RunFolder(run).metrics()
    found = {key: metrics["heldout"][key] for key in SCORES} | {"seconds": metrics["seconds"]}
    return found | at_true_cameras(run, clean)


def at_true_cameras(run: Path, clean: Dataset) -> dict[str, float]:
    """Scores of materials as the true cameras see them, and the errors of poses in pixels.

    Args:
        run: that was evaluated.
        clean: the data set before `degrade`.
    """
    recovered, metrics = load_run(run), RunFolder(run).metrics()
    found = {f"true_{key}": value for key, value in as_seen(recovered, clean).items()}
    poses = {
        row["name"]: np.array(row["transform_matrix"])
        for row in metrics.get("camera", {}).get("images", ())
        if "transform_matrix" in row  # not where poses were taken as given
    }
    scene = recovered.problem.scene_view.scene
    given = {view.name: view for view in recovered.dataset.views}
    for split in ("train", "heldout"):
        views: list[View] = [view for view in clean.views if view.split == split]
        squares = []
        for view in views:
            camera = given[view.name].camera
            camera = replace(camera, to_world=poses.get(view.name, camera.to_world))
            squares.append(told_of_place(scene, camera, view.camera)["pixels"] ** 2)
        found[f"{split}_pixels"] = float(np.sqrt(np.mean(squares)))
    return found


def as_seen(recovered: Recovered, captured: Dataset) -> dict[str, float]:
    """Scores of recovered materials as the held-out views of another data set see them.

    Args:
        recovered: of the same geometry.
        captured: with true materials.
    """
    seen = MaterialBuffers.of(recovered.problem, captured.heldout, SAMPLES, 0)
    truths = [GroundTruth.of(view) for view in captured.heldout]
    each = [s.psnr(t) for s, t in zip(seen, truths, strict=True) if t is not None]
    means = {key: mean_psnr(row[key] for row in each) for key in (each[0] if each else ())}
    return {key: value for key, value in means.items() if value is not None}


if __name__ == "__main__":
    main()
