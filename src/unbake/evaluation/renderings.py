"""Path traced pictures of a scene, and how near they come to photographs."""

from __future__ import annotations

import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..imaging.metrics import psnr
from ..training.validation import GroundTruth, MaterialBuffers, finite
from ..transport.render import render_radiance
from ..transport.vertex import SceneView
from .settings import EvaluationSettings, RenderSettings

#: Scores of a rendering; those of materials come after them.
METRICS = ("render_psnr", "render_psnr_unclamped")


def render_camera(
    scene_view: SceneView,
    camera: Camera,
    settings: EvaluationSettings | RenderSettings,
    hide_emitters: bool,
    seed: int = 1,
) -> np.ndarray:
    """What a camera sees with full global illumination.

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
    ).reshape(camera.height, camera.width, 3)


def counted_pixels(
    photograph: np.ndarray, seen: MaterialBuffers | None, truth: GroundTruth | None
) -> np.ndarray:
    """The pixels of a view that scores of its rendering count, (H, W) bool.

    Args:
        photograph: (H, W, 4), with alpha.
        seen: the recovered materials; None where they are known.
        truth: the true ones; None where they are not known: every foreground pixel counts.
    """
    if truth is None:
        return photograph[..., 3] >= 1
    return truth.known if seen is None else seen.mask(truth)


def render_psnr(
    radiance: np.ndarray, photograph: np.ndarray, mask: np.ndarray
) -> dict[str, float | None]:
    """The scores of `METRICS`, in dB, of a rendering (H, W, 3); `mask` must not be empty."""
    return {
        "render_psnr": finite(psnr(radiance.clip(0, 1), photograph.clip(0, 1), mask)),
        "render_psnr_unclamped": finite(psnr(radiance, photograph, mask)),
    }
