"""Path replay backpropagation: Mitsuba's own `prb`, used for samples (Sec. 6).

All but the light transport it shares with the method of the paper: scene, unknowns, batches,
losses, optimiser.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import drjit as dr
import mitsuba as mi

from ..fields.materials import Materials, carry, carrying
from .vertex import behind_area_emitters, evaluate

#: Computes what `RayFlags.All` does, but compares unequal to it, so that `materials_along_paths`
#: leaves these interactions without a material.
_WITHOUT_MATERIAL = mi.RayFlags.All | mi.RayFlags.Minimal


def path_replay(max_depth: int, rr_depth: int, hide_emitters: bool) -> mi.CppADIntegrator:
    """The integrator.

    Args:
        max_depth: longest path in bounces, plus one.
        rr_depth: Mitsuba's. With 5, the seventh interaction is the first that Russian roulette may
            take away (3.9.1).
        hide_emitters: whether cameras see neither environment nor lights, as in photographs whose
            background is hidden.

    Paper: Sec. 6.
    """
    return mi.load_dict(
        {
            "type": "prb",
            "max_depth": max_depth,
            "rr_depth": rr_depth,
            "hide_emitters": hide_emitters,
        }
    )


@contextmanager
def materials_along_paths(materials: Materials | None) -> Iterator[None]:
    """Let paths find materials, while they are followed and replayed.

    The fields are asked once a vertex, as in `operator.py`, not by textures inside virtual calls.

    Args:
        materials: assigned for good; None: the scene has its own.
    """
    if materials is None:
        yield
        return
    before = materials.carried
    materials.stand_alone()
    interaction = mi.PreliminaryIntersection3f.compute_surface_interaction

    def with_material(pi, ray, ray_flags=mi.RayFlags.All, active=True):
        si = interaction(pi, ray, ray_flags, active)
        if ray_flags == mi.RayFlags.All:  # others only ask where the surface is
            carry(si, materials.evaluate(si, si.is_valid(), "coopvec"))
        return si

    # `prb` of Mitsuba 3.9.1 computes one interaction per vertex with `RayFlags.All`, in Python
    # and before it asks the BSDF; it computes all others with `RayFlags.Minimal`.
    mi.PreliminaryIntersection3f.compute_surface_interaction = with_material
    try:
        with carrying():
            yield
    finally:
        mi.PreliminaryIntersection3f.compute_surface_interaction = interaction
        materials.carried = before


def path_radiance(
    integrator: mi.CppADIntegrator,
    scene: mi.Scene,
    sampler: mi.Sampler,
    ray: mi.Ray3f,
    arrays: dict[str, mi.Float | mi.TensorXf],
) -> mi.Color3f:
    """Radiance along camera rays, one path a lane, differentiable in the arrays.

    Sampling is detached. When a loss on the samples is backpropagated, every path is followed a
    second time, with the same random numbers.

    Args:
        integrator: from `path_replay`.
        sampler: seeded for as many lanes as there are rays; it is advanced.
        ray: world space rays.
        arrays: all that the scene's textures and emitters read and that gradients should reach.

    Returns:
        Linear RGB radiance, evaluated.

    Paper: Sec. 5.2, Sec. 6.
    """
    return dr.custom(_ReplayedPaths, arrays, integrator, scene, sampler, ray)


def light_through_holes(scene: mi.Scene, ray: mi.Ray3f, max_depth: int) -> mi.Color3f:
    """The expected light of emitters that paths see through cut-outs alone.

    Mitsuba's `prb` hides emitters from the camera only where nothing is before them, and
    photographs whose background is hidden hide them behind cut-outs as well: what it sees there is
    to be subtracted. What lamps behind cut-outs reflect stays.

    Args:
        ray: world space rays from cameras.
        max_depth: of the paths, in which each cut-out counts.

    Returns:
        Linear RGB radiance; it passes gradients to lights.
    """
    with dr.suspend_grad():
        ray, everywhere = mi.Ray3f(ray), mi.Bool(True)
        pi = scene.ray_intersect_preliminary(ray, True, everywhere)
        pi, ray = behind_area_emitters(scene, pi, ray, everywhere)
        pi, ray, share, light, reached = _through_holes(scene, pi, ray, max_depth)
        si = pi.compute_surface_interaction(ray, _WITHOUT_MATERIAL, reached)
    return light + share * si.emitter(scene, reached).eval(si, reached)


@dr.syntax
def _through_holes(
    scene: mi.Scene, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, max_depth: int
):
    """Follow rays through cut-outs to the first surface without holes, or to none.

    Returns:
        What is met there (an invalid `pi`: nothing), the last ray, the share that arrives, the
        emission of cut-outs on the way, and whether there was a cut-out.
    """
    pi, ray = mi.PreliminaryIntersection3f(pi), mi.Ray3f(ray)
    share, light = mi.Float(1), mi.Color3f(0)
    depth = mi.UInt32(0)
    active = pi.is_valid()

    while dr.hint(active, label="holes"):
        si = pi.compute_surface_interaction(ray, _WITHOUT_MATERIAL, active)
        bsdf = si.bsdf()
        cut_out = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) & (depth + 1 < max_depth)
        passing = dr.mean(bsdf.eval_null_transmission(si, cut_out))
        active = cut_out & (passing > 0)
        seen = active & (depth > 0)
        light += share * si.emitter(scene, seen).eval(si, seen)
        share = dr.select(active, share * passing, share)
        ray = dr.select(active, si.spawn_ray(ray.d), ray)
        pi = dr.select(active, scene.ray_intersect_preliminary(ray, False, active), pi)
        depth = dr.select(active, depth + 1, depth)
        active &= pi.is_valid()

    return pi, ray, share, light, depth > 0


class _ReplayedPaths(dr.CustomOp):
    """Path replay as one operation: Mitsuba does so for images, this for samples.

    The arrays are an input so that Dr.Jit expects gradients from here. The replay
    itself adds them up there, because textures and emitters read these very arrays.
    """

    def eval(self, arrays, integrator, scene, sampler, ray):
        self.integrator, self.scene, self.ray = integrator, scene, ray
        self.sampler = sampler.clone()
        mode, everywhere = dr.ADMode.Primal, mi.Bool(True)
        radiance, _, _, self.state = integrator.sample(
            mode, scene, sampler, ray, δL=None, state_in=None, active=everywhere
        )
        self.sampler.schedule_state()
        evaluate(sampler, radiance, self.state)
        return mi.Color3f(radiance)

    def backward(self):
        δL, state = self.grad_out(), self.state
        mode, everywhere = dr.ADMode.Backward, mi.Bool(True)
        dr.eval(δL)
        with dr.suspend_grad():
            self.integrator.sample(
                mode, self.scene, self.sampler, self.ray, δL=δL, state_in=state, active=everywhere
            )
        dr.eval()  # gradients are side effects of the replay, whose results are not used

    def name(self) -> str:
        return "path replay"
