"""Terms of the objective that do not depend on photographs: regularizers."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..config import FitConfig
from ..transport.regularizers import (
    albedo_ties_roughness,
    mean_albedo_deviation,
    roughness_smoothness,
)
from ..transport.vertex import find_vertex
from .problem import Problem


def regularization_terms(
    problem: Problem, config: FitConfig, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler
) -> dict[str, mi.Float]:
    """Weighted terms, at the points of optimized material that camera rays hit.

    No term where none has a weight. They are the same for all methods, and cost one more ray a
    sample.
    """
    materials, r = problem.materials, config.regularization
    anchored = is_anchored(problem, config)
    if materials is None or not (r.roughness_smoothness or r.albedo_ties_roughness or anchored):
        return {}
    scene_view, everywhere = problem.scene_view.with_scene(scene), mi.Bool(True)
    vertex = find_vertex(scene_view, ray, everywhere, sampler, hide_emitters=problem.hide_emitters)
    valid = vertex.valid & scene_view.is_optimized(vertex.si.shape)
    here = materials.evaluate(vertex.si, valid)
    dr.eval(here)
    terms: dict[str, mi.Float] = {}
    if r.roughness_smoothness:
        near = materials.evaluate_near(vertex.si, valid, sampler.next_2d(), r.radius)
        value = roughness_smoothness(here, near, valid)
        terms["roughness_smoothness"] = r.roughness_smoothness * value
    if r.albedo_ties_roughness:
        value = albedo_ties_roughness(here, valid, r.similarity, shift=config.spp)
        terms["albedo_ties_roughness"] = r.albedo_ties_roughness * value
    if anchored:
        value = mean_albedo_deviation(here, valid, config.lighting.mean_albedo)
        terms["mean_albedo"] = config.lighting.anchor * value
    return terms


def is_anchored(problem: Problem, config: FitConfig) -> bool:
    """Whether the scale between albedo and light is set by convention.

    Photographs determine it where they show the environment itself, and where some light is known.
    """
    both = problem.environment is not None and "albedo" in (problem.materials or ())
    alone = len(problem.scene_view.scene.emitters()) == 1
    return both and alone and problem.hide_emitters and config.lighting.anchor > 0
