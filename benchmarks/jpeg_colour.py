"""How near decoded JPEG photographs are to the light they were of, by how colour is decoded.

    python benchmarks/jpeg_colour.py --data DATA [DATA ...] --out FILE.json [--quality 92]

Held-out photographs of rendered data sets are compressed with colour at half the resolution
(4:2:0), with blocks at several places, and decoded: with smooth colour, as libjpeg does, and with
the edges of brightness, as `imaging/chroma.py` does. `single` is the mean squared error of a
photograph, relative to its light; `mean` that of the mean of all places, which is what many views
of a surface leave: errors of blocks average, those at edges of colour do not. Pixels that are
nearly black or white do not count.
"""

from __future__ import annotations

import argparse
from io import BytesIO
from pathlib import Path
from typing import Any

import here

import numpy as np
from cameras import about_data
from PIL import Image

from unbake import backend
from unbake.dataset.views import Dataset, read_photograph
from unbake.imaging.chroma import with_sharp_colour
from unbake.imaging.pictures import tonemap
from unbake.imaging.srgb import from_srgb
from unbake.io import write_json
from unbake.machine import machine

#: Where blocks begin, in pixels.
PLACES = ((0, 0), (3, 5), (6, 2), (1, 7), (4, 4), (7, 1))
#: Of white, between which pixels count, and what is added to the light that errors are relative to.
LEAST, MOST, BESIDE = 0.01, 0.9, 0.02


def main() -> None:
    """Compress, print the errors, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--quality", type=int, default=92)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    rows: list[dict[str, Any]] = []
    for data in args.data:
        views = Dataset.load(data).heldout
        found = [errors(read_photograph(view)[..., :3], args.quality) for view in views]
        for kind in found[0]:
            single, mean = np.mean([row[kind] for row in found], axis=0)
            rows.append({"data": data.name, "colour": kind, "single": single, "mean": mean})
            print(f"{data.name}, {kind}: single {single:.5f}, mean {mean:.5f}", flush=True)
    about = {"machine": machine(), "data": [about_data(data) for data in args.data]}
    write_json(args.out, about | {"quality": args.quality, "places": PLACES, "rows": rows})


def errors(photograph: np.ndarray, quality: int) -> dict[str, tuple[float, float]]:
    """`single` and `mean` of a photograph, linear RGB, for each kind of colour."""
    light = np.maximum(photograph / np.quantile(photograph.max(-1), 0.99), 0)
    counted = (light.max(-1) < MOST) & (light.max(-1) > LEAST)
    relative_to = light.mean(-1, keepdims=True) + BESIDE
    decoded: dict[str, list[np.ndarray]] = {"smooth": [], "edges": []}
    for place in PLACES:
        file = BytesIO()
        codes = tonemap(np.roll(light, place, (0, 1)).astype(np.float32))
        Image.fromarray(codes).save(file, "JPEG", quality=quality, subsampling="4:2:0")
        with Image.open(file) as image:
            decoded["smooth"].append(np.array(image.convert("RGB")))
        with Image.open(file) as image:
            image.draft("YCbCr", image.size)
            decoded["edges"].append(with_sharp_colour(np.array(image), 2, 2))
    found = {}
    for kind, pictures in decoded.items():
        back = [
            np.roll(from_srgb(codes / 255), (-y, -x), (0, 1))
            for codes, (y, x) in zip(pictures, PLACES, strict=True)
        ]
        wrong = [((x - light) / relative_to)[counted] for x in (*back, np.mean(back, axis=0))]
        squares = [float(np.mean(np.square(x))) for x in wrong]
        found[kind] = (float(np.mean(squares[:-1])), squares[-1])
    return found


if __name__ == "__main__":
    main()
