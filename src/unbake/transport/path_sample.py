"""Path samples, from which both sides of the rendering equation are estimated.

    L(x, ω) = E(x, ω) + T(L)(x, ω)
     LHS         RHS

`trace` samples the vertices, bounces and look-ups of L_θ that the loss terms read, each once. A
term may ask for a second, independent bounce from x₁ (`PathSample.pair`).
`Requirements` lists them, and says which pass gradients.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import drjit as dr
import mitsuba as mi

from ..fields.guide import LightGuide
from ..fields.radiance import RadianceField
from .operator import Bounce, attach_albedo, attach_material, bounce, transported
from .vertex import SceneView, Vertex, find_vertex

Piece = TypeVar("Piece")


@dataclass
class PathSample:
    """One camera sample a lane: x₁, bounces from x₁, x₂, …, and L_θ at those vertices.

    Some bounces pass gradients to φ, and some of the radiance to θ: those that `Requirements` asks
    for.
    """

    x1: Vertex
    bounces: list[Bounce]  # from x₁, x₂, …; each starts at the next vertex of the one before
    radiance: list[mi.Color3f]  # L_θ at x₁, x₂, …; zero where no term reads it
    learned: PathSample | None = None  # the samples that L_θ learns of; None: all of these
    #: One more bounce from the same x₁, independent of the first; None where no term reads it.
    pair: PathSample | None = None

    def vertex(self, number: int) -> Vertex:
        """Vertex x₁, x₂, … of the path."""
        return self.x1 if number == 1 else self.bounces[number - 2].next

    def place(self, number: int, vertex: Vertex) -> None:
        """Replace vertex x₁, x₂, …."""
        if number == 1:
            self.x1 = vertex
        else:
            self.bounces[number - 2].next = vertex


@dataclass(frozen=True)
class Requirements:
    """What `trace` computes for a method, and which of it passes gradients.

    There are two sets of paths, one and the same unless `trace` gets a subset: those of the image,
    with `bounces` bounces and then L_θ, and those that train L_θ, with at least `residuals`
    bounces. Vertices are given by number: 1 is x₁. `requirements` in `objective.py` derives all
    of this from a method's terms.
    """

    bounces: int  #: k, bounces of the image's paths; they pass gradients to φ
    residuals: int = 0  #: bounces that the terms read of the paths that train L_θ
    attached: frozenset[int] = frozenset()  #: where L_θ on those paths passes gradients to θ
    constant: frozenset[int] = frozenset()  #: where L_θ on those paths is read without gradients
    image_attached: bool = False  #: whether L_θ at the end of the image's paths passes gradients
    differentiable: frozenset[int] = frozenset()  #: vertices beyond k with gradients to φ
    pair: bool = False  #: a second, independent bounce from x₁, with gradients to φ
    pair_attached: bool = False  #: whether L_θ at its end passes gradients to θ

    @property
    def radiance(self) -> bool:
        """Whether there is a radiance field."""
        return bool(self.attached or self.constant or self.image_attached)


@dataclass
class SampleSubset:
    """The camera samples that L_θ learns from; the others are only part of the image.

    Args:
        lanes: their lanes.
        sampler: seeded for as many lanes.
    """

    lanes: mi.UInt32
    sampler: mi.Sampler


def trace(
    scene_view: SceneView,
    radiance: RadianceField | None,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    requirements: Requirements,
    *,
    hide_emitters: bool = False,
    subset: SampleSubset | None = None,
    guide: LightGuide | None = None,
) -> PathSample:
    """Trace one path sample for each camera ray.

    Materials are evaluated once a vertex, and L_θ once where the image and a residual share it.

    Args:
        scene_view: the scene, with fields in the place of unknown materials.
        radiance: L_θ; None where `requirements` does not read it.
        ray: camera rays, world space, one a lane.
        sampler: seeded for as many lanes; it is advanced.
        requirements: what to compute.
        hide_emitters: whether cameras see neither environment nor area emitters.
        subset: the samples that L_θ learns from; None: all.
        guide: path guiding, mixed with BSDF sampling; None: BSDF sampling alone.

    Raises:
        ValueError: a radiance field is needed and there is none.

    Paper: Sec. 4.2, 6.3, Fig. 2.
    """
    if guide is not None:
        guide.prepare()
    x1 = find_vertex(scene_view, ray, mi.Bool(True), sampler, hide_emitters=hide_emitters)
    sample = learned = PathSample(x1, [], [])
    _prolong(scene_view, sample, requirements.bounces, sampler, requirements, guide)
    if subset is not None and requirements.radiance:
        _end(scene_view, sample)
        x1, bounces = _gather(sample.x1, subset), [_gather(b, subset) for b in sample.bounces]
        sample.learned = learned = PathSample(x1, bounces, [])
        sampler = subset.sampler
    _prolong(scene_view, learned, requirements.residuals, sampler, requirements, guide)
    if requirements.radiance and (
        learned is sample or requirements.residuals > requirements.bounces
    ):
        _end(scene_view, learned)
    if requirements.pair:
        # The material at x₁ is attached already, by the first bounce.
        again = bounce(scene_view, learned.x1, sampler, guide)
        learned.pair = PathSample(learned.x1, [again], [])
        _end(scene_view, learned.pair)
    for paths in filter(None, (sample, learned, learned.pair)):
        paths.radiance = [mi.Color3f(0)] * (len(paths.bounces) + 1)
    if requirements.radiance:
        if radiance is None:
            raise ValueError("the terms read a radiance field, and there is none")
        attached, constant = set(requirements.attached), set(requirements.constant)
        last = {requirements.bounces + 1}  # where the image ends
        if learned is sample:  # the image shares the look-ups
            attached |= last if requirements.image_attached else set()
            constant = (constant | last) - attached
        _look_up(radiance, learned, attached)
        if learned is not sample:
            with dr.suspend_grad(when=not requirements.image_attached):
                _look_up(radiance, sample, last)
            end = requirements.bounces
            same = requirements.residuals <= end and not requirements.image_attached
            if same and subset is not None and end + 1 in constant:
                # Both paths end alike: of these lanes it is known.
                learned.radiance[end] = _gather(sample.radiance[end], subset)
                constant.remove(end + 1)
        if learned.pair is not None:
            with dr.suspend_grad(when=not requirements.pair_attached):
                _look_up(radiance, learned.pair, {2})
        with dr.suspend_grad():
            _look_up(radiance, learned, constant)
    return sample


def _prolong(
    scene_view: SceneView,
    sample: PathSample,
    bounces: int,
    sampler: mi.Sampler,
    requirements: Requirements,
    guide: LightGuide | None,
) -> None:
    """Extend a path to this number of bounces."""
    for number in range(len(sample.bounces) + 1, bounces + 1):
        passes = number <= requirements.bounces or number in requirements.differentiable
        with dr.suspend_grad(when=not passes):
            x = attach_material(scene_view, sample.vertex(number))
            sample.place(number, x)
            sample.bounces.append(bounce(scene_view, x, sampler, guide))


def _end(scene_view: SceneView, sample: PathSample) -> None:
    """Look up the albedo at the last vertex, an input of L_θ."""
    last = len(sample.bounces) + 1
    with dr.suspend_grad():
        sample.place(last, attach_albedo(scene_view, sample.vertex(last)))


def _gather(piece: Piece, subset: SampleSubset) -> Piece:
    """The lanes of a subset, of an array or of all arrays of a dataclass; None stays None."""
    if piece is None:
        return piece
    if isinstance(piece, type) or not dataclasses.is_dataclass(piece):
        return dr.gather(type(piece), piece, subset.lanes)
    parts = {f.name: _gather(getattr(piece, f.name), subset) for f in dataclasses.fields(piece)}
    return dataclasses.replace(cast(Any, piece), **parts)


def _look_up(radiance: RadianceField, sample: PathSample, numbers: set[int]) -> None:
    found = reflected_radiance(radiance, *(sample.vertex(i) for i in sorted(numbers)))
    for number, value in zip(sorted(numbers), found, strict=True):
        sample.radiance[number - 1] = value


def reflected_radiance(radiance: RadianceField, *vertices: Vertex) -> list[mi.Color3f]:
    """L_θ at vertices, back along the ray that found each, in one evaluation of the field."""
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
        # Dr.Jit 1.5 on LLVM loses gradients now and then where several kernels add to a small array
        # (those of L_θ at x₁ and at x₂ were a third too small in one step of ten). `NoConflicts`,
        # which holds because all lanes differ, avoids the buffers in which they are lost.
        parts.append(dr.gather(mi.Color3f, together, lanes, mode=dr.ReduceMode.NoConflicts))
        offset += dr.width(x.valid)
    return parts


def _join(vectors: list) -> object:
    """Vectors, one after the other in one array."""
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
