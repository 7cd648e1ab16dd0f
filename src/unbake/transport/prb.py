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
from .vertex import evaluate


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

    # The one call that is made in Python at each vertex, and before its BSDF is asked.
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
