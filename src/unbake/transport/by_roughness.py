"""Pixels as functions of the roughness of what they see, from one set of samples (ours).

At x₁ the light that T(L_θ) gathers is sampled once. The BSDF is then evaluated for several values
of roughness, and with albedo as it is and half of it, because reflected light is linear in albedo
(transmitted light is not, where `spec_trans` is not zero: it is taken to be):

    pixel(r, g) ≈ S(r) + g · D(r)

where S is what is reflected without albedo, D what albedo adds, and g a factor of the albedo. The
tint of highlights (`spec_tint`) is the hue of the albedo, which no factor changes, and is in S. The
samples are the same for all r, so that what differs between two values of r has little noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.domain import SurfacePoint
from ..fields.guide import LightGuide
from ..fields.materials import Material, carry, carrying
from ..fields.pieces import Piece
from ..fields.radiance import RadianceField
from .emitter_sampling import sample_emitter
from .operator import attach_albedo, mixture_at
from .path_sample import reflected_radiance
from .vertex import Scattering, SceneView, Vertex, evaluate, find_vertex, mis_weight

#: Factor of the albedo with which reflected light is told apart from what albedo adds.
_HALF = 0.5
#: Roughness of the lobe that looks for highlights sharper than those that the BSDF has by now.
_SHARP = 0.2


#: What a pixel shows, told by its first sample.
PLACE = [
    ("position", "f4", 3),  # in the unit cube of fields
    ("piece", "u4"),  # of surface, by number
    ("strength", "f4"),  # of that piece
    ("albedo", "f4", 3),  # as it is by now, linear RGB; zero where it is not unknown
]


def row_type(nodes: int) -> np.dtype:
    """A pixel as a function of roughness r and of a factor g of the albedo, S(r) + g · D(r).

    Products are means over all pairs of different sets of a pixel's samples (`stratified`): their
    expectation is the product of the expected values.

    Args:
        nodes: how many values of r there are.
    """
    of_nodes = ("f4", (nodes, 3))
    return np.dtype(
        [
            *PLACE,
            ("target", "f4", 3),  # the photograph as light, linear RGB radiance
            ("weight", "f4", 3),  # of squared errors
            ("gain", "f4", 3),  # by which light is multiplied before it is compared
            ("plain", *of_nodes),  # S, linear RGB radiance
            ("coloured", *of_nodes),  # D
            ("plain2", *of_nodes),  # S · S
            ("mixed", *of_nodes),  # S · D
            ("coloured2", *of_nodes),  # D · D
        ]
    )


def stratified(spp: int) -> mi.Sampler:
    """A sampler for `by_roughness`.

    Samples of a pixel fall into sets, of `_together` each. Those of a set are stratified in every
    dimension, and sets are independent of each other.

    Args:
        spp: samples of a pixel, consecutive lanes.
    """
    together = _together(spp)
    sampler = mi.load_dict({"type": "stratified", "sample_count": together})
    sampler.set_samples_per_wavefront(together)
    return sampler


def _together(spp: int) -> int:
    """How many samples are a set: the largest square that leaves four sets or more, or 1."""
    sides = range(1, math.isqrt(spp // 4) + 1)
    return max((side**2 for side in sides if spp % side**2 == 0), default=1)


@dataclass
class _Light:
    """Light at x₁ from one direction a lane."""

    direction: mi.Vector3f  # local
    active: mi.Bool
    incident: mi.Color3f  # radiance, MIS weighted, over the density of the direction


def by_roughness(
    scene_view: SceneView,
    radiance: RadianceField,
    guide: LightGuide | None,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    spp: int,
    nodes: Sequence[float],
    *,
    hide_emitters: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Sample some pixels; within `carrying`.

    Args:
        scene_view: with a field of roughness, and pieces of surface. Where that of albedo is none,
            D is zero.
        ray: camera rays, world space, `spp` consecutive lanes a pixel.
        sampler: of `stratified`, seeded for as many lanes.
        nodes: values of roughness.

    Returns:
        The pixels all of whose samples meet one piece of surface, and no light on the way: their
        places among all, and rows of `row_type` without what they are compared with.

    Paper: Eq. 1, Eq. 12.
    """
    with dr.suspend_grad():
        x, point, piece = _met(scene_view, ray, sampler, hide_emitters=hide_emitters)
        material = _material(scene_view, point)
        chosen = np.flatnonzero(_of_one_piece(scene_view, x, piece, spp))
        rows = np.zeros(len(chosen), row_type(len(nodes)))
        _tell(rows, chosen * spp, point, piece, material)
        lights = _lights(scene_view, radiance, guide, x, material, sampler)
        for number, node in enumerate(nodes):
            r = dr.opaque(mi.Float, node)
            whole = _reflected(x, lights, material, r, dr.opaque(mi.Float, 1))
            coloured = dr.zeros(mi.Color3f, dr.width(whole))
            if "albedo" in material:
                half = _reflected(x, lights, material, r, dr.opaque(mi.Float, _HALF))
                coloured = (whole - half) / (1 - _HALF)
            plain = whole - coloured
            dr.eval(plain, coloured)
            for name, values in moments(plain, coloured, spp).items():
                rows[name][:, number] = values[chosen]
    return chosen, rows


