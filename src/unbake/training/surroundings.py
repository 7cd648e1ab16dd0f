"""Which directions of an environment light what training views show (ours).

A room with a window has light from a part of the sky alone. Of the rest a fit learns nothing: there
the recovered map is what it began with, and what its network makes of that.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.pixels import CameraRays
from ..dataset.views import fitted_pixels
from ..fields.arrays import from_numpy
from ..fields.envmap import latlong, solid_angles, to_square
from .recovered import Recovered

#: Cells along an edge of the square that stands for all directions, each of the same solid angle.
_CELLS = 48
#: Rays through random pixels of a pass; passes, at most; and rays that leave, which are enough.
_RAYS, _MOST_PASSES, _ENOUGH = 1 << 17, 64, 1 << 17
#: Directions that light less than this part of the mean tell next to nothing; and fewer rays than
#: that leave through the joints of walls.
_LEAST, _FEWEST = 0.02, 3
#: The share of directions that are told, beyond which nothing is said of the others.
_MOST_OF_IT = 0.95
#: Surfaces that a ray goes through, at most.
_PASSED = 8


@final
@dataclass(frozen=True, eq=False)
class Surroundings:
    """What training views tell of an environment.

    Args:
        lit: whether light from a direction reaches what they show, or they show the environment
            there; bool, shape (rows, 2 rows), in the layout of `latlong`.
    """

    lit: np.ndarray

    @property
    def share(self) -> float:
        """Of all directions, those that are told, by solid angle."""
        return float(np.average(self.lit, weights=solid_angles(len(self.lit))))

    @property
    def note(self) -> str | None:
        """A line where a part of the environment is not known."""
        if self.share > _MOST_OF_IT:
            return None
        return f"nothing is known of {100 * (1 - self.share):.0f} % of the environment"


def surroundings(recovered: Recovered, rows: int) -> Surroundings:
    """What the training views of a run tell of the environment.

    Panes and cut-outs hide nothing here. What reaches surfaces over others alone does not count.

    Args:
        recovered: of a scene with an environment.
        rows: of its picture.
    """
    problem = recovered.problem
    scene, rays = problem.scene_view.scene, CameraRays.of(recovered.cameras)
    counted = _counted(recovered)
    count = rays.pixels if counted is None else dr.width(counted)
    sampler = mi.load_dict({"type": "independent"})
    counts = np.zeros(_CELLS**2)
    with dr.suspend_grad():
        for number in range(_MOST_PASSES):
            sampler.seed(number, _RAYS)
            pixel = mi.UInt32(dr.minimum(sampler.next_1d() * count, count - 1))
            if counted is not None:
                pixel = dr.gather(mi.UInt32, counted, pixel)
            ray = rays.through(pixel, sampler.next_2d())
            met, outside = _followed(scene, ray, mi.Bool(True))
            if problem.hide_emitters:  # photographs do not show it
                outside = mi.Bool(False)
            local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
            local.z = dr.mulsign(local.z, mi.Frame3f.cos_theta(met.wi))
            bounced = met.spawn_ray(met.to_world(local))
            free = outside | _followed(scene, bounced, met.is_valid())[1]
            d = dr.select(outside, ray.d, bounced.d)
            cell = np.array(_cell(d))[np.array(free)]
            counts += np.bincount(cell, minlength=len(counts))
            if counts.sum() >= _ENOUGH:
                break
    lit = counts >= max(_FEWEST, _LEAST * counts.mean())
    table = from_numpy(mi.Float, lit.astype(np.float32))
    picture = latlong(lambda d: mi.Color3f(dr.gather(mi.Float, table, _cell(d))), rows, 1)
    return Surroundings(picture[..., 0] > 0)


def _cell(d: mi.Vector3f) -> mi.UInt32:
    """The cell of unit directions."""
    place = mi.Point2u(dr.clip(to_square(d) * _CELLS, 0, _CELLS - 1))
    return place.y * _CELLS + place.x


def _counted(recovered: Recovered) -> mi.UInt32 | None:
    """The numbers of the pixels that were fitted, of all training views; None: all."""
    views, background = recovered.dataset.train, recovered.dataset.background
    fitted = [fitted_pixels(view, background) for view in views]
    if all(counted is None for counted in fitted):
        return None
    numbers, first = [], 0
    for view, counted in zip(views, fitted, strict=True):
        size = view.camera.width * view.camera.height
        own = np.arange(size) if counted is None else np.flatnonzero(counted)
        numbers.append(first + own)
        first += size
    return from_numpy(mi.UInt32, np.concatenate(numbers).astype(np.uint32))


def _followed(
    scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.Bool]:
    """Where rays end, straight through what lets light pass, and whether they leave the scene."""
    free, active = mi.Bool(False), mi.Bool(active)
    end = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray))
    for _ in range(_PASSED):
        hit = scene.ray_intersect(ray, active)
        met = active & hit.is_valid()
        free |= active & ~met
        flags = hit.bsdf().flags()
        passes = mi.has_flag(flags, mi.BSDFFlags.Null)
        passes |= mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
        end = dr.select(met & ~passes, hit, end)
        active = met & passes
        ray = hit.spawn_ray(ray.d)
        dr.eval(free, active, ray, end)
        if not dr.any(active):
            break
    return end, free
