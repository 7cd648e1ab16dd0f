"""What a search finds of roughness, with pieces where they are most probable and as is expected.

    python benchmarks/piece_levels.py --runs RUN [RUN ...] [--pixels 131072] [--spp 64]
        --out FILE.json

One more search is made at the end of each run, of samples that all variants share. Told is the
roughness of these pixels against the true one, PSNR in dB:

- as it was fitted;
- where the search's descent ends;
- with each piece of surface moved to what is to be expected of it, which is the default;
- with each piece moved to its true mean, which no fit knows: the most that moving pieces can give.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "src"))
os.environ["PYTHONPATH"] = str(ROOT / "src")

from roughness_curves import opened  # noqa: E402
from roughness_limits import Shared, psnr, sampled  # noqa: E402

from unbake import backend  # noqa: E402
from unbake.config import RoughnessSearchConfig  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402


def main() -> None:
    """Search in every run, and tell the PSNR of each variant."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="folders of fits")
    parser.add_argument("--pixels", type=int, default=1 << 17)
    parser.add_argument("--spp", type=int, default=64)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    found = [levels_of(run, args.pixels, args.spp) for run in args.runs]
    write_json(args.out, {"machine": machine(), "spp": args.spp, "rows": found})


def levels_of(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """The PSNRs of a run's variants in dB, by name, and what the run is.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training.roughness_curves import precision

    run, steps = opened(folder)
    (rows,), true = sampled(run, pixels, (spp,))
    roughness = true[:, 0]
    shared = Shared(run, rows, roughness)
    rows["weight"] *= precision(rows, shared.values)
    search = RoughnessSearchConfig()
    probable = shared.searched(rows, settings=replace(search, pixels_as_one=0))
    told = {
        "as fitted": shared.score({}),
        "most probable": shared.score(probable),
        "expected": shared.score(shared.searched(rows, settings=search)),
        "true means": psnr(
            at_means(shared.values_with(probable), rows["piece"], roughness), roughness
        ),
    }
    name = run.dataset.folder.name
    print(", ".join([name, *(f"{key} {value:.2f} dB" for key, value in told.items())]), flush=True)
    about = {"data": name, "steps": steps, "pixels": len(rows)}
    return about | {"pieces": len(np.unique(rows["piece"])), "roughness_psnr": told}


def at_means(values: np.ndarray, pieces: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Roughness with each piece moved, before bounds, until its mean is the true one, shape (n,).

    Args:
        values: roughness, shape (n,).
        pieces: the number of each pixel's piece, shape (n,).
        truth: as `values`.
    """
    from unbake.quantities import QUANTITIES
    from unbake.training.piece_levels import SHIFTS

    quantity, found = QUANTITIES["roughness"], values.copy()
    span = quantity.upper - quantity.lower
    for piece in np.unique(pieces):
        own = pieces == piece
        unit = np.clip((values[own] - quantity.lower) / span, 1e-6, 1 - 1e-6)
        moved = 1 / (1 + (1 / unit - 1) * np.exp(-SHIFTS[:, None]))
        moved = quantity.lower + span * moved
        shift = np.interp(truth[own].mean(), moved.mean(1), SHIFTS)
        found[own] = quantity.lower + span / (1 + (1 / unit - 1) * np.exp(-shift))
    return found


if __name__ == "__main__":
    main()