def meet_one_piece(
    scene_view: SceneView, ray: mi.Ray3f, sampler: mi.Sampler, spp: int, *, hide_emitters: bool
) -> np.ndarray:
    """Whether all samples of a pixel meet one piece of surface, and no light on the way.

    Only then can `by_roughness` tell the pixel; within `carrying`.

    Args:
        scene_view, ray, sampler, hide_emitters: as of `by_roughness`.
        spp: consecutive lanes a pixel.

    Returns:
        Of each pixel, shape (n,).
    """
    with dr.suspend_grad():
        x, _, piece = _met(scene_view, ray, sampler, hide_emitters=hide_emitters)
        return _of_one_piece(scene_view, x, piece, spp)


def places(
    scene_view: SceneView, ray: mi.Ray3f, sampler: mi.Sampler, *, hide_emitters: bool
) -> np.ndarray:
    """What pixels show, also those that `by_roughness` cannot tell; within `carrying`.

    Args:
        scene_view, sampler, hide_emitters: as of `by_roughness`.
        ray: camera rays, world space, one a pixel.

    Returns:
        An array of `PLACE`, of those that meet a surface of unknown material, and no light on the
        way, and whose numbers are finite.
    """
    with dr.suspend_grad():
        x, point, piece = _met(scene_view, ray, sampler, hide_emitters=hide_emitters)
        material = _material(scene_view, point)
        lanes = np.flatnonzero(np.array(_counted(scene_view, x)))
        found = np.zeros(len(lanes), PLACE)
        _tell(found, lanes, point, piece, material)
    numbers = np.column_stack([found[name] for name in ("position", "strength", "albedo")])
    return found[np.isfinite(numbers).all(1)]


def _met(
    scene_view: SceneView, ray: mi.Ray3f, sampler: mi.Sampler, *, hide_emitters: bool
) -> tuple[Vertex, SurfacePoint, Piece]:
    """What camera rays meet first: the vertex, its place in fields, and its piece of surface."""
    assert scene_view.materials is not None
    x = find_vertex(scene_view, ray, mi.Bool(True), sampler, hide_emitters=hide_emitters)
    point = scene_view.materials.locate(x.si, x.valid)
    assert point.piece is not None
    return x, point, point.piece


def _material(scene_view: SceneView, point: SurfacePoint) -> Material:
    """What fields say of points, evaluated."""
    assert scene_view.materials is not None and point.piece is not None
    material = scene_view.materials.evaluate_at(point)
    dr.eval(material, point.position, point.piece)
    return material


def _tell(
    rows: np.ndarray, lanes: np.ndarray, point: SurfacePoint, piece: Piece, material: Material
) -> None:
    """Write what some lanes show, as of `PLACE`, one a row."""
    rows["piece"] = np.array(piece.number)[lanes]
    rows["strength"] = np.array(piece.strength)[lanes]
    rows["position"] = np.array(point.position).T[lanes]
    if "albedo" in material:
        albedo = np.array(mi.Color3f(material["albedo"])).T
        rows["albedo"] = np.broadcast_to(albedo, (dr.width(piece.number), 3))[lanes]


def _counted(scene_view: SceneView, x: Vertex) -> mi.Bool:
    """Whether vertices are on a surface of unknown material, and no light was met on the way."""
    return x.valid & (dr.max(x.emitted) <= 0) & scene_view.is_optimized(x.si.shape)


def _of_one_piece(scene_view: SceneView, x: Vertex, piece: Piece, spp: int) -> np.ndarray:
    """The same, where the vertices of the samples and their pieces are known."""
    first = dr.arange(mi.UInt32, dr.width(x.valid)) // spp * spp
    counted = _counted(scene_view, x)
    counted &= dr.gather(mi.UInt32, piece.number, first) == piece.number
    return np.logical_and.reduce(np.array(counted).reshape(-1, spp), axis=1)


def _carrying(
    x: Vertex, material: Material, roughness: mi.Float, factor: mi.Float | None = None
) -> mi.SurfaceInteraction3f:
    """The interaction at x₁ with this roughness, and with albedo times a factor."""
    si, material = mi.SurfaceInteraction3f(x.si), {**material, "roughness": roughness}
    if factor is not None and "albedo" in material:
        material["albedo"] = factor * mi.Color3f(material["albedo"])
    carry(si, material)
    return si


