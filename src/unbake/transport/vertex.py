"""From a ray to the first surface that is not specular, where L_θ is defined (Sec. 7).

Symbols follow Mitsuba: `si` surface interaction, `pi` its preliminary form, `ds` a direction
sample, β throughput. Directions point away from the surface.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import drjit as dr
import mitsuba as mi

from ..fields.materials import Materials, carrying
from ..fields.shapes import met_shapes, registry_number
from .emitter_sampling import bsdf_flags, lets_pass
from .optimized import optimized_shapes


@dataclass(frozen=True)
class SceneView:
    """A scene, with fields in the place of its unknown materials.

    Args:
        scene: geometry, emitters and BSDFs.
        materials: fields that stand in for the unknown materials; None: the scene's own are used.
        max_specular: longest chain of specular interactions followed; longer ones end in black.
        has_chains: whether any surface of the scene is specular or cut out (found by `of`).
        has_holes: whether any lets rays pass as they are: cut-outs, thin panes (found by `of`).
        has_area_emitters: whether any surface of the scene emits light (found by `of`).
        optimized: numbers of the shapes whose material is optimized (found by `of`).
    """

    scene: mi.Scene
    materials: Materials | None
    max_specular: int
    has_chains: bool
    has_holes: bool
    has_area_emitters: bool
    optimized: frozenset[int]

    @staticmethod
    def of(scene: mi.Scene, materials: Materials | None, max_specular: int) -> SceneView:
        """The view of a scene; looks at every BSDF, also at those inside of instances."""
        holes, smooth = lets_pass(scene), int(mi.BSDFFlags.Smooth)
        chains = holes or any(not flags & smooth for flags in bsdf_flags(scene))
        found = chains, holes, has_area_emitters(scene), optimized_shapes(scene)
        return SceneView(scene, materials, max_specular, *found)

    def with_scene(self, scene: mi.Scene) -> SceneView:
        """The same around this handle of the scene (frozen functions bring their own)."""
        return replace(self, scene=scene)

    def is_optimized(self, shape: mi.ShapePtr) -> mi.Bool:
        """Whether the material of shapes is optimized; False where there is no shape."""
        # Each shape is asked once, while this is traced. (A table would be an array that comes
        # from outside of a frozen function.)
        return dr.dispatch(shape, lambda s: mi.Bool(registry_number(s) in self.optimized))


@dataclass
class Vertex:
    """A point on a surface that is not specular, with the specular chain that leads to it.

    All colours are linear RGB radiance, W·sr⁻¹·m⁻².
    """

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    valid: mi.Bool  # whether there is such a point
    emitted: mi.Color3f  # emission on the way, weighted
    throughput: mi.Color3f  # of the specular chain
    opacity: mi.Float  # probability with which a cut-out stopped the ray here
    direct_view: mi.Bool  # no mirror or glass on the way
    albedo: mi.Color3f  # of the material at the point, linear RGB

    @property
    def w(self) -> mi.Vector3f:
        """Unit direction back along the ray, world space."""
        return self.si.to_world(self.si.wi)

    @property
    def n(self) -> mi.Normal3f:
        """Shading normal on the side of `w`, world space."""
        n = self.si.sh_frame.n
        return mi.Normal3f(dr.select(self.si.wi.z < 0, -n, n))

    def gathered(self, lanes: mi.UInt32) -> Vertex:
        """The vertices of some lanes."""
        values = {f.name: getattr(self, f.name) for f in fields(Vertex)}
        return Vertex(**{name: dr.gather(type(v), v, lanes) for name, v in values.items()})


@dataclass
class Scattering:
    """The BSDF sample that made a ray: needed for the MIS weight of emission that it meets."""

    si: mi.SurfaceInteraction3f
    pdf: mi.Float  # solid angle
    delta: mi.Bool


@carrying()
def find_vertex(
    scene_view: SceneView,
    ray: mi.Ray3f,
    active: mi.Bool,
    sampler: mi.Sampler,
    *,
    origin: Scattering | None = None,
    hide_emitters: bool = False,
) -> Vertex:
    """Follow a ray through mirrors, glass and cut-outs to the first surface that scatters.

    Args:
        origin: the BSDF sample that made the ray; None for a ray from the camera.
        hide_emitters: whether a camera ray passes through area emitters and sees no environment,
            as in Mitsuba's integrators. Through cut-outs it sees neither, as in `volpath`.

    Returns:
        The vertex, evaluated; its material is not yet attached. Only `emitted` passes gradients, to
        lights.

    Paper: Sec. 7.
    """
    scene = scene_view.scene
    with dr.suspend_grad():
        ray, active = mi.Ray3f(ray), mi.Bool(active)
        pi = scene.ray_intersect_preliminary(ray, origin is None, active)
        if scene_view.has_area_emitters and hide_emitters:
            pi, ray = behind_area_emitters(scene, pi, ray, active)
        first = si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        seen = active & (si.is_valid() | (not hide_emitters))
        weight = _emission_weight(scene_view, si, origin, active)
        valid, β, opacity = active & si.is_valid(), mi.Color3f(1), mi.Float(1)
        direct_view = mi.Bool(valid)
        chain, end_weight = None, mi.Float(1)
        if scene_view.has_chains:
            hidden = hide_emitters and origin is None
            chain = _follow_chain(scene_view, pi, ray, valid, sampler, hidden, origin)
            pi, ray, β = chain.pi, chain.ray, chain.throughput
            direct_view &= ~chain.specular
            valid = valid & pi.is_valid()
            # Of a chain that ends nowhere it is that of the last hole, which may be 0.
            opacity = dr.select(valid, chain.opacity, 1)
            si = pi.compute_surface_interaction(ray, mi.RayFlags.All, valid | chain.sees_end)
            if scene_view.has_holes:
                end_weight = _emission_weight(
                    scene_view, si, origin, chain.sees_end & chain.straight
                )

    # The light that is met passes gradients: lighting may be unknown.
    emitted = weight * first.emitter(scene).eval(first, seen)
    if chain is not None:
        seen = chain.sees_end
        emitted += chain.emitted + β * end_weight * si.emitter(scene, seen).eval(si, seen)
    unknown = dr.zeros(mi.Color3f)
    vertex = Vertex(si, si.bsdf(), valid, emitted, β, opacity, direct_view, unknown)
    evaluate(sampler, vertex)
    return vertex


@dr.syntax
def behind_area_emitters(
    scene: mi.Scene, pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, active: mi.Bool
) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
    """The first hits behind area emitters, and the rays that start there.

    A hit says how far along its ray it is. (`skip_area_emitters` of Mitsuba's integrators moves the
    ray and returns the hit alone; `path` and `prb` go on with a ray that was not moved. What is not
    a mesh then lies elsewhere.)
    """
    pi, ray = mi.PreliminaryIntersection3f(pi), mi.Ray3f(ray)
    on_emitter = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    while dr.hint(on_emitter, label="behind lamps"):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, on_emitter)
        ray = dr.select(on_emitter, si.spawn_ray(ray.d), ray)
        pi_next = scene.ray_intersect_preliminary(ray, False, on_emitter)
        pi = dr.select(on_emitter, pi_next, pi)
        on_emitter &= pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711
    return pi, ray


def has_area_emitters(scene: mi.Scene) -> bool:
    """Whether any surface emits light."""
    return any(shape.emitter() is not None for shape in met_shapes(scene))


def rays_behind_area_emitters(scene: mi.Scene, ray: mi.Ray3f) -> mi.Ray3f:
    """Rays of cameras that see no lamps, starting behind those: for integrators of Mitsuba."""
    with dr.suspend_grad():
        everywhere = mi.Bool(True)
        pi = scene.ray_intersect_preliminary(ray, True, everywhere)
        _, moved = behind_area_emitters(scene, pi, ray, everywhere)
        dr.eval(moved)
    return moved


def _emission_weight(
    scene_view: SceneView, si: mi.SurfaceInteraction3f, origin: Scattering | None, active: mi.Bool
) -> mi.Float:
    """MIS weight of emission that a BSDF sample met, also through holes.

    1 for the camera, for delta lobes, and in lanes that are not active.
    """
    if origin is None:
        return mi.Float(1)
    emitter = si.emitter(scene_view.scene, active)
    lit = active & (emitter != None) & ~origin.delta  # noqa: E711
    ds = mi.DirectionSample3f(scene_view.scene, si, origin.si)
    pdf = scene_view.scene.pdf_emitter_direction(origin.si, ds, lit)
    return dr.select(lit, mis_weight(origin.pdf, pdf), 1)


@dataclass
class _Chain:
    """Specular and cut-out surfaces that a ray has passed, up to one that scatters."""

    pi: mi.PreliminaryIntersection3f  #: where it ends; invalid: nowhere, or in black
    ray: mi.Ray3f  #: the last one
    throughput: mi.Color3f
    emitted: mi.Color3f  #: by surfaces on the way, times the throughput up to each
    opacity: mi.Float  #: the probability with which a cut-out stopped the ray at the end
    specular: mi.Bool  #: whether any surface was
    #: Whether the ray went on as it was at all of them: emitter sampling finds what it meets, too.
    straight: mi.Bool
    #: Whether light at the end counts in addition to that of the first surface: the ray has left
    #: that one, has not ended in black, and may see lights.
    sees_end: mi.Bool


@dr.syntax
def _follow_chain(
    scene_view: SceneView,
    pi: mi.PreliminaryIntersection3f,
    ray: mi.Ray3f,
    active: mi.Bool,
    sampler: mi.Sampler,
    hide_emitters: bool,
    origin: Scattering | None,
) -> _Chain:
    """Follow specular and cut-out surfaces, as long as there are any.

    Args:
        hide_emitters: whether no light is seen through holes alone, as in `find_vertex`.
        origin: as there.
    """
    scene, limit, ctx = scene_view.scene, scene_view.max_specular, mi.BSDFContext()
    pi = mi.PreliminaryIntersection3f(pi)
    active = mi.Bool(active)
    β = mi.Color3f(1)
    emitted = mi.Color3f(0)
    opacity = mi.Float(1)
    any_specular = mi.Bool(False)
    straight = mi.Bool(True)
    lost = mi.Bool(False)
    hidden = mi.Bool(hide_emitters)
    holes = scene_view.has_holes
    looks_behind = scene_view.has_area_emitters and hide_emitters
    depth = mi.UInt32(0)

    def share(si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """What emitter sampling leaves of the light that is met; all where there are no holes."""
        return _emission_weight(scene_view, si, origin, active) if holes else mi.Float(1)

    while dr.hint(active, label="specular chain"):
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        bsdf = si.bsdf()
        flags = bsdf.flags()
        smooth = mi.has_flag(flags, mi.BSDFFlags.Smooth)

        # A cut-out lets the ray pass, or stops it, with the probability of its opacity.
        cut_out = active & smooth & mi.has_flag(flags, mi.BSDFFlags.Null)
        opacity = dr.select(cut_out, 1 - dr.mean(bsdf.eval_null_transmission(si, cut_out)), 1)
        passes = cut_out & (sampler.next_1d() >= opacity)

        specular = active & ~smooth
        any_specular |= specular
        passed = (passes | specular) & (depth > 0) & ~hidden
        found = si.emitter(scene, passed).eval(si, passed)
        emitted += β * share(si, passed & straight) * found
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d(), specular)
        β = dr.select(specular, β * weight, β)
        goes_straight = ~specular | mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        hidden &= goes_straight
        straight &= goes_straight

        # A chain that outgrows the limit, or is absorbed, ends in black.
        active = passes | specular
        black = active & ((depth >= limit) | (dr.max(β) <= 0))
        active &= ~black
        ray_next = si.spawn_ray(dr.select(passes, ray.d, si.to_world(bs.wo)))
        ray = dr.select(active, ray_next, ray)
        pi_next = scene.ray_intersect_preliminary(ray, False, active)
        if looks_behind:
            pi_next, ray = behind_area_emitters(scene, pi_next, ray, active & hidden)
        pi = dr.select(active, pi_next, pi)
        pi.valid &= ~black
        lost |= black
        depth = dr.select(active, depth + 1, depth)
        active &= pi.is_valid()

    sees_end = (depth > 0) & ~lost & ~hidden
    return _Chain(pi, ray, β, emitted, opacity, any_specular, straight, sees_end)


def evaluate(sampler: mi.Sampler, *values: object) -> None:
    """`dr.eval` for values and the state of a sampler, which `dr.eval` itself passes over.

    A state that is not evaluated holds all that was traced since, and has it computed again with
    the next number drawn.
    """
    sampler.schedule_state()
    dr.eval(*values)


def mis_weight(pdf_a: mi.Float, pdf_b: mi.Float) -> mi.Float:
    """Power heuristic, β = 2: the weight of a sample drawn with density `pdf_a` (Veach 1997).

    Densities of points on an emitter that see it edge on are larger than the root of the largest
    number: they are divided before they are squared.
    """
    ratio = pdf_b / pdf_a
    return dr.detach(dr.select((pdf_a > 0) & dr.isfinite(ratio), dr.rcp(1 + dr.square(ratio)), 0))
