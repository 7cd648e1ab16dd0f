"""Path traced pictures of a scene, and how near they come to photographs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..dataset.views import View, read_photograph
from ..imaging import perceptual
from ..imaging.metrics import mean_psnr, psnr
from ..imaging.pictures import encoded, fitting_exposure, sample
from ..progress import each_told
from ..transport.render import render_radiance
from ..transport.vertex import SceneView
from .settings import EvaluationSettings, RenderSettings

#: Scores of a rendering; those of materials come after them.
METRICS = ("render_psnr", "render_psnr_unclamped", "render_ssim", "render_flip")
#: How many pixels of a rendering are not finite; a view without any has no such key.
NOT_FINITE = "not_finite"
#: Stops of `display_exposure` beyond which a peak of 1 is that of no photograph.
_FAR = 3.0
#: Samples a pixel below which the noise of a rendering outweighs errors of a fit, as a rule.
_FEW = 16
#: What they are; `display_exposure` stands beside them.
DEFINITIONS = {
    "render_ssim": "structural similarity of rendering and photograph as sRGB, clipped, at "
    "`display_exposure` stops; 1: equal. Gaussian window of 11 x 11 pixels with sigma 1.5, K1 "
    "0.01, K2 0.03, mirrored borders; mean over channels and unmasked pixels, then over views. In "
    "windows around these the rendering has the masked pixels of the photograph: they differ in "
    "nothing",
    "render_flip": "LDR-FLIP of the same pictures at 67 pixels a degree: how visible the "
    "difference is, from 0, not at all, to 1; mean over unmasked pixels, then over views. Masked "
    "pixels are as for render_ssim",
    NOT_FINITE: "pixels of a rendering that count and are not numbers: scores leave them out",
    "display_exposure": "stops: the 95th percentile of the photographs' radiance becomes about 0.8",
    "scored": "how many views a mean is of, where it is not of all `views`: in the others no pixel "
    "counts, or the truth is not known",
}


def render_camera(
    scene_view: SceneView,
    camera: Camera,
    settings: EvaluationSettings | RenderSettings,
    hide_emitters: bool,
    seed: int = 1,
    done: Callable[[float], object] | None = None,
) -> np.ndarray:
    """What a camera sees with full global illumination.

    Args:
        scene_view: what is seen.
        camera: of the picture.
        settings: how it is rendered.
        hide_emitters: whether emitters that are seen directly are left out.
        seed: of all random numbers.
        done: called with the share of the picture that is rendered, after each wavefront.

    Returns:
        Linear RGB, float32, (H, W, 3).
    """
    rays = CameraRays.of([camera])
    return render_radiance(
        scene_view,
        rays.through,
        rays.pixels,
        settings.spp,
        seed=seed,
        max_depth=settings.max_depth,
        rr_depth=settings.rr_depth,
        hide_emitters=hide_emitters,
        done=done,
    ).reshape(camera.height, camera.width, 3)


def photographs_of(
    views: Sequence[View], clip_negative: bool, tell: Callable[[str], None]
) -> Iterator[np.ndarray]:
    """The photographs of views, one after the other; linear RGB and alpha, (H, W, 4).

    Args:
        views: whose photographs are read.
        clip_negative: take negative pixels as zero.
        tell: called with how many were read, every few seconds.

    Raises:
        UserError: an image cannot be used.
    """
    count = len(views)
    read = (read_photograph(view, clip_negative) for view in views)
    return each_told(read, count, lambda n: f"reading photographs: {n} of {count}", tell)


def samples_of(camera: Camera, settings: EvaluationSettings | RenderSettings) -> int:
    """Camera samples of a picture."""
    return camera.width * camera.height * settings.spp


def told_unit(exposure: float | None) -> str | None:
    """A line where PSNRs of renderings say little, as photographs are far from their white, 1.

    Args:
        exposure: as `display_exposure`; None: there is none.
    """
    if exposure is None or abs(exposure) <= _FAR:
        return None
    far = "darker than white, 1" if exposure > 0 else "brighter than white, 1"
    return f"photographs are far {far}: render_psnr says little here; see render_ssim, render_flip"


def told_noise(spp: int) -> str | None:
    """A line where renderings of so many samples a pixel differ from photographs by noise first."""
    if spp >= _FEW:
        return None
    return f"scores of renderings are those of the noise of {spp} samples a pixel: raise --spp"


def render_scores(
    radiance: np.ndarray, photograph: np.ndarray, mask: np.ndarray, exposure: float
) -> dict[str, float | None]:
    """The scores of `METRICS` of a rendering (H, W, 3); see `DEFINITIONS`.

    Args:
        radiance: linear RGB.
        photograph: linear RGB, the same size.
        mask: (H, W) bool, the pixels that count. SSIM and FLIP see the photograph in the others.
        exposure: stops, of SSIM and FLIP alone.

    Returns:
        None for each score where no pixel counts. Pixels of the rendering that are not finite do
        not; where there are some, `NOT_FINITE` is how many.
    """
    counted = mask & finite_pixels(radiance)
    lost = int(np.count_nonzero(mask)) - int(np.count_nonzero(counted))
    told: dict[str, float | None] = {NOT_FINITE: lost} if lost else {}
    if not counted.any():
        return dict.fromkeys(METRICS) | told
    compared = np.where(counted[..., None], radiance, photograph)
    image, reference = (encoded(x, exposure) for x in (compared, photograph))
    return {
        "render_psnr": render_psnr(radiance, photograph, counted),
        "render_psnr_unclamped": psnr(radiance, photograph, counted),
        "render_ssim": float(perceptual.ssim(image, reference)[counted].mean()),
        "render_flip": float(perceptual.flip(image, reference)[counted].mean()),
    } | told


def render_psnr(radiance: np.ndarray, photograph: np.ndarray, mask: np.ndarray) -> float | None:
    """The score `render_psnr` alone; arguments and None as of `render_scores`."""
    counted = mask & finite_pixels(radiance)
    return psnr(radiance.clip(0, 1), photograph.clip(0, 1), counted) if counted.any() else None


def finite_pixels(picture: np.ndarray) -> np.ndarray:
    """The pixels of a picture (H, W, C) all of whose channels are finite, (H, W) bool."""
    return np.asarray(np.isfinite(picture).all(axis=2))


def told_not_finite(row: Mapping[str, Any]) -> str | None:
    """That pixels of a view are left out of its scores, as they are not finite; None: none are."""
    lost = row.get(NOT_FINITE)
    if not lost:
        return None
    return f"{lost} {'pixel is' if lost == 1 else 'pixels are'} not finite and left out"


def mean_scores(rows: Sequence[Mapping[str, Any]], keys: Iterable[str]) -> dict[str, Any]:
    """The number of `views`, and the mean of each score over those that have it.

    Args:
        rows: a view each, with all keys.
        keys: of the scores.
    """
    return {"views": len(rows)} | {key: mean_psnr(row[key] for row in rows) for key in keys}


def scored_views(rows: Sequence[Mapping[str, Any]], keys: Iterable[str]) -> dict[str, int]:
    """How many views have a score, of scores that some have and others lack; see `mean_scores`."""
    counts = {key: sum(row[key] is not None for row in rows) for key in keys}
    return {key: count for key, count in counts.items() if 0 < count < len(rows)}


def exposure_of(photographs: Iterable[np.ndarray]) -> float:
    """The exposure in stops that suits photographs (H, W, 4), linear RGB and alpha."""
    return fitting_exposure(
        [sample(x[..., :3].mean(axis=2)[x[..., 3] >= 0.5]) for x in photographs]
    )
