"""How good a run is: its materials and its renderings against the photographs and the truth."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..data.batches import CameraRays
from ..data.views import View, read_image
from ..fit.recovered import Recovered, load_run
from ..imaging.metrics import mean_psnr, psnr
from ..imaging.pictures import to_bytes, tonemap, write_atomically, write_exr, write_png
from ..transport.render import render_materials, render_radiance

DEFINITIONS = {
    "psnr": "10 log10(1 / MSE), peak 1; MSE over unmasked pixels and channels of a view; the "
    "value of a split is the mean over its views. Renderings: both pictures clipped to [0,1], "
    "because one caustic pixel of a photograph would decide all; render_psnr_unclamped does not. "
    "Albedo and roughness are not clipped",
    "colour_space": "linear RGB; roughness is perceptual (GGX alpha = roughness squared)",
    "mask": "pixels all of whose samples see a material that is sought: emitters, mirrors, glass "
    "and background are left out; without truth images every foreground pixel counts",
}


METRICS = ("render_psnr", "render_psnr_unclamped", "albedo_psnr", "roughness_psnr")


@dataclass(frozen=True)
class EvaluationSettings:
    """How the recovered scene is rendered."""

    spp: int = 64  #: camera samples a pixel
    max_depth: int = 48  #: bounces, plus one; specular ones are not counted
    rr_depth: int = 5  #: bounces before Russian roulette
    train_views: int = 4  #: training views to render; all held-out views are rendered
    material_spp: int = 16  #: camera samples a pixel of the albedo and roughness pictures
    clip_negative: bool = False  #: take negative pixels as zero; also where the fit did


def evaluate(
    run: Path,
    settings: EvaluationSettings | None = None,
    *,
    tell: Callable[[str], None] = print,
) -> dict:
    """Render a run's views with the recovered materials and compare.

    Renderings are path traced with full global illumination; the radiance field plays no part.

    Args:
        run: folder of a fit.
        settings: how to render.
        tell: called with lines of progress.

    Returns:
        What it writes to `evaluation/metrics.json`; pictures go beside it.

    Raises:
        UserError: the run or its data set cannot be read.

    Paper: Sec. 6, Fig. 6.
    """
    settings = settings or EvaluationSettings()
    recovered = load_run(run)
    dataset = recovered.dataset
    spread = np.linspace(0, len(dataset.train) - 1, min(settings.train_views, len(dataset.train)))
    views = [*dataset.heldout, *(dataset.train[i] for i in sorted({round(x) for x in spread}))]
    rows = []
    for view in views:
        row = _evaluate_view(recovered, view, run / "evaluation" / view.split, settings)
        rows.append(row)
        values = (f"{k.removesuffix('_psnr')} {_db(row[k])}" for k in row if k.endswith("_psnr"))
        tell(f"{view.name}: {', '.join(values)}")
    metrics = {
        "method": recovered.config.method,
        "steps": recovered.progress.step,
        "samples": recovered.progress.samples,
        "seconds": round(recovered.progress.seconds, 2),
        "heldout": _summary(rows, "heldout"),
        "train": _summary(rows, "train"),
        "per_view": rows,
        "definitions": DEFINITIONS,
        "data": str(dataset.folder),
        "render": {"spp": settings.spp, "max_depth": settings.max_depth},
    }
    text = json.dumps(metrics, indent=1) + "\n"
    write_atomically(run / "evaluation" / "metrics.json", lambda p: Path(p).write_text(text))
    return metrics


def _evaluate_view(
    recovered: Recovered, view: View, folder: Path, settings: EvaluationSettings
) -> dict:
    problem, camera = recovered.problem, view.camera
    shape = (camera.height, camera.width)
    rays = CameraRays.of([camera])
    radiance = render_radiance(
        problem.world,
        rays.through,
        rays.pixels,
        settings.spp,
        seed=1,
        max_depth=settings.max_depth,
        rr_depth=settings.rr_depth,
        see_environment=problem.see_environment,
    ).reshape(*shape, 3)
    albedo, roughness, coverage = render_materials(
        problem.world, rays.through, rays.pixels, settings.material_spp, seed=1
    )
    albedo, roughness = albedo.reshape(*shape, 3), roughness.reshape(shape)
    grey = np.repeat(roughness[..., None], 3, -1)
    alpha = coverage.reshape(*shape, 1)
    for name, picture in {"render": radiance, "albedo": albedo, "roughness": grey}.items():
        write_exr(folder / f"{view.name}_{name}.exr", np.concatenate([picture, alpha], -1))
        write_png(
            folder / f"{view.name}_{name}.png",
            to_bytes(picture) if name == "roughness" else tonemap(picture),
        )

    clip = settings.clip_negative or recovered.clip_negative
    photograph = _read(view.image, view, clip)
    row = {"name": view.name, "split": view.split}
    if view.albedo is None or view.roughness is None:
        mask = photograph[..., 3] >= 1
        row |= _render_psnr(radiance, photograph[..., :3], mask)
        return row | {"albedo_psnr": None, "roughness_psnr": None}
    true_albedo, true_roughness = _read(view.albedo, view), _read(view.roughness, view)
    mask = (true_albedo[..., 3] >= 1) & (alpha[..., 0] >= 1)
    if not mask.any():
        return row | dict.fromkeys(METRICS)
    row |= _render_psnr(radiance, photograph[..., :3], mask)
    return row | {
        "albedo_psnr": _finite(psnr(albedo, true_albedo[..., :3], mask)),
        "roughness_psnr": _finite(psnr(roughness, true_roughness[..., 0], mask)),
    }


def _render_psnr(radiance: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> dict:
    return {
        "render_psnr": _finite(psnr(radiance.clip(0, 1), photograph.clip(0, 1), mask)),
        "render_psnr_unclamped": _finite(psnr(radiance, photograph, mask)),
    }


def _read(image: Path, view: View, clip_negative: bool = False) -> np.ndarray:
    """An image of a view, (height, width, 4)."""
    width, height = view.camera.width, view.camera.height
    return read_image(image, width, height, clip_negative).reshape(height, width, 4)


def _summary(rows: list[dict], split: str) -> dict:
    chosen = [row for row in rows if row["split"] == split]
    return {"views": len(chosen)} | {k: mean_psnr(row[k] for row in chosen) for k in METRICS}


def _finite(value: float) -> float | None:
    # JSON has no infinity; two equal pictures have no number to compare.
    return value if math.isfinite(value) else None


def _db(value: float | None) -> str:
    return "—" if value is None else f"{value:.1f} dB"
