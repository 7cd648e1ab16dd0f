"""Of which objects the error of albedo is that a coarse mesh makes.

    python benchmarks/mesh_errors.py --data DATA --out FILE.json [--keep 1 0.1] [--steps 1200]

The meshes of a rendered data set keep a share of their triangles (`unbake degrade --decimate`), and
a fit with default settings follows. The squared error of the albedo of its held-out views is told
by what the true scene shows there: shape by shape, numbered as in the scene file, those with the
largest part of it first. `hidden` is the share of its pixels where the coarse mesh has another
shape. A share of 1 is the mesh as it was.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import here

import numpy as np
from cameras import EVALUATION, about_data

from unbake import backend
from unbake.acquisition.degrade import degrade
from unbake.acquisition.settings import DegradeSettings
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset, View
from unbake.experiments.commands import unbake
from unbake.imaging.pictures import read_exr
from unbake.io import write_json
from unbake.machine import machine
from unbake.scene.parse import parse
from unbake.training.run_folder import RunFolder

#: Shapes that are told.
MOST = 8


def main() -> None:
    """Fit, print the shapes, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--keep", type=float, nargs="+", default=[1.0, 0.1])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    about = {"machine": machine(), **about_data(args.data)}
    about |= {"steps": args.steps, "seed": args.seed}
    rows: list[dict[str, Any]] = []
    for share in args.keep:
        rows.append({"decimate": share} | by_shape(args.data, share, args.steps, args.seed))
        print(rows[-1], flush=True)
        write_json(args.out, about | {"rows": rows})


def by_shape(data: Path, share: float, steps: int, seed: int) -> dict[str, Any]:
    """The error of all pixels in dB, and what part of it is of which shapes."""
    from unbake.evaluation.evaluate import evaluate  # this needs the variant

    known = Dataset.load(data)
    with tempfile.TemporaryDirectory() as folder:
        coarse, run = data, Path(folder) / "run"
        shapes, triangles = shapes_of(known.heldout, known)
        there = shapes
        if share < 1:
            coarse = Path(folder) / "data"
            settings = DegradeSettings(decimate=share, seed=seed)
            worse = degrade(data, coarse, settings, tell=lambda line: None)
            there, _ = shapes_of(known.heldout, worse)
        words = ["--steps", steps, "--seed", seed]
        unbake("fit", coarse, "--out", run, *words, log=Path(folder) / "log.txt")
        evaluate(run, EVALUATION, tell=lambda line: None)
        picture = partial(RunFolder(run).picture, "heldout", quantity="albedo")
        fitted = colours([picture(view=view.name) for view in known.heldout])
    true = colours([DataFolder(data).truth("albedo", view.name) for view in known.heldout])
    counted = np.isfinite(true).all(1)
    true, fitted, shapes, there = (x[counted] for x in (true, fitted, shapes, there))
    error = np.square(true - fitted).mean(1)
    count = len(triangles) + 1  # first, what meets nothing
    sums, pixels = (np.bincount(shapes + 1, x, count)[1:] for x in (error, None))
    found = [
        {
            "shape": int(shape),
            "triangles": triangles[shape],
            "pixels": float(pixels[shape] / len(error)),
            "error": float(sums[shape] / error.sum()),
            "albedo_psnr": float(-10 * np.log10(sums[shape] / pixels[shape])),
            "hidden": float((there != shapes)[shapes == shape].mean()),
            "true": float(true[shapes == shape].mean()),
            "fitted": float(fitted[shapes == shape].mean()),
        }
        for shape in np.argsort(-sums)[:MOST]
    ]
    return {"albedo_psnr": float(-10 * np.log10(error.mean())), "shapes": found}


def colours(files: Sequence[Path]) -> np.ndarray:
    """The pixels of all pictures, (n, 3)."""
    return np.concatenate([read_exr(file)[..., :3].reshape(-1, 3) for file in files])


def shapes_of(views: Sequence[View], dataset: Dataset) -> tuple[np.ndarray, list[int]]:
    """The number of the shape at the centre of each pixel, or -1; triangles of all shapes."""
    import drjit as dr  # these need the variant
    import mitsuba as mi

    from unbake.dataset.small_views import pixel_rays
    from unbake.scene.free_space import as_ray

    scene = parse(dataset.scene, dataset.root).instantiate(merge=False)
    rays = as_ray(*pixel_rays([view.camera for view in views]))
    hit = scene.ray_intersect(rays).shape
    number = np.full(dr.width(rays), -1)
    for place, shape in enumerate(scene.shapes()):
        number[np.array(hit == mi.ShapePtr(shape))] = place
    counts = [shape.face_count() if shape.is_mesh() else 0 for shape in scene.shapes()]
    return number, counts


if __name__ == "__main__":
    main()
