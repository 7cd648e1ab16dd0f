"""Terms of the objective that do not depend on photographs: regularizers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..config import FitConfig
from ..fields.grid_sizes import USUAL
from ..transport.loss import as_weight
from ..transport.regularizers import (
    albedo_smoothness,
    albedo_ties_roughness,
    mean_albedo_deviation,
    roughness_smoothness,
)
from ..transport.vertex import find_vertex
from .problem import Problem
from .told_scale import is_shared

#: The largest photometric loss that differences of albedo are weighed by: that of black pictures.
_LARGEST_LOSS = 1.0


def has_terms(problem: Problem, config: FitConfig) -> bool:
    """Whether any regularizer has a weight."""
    r = config.regularization
    weights = (r.roughness_smoothness, r.albedo_ties_roughness, smooths_albedo(problem, config))
    return problem.materials is not None and (any(weights) or is_anchored(problem, config))


def smooths_albedo(problem: Problem, config: FitConfig) -> bool:
    """Whether differences of albedo between near points have a weight."""
    return "albedo" in (problem.materials or ()) and config.regularization.albedo_smoothness > 0


def regularization_terms(
    problem: Problem,
    config: FitConfig,
    scene: mi.Scene,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    photometric: mi.Float | None,
    anchor: mi.Float | None = None,
) -> dict[str, mi.Float]:
    """Weighted terms, at the points of optimized material that camera rays hit.

    They are the same for all methods, and cost one more ray a pixel. `has_terms` tells whether
    there are any.

    Albedo smoothness is weighted by the photometric loss. One photograph cannot distinguish noise
    from texture, but a fit can: texture is the same in all views and is learned, noise is not, and
    stays in the loss. The expected loss has no variance of the rendering in it. That of a batch can
    be negative and is then clamped to zero, so that clean photographs are smoothed a little, too.

    Args:
        ray: a camera ray for each pixel of the batch.
        sampler: of as many lanes.
        photometric: the photometric loss of the batch. Where it is None, because a method has no
            such term, differences of albedo have no weight.
        anchor: weight of the deviation of the mean albedo; None: that of the beginning of a fit.
    """
    materials, r = problem.materials, config.regularization
    if materials is None:
        return {}
    scene_view, everywhere = problem.scene_view.with_scene(scene), mi.Bool(True)
    vertex = find_vertex(scene_view, ray, everywhere, sampler, hide_emitters=problem.hide_emitters)
    valid = vertex.valid & scene_view.is_optimized(vertex.si.shape)
    terms: dict[str, mi.Float] = {}
    if photometric is not None and smooths_albedo(problem, config):
        radius = r.albedo_radius or USUAL.footprint
        here, near = materials.evaluate_one_and_near(
            "albedo", vertex.si, valid, sampler.next_2d(), radius
        )
        unexplained = as_weight(photometric, 0, _LARGEST_LOSS)
        value = albedo_smoothness(here, near, valid)
        terms["albedo_smoothness"] = r.albedo_smoothness * unexplained * value
    anchored = is_anchored(problem, config)
    if not (r.roughness_smoothness or r.albedo_ties_roughness or anchored):
        return terms
    here = materials.evaluate(vertex.si, valid)
    dr.eval(here)
    if r.roughness_smoothness:
        near = materials.evaluate_near(vertex.si, valid, sampler.next_2d(), r.radius)
        value = roughness_smoothness(here, near, valid)
        terms["roughness_smoothness"] = r.roughness_smoothness * value
    if r.albedo_ties_roughness:
        value = albedo_ties_roughness(here, valid, r.similarity, shift=1)
        terms["albedo_ties_roughness"] = r.albedo_ties_roughness * value
    if anchored:
        value = mean_albedo_deviation(here, valid, problem.mean_albedo)
        terms["mean_albedo"] = (config.lighting.anchor if anchor is None else anchor) * value
    return terms


def is_anchored(problem: Problem, config: FitConfig) -> bool:
    """Whether the scale between albedo and light is set by convention.

    Photographs determine it where they show unknown light itself, and where some light is known.
    Where nobody has looked what they show, a visible background is taken for it.
    """
    told = problem.shows_light
    if told is None:
        told = not problem.hide_emitters
    return is_shared(problem) and not told and config.lighting.anchor > 0
