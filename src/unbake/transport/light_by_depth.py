"""How much light paths carry, by their depth: where methods that follow paths may end them."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .emitter_sampling import lights_pierce, sample_emitter
from .vertex import behind_area_emitters, mis_weight


def light_by_depth(
    scene: mi.Scene,
    ray: mi.Ray3f,
    seed: int,
    *,
    max_depth: int,
    rr_depth: int,
    hide_emitters: bool,
    groups: int = 16,
) -> np.ndarray:
    """The share of reflected light that reaches cameras on paths of depth 1, 2, …, `max_depth`.

    Depth has the meaning of `max_depth` of Mitsuba's integrators: 2 is direct illumination, and
    mirrors, glass and cut-outs count as other surfaces do. Emission that cameras see directly,
    depth 1, is left out: it tells nothing about materials. Shares are medians over groups of rays,
    so that a few extreme samples do not decide them.

    Args:
        scene: with its own materials.
        ray: camera rays, world space; lane i is in group i % `groups`.
        seed: of all random numbers.
        max_depth: of the paths that carry all light.
        rr_depth: interactions before Russian roulette.
        hide_emitters: whether cameras look through area emitters.

    Returns:
        Shares of the mean radiance (mean of RGB) of paths up to each depth, float64, shape
        (max_depth,), not decreasing. All zero where there is no light.

    Paper: Sec. 6 ("limited to 15 bounces").
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), dr.width(ray))
    group = dr.arange(mi.UInt32, dr.width(ray)) % groups
    with dr.suspend_grad():
        pi = scene.ray_intersect_preliminary(ray, True, True)
        if hide_emitters:
            pi, ray = behind_area_emitters(scene, pi, ray, mi.Bool(True))
        limits = max_depth, rr_depth, hide_emitters, lights_pierce(scene)
        sums = _follow(scene, pi, ray, sampler, group, groups, *limits)
    light = np.array(sums, np.float64).reshape(max_depth, groups)
    total = light.sum(0)
    lit = light[:, (total > 0) & np.isfinite(total)]
    if not lit.size:
        return np.zeros(max_depth)
    return np.median(lit.cumsum(0) / lit.sum(0), axis=1)


def depth_of_light(shares: Sequence[float], share: float) -> int | None:
    """The smallest depth of paths that carry this share of the light; None if it is unknown.

    Args:
        shares: from `light_by_depth`; deeper paths add nothing to the last one.
    """
    return next((depth for depth, x in enumerate(shares, 1) if x >= share), None)


def light_of_depth(shares: Sequence[float], depth: int) -> float | None:
    """The share of the light that paths of at most this depth carry; None if it is unknown.

    Args:
        shares: as in `depth_of_light`.
    """
    return shares[min(depth, len(shares)) - 1] if shares else None


@dr.syntax
def _follow(
    scene: mi.Scene,
    pi: mi.PreliminaryIntersection3f,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    group: mi.UInt32,
    groups: int,
    max_depth: int,
    rr_depth: int,
    hide_emitters: bool,
    pierced: bool,
) -> mi.Float:
    """Sums of radiance by depth and group, in one kernel: Mitsuba's `path`, its light sorted."""
    ctx = mi.BSDFContext()
    sums = dr.zeros(mi.Float, max_depth * groups)
    β, η = mi.Color3f(1), mi.Float(1)
    depth, active = mi.UInt32(0), mi.Bool(True)
    si_prev, pdf_prev = dr.zeros(mi.SurfaceInteraction3f), mi.Float(1)
    delta_prev = mi.Bool(True)
    hidden = mi.Bool(hide_emitters)  # nor are emitters seen through cut-outs alone

    while dr.hint(active, max_iterations=max_depth, label="light by depth"):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        bsdf = si.bsdf()

        # ---------------------- Emission that a BSDF sample meets ----------------------

        ds = mi.DirectionSample3f(scene, si, si_prev)
        pdf_em = scene.pdf_emitter_direction(si_prev, ds, active & ~delta_prev)
        seen = active & (depth > 0) & ~hidden
        met = β * mis_weight(pdf_prev, pdf_em) * ds.emitter.eval(si, seen)
        dr.scatter_add(sums, dr.mean(met), depth * groups + group, seen)

        # ------------------------------ Emitter sampling -------------------------------

        active &= si.is_valid() & (depth + 1 < max_depth)
        lit = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight = sample_emitter(scene, si, sampler.next_2d(), lit, holes=pierced, sized=False)
        lit &= ds.pdf != 0
        value, pdf = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), lit)
        mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf))
        dr.scatter_add(sums, dr.mean(β * mis * value * weight), (depth + 1) * groups + group, lit)

        # ------------------------ BSDF sampling, Russian roulette -----------------------

        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), active)
        β *= weight
        η *= bs.eta
        hidden &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        depth[active] += 1
        survival = dr.minimum(dr.max(β) * dr.square(η), 0.95)
        roulette = depth >= rr_depth
        active &= (dr.max(β) > 0) & (~roulette | (sampler.next_1d() < survival))
        β[roulette] *= dr.rcp(survival)

        si_prev, pdf_prev = si, bs.pdf
        delta_prev = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        ray = si.spawn_ray(si.to_world(bs.wo))
        pi = scene.ray_intersect_preliminary(ray, False, active)
    return sums
