"""Where the photometric loss of parts of a scene has its minimum, as a function of their roughness.

    python benchmarks/roughness_curves.py --run RUN [--pixels 80000] [--spp 128] --out FILE.json

Parts are pixels of one piece of surface and of one true roughness, to 0.04, which no fit knows. The
radiance field is that of the run. Albedo is as it was fitted, or eliminated for each roughness, as
a search does it. What differs between the two is what holds roughness back.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import here

import numpy as np

from unbake import backend
from unbake.io import write_json
from unbake.machine import machine

#: Width of the bins of true roughness.
BIN = 0.04
#: Parts with fewer of the pixels are not shown.
FEWEST = 1000
#: Resampled parts, whose spread is that of a minimum.
RESAMPLED = 20


def main() -> None:
    """Sample the curves of a run, and tell their minima."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=Path, required=True, help="folder of a fit")
    parser.add_argument("--pixels", type=int, default=80_000)
    parser.add_argument("--spp", type=int, default=128)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    from unbake.training.problem import pixels_of
    from unbake.training.roughness_curves import (
        NODES,
        groups,
        losses_by_roughness,
        squared_errors,
    )
    from unbake.training.search_samples import SearchSamples
    from unbake.training.step import TrainingStep
    from unbake.training.truth_fit import TrueMaps

    run, steps = opened(args.run)
    pixels = pixels_of(run.dataset, run.config, clip_negative=run.clip_negative)
    samples = SearchSamples(run.problem, TrainingStep(run.problem, pixels, run.config))
    each = 2048
    rows = np.concatenate(
        [
            samples.by_roughness(run.state, (seed, seed), each, args.spp, NODES)
            for seed in range(-(-args.pixels // each))
        ]
    )
    maps = TrueMaps.load(run.dataset, ("roughness",))
    truth = np.full(len(pixels.photographs.table), np.nan, np.float32)
    truth[maps.numbers] = maps.values[:, 0]
    truth = truth[numbers_of(rows["target"], pixels.photographs.table[:, :3])]
    known = np.isfinite(truth)
    rows, roughness = rows[known], truth[known]
    search = run.config.roughness_search
    part = np.unique(np.stack([rows["piece"], roughness // BIN], 1), axis=0, return_inverse=True)
    part = part[1].ravel()
    eliminated = losses_by_roughness(rows, groups(rows, search.cells, search.colours))
    losses = {
        "fitted": squared_errors(rows, np.ones(3)),
        "eliminated": eliminated,
    }
    rng, found = np.random.default_rng(0), []
    for number in np.argsort(-np.bincount(part)):
        chosen = np.flatnonzero(part == number)
        if len(chosen) < FEWEST:
            break
        row = {"piece": int(rows["piece"][chosen[0]]), "pixels": len(chosen)}
        row["true"] = float(roughness[chosen].mean())
        for name, values in losses.items():
            row[name] = minimum(values[chosen], NODES)
            again = [
                minimum(values[rng.choice(chosen, len(chosen))], NODES) for _ in range(RESAMPLED)
            ]
            row[f"{name}_sd"] = float(np.std(again, ddof=1))
        found.append(row)
        told = ", ".join(f"{name} {row[name]:.3f} ± {row[f'{name}_sd']:.3f}" for name in losses)
        print(f"piece {row['piece']}, {row['pixels']} pixels, {row['true']:.3f}: {told}")
    result = {"machine": machine(), "data": run.dataset.folder.name, "method": run.config.method}
    result |= {"steps": steps, "pixels": len(rows), "spp": args.spp}
    write_json(args.out, result | {"searches": search.times, "rows": found})


def opened(folder: Path) -> tuple[Any, int]:
    """A run with the fields of its checkpoint, and how many steps it has taken."""
    from unbake.training.checkpoint import load_checkpoint
    from unbake.training.recovered import open_run

    run = open_run(folder)
    progress = load_checkpoint(run.folder, run.state)
    run.state.publish(run.problem)
    return run, progress.step if progress else 0


def numbers_of(targets: np.ndarray, table: np.ndarray) -> np.ndarray:
    """The numbers of pixels by their photographs, which differ in their noise."""
    every = np.concatenate([table, targets]).astype(np.float32)
    kind = np.unique(every, axis=0, return_inverse=True)[1].ravel()
    number = np.empty(kind.max() + 1, np.int64)
    number[kind[: len(table)]] = np.arange(len(table))
    return number[kind[len(table) :]]


def minimum(losses: np.ndarray, nodes: tuple[float, ...]) -> float:
    """Where the sum of curves is least: at the vertex of the parabola around the least node."""
    total, x = losses.sum(0), np.log(nodes)
    least = int(total.argmin())
    if least in (0, len(nodes) - 1):
        return float(nodes[least])
    a, b, _ = np.polyfit(x[least - 1 : least + 2], total[least - 1 : least + 2], 2)
    return float(np.exp(-b / (2 * a)))


if __name__ == "__main__":
    main()
