"""How much light a coarse mesh leaves in a scene, with its true materials and lights.

    python benchmarks/mesh_light.py --data DATA [DATA ...] --out FILE.json [--keep 1 0.1]
        [--spp 64] [--block 4]

The meshes of a rendered data set keep a share of their triangles (`unbake degrade --decimate`). Its
held-out views are rendered once more and compared with the photographs, blocks of pixels with their
means. Where the ratio is far from 1, the mesh lets light in or keeps it out, and no material
explains the photographs. A share of 1 is the mesh as it was: what noise leaves.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import here

import numpy as np
from cameras import about_data

from unbake import backend
from unbake.acquisition.degrade import degrade
from unbake.acquisition.settings import DegradeSettings
from unbake.dataset.views import Dataset, read_photograph
from unbake.evaluation.settings import EvaluationSettings
from unbake.io import write_json
from unbake.machine import machine
from unbake.scene.parse import parse

QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)


def main() -> None:
    """Render, print the ratios, and write the result."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--keep", type=float, nargs="+", default=[1.0, 0.1])
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel")
    parser.add_argument("--block", type=int, default=4, help="edge of blocks in pixels")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    rows: list[dict[str, Any]] = []
    for data in args.data:
        for share in args.keep:
            ratios = light(data, share, args.spp, args.block)
            found = np.quantile(ratios, QUANTILES).tolist()
            rows.append({"data": data.name, "decimate": share, "ratios": found})
            print(f"{data.name}, {share:g}: {np.round(found, 3).tolist()}", flush=True)
    about = {"machine": machine(), "data": [about_data(data) for data in args.data]}
    about |= {"spp": args.spp, "block": args.block, "quantiles": QUANTILES}
    write_json(args.out, about | {"rows": rows})


def light(data: Path, share: float, spp: int, block: int) -> np.ndarray:
    """Renderings over photographs, by blocks of the held-out views."""
    from unbake.evaluation.renderings import render_camera  # these need the variant
    from unbake.transport.vertex import SceneView

    known = Dataset.load(data)
    with tempfile.TemporaryDirectory() as folder:
        coarse = known
        if share < 1:
            settings = DegradeSettings(decimate=share)
            coarse = degrade(data, Path(folder) / "data", settings, tell=lambda line: None)
        parsed = parse(coarse.scene, coarse.root)
        scene = SceneView.of(parsed.instantiate(), None, 8)
        settings, hidden = EvaluationSettings(spp=spp), coarse.background == "hidden"
        ratios = []
        for view in known.heldout:
            seen = _blocks(render_camera(scene, view.camera, settings, hidden), block)
            shown = _blocks(read_photograph(view)[..., :3] / view.exposure, block)
            told = shown > 0
            ratios.append(seen[told] / shown[told])
    return np.concatenate(ratios)


def _blocks(picture: np.ndarray, edge: int) -> np.ndarray:
    """Means over channels and blocks of pixels."""
    height, width = (size // edge for size in picture.shape[:2])
    parts = picture[: height * edge, : width * edge].reshape(height, edge, width, edge, -1)
    return parts.mean((1, 3, 4))


if __name__ == "__main__":
    main()
