"""How bright a radiance field has to be under the lights of a scene."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.materials import carrying
from ..fields.radiance import RadianceField
from ..transport.operator import attach_albedo, attach_material, bounce, transported
from ..transport.path_sample import reflected_radiance
from ..transport.vertex import SceneView, find_vertex
from .points import SurfacePoints

#: Points that means are taken over.
_POINTS = 1 << 15
#: Of its light, what a field loses at a bounce at least: below, it is the noise of the estimate.
_LEAST_LOST = 0.01


def direct_light(scene_view: SceneView, points: SurfacePoints, seed: int) -> float:
    """The mean reflected radiance of one bounce: the radiance of an untrained field.

    Raises:
        UserError: no light reaches any surface, or it is not finite.
    """
    return _means(scene_view, None, points, seed)[0]


def matching_scale(
    scene_view: SceneView, radiance: RadianceField, points: SurfacePoints, seed: int
) -> float:
    """The factor on a field with which both sides of the rendering equation have the same mean.

    Of c L = D + c K L, with the direct light D and one bounce K of the field: 1 where the field
    solves the equation, and where it has no light at all. Where L − K L is not told, it is taken
    for the least share of L that could be.

    Raises:
        UserError: no light reaches any surface, or it is not finite.
    """
    direct, _, own = _means(scene_view, radiance, points, seed)
    if not 0 < own < math.inf:
        return 1.0
    given = radiance.scale
    try:  # single precision tells light from a field of much the same alone
        radiance.scale = given * direct / own
        direct, lost, near = _means(scene_view, radiance, points, seed)
    finally:
        radiance.scale = given
    least = _LEAST_LOST * near
    return direct / own * (direct / (lost if least < lost < math.inf else least))


@carrying()
def _means(
    scene_view: SceneView, radiance: RadianceField | None, points: SurfacePoints, seed: int
) -> tuple[float, float, float]:
    """Means over points and directions of D, and of L − K L and L of a field; else 0."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, _POINTS)
    lost = own = mi.Float(0)
    with dr.suspend_grad():
        x = find_vertex(scene_view, points.rays(sampler), mi.Bool(True), sampler)
        x = attach_material(scene_view, x)
        step = bounce(scene_view, x, sampler)
        light = dr.mean(transported(step, mi.Color3f(0)))
        if radiance is not None:
            end = attach_albedo(scene_view, step.next)
            left, incoming = reflected_radiance(radiance, x, end)
            own = dr.mean(left)
            lost = dr.mean(left - (transported(step, incoming) - light))
    valid = np.array(x.valid)
    mean, lost, own = (
        float(np.mean(np.broadcast_to(v, valid.shape)[valid], dtype=np.float64))
        for v in (light, lost, own)
    )
    if not np.isfinite(mean):
        raise UserError("the direct light is not finite", None, "Check the scene's values")
    if mean <= 0:
        raise UserError("no light reaches any surface", None, "Check where the lights are")
    return mean, lost, own
