"""Pictures of both sides of the rendering equation, and how far they are from a reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..acquisition.capture import photographs
from ..acquisition.settings import CaptureSettings
from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..fields.materials import carrying
from ..fields.radiance import RadianceField
from ..transport.path_sample import Requirements, lhs, rhs, trace
from ..transport.render import parts_of, render_radiance
from ..transport.vertex import SceneView
from .settings import SolveSettings, epsilon_at

#: Added to squared pixels of the reference in relMSE.
EPSILON = 0.01
#: One bounce, and L_θ as a constant at either end of it.
_BOTH_SIDES = Requirements(bounces=1, constant=frozenset({1, 2}))
#: Tells the random numbers of pictures from those of the reference.
_PICTURES = 0x5049


@carrying()
def both_sides(
    scene_view: SceneView,
    radiance: RadianceField,
    cameras: Sequence[Camera],
    spp: int,
    seed: int,
    *,
    hide_emitters: bool,
    ended: Callable[[], bool] = lambda: False,
) -> dict[str, list[np.ndarray]]:
    """What cameras see of both sides: `lhs`, E + L_θ at x₁, and `rhs`, one bounce and L_θ at x₂.

    Args:
        spp: samples a pixel.
        ended: asked again and again whether nobody waits for the pictures any more.

    Returns:
        Pictures of each camera, linear RGB, float32, (H, W, 3); nothing where it was ended.

    Paper: Eq. 12, Eq. 13, Sec. 3.1.
    """
    rays = CameraRays.of(cameras)
    images = {side: np.zeros((rays.pixels, 3), np.float32) for side in ("lhs", "rhs")}
    sampler = mi.load_dict({"type": "independent"})
    for part, ray, number in parts_of(rays.through, rays.pixels, spp, seed ^ _PICTURES):
        if ended():
            return {}
        sampler.seed(dr.opaque(mi.UInt32, number), dr.width(ray))
        with dr.suspend_grad():
            sample = trace(
                scene_view, radiance, ray, sampler, _BOTH_SIDES, hide_emitters=hide_emitters
            )
            left, right = lhs(sample, sample.radiance[0]), rhs(sample, sample.radiance[1])
            dr.eval(left, right)
        for side, value in (("lhs", left), ("rhs", right)):
            images[side][part] = np.stack([np.array(dr.block_sum(c, spp)) / spp for c in value], -1)
    return {side: _parted(image, cameras) for side, image in images.items()}


def path_traced_halves(
    scene_view: SceneView,
    cameras: Sequence[Camera],
    settings: SolveSettings,
    *,
    room: bool,
    tell: Callable[[str], None],
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The reference by path tracing, twice, of half of its samples each.

    Mitsuba's path tracer makes it, or where materials are fields our own, as `relight` does: it
    asks them once a vertex.

    Args:
        room: whether emitters are seen.
        tell: called with lines of progress.

    Returns:
        Pictures of each camera, linear RGB, float32, (H, W, 3).
    """
    rays, halves, spp = CameraRays.of(cameras), [], settings.reference_spp // 2
    depths = {"max_depth": settings.max_depth, "rr_depth": settings.rr_depth}
    for half, part in enumerate(("first", "second")):
        seed = (2 * settings.seed + half) & 0x7FFFFFFF
        if scene_view.materials is None:
            sampler = mi.load_dict({"type": "independent", "sample_count": spp})
            how = replace(CaptureSettings(), **depths, seed=seed)
            rgb, _, _ = photographs(
                scene_view.scene, rays, how, sampler, room,
                lambda line, part=part: tell(f"{part} half: {line}"),
            )  # fmt: skip
        else:
            paths = {**depths, "seed": seed, "hide_emitters": not room}
            rgb = render_radiance(scene_view, rays.through, rays.pixels, spp, **paths)
            tell(f"{part} half: rendered")
        halves.append(_parted(rgb, cameras))
    return halves[0], halves[1]


def relative_mse(images: Sequence[np.ndarray], reference: Sequence[np.ndarray]) -> float:
    """relMSE: the mean of (a − b)² / (b² + ε) over all pixels and channels of all pictures.

    ε is 0.01, or follows the mean of b as of `epsilon_at`. Pixels that are not finite are left out,
    in all pictures; it is NaN where none is left.

    Args:
        images: a, linear RGB, (H, W, 3) each.
        reference: b, the same.
    """
    a, b = _finite(images, reference)
    if not a.size:
        return math.nan
    return float(np.mean((a - b) ** 2 / (b**2 + epsilon_at(EPSILON, float(b.mean())))))


def debiased_relative_mse(
    images: Sequence[np.ndarray], halves: Sequence[Sequence[np.ndarray]]
) -> float:
    """RelMSE that the noise of the reference adds nothing to; it may be negative.

    The square is the product of the differences from two independent references. Pixels are left
    out as of `relative_mse`.

    Args:
        images: linear RGB, (H, W, 3) each.
        halves: two references, the same; their mean is what errors are relative to.
    """
    a, b, c = _finite(images, *halves)
    if not a.size:
        return math.nan
    mean = (b + c) / 2
    below = mean**2 + epsilon_at(EPSILON, float(mean.mean()))
    return float(np.mean((a - b) * (a - c) / below))


def broken_pixels(images: Sequence[np.ndarray]) -> int:
    """How many pixels of pictures are not finite."""
    return sum(int((~np.isfinite(image).all(-1)).sum()) for image in images)


def _finite(*pictures: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The numbers of the pixels that are finite in all of several versions, one after another."""
    rows = [np.concatenate([x.reshape(-1, 3) for x in images]) for images in pictures]
    good = np.logical_and.reduce([np.isfinite(x).all(1) for x in rows])
    chosen = rows if good.all() else [x[good] for x in rows]
    return [x.ravel().astype(np.float64) for x in chosen]


def _parted(pixels: np.ndarray, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """The pixels of each camera, as pictures."""
    ends = np.cumsum([camera.width * camera.height for camera in cameras])[:-1]
    parts = zip(np.split(pixels, ends), cameras, strict=True)
    return [part.reshape(camera.height, camera.width, 3) for part, camera in parts]
