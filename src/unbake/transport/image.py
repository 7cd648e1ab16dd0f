"""What a pixel's samples see: the right-hand and the left-hand side of the rendering equation.

    L(x, ω) = E(x, ω) + T(L)(x, ω)
     LHS         RHS

`trace` walks two surface vertices behind the camera and gathers all that every loss term needs,
each piece evaluated once. Which of the pieces pass gradients is decided elsewhere, in
`objective.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..fields.radiance import RadianceField
from .operator import Bounce, attach_albedo, attach_material, bounce, transported
from .vertex import Vertex, World, find_vertex


@dataclass
class PathSample:
    """One camera sample a lane: vertices x₁, x₂, a bounce from each, and L_θ where it is needed.

    The radiance at x₁ and x₂ passes gradients to θ, the bounce at x₁ to φ. The bounce at x₂ passes
    none.
    """

    x1: Vertex
    bounce1: Bounce  # from x₁; its next vertex is x₂
    bounce2: Bounce | None  # from x₂, if the prior is wanted there
    L1: mi.Color3f | None  # L_θ(x₁); None: no radiance field
    L2: mi.Color3f | None
    L3: mi.Color3f | None  # L_θ(x₃), without gradient


@dataclass(frozen=True)
class Needs:
    """Which pieces of a path sample a method uses; the others are not computed."""

    radiance: bool  #: L_θ at x₁ and x₂
    second_bounce: bool  #: the bounce at x₂ and L_θ at x₃


def trace(
    world: World,
    radiance: RadianceField | None,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    needs: Needs,
    see_environment: bool,
) -> PathSample:
    """Trace one path sample for each camera ray.

    Materials are evaluated once a vertex, and L_θ(x₂), which both the image and the second residual
    need, once altogether.

    Paper: Sec. 4.2, Fig. 2.
    """
    x1 = find_vertex(world, ray, mi.Bool(True), sampler, see_environment=see_environment)
    x1 = attach_material(world, x1)
    bounce1 = bounce(world, x1, sampler)
    if not needs.radiance:
        return PathSample(x1, bounce1, None, None, None, None)

    with dr.suspend_grad():
        x2 = bounce1.next = attach_material(world, bounce1.next)
        bounce2 = L3 = None
        if needs.second_bounce:
            bounce2 = bounce(world, x2, sampler)
            bounce2.next = attach_albedo(world, bounce2.next)
            (L3,) = reflected_radiance(radiance, bounce2.next)
    L1, L2 = reflected_radiance(radiance, x1, x2)
    return PathSample(x1, bounce1, bounce2, L1, L2, L3)


def reflected_radiance(radiance: RadianceField, *vertices: Vertex) -> list[mi.Color3f]:
    """L_θ at several vertices, towards where each was seen from, in one evaluation of it."""
    v = vertices
    if len(v) == 1:
        return [radiance.evaluate(v[0].si.p, v[0].w, v[0].n, v[0].albedo, v[0].valid)]
    together = radiance.evaluate(
        _join([mi.Point3f(x.si.p) for x in v]),
        _join([mi.Vector3f(x.w) for x in v]),
        _join([x.n for x in v]),
        _join([x.albedo for x in v]),
        dr.concat([x.valid for x in v]),
    )
    parts, offset = [], 0
    for x in v:
        lanes = dr.arange(mi.UInt32, offset, offset + dr.width(x.valid))
        parts.append(dr.gather(mi.Color3f, together, lanes))
        offset += dr.width(x.valid)
    return parts


def _join(vectors: list) -> object:
    """Lanes of several vectors, one after the other."""
    columns = [dr.concat([v[i] for v in vectors]) for i in range(3)]
    return type(vectors[0])(columns)


def lhs(sample: PathSample, radiance: mi.Color3f) -> mi.Color3f:
    """The radiance field seen directly, E + L(x₁), per camera sample, where L at x₁ is `radiance`.

    Paper: Eq. 13, Sec. 4.3.
    """
    return sample.x1.emitted + sample.x1.throughput * radiance


def rhs(sample: PathSample, radiance: mi.Color3f) -> mi.Color3f:
    """E + T(L)(x₁), per camera sample, where L at x₂ is `radiance`.

    Paper: Eq. 2, Eq. 12.
    """
    x1 = sample.x1
    return x1.emitted + x1.throughput * transported(sample.bounce1, radiance)
