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
    """One camera sample a lane: x₁, bounces from x₁, x₂, …, and L_θ at those vertices.

    The first bounces pass gradients to φ, the radiance at the first vertices to θ: those that
    `Needs` asked for.
    """

    x1: Vertex
    bounces: list[Bounce]  # from x₁, x₂, …; the next vertex of each is where the next one starts
    radiance: list[mi.Color3f]  # L_θ at x₁, x₂, …; zero where nobody needs it

    def vertex(self, number: int) -> Vertex:
        """x₁, x₂, …"""
        return self.x1 if number == 1 else self.bounces[number - 2].next


@dataclass(frozen=True)
class Needs:
    """Which pieces of a path sample a method uses; the others are not computed."""

    bounces: int  #: k, of the image: differentiable
    residuals: int  #: number of first vertices where the residual is taken: 0, 1 or 2
    lhs: bool  #: whether the radiance field is seen directly

    @property
    def radiance(self) -> bool:
        """Whether there is a radiance field."""
        return self.lhs or self.residuals > 0


def trace(
    world: World,
    radiance: RadianceField | None,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    needs: Needs,
    see_lights: bool,
) -> PathSample:
    """Trace one path sample for each camera ray.

    Materials are evaluated once a vertex, and L_θ once where the image and residuals both need it.

    Paper: Sec. 4.2, 6.3, Fig. 2.
    """
    ends = max(needs.bounces, needs.residuals)
    x = find_vertex(world, ray, mi.Bool(True), sampler, see_lights=see_lights)
    x1 = x = attach_material(world, x)
    bounces: list[Bounce] = []
    for number in range(1, ends + 1):
        with dr.suspend_grad(when=number > needs.bounces):
            step = bounce(world, x, sampler)
        bounces.append(step)
        if number < ends:
            with dr.suspend_grad(when=number >= needs.bounces):
                step.next = attach_material(world, step.next)
        elif needs.radiance:
            with dr.suspend_grad():
                step.next = attach_albedo(world, step.next)
        x = step.next
    sample = PathSample(x1, bounces, [mi.Color3f(0)] * (ends + 1))
    if needs.radiance:
        learned, constant = _where_radiance_is_needed(needs)
        _look_up(radiance, sample, learned)
        with dr.suspend_grad():
            _look_up(radiance, sample, constant)
    return sample


def _where_radiance_is_needed(needs: Needs) -> tuple[list[int], list[int]]:
    """Numbers of the vertices where L_θ is needed: with gradients to θ, and without.

    A residual at xᵢ compares L(xᵢ) with L(xᵢ₊₁); the image ends with L(x) after k bounces.
    """
    learned = set(range(1, needs.residuals + 1)) | ({1} if needs.lhs else set())
    read = {needs.bounces + 1} | {i + 1 for i in range(1, needs.residuals + 1)}
    return sorted(learned), sorted(read - learned)


def _look_up(radiance: RadianceField, sample: PathSample, numbers: list[int]) -> None:
    found = reflected_radiance(radiance, *(sample.vertex(i) for i in numbers))
    for number, value in zip(numbers, found, strict=True):
        sample.radiance[number - 1] = value


def reflected_radiance(radiance: RadianceField, *vertices: Vertex) -> list[mi.Color3f]:
    """L_θ at several vertices, towards where each was seen from, in one evaluation of it."""
    v = vertices
    if not v:
        return []
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


def rhs(sample: PathSample, radiance: mi.Color3f, bounces: int = 1) -> mi.Color3f:
    """E + T(L)(x₁) per camera sample, where L at x₂ is `radiance`; or k bounces in place of one.

    With k bounces, Σ_{i<k} Tⁱ(E) + Tᵏ(L), where `radiance` is L at x_{k+1}.

    Paper: Eq. 2, Eq. 12, Sec. 6.3.
    """
    for number in range(bounces, 0, -1):
        radiance = transported(sample.bounces[number - 1], radiance)
        if number > 1:
            radiance = dr.custom(_Evaluated, radiance)
    return sample.x1.emitted + sample.x1.throughput * radiance


class _Evaluated(dr.CustomOp):
    """Identity that evaluates its value, and on the way back its gradient.

    So all bounces share one kernel, rather than each having a longer one with the products of
    others in it: they are compiled once, and nothing is computed again by each further bounce.
    """

    def eval(self, radiance):
        dr.eval(radiance)
        return mi.Color3f(radiance)

    def backward(self):
        gradient = self.grad_out()
        dr.eval(gradient)
        self.set_grad_in("radiance", gradient)

    def name(self) -> str:
        return "radiance of a bounce"
