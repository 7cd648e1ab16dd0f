"""What searches do with pieces of surface that no pixel shows by itself.

    python benchmarks/untold_pieces.py --runs RUN [RUN ...] [--pixels 131072] [--spp 64]
        --out FILE.json

A search can use those pixels alone that show a single piece of surface. Pieces that are smaller
have no curve. Each run is one without searches (`[roughness_search] times = 0`). At its end
roughness is searched for twice with the same samples: such pieces stay as the descent leaves them,
or go to what is to be expected of their colour, which is the default. Told are the share of what
photographs show that is of such pieces, and the roughness of held-out views, PSNR in dB.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import here

import numpy as np
from piece_middles import replaced, searchable
from roughness_limits import told_of_runs

from unbake.config import RoughnessSearchConfig


def main() -> None:
    """Search in every run, and tell both variants."""
    told_of_runs(__doc__.splitlines()[0], untold_of, 1 << 17, 64)


def untold_of(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """The roughness of a run after a search, without and with its untold pieces.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training.roughness_curves import Curves, pieces_of
    from unbake.training.roughness_search import searched
    from unbake.training.validation import Score

    run, steps, rows, places = searchable(folder, pixels, spp)
    search = RoughnessSearchConfig()
    curves = Curves.of(rows, search.cells, search.colours, True, shown=places)
    score = Score(run.problem, run.dataset.heldout)
    rate = search.rate * run.config.material_settings["roughness"].learning_rate

    def told(pieces: Any) -> float:
        field = run.problem.materials["roughness"]
        found = searched(field, replace(curves, pieces=pieces), search, rate)
        with replaced(run, "roughness", found):
            return score.measure()["roughness_psnr"]

    found = {
        "as fitted": score.measure()["roughness_psnr"],
        "as the descent leaves them": told(pieces_of(rows)),
        "by their colour": told(curves.pieces),
    }
    name = run.dataset.folder.name
    untold = ~np.isin(places["piece"], rows["piece"])
    print(name, f"{untold.mean():.1%}", found, flush=True)
    return {
        "data": name,
        "steps": steps,
        "pixels": len(rows),
        "pieces": len(np.unique(rows["piece"])),
        "untold_pieces": len(np.unique(places["piece"][untold])),
        "untold_share": float(untold.mean()),
        "roughness_psnr": found,
    }


if __name__ == "__main__":
    main()
