"""How many samples of a pixel a search of roughness needs, of the same number of samples in all.

    python benchmarks/search_samples.py --runs RUN [RUN ...] --out FILE.json
        [--samples 4194304] [--spp 16 64 256] [--times 4]

After a finished fit roughness is searched once more, with few samples of many pixels and with many
of few ones, as of `training/roughness_search.py`, several times with other random numbers. Scores
are PSNRs in dB of roughness at the pixels of the first search. The curves' own noise is that of the
roughness at which the loss of all pixels of a piece of surface and of one brightness is least: its
standard deviation over resampled pixels, the median over groups of more than a 256th of all.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import here

import numpy as np
from roughness_curves import opened
from roughness_limits import Shared, sampled

from unbake import backend
from unbake.experiments.seeds import spread
from unbake.io import write_json
from unbake.machine import machine

#: Brightnesses of a piece that are told apart, and times that pixels are resampled.
BRIGHTNESSES, RESAMPLED = 8, 16
#: More than a search has.
_BATCHES = 1 << 16
#: The smallest share of all pixels that a group has.
LEAST_SHARE = 1 / 256


def main() -> None:
    """Search, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=Path, nargs="+", required=True, help="folders of fits")
    parser.add_argument("--samples", type=int, default=1 << 22, help="of a search")
    parser.add_argument("--spp", type=int, nargs="+", default=[16, 64, 256])
    parser.add_argument("--times", type=int, default=4, help="searches of each kind")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    found = [searches_of(run, args.samples, args.spp, args.times) for run in args.runs]
    about = {"machine": machine(), "samples": args.samples, "times": args.times}
    write_json(args.out, about | {"rows": found})


def searches_of(folder: Path, samples: int, spps: list[int], times: int) -> dict[str, Any]:
    """The scores of a run's searches, by their samples a pixel."""
    from unbake.training.roughness_curves import precision

    run, steps = opened(folder)
    (rows,), true = sampled(run, samples // min(spps), (min(spps),))
    seen = Shared(run, rows, true[:, 0])
    found = {"data": run.dataset.folder.name, "steps": steps}
    found |= {"as_fitted": seen.score({}), "searches": []}
    for spp in spps:
        scores, noise = [], []
        for number in range(times):
            (rows,), true = sampled(run, samples // spp, (spp,), _BATCHES * (1 + number))
            rows["weight"] *= precision(rows, Shared(run, rows, true[:, 0]).values)
            scores.append(seen.score(seen.searched(rows)))
            noise.append(noise_of(rows))
        row = {"spp": spp, "pixels": len(rows), "noise": statistics.median(noise)}
        found["searches"].append(row | spread("roughness_psnr", scores) | {"scores": scores})
        told = f"{found['data']}, {spp} samples of {len(rows)} pixels: noise {row['noise']:.3f}, "
        print(told + ", ".join(f"{score:.2f} dB" for score in scores), flush=True)
    return found


def noise_of(rows: np.ndarray) -> float:
    """The standard deviation of the roughness with the least loss, over resampled pixels.

    Args:
        rows: of `row_type`.
    """
    from unbake.config import RoughnessSearchConfig
    from unbake.training.roughness_curves import groups, losses_by_roughness

    settings = RoughnessSearchConfig()
    losses = losses_by_roughness(rows, groups(rows, settings.cells, settings.colours))
    bright = np.sqrt(np.clip(rows["albedo"].mean(1), 0, 1)) * (BRIGHTNESSES - 1)
    group = rows["piece"].astype(np.int64) * BRIGHTNESSES + np.round(bright).astype(np.int64)
    rng, found = np.random.default_rng(0), []
    for number in np.unique(group):
        own = losses[group == number]
        if len(own) >= LEAST_SHARE * len(rows):
            drawn = rng.integers(0, len(own), (RESAMPLED, len(own)))
            found.append(np.std([least(own[places].sum(0)) for places in drawn]))
    return float(np.median(found))


def least(losses: np.ndarray) -> float:
    """Where a loss is least, by a parabola through the three nodes about the smallest value."""
    from unbake.training.roughness_curves import NODES

    middle = int(np.argmin(losses))
    if middle in (0, len(NODES) - 1):
        return NODES[middle]
    near = slice(middle - 1, middle + 2)
    square, slope, _ = np.polyfit(np.log(NODES[near]), losses[near], 2)
    return float(np.exp(-slope / (2 * square)))


if __name__ == "__main__":
    main()
