"""What photographs tell of roughness that differs within pieces of surface, and what hides it.

    python benchmarks/told_within_pieces.py --runs RUN [RUN ...] [--pixels 65536] [--spp 64]
        --out FILE.json

At the end of a fit, of pixels that one more search samples:

- how much less error the true roughness of each large piece has than its best single one, in units
  of variance (-2 log of how probable it is), with the photographs and with made-up ones of the true
  roughness, under the run's own radiance field and albedo, as noisy as the real ones;
- the PSNR of roughness after the search, with the photographs; with made-up ones of the same noise,
  of half and of a quarter of it, and without; and where samples have no noise, either.

What is told, and not found, the search is to blame for; what is not told, no search can find.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import here

import numpy as np
from roughness_curves import opened
from roughness_limits import made_up, print_scores, psnr, sampled, told_of_runs, without_noise

#: Pieces of fewer pixels are left out of the evidence.
LARGE = 1500
#: Values of a single roughness.
SINGLE = np.linspace(0.12, 0.88, 39)
#: Noise of made-up photographs, as a multiple of that of the real ones.
NOISE = (1.0, 0.5, 0.25, 0.0)


def main() -> None:
    """Tell what photographs say of each run."""
    told_of_runs(__doc__.splitlines()[0], told, 1 << 16, 64)


def told(folder: Path, pixels: int, spp: int) -> dict[str, Any]:
    """What photographs tell of a run.

    Args:
        pixels: how many are sampled; those that searches cannot use are left out.
        spp: camera samples of each.
    """
    from unbake.config import RoughnessSearchConfig
    from unbake.fields.field import holding
    from unbake.training.roughness_curves import Curves, points, precision, roughness_of
    from unbake.training.roughness_search import searched

    run, steps = opened(folder)
    (rows,), true = sampled(run, pixels, (spp,))
    truth, field = true[:, 0], run.problem.materials["roughness"]
    settings, at = RoughnessSearchConfig(), points(rows, albedo=True)
    rate = settings.rate * run.config.material_settings["roughness"].learning_rate

    def values(found: dict[str, Any]) -> np.ndarray:
        with holding(field, found):
            return roughness_of(field, at).numpy()

    fitted = values({})

    def curves(chosen: np.ndarray) -> tuple[np.ndarray, Curves]:
        weighed = chosen.copy()
        weighed["weight"] *= precision(chosen, fitted)
        return weighed, Curves.of(weighed, settings.cells, settings.colours, albedo=True)

    def score(chosen: np.ndarray) -> float:
        weighed, of_pixels = curves(chosen)
        return psnr(values(searched(field, of_pixels, settings, rate, None, weighed)), truth)

    scores = {"fitted": psnr(fitted, truth), "photographs": score(rows)}
    deviation = 1 / np.sqrt(np.maximum(rows["weight"] * precision(rows, truth), 1e-12))
    clean = made_up(rows, truth, rows["albedo"])
    noise = deviation * np.random.default_rng(0).standard_normal(clean.shape)
    made = {part: with_target(rows, clean + part * noise) for part in NOISE}
    scores |= {f"made up, {part:g} of their noise": score(x) for part, x in made.items()}
    exact = without_noise(rows)
    scores["no noise of samples, either"] = score(
        with_target(exact, made_up(exact, truth, exact["albedo"]))
    )
    both = {"photographs": rows, "made_up": made[1.0]}
    found = evidence(rows, truth, {key: curves(x)[1].at for key, x in both.items()})
    name = run.dataset.folder.name
    print_scores(name, scores)
    for piece in found:
        print(name, " ".join(f"{key} {value:.4g}" for key, value in piece.items()), flush=True)
    about = {"data": name, "steps": steps, "pixels": len(rows)}
    return about | {"roughness_psnr": scores, "pieces": found}


def with_target(rows: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The rows with other photographs, shape (n, 3)."""
    found = rows.copy()
    found["target"] = target
    return found


def evidence(
    rows: np.ndarray, truth: np.ndarray, curves: dict[str, Callable[[Any], Any]]
) -> list[dict[str, float]]:
    """What large pieces have less of error with their true roughness than with one alone.

    Args:
        rows: of `row_type`.
        truth: roughness of the pixels, shape (n,).
        curves: errors of pixels at their roughness, by the name of what they were compared with.
    """
    import mitsuba as mi

    from unbake.fields.arrays import from_numpy

    piece, number, pixels = np.unique(rows["piece"], return_inverse=True, return_counts=True)

    def of_pieces(at: Callable[[Any], Any], roughness: np.ndarray) -> np.ndarray:
        errors = at(from_numpy(mi.Float, roughness.astype(np.float32))).numpy()
        return np.bincount(number.ravel(), errors)

    gains = {}
    for name, at in curves.items():
        single = [of_pieces(at, np.full(len(truth), one)) for one in SINGLE]
        gains[name] = np.min(single, 0) - of_pieces(at, truth)
    return [
        {
            "piece": int(piece[i]),
            "pixels": int(pixels[i]),
            "deviation": float(truth[rows["piece"] == piece[i]].std()),
            **{name: float(less[i]) for name, less in gains.items()},
        }
        for i in np.flatnonzero(pixels >= LARGE)
    ]


if __name__ == "__main__":
    main()
