"""What photographs tell of roughness, by what is known of where it is one.

    python benchmarks/roughness_regions.py --runs RUN [RUN ...] [--pixels 131072] [--spp 64]
        --out FILE.json

At the end of each run pixels are sampled as for one more search, with albedo eliminated. Pixels of
a region are taken to share what is wrong of their roughness: each region moves by what is to be
expected of it, from a normal distribution about no change. Regions are

- pieces of surface;
- those parts of them that are of one colour of the albedo, which a fit knows;
- those that are of one true roughness, to 0.02, which no fit knows;
- those parts of these that lie in one cell of the scene's cube, 1/8 of its edge wide.

Told are PSNRs in dB of roughness at the sampled pixels, as it is expected, and with the true mean
in each region: the first is bounded by noise and by the radiance field, the second by the regions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import here

import numpy as np
from piece_levels import finite
from roughness_limits import (
    colours_of,
    in_units_of_variance,
    means_of,
    numbered,
    outputs_at,
    psnr,
    roughness_at,
    told_of_runs,
)

from unbake.config import RoughnessSearchConfig

#: Expected standard deviation of what is wrong of a region, of outputs before their bounds.
SPREAD = 0.3
#: By how much regions are moved on trial, in the same units.
SHIFTS = np.linspace(-2, 2, 81)
#: Width of the bins of true roughness, and cells along the scene's cube.
BIN, CELLS = 0.02, 8


def main() -> None:
    """Sample every run, and tell the PSNR of each kind of regions."""
    told_of_runs(__doc__.splitlines()[0], regions_of, 1 << 17, 64)


def regions_of(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """The PSNRs of a run by kind of regions in dB, and what the run is.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training.roughness_curves import Curves

    run, steps, rows, truth, shared = in_units_of_variance(folder, pixels, spp)
    search = RoughnessSearchConfig()
    curves = Curves.of(rows, search.cells, search.colours, albedo=True)
    outputs = outputs_at(shared.values.astype(float))
    told = [
        {
            "kind": name,
            "regions": int(region.max()) + 1,
            "expected": psnr(roughness_at(expected(curves, outputs, region, search)), truth),
            "true means": finite(psnr(means_of(truth, region), truth)),
        }
        for name, region in kinds(rows, truth).items()
    ]
    name, fitted = run.dataset.folder.name, psnr(shared.values, truth)
    lines = (f"{row['kind']} {row['expected']:.2f} dB" for row in told)
    print(", ".join([name, f"as fitted {fitted:.2f} dB", *lines]), flush=True)
    about = {"data": name, "steps": steps, "pixels": len(rows)}
    return about | {"as fitted": fitted, "kinds": told}


def kinds(rows: np.ndarray, truth: np.ndarray) -> dict[str, np.ndarray]:
    """The region of each pixel, from 0, by kind of regions."""
    piece, level = rows["piece"][:, None], np.floor(truth / BIN)[:, None]
    cell = np.floor(rows["position"] * CELLS)
    columns = {
        "pieces": (piece,),
        "colours": (piece, colours_of(rows)),
        "one roughness": (piece, level),
        "one roughness in cells": (piece, level, cell),
    }
    return {name: numbered(*parts) for name, parts in columns.items()}


def expected(
    curves: Any, outputs: np.ndarray, region: np.ndarray, settings: RoughnessSearchConfig
) -> np.ndarray:
    """Outputs before their bounds, with each region moved to what is to be expected, shape (n,)."""
    from unbake.training.piece_levels import errors_of
    from unbake.training.seen_pieces import chances, normalized

    sums = [np.bincount(region, errors_of(curves, outputs + by)) for by in SHIFTS]
    chance = chances(np.stack(sums, 1), np.bincount(region), settings)
    by = normalized(chance * np.exp(-((SHIFTS / SPREAD) ** 2) / 2)) @ SHIFTS
    return outputs + by[region]


if __name__ == "__main__":
    main()