@carrying()
def _lights(
    scene_view: SceneView,
    radiance: RadianceField,
    guide: LightGuide | None,
    x: Vertex,
    material: Material,
    sampler: mi.Sampler,
) -> list[_Light]:
    """Light from an emitter, from where a bounce would look, and from where a sharp lobe would.

    The three are combined by MIS; see `operator.bounce`.
    """
    scene, bsdf, active, ctx = scene_view.scene, x.bsdf, x.valid, mi.BSDFContext()
    roughness = mi.Float(material["roughness"])
    own = _carrying(x, material, roughness)
    sharp = _carrying(x, material, dr.minimum(roughness, _SHARP))
    opacity = x.opacity if scene_view.has_chains else mi.Float(1)
    inv_opacity = dr.rcp(opacity)
    mixture = None
    if guide is not None:
        guide.prepare()
        mixture = mixture_at(guide, x)

    def density(wo: mi.Vector3f) -> mi.Float:
        """That of both samples of direction together."""
        found = bsdf.pdf(ctx, own, wo, active) * inv_opacity
        if mixture is not None:
            found = mixture.pdf(found, x.si.to_world(wo))
        return found + bsdf.pdf(ctx, sharp, wo, active) * inv_opacity

    ds, light = sample_emitter(scene, own, sampler.next_2d(), active, holes=scene_view.has_holes)
    towards, lit = x.si.to_local(ds.d), active & (ds.pdf != 0)
    weight = dr.select(ds.delta, 1, mis_weight(ds.pdf, density(towards)))
    found = [_Light(towards, lit, dr.select(lit, light * weight * inv_opacity, 0))]
    for si, guided_too in ((own, mixture), (sharp, None)):
        number, square = sampler.next_1d(), sampler.next_2d()
        guided = mi.Bool(False)
        if guided_too is not None:
            guided, number = guided_too.decide(number)
        bs, _ = bsdf.sample(ctx, si, number * opacity, square, active)
        on = active & (bs.pdf > 0)
        on &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta | mi.BSDFFlags.Null)
        wo = bs.wo
        if guided_too is not None:
            looked = guided_too.guide.sample(guided_too.cell, square)
            wo = dr.select(guided, x.si.to_local(looked), wo)
            on = active & (guided | on)
        pdf = density(wo)
        on &= pdf > 0
        ray = x.si.spawn_ray(x.si.to_world(wo))
        evaluate(sampler, ray, wo, on, pdf)
        origin = Scattering(x.si, pdf, mi.Bool(False))
        y = attach_albedo(scene_view, find_vertex(scene_view, ray, on, sampler, origin=origin))
        incident = y.emitted + y.throughput * reflected_radiance(radiance, y)[0]
        # Values of cut-outs have their opacity in them, by which they were met.
        found.append(_Light(wo, on, dr.select(on, incident * inv_opacity / pdf, 0)))
    evaluate(sampler, found)
    return found


@carrying()
def _reflected(
    x: Vertex, lights: Sequence[_Light], material: Material, roughness: mi.Float, factor: mi.Float
) -> mi.Color3f:
    """What is reflected towards the camera, with this roughness and albedo times a factor."""
    si = _carrying(x, material, roughness, factor)
    total = mi.Color3f(0)
    for light in lights:
        value = x.bsdf.eval(mi.BSDFContext(), si, light.direction, light.active)
        total += dr.select(light.active, value * light.incident, 0)
    return x.throughput * total


def moments(plain: mi.Color3f, coloured: mi.Color3f, spp: int) -> dict[str, np.ndarray]:
    """Means over a pixel's samples, and over products of pairs of sets.

    Args:
        plain, coloured: of the samples, `spp` consecutive lanes a pixel, of `stratified`.
        spp: samples of a pixel.

    Returns:
        By their names in `row_type`, each of shape (n, 3).
    """
    together = _together(spp)
    sets = spp // together
    colours = {
        name: [dr.block_sum(channel, together) / together for channel in colour]
        for name, colour in (("plain", plain), ("coloured", coloured))
    }
    sums = {name: [dr.block_sum(c, sets) for c in colour] for name, colour in colours.items()}
    dr.eval(sums)

    def mean(name: str) -> np.ndarray:
        return np.stack([np.array(total) for total in sums[name]], 1) / sets

    def pairs(a: str, b: str) -> np.ndarray:
        of_sets = zip(colours[a], colours[b], sums[a], sums[b], strict=True)
        found = [np.array(u * v - dr.block_sum(x * y, sets)) for x, y, u, v in of_sets]
        return np.stack(found, 1) / (sets * (sets - 1))

    return {
        "plain": mean("plain"),
        "coloured": mean("coloured"),
        "plain2": pairs("plain", "plain"),
        "mixed": pairs("plain", "coloured"),
        "coloured2": pairs("coloured", "coloured"),
    }
