"""The transport operator T: one bounce by emitter and direction sampling with MIS (Eq. 1, 8)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..fields.guide import Choice, LightGuide, Mixture
from ..fields.materials import carry, carrying, with_joint_gradients
from .emitter_sampling import sample_emitter
from .vertex import Scattering, SceneView, Vertex, evaluate, find_vertex, mis_weight


@dataclass
class Bounce:
    """One sample of T at a vertex.

    T(L) ≈ direct + weight · (next.emitted + next.throughput · L(next)); see `transported`.
    """

    direct: mi.Color3f  # light of emitters, by emitter sampling, MIS weighted
    weight: mi.Color3f  # BSDF · cosine / density of the sampled direction
    next: Vertex
    choice: Choice | None = None  # how the direction was drawn, where there is a guide


def attach_material(scene_view: SceneView, vertex: Vertex) -> Vertex:
    """Evaluate the material fields at a vertex, once, and put them on its surface interaction.

    BSDF evaluations at the vertex then pass gradients to φ. Without fields the scene's own textures
    are used, and only the albedo is looked up.
    """
    if scene_view.materials is None:
        return attach_albedo(scene_view, vertex)
    si = vertex.si
    material = with_joint_gradients(scene_view.materials.evaluate(si, vertex.valid))
    si = mi.SurfaceInteraction3f(si)
    carry(si, material)
    if "albedo" not in material:
        return attach_albedo(scene_view, replace(vertex, si=si))
    return replace(vertex, si=si, albedo=dr.detach(material["albedo"]))


@carrying()
def attach_albedo(scene_view: SceneView, vertex: Vertex) -> Vertex:
    """Look up the albedo alone, for a vertex where L_θ is evaluated and no BSDF is.

    Of metals Mitsuba takes the peak of their lobe for it, which may be thousands. L_θ, which is
    multiplied by it, gets 1 at most.
    """
    if scene_view.materials is None or "albedo" not in scene_view.materials:
        albedo = mi.Color3f(vertex.bsdf.eval_diffuse_reflectance(vertex.si, vertex.valid))
        albedo = dr.clip(albedo, 0, 1)
    else:
        albedo = scene_view.materials.evaluate_one("albedo", vertex.si, vertex.valid)
    return replace(vertex, albedo=dr.detach(albedo))


@carrying()
def bounce(
    scene_view: SceneView,
    vertex: Vertex,
    sampler: mi.Sampler,
    guide: LightGuide | None = None,
) -> Bounce:
    """Sample T at a vertex: one emitter sample and one of direction, combined by MIS.

    The direction is drawn by the BSDF, or with a guide by one of the two, with the density of both
    together. Sampling is detached; the BSDF is evaluated with gradients (value / detached density).

    Args:
        guide: prepared; None: the BSDF alone draws directions.

    Paper: Eq. 1, Eq. 8, Sec. 4.2, 5.2.
    """
    scene, si, bsdf, active = scene_view.scene, vertex.si, vertex.bsdf, vertex.valid
    ctx = mi.BSDFContext()
    # A cut-out stopped the ray with probability `opacity`, so its material scatters as if it were
    # opaque. Mitsuba 3.9.1 scales that material's value and density by the opacity: `inv_opacity`
    # undoes it, and in value / density it cancels. Mitsuba samples the material where the first
    # random number is below the opacity, hence `number * opacity`. (A context without the `Null`
    # lobe does the opposite of what it should: it lets every ray pass.)
    opacity = vertex.opacity if scene_view.has_chains else mi.Float(1)
    inv_opacity = dr.rcp(opacity)
    mixture = None if guide is None else mixture_at(guide, vertex)

    # -------------------------------- Emitter sampling --------------------------------

    ds, em_weight = sample_emitter(scene, si, sampler.next_2d(), active, holes=scene_view.has_holes)
    active_em = active & (ds.pdf != 0)
    bsdf_em, bsdf_pdf_em = bsdf.eval_pdf(ctx, si, si.to_local(ds.d), active_em)
    pdf_em = bsdf_pdf_em * inv_opacity
    if mixture is not None:
        pdf_em = mixture.pdf(pdf_em, ds.d)
    mis_em = dr.select(ds.delta, 1, mis_weight(ds.pdf, pdf_em))
    direct = dr.select(active_em, bsdf_em * em_weight * mis_em * inv_opacity, 0)

    # -------------------------- Detached sampling of directions -----------------------

    with dr.suspend_grad():
        number = sampler.next_1d()
        guided = mi.Bool(False)
        if mixture is not None:
            # One number decides who draws, and then the lobe.
            guided, number = mixture.decide(number)
        square = sampler.next_2d()
        bs, bs_weight = bsdf.sample(ctx, si, number * opacity, square, active)
        wo, pdf, delta = bs.wo, bs.pdf, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        goes_on = active & (bs.pdf > 0) & (dr.max(bs_weight) > 0)
        goes_on &= ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        if mixture is not None:
            found = mixture.guide.sample(mixture.cell, square)
            wo = dr.select(guided, si.to_local(found), wo)
            delta, goes_on = delta & ~guided, active & (guided | goes_on)
        ray = si.spawn_ray(si.to_world(wo))

    choice = None
    if mixture is None:
        value = bsdf.eval(ctx, si, wo, goes_on & ~delta)
    else:
        value, own = bsdf.eval_pdf(ctx, si, wo, goes_on & ~delta)
        with dr.suspend_grad():
            goes_on &= delta | (dr.max(dr.detach(value)) > 0)
            choice = Choice(mixture.cell, ray.d, dr.detach(own) * inv_opacity)
            pdf = dr.select(delta, pdf, mixture.pdf(choice.pdf, ray.d) * opacity)
    smooth = value * dr.select(pdf > 0, dr.rcp(pdf), 0)
    weight = dr.select(goes_on, dr.select(delta, bs_weight, smooth), 0)

    # Evaluated together here: each reduction further on would compute them again.
    evaluate(sampler, direct, weight, ray, goes_on, pdf, delta, choice)
    origin = Scattering(dr.detach(si), pdf * inv_opacity, delta)
    following = find_vertex(scene_view, ray, goes_on, sampler, origin=origin)
    return Bounce(direct, weight, following, choice)


def mixture_at(guide: LightGuide, vertex: Vertex) -> Mixture:
    """The guide and the BSDF; it alone where it has directions without a density (a coating)."""
    # A cut-out's way through is no direction of a bounce: what is met here was stopped by it.
    flags = vertex.bsdf.flags()
    single = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    single |= mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
    dense = vertex.valid & ~single
    return guide.mixture(guide.cell(vertex.si.p, vertex.n, vertex.valid), dense)


def transported(step: Bounce, radiance: mi.Color3f) -> mi.Color3f:
    """One sample of T(L) from a bounce and the reflected radiance L at its next vertex.

    Paper: Eq. 1, Eq. 12.
    """
    return step.direct + step.weight * (step.next.emitted + step.next.throughput * radiance)
