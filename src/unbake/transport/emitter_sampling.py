"""Light of a sampled emitter, and what cut-outs and thin panes let pass of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..fields.shapes import met_shapes

#: Surfaces that a shadow ray passes; it ends in black at the next one.
MOST_PASSED = 64


def has_cut_outs(scene: mi.Scene) -> bool:
    """Whether any surface scatters and lets rays pass as they are."""
    wanted = int(mi.BSDFFlags.Null), int(mi.BSDFFlags.Smooth)
    return any(all(f & one for one in wanted) for f in bsdf_flags(scene))


def lets_pass(scene: mi.Scene) -> bool:
    """Whether any surface lets rays pass as they are: cut-outs, thin panes, `null`."""
    return any(f & int(mi.BSDFFlags.Null) for f in bsdf_flags(scene))


def lights_pierce(scene: mi.Scene) -> bool:
    """Whether lights without size (points, spots, directions) shine through any surface."""
    return has_lights_without_size(scene) and lets_pass(scene)


def has_lights_without_size(scene: mi.Scene) -> bool:
    """Whether there are points, spots or directions, which no ray meets."""
    return any(int(e.flags()) & int(mi.EmitterFlags.Delta) for e in scene.emitters())


def bsdf_flags(scene: mi.Scene) -> list[int]:
    """What the BSDFs of all surfaces can do, as bits of `BSDFFlags`."""
    return [int(shape.bsdf().flags()) for shape in met_shapes(scene) if shape.bsdf() is not None]


def sample_emitter(
    scene: mi.Scene,
    si: mi.SurfaceInteraction3f,
    sample: mi.Point2f,
    active: mi.Bool,
    *,
    holes: bool,
    sized: bool = True,
) -> tuple[mi.DirectionSample3f, mi.Color3f]:
    """An emitter in sight of a point, as `mi.Scene.sample_emitter_direction` samples it.

    Mitsuba takes cut-outs and panes for opaque then. Here light is multiplied by what surfaces on
    the way let pass, as in `volpath`: no ray meets a light without size, and few meet a small one.

    Args:
        sample: uniform in [0, 1)².
        holes: whether any surface lets rays pass (`lets_pass`).
        sized: whether light of areas and of the environment passes, too, and what passes is
            evaluated, so not in a loop; else it is left to rays that pass.

    Returns:
        Direction and density, and radiance over the density, linear RGB; 0 where it is hidden.
    """
    if not holes:
        return scene.sample_emitter_direction(si, sample, True, active)
    ds, weight = scene.sample_emitter_direction(si, sample, False, active)
    lit = active & (ds.pdf != 0)
    with dr.suspend_grad():
        passed = _passed(scene, si, ds.p, lit if sized else lit & ds.delta)
        if sized:
            dr.eval(passed)  # gradients would follow the rays once more
        else:
            hidden = scene.ray_test(si.spawn_ray_to(ds.p), lit & ~ds.delta)
            passed = dr.select(ds.delta, passed, dr.select(hidden, 0.0, 1.0))
    return ds, passed * weight


@dr.syntax
def _passed(
    scene: mi.Scene, si: mi.SurfaceInteraction3f, target: mi.Point3f, active: mi.Bool
) -> mi.Color3f:
    """The share of light that surfaces between two points let pass as it is, linear RGB."""
    ray, active = si.spawn_ray_to(target), mi.Bool(active)
    share, count = mi.Color3f(1), mi.UInt32(0)
    while dr.hint(active, label="light through cut-outs"):
        hit = scene.ray_intersect(ray, mi.RayFlags.All, False, active)
        met = active & hit.is_valid()
        bsdf = hit.bsdf()
        passes = met & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) & (count < MOST_PASSED)
        through = dr.select(passes, bsdf.eval_null_transmission(hit, passes), 0)
        share = dr.select(met, share * through, share)
        ray = dr.select(passes, hit.spawn_ray_to(target), ray)
        count += 1
        active = passes & (dr.max(share) > 0)
    return share
