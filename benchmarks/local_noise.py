"""Whether a search of roughness gains from knowing the noise of photographs place by place.

    python benchmarks/local_noise.py --runs RUN [RUN ...] [--pixels 131072] [--spp 64]
        --out FILE.json

A search divides errors by their variance, which it takes to be that of all pixels as bright. But
where light comes by one bounce, photographs have less noise than where it comes by many. Here one
more search is made, with default settings, of the same samples: as it is, and with the variance of
each piece of surface in small cells of space, at the roughness that suits them best, as far as
their pixels tell it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import here

import numpy as np
from roughness_limits import in_units_of_variance, numbered, print_scores, told_of_runs

from unbake.config import RoughnessSearchConfig

#: Cells along an edge of the scene's cube.
CELLS = (8, 16, 32)
#: The variance of all pixels as bright counts as much as so many of a cell.
EXPECTED = 8


def main() -> None:
    """Search with the variance of small cells, and tell the PSNR."""
    told_of_runs(__doc__.splitlines()[0], with_local_noise, 1 << 17, 64)


def with_local_noise(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """The PSNRs of roughness in dB, by name, and what the run is.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    run, steps, rows, _, shared = in_units_of_variance(folder, pixels, spp)
    settings = RoughnessSearchConfig()

    def searched() -> float:
        return shared.score(shared.searched(rows, settings=settings, places=True))

    errors = errors_at_nodes(rows)
    told = {"as fitted": shared.score({}), "by brightness": searched()}
    weight = rows["weight"].copy()
    for cells in CELLS:
        rows["weight"] = weight / local_variance(rows, errors, cells)[:, None]
        told[f"{cells} cells"] = searched()
    name = run.dataset.folder.name
    print_scores(name, told)
    return {"data": name, "steps": steps, "pixels": len(rows), "roughness_psnr": told}


def errors_at_nodes(rows: np.ndarray) -> np.ndarray:
    """Squared errors of pixels in units of their variance, by roughness, shape (n, nodes)."""
    image = rows["gain"][:, None] * (rows["plain"] + rows["coloured"])
    return (rows["weight"][:, None] * (image - rows["target"][:, None]) ** 2).mean(2)


def local_variance(rows: np.ndarray, errors: np.ndarray, cells: int) -> np.ndarray:
    """The variance around each pixel, as a multiple of that of all as bright, shape (n,).

    Args:
        rows: of `row_type`.
        errors: of `errors_at_nodes`.
        cells: along an edge of the scene's cube.
    """
    group = numbered(np.floor(rows["position"] * cells), rows["piece"][:, None])
    count = np.bincount(group)
    sums = np.stack([np.bincount(group, of_node) for of_node in errors.T]).min(0)
    mean = sums.sum() / len(rows)
    return ((EXPECTED * mean + sums) / ((EXPECTED + count) * mean))[group]


if __name__ == "__main__":
    main()
