"""How far weights that follow a photograph's own noise pull a fit, told without any fit.

    python benchmarks/weight_bias.py --data A B C [D ...] --out FILE.json

The data sets are captures of one scene from the same cameras, each with noise of its own
(`unbake capture SCENE --cameras A/transforms.json --seed N --out B`). The loss of a rendering that
is right but for a scale s is Σ w(A) (s · I − A)². Its optimum is Σ w(A) A I / Σ w(A) I²; the light
I is not known, but independent photographs have its expectation: Σ w(A) A B / Σ w(A) B C. Where
weights w do not know the noise of their own photograph it is 1, whatever that noise is.
`photograph` is the weight of errors that are relative to the photograph itself.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import here

import numpy as np
from cameras import about_data

from unbake import backend
from unbake.dataset.photographs import Photographs
from unbake.dataset.views import Dataset
from unbake.io import write_json
from unbake.machine import machine

#: What is added to squares that errors are relative to, as a share of the mean radiance's square.
EPSILON = 0.01


def main() -> None:
    """Measure, print the optima, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="three or more")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    if len(args.data) < 3:
        parser.error("--data: three captures, with the noise of three seeds")
    backend.activate()
    sets = [Dataset.load(data) for data in args.data]
    if any(not alike(sets[0], one) for one in sets):
        parser.error("--data: they must have the same cameras, --resolution included")
    loaded = [Photographs.load(one, False, smoothed=True) for one in sets]
    tables = [one.table.astype(np.float64) for one in loaded]
    rows = {}
    for kind, columns in {"smoothed": slice(3, 6), "photograph": slice(0, 3)}.items():
        optima = [optimum(tables[i:] + tables[:i], columns) for i in range(len(tables))]
        mean, deviation = np.mean(optima, 0), np.std(optima, 0, ddof=1)
        rows[kind] = {"optimum": mean.tolist(), "deviation": deviation.tolist()}
        print(
            f"{kind}: optimum {mean.round(3)}, standard deviation {deviation.round(4)}", flush=True
        )
    about = {"machine": machine(), "data": [about_data(data) for data in args.data]}
    write_json(args.out, about | {"rows": rows})


def alike(first: Dataset, other: Dataset) -> bool:
    """Whether two data sets have the same training views, seen by the same cameras."""
    views = list(zip(first.train, other.train, strict=False))
    sizes = [(view.camera.width, view.camera.height) for pair in views for view in pair]
    same = all(np.allclose(a.camera.to_world, b.camera.to_world) for a, b in views)
    return len(first.train) == len(other.train) and len({*sizes}) == 1 and same


def optimum(tables: list[np.ndarray], columns: slice) -> np.ndarray:
    """The scale of each channel that fits the first photographs best, shape (3,).

    Args:
        tables: linear RGB and what errors are relative to, of each data set, shape (pixels, 6).
        columns: of the table that errors are relative to.
    """
    own, other, third = (table[:, :3] for table in tables[:3])
    weight = 1 / (tables[0][:, columns] ** 2 + EPSILON * own.mean() ** 2)
    return (weight * own * other).sum(0) / (weight * other * third).sum(0)


if __name__ == "__main__":
    main()
