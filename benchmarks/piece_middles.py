"""What searches take from the albedo of pieces, by what these vary about.

    python benchmarks/piece_middles.py --runs RUN [RUN ...] [--pixels 32768] [--spp 64]
        --out FILE.json

A search can use those pixels alone that show a single piece of surface: of a leaf its broad parts.
Each run is one without searches (`[roughness_search] times = 0`), from which nothing was taken. At
its end the albedo of pieces is let vary as much as samples say, with roughness as it is: about the
median over the pixels that can be used, and about that over any pixels, which is the default. Told
are the albedo of the held-out views, PSNR in dB of linear RGB; the share of the variance within
pieces that is kept, over all pixels of pieces that can be used; and by how much the two medians
differ, linear RGB, root mean square over these.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import here

import numpy as np
from roughness_curves import opened
from roughness_limits import AT_ONCE, means_of, told_of_runs

from unbake.config import RoughnessSearchConfig


def main() -> None:
    """Let the albedo of every run vary less, and tell what is left of it."""
    told_of_runs(__doc__.splitlines()[0], middles_of, 1 << 15, 64)


def middles_of(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """What is left of a run's albedo, by the median that pieces vary about.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.training.piece_variation import expected_albedo
    from unbake.training.roughness_curves import pieces_of, points, roughness_of
    from unbake.training.seen_pieces import SeenPieces, values_of
    from unbake.training.validation import Score

    run, steps, rows, places = searchable(folder, pixels, spp)
    roughness = roughness_of(run.problem.materials["roughness"], points(rows, albedo=True)).numpy()
    field, shown = run.problem.materials["albedo"], points(places, albedo=False)
    seen = SeenPieces(field, points(rows, albedo=False), pieces_of(rows), {})
    by_rows = values_of(seen.middles(points(rows, albedo=False)))
    by_any = values_of(seen.middles(shown))
    known = np.isin(places["piece"], rows["piece"])
    piece = places["piece"][known]
    number = np.searchsorted(np.unique(rows["piece"]), piece)
    score = Score(run.problem, run.dataset.heldout)

    def told(found: dict[str, Any]) -> dict[str, float]:
        with replaced(run, "albedo", found):
            values = np.array([np.array(x, float) for x in field.evaluate(shown)])[:, known]
            variance = np.mean([np.square(x - means_of(x, piece)).mean() for x in values])
            psnr = score.measure()["albedo_psnr"]
        return {"albedo_psnr": psnr, "variance": float(variance)}

    search = RoughnessSearchConfig()
    variants = {
        "as fitted": told({}),
        "pixels that can be used": told(expected_albedo(field, rows, roughness, search)),
        "any pixels": told(expected_albedo(field, rows, roughness, search, places)),
    }
    fitted = variants["as fitted"]["variance"]
    for variant in variants.values():
        variant["variance_kept"] = variant.pop("variance") / fitted
    name = run.dataset.folder.name
    print(name, variants, flush=True)
    apart = (by_rows - by_any)[:, number]
    return {
        "data": name,
        "steps": steps,
        "pixels": len(rows),
        "pieces": len(np.unique(rows["piece"])),
        "medians_apart": float(np.sqrt(np.square(apart).mean())),
        "variants": variants,
    }


@contextmanager
def replaced(run: Any, name: str, found: dict[str, Any]) -> Iterator[None]:
    """Meanwhile the field of a quantity has other numbers."""
    before = dict(run.state.phi.items())
    run.state.replace({f"{name}.{key}": x for key, x in found.items()})
    run.state.publish(run.problem)
    yield
    run.state.replace(before)
    run.state.publish(run.problem)


def searchable(folder: Path, pixels: int, spp: int) -> tuple[Any, int, np.ndarray, np.ndarray]:
    """A run without searches, and what one of it would sample.

    Args:
        folder: of the run.
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.

    Returns:
        The run, its steps, samples whose weights are inverse variances, and places of any pixels.
    """
    from unbake.training.problem import pixels_of
    from unbake.training.roughness_curves import NODES, points, precision, roughness_of
    from unbake.training.search_samples import SearchSamples
    from unbake.training.step import TrainingStep, without_garbage_collection

    run, steps = opened(folder)
    if run.config.roughness_search.times:
        raise SystemExit(f"{folder}: its searches have taken something already")
    photographs = pixels_of(run.dataset, run.config, clip_negative=run.clip_negative)
    samples = SearchSamples(run.problem, TrainingStep(run.problem, photographs, run.config))
    each = min(pixels, AT_ONCE // spp)
    with without_garbage_collection():
        rows = np.concatenate(
            [
                samples.by_roughness(run.state, (2 * number, 2 * number + 1), each, spp, NODES)
                for number in range(-(-pixels // each))
            ]
        )
        places = samples.places(run.state, (1, 0), min(4 * pixels, AT_ONCE))
    present = roughness_of(run.problem.materials["roughness"], points(rows, albedo=True)).numpy()
    rows["weight"] *= precision(rows, present)
    return run, steps, rows, places


if __name__ == "__main__":
    main()
