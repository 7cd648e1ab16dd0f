"""What images show of surfaces: holes hide nothing, nor do lamps that images do not show."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..transport.emitter_sampling import MOST_PASSED, has_cut_outs

#: A cut-out that lets more than this pass is a hole.
_HOLE = 0.5


@dataclass(frozen=True)
class Sight:
    """What hides the surfaces of a scene from cameras; glass and mirrors do."""

    lamps_pass: bool
    holes_pass: bool

    @staticmethod
    def of(scene: mi.Scene, *, hide_emitters: bool) -> Sight:
        """The sight of cameras.

        Args:
            scene: what stands in the way.
            hide_emitters: whether images do not show lamps, which then hide nothing.
        """
        lamps = hide_emitters and any(shape.is_emitter() for shape in scene.shapes())
        return Sight(lamps, has_cut_outs(scene))

    def free(self, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool) -> mi.Bool:
        """Whether images show the ends of rays."""
        if not (self.lamps_pass or self.holes_pass):
            return active & ~scene.ray_test(ray, active)
        return _free(scene, ray, active, self.lamps_pass)


#: Of rays that all surfaces stop.
OPAQUE = Sight(lamps_pass=False, holes_pass=False)


@dr.syntax
def _free(scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, lamps_pass: bool) -> mi.Bool:
    """Whether images show the ends of rays: holes and hidden lamps stop none."""
    end, lamps = ray(ray.maxt), mi.Bool(lamps_pass)
    ray, active = mi.Ray3f(ray), mi.Bool(active)
    free, count = mi.Bool(False), mi.UInt32(0)
    while dr.hint(active, label="what cameras see"):
        hit = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        met = active & hit.is_valid()
        free |= active & ~met
        passes = is_hole(hit, met)
        passes |= met & lamps & hit.shape.is_emitter()
        ray = dr.select(passes, hit.spawn_ray_to(end), ray)
        count += 1
        active = passes & (count < MOST_PASSED)
    return free


def is_hole(hit: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
    """Whether surfaces are cut out where rays met them."""
    bsdf = hit.bsdf()
    cut = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
    cut &= mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    return cut & (dr.max(bsdf.eval_null_transmission(hit, cut)) > _HOLE)
