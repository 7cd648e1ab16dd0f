"""How bright a radiance field has to be under the lights of a scene."""

from __future__ import annotations

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
#: Factors on the scale of a field that are believed.
_LEAST, _MOST = 1e-4, 1e4


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
    solves the equation.

    Raises:
        UserError: no light reaches any surface, or it is not finite.
    """
    direct, lost = _means(scene_view, radiance, points, seed)
    factor = direct / lost if lost > 0 else 1.0
    return factor if _LEAST < factor < _MOST else 1.0


@carrying()
def _means(
    scene_view: SceneView, radiance: RadianceField | None, points: SurfacePoints, seed: int
) -> tuple[float, float]:
    """Means over points and directions of D, and of L − K L where there is a field; else 0."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, _POINTS)
    lost = mi.Float(0)
    with dr.suspend_grad():
        x = find_vertex(scene_view, points.rays(sampler), mi.Bool(True), sampler)
        x = attach_material(scene_view, x)
        step = bounce(scene_view, x, sampler)
        light = dr.mean(transported(step, mi.Color3f(0)))
        if radiance is not None:
            end = attach_albedo(scene_view, step.next)
            left, incoming = reflected_radiance(radiance, x, end)
            lost = dr.mean(left - (transported(step, incoming) - light))
    valid = np.array(x.valid)
    mean, lost = (float(np.mean(np.broadcast_to(v, valid.shape)[valid])) for v in (light, lost))
    if not np.isfinite(mean):
        raise UserError("the direct light is not finite", None, "Check the scene's values")
    if mean <= 0:
        raise UserError("no light reaches any surface", None, "Check where the lights are")
    return mean, lost
