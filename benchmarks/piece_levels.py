"""What a search finds of roughness: where it is most probable, and as is expected of pieces.

    python benchmarks/piece_levels.py --runs RUN [RUN ...] [--pixels 131072] [--spp 64]
        --out FILE.json

One more search is made at the end of each run, of samples that all variants share. Told is the
roughness of these pixels against the true one, PSNR in dB:

- as it was fitted;
- where the search's descent ends;
- with each piece of surface moved to what is to be expected of it: as one crowd, in which next to
  none has a material of its own; by what all pieces show, its odd ones too; and with the default,
  odd pieces by what the others show without them;
- with each piece varying as much as is to be expected of it, and then moved so: the default;
- with each piece moved to its true mean, which no fit knows: the most that moving pieces can give;
- with one roughness, the true mean, on each piece: what is left is how much it truly varies there.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import here

import numpy as np
from roughness_limits import (
    in_units_of_variance,
    means_of,
    outputs_at,
    psnr,
    roughness_at,
    told_of_runs,
)

from unbake.config import RoughnessSearchConfig

#: How much a material of its own counts, in pieces, where next to none has one.
SELDOM = 0.02
#: A piece counts as moved if its mean roughness did by more.
MOVED = 0.01


def main() -> None:
    """Search in every run, and tell the PSNR of each variant."""
    told_of_runs(__doc__.splitlines()[0], levels_of, 1 << 17, 64)


def levels_of(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """The PSNRs of a run's variants in dB, by name, and what the run is.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training import piece_levels
    from unbake.training.roughness_curves import Curves

    run, steps, rows, roughness, shared = in_units_of_variance(folder, pixels, spp)
    search = RoughnessSearchConfig()
    probable = shared.searched(rows, settings=replace(search, pixels_as_one=0))
    curves = Curves.of(rows, search.cells, search.colours, albedo=True)
    values = shared.values_with(probable)
    leveled = piece_levels.with_expected_levels
    with patch.object(piece_levels, "_NEW", SELDOM):
        crowd = leveled(shared.field, curves, probable, search)
    with patch.object(piece_levels, "_MOST_ODD", 0):
        echoing = leveled(shared.field, curves, probable, search)
    levels = leveled(shared.field, curves, probable, search)
    told = {
        "as fitted": shared.score({}),
        "most probable": shared.score(probable),
        "one crowd": shared.score(crowd),
        "odd ones too": shared.score(echoing),
        "levels": shared.score(levels),
        "expected": shared.score(shared.searched(rows, settings=search)),
        "true means": psnr(at_means(values, rows["piece"], roughness), roughness),
        "one true roughness": finite(psnr(means_of(roughness, rows["piece"]), roughness)),
    }
    name = run.dataset.folder.name
    lines = (f"{key} {np.inf if x is None else x:.2f} dB" for key, x in told.items())
    print(", ".join([name, *lines]), flush=True)
    about = {"data": name, "steps": steps, "pixels": len(rows)}
    moved = moved_pieces(
        rows["piece"], roughness, shared.values_with(echoing), shared.values_with(levels)
    )
    return about | {
        "pieces": len(np.unique(rows["piece"])),
        "roughness_psnr": told,
        "odd": moved,
    }


def finite(decibels: float) -> float | None:
    """A PSNR; None where there is no error."""
    return decibels if np.isfinite(decibels) else None


def moved_pieces(
    pieces: np.ndarray, truth: np.ndarray, echoing: np.ndarray, levels: np.ndarray
) -> list[dict[str, float]]:
    """Pieces that the others judge otherwise without them, those that moved the most first.

    Args:
        pieces: the number of each pixel's piece, shape (n,).
        truth: roughness of pixels, shape (n,).
        echoing, levels: as `truth`, as found by what all pieces show, and without odd ones.

    Returns:
        Of each, pixels and the means of the three.
    """
    numbers, piece, pixels = np.unique(pieces, return_inverse=True, return_counts=True)
    true, before, after = (
        np.bincount(piece, values, len(numbers)) / pixels for values in (truth, echoing, levels)
    )
    order = np.argsort(-np.abs(after - before), kind="stable")
    return [
        {
            "pixels": int(pixels[n]),
            "true": float(true[n]),
            "odd ones too": float(before[n]),
            "levels": float(after[n]),
        }
        for n in order[: np.count_nonzero(np.abs(after - before) > MOVED)]
    ]


def at_means(values: np.ndarray, pieces: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Roughness with each piece moved, before bounds, until its mean is the true one, shape (n,).

    Args:
        values: roughness, shape (n,).
        pieces: the number of each pixel's piece, shape (n,).
        truth: as `values`.
    """
    from unbake.training.piece_levels import SHIFTS

    found = values.copy()
    for piece in np.unique(pieces):
        own = pieces == piece
        outputs = outputs_at(values[own])
        means = [roughness_at(outputs + by).mean() for by in SHIFTS]
        by = float(np.interp(truth[own].mean(), means, SHIFTS))
        found[own] = roughness_at(outputs + by)
    return found


if __name__ == "__main__":
    main()
