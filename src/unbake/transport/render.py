"""Images of a scene view: radiance and materials."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.materials import carrying, read_carried
from ..fields.radiance import RadianceField
from .emitter_sampling import has_cut_outs, lights_pierce
from .operator import attach_material
from .path_sample import Requirements, rhs, trace
from .path_tracer import path_traced
from .vertex import SceneView, find_vertex

#: Camera rays through pixels: pixel numbers and positions inside the pixels to world space rays. In
#: quotes, because Mitsuba has no such types before a variant is set.
RayGenerator = Callable[["mi.UInt32", "mi.Point2f"], "mi.Ray3f"]

#: Camera samples in flight at once; bounds the memory.
WAVEFRONT = 1 << 20


@carrying()
def render_radiance(
    scene_view: SceneView,
    through: RayGenerator,
    pixels: int,
    spp: int,
    *,
    seed: int,
    max_depth: int,
    rr_depth: int,
    hide_emitters: bool,
    done: Callable[[float], object] | None = None,
) -> np.ndarray:
    """Path trace pixels with full global illumination (box filter).

    Args:
        scene_view: what is seen.
        through: rays of the pixels.
        pixels: how many there are.
        spp: samples a pixel.
        seed: of all random numbers.
        max_depth: longest light path.
        rr_depth: first bounce that Russian roulette may take away.
        hide_emitters: whether emitters that are seen directly are left out.
        done: called with the share of the pixels that are rendered, after each wavefront.

    Returns:
        Linear RGB, float32, shape (pixels, 3).

    Paper: Eq. 2, Sec. 6.
    """
    image = np.zeros((pixels, 3), np.float32)
    for part, ray, part_seed in parts_of(through, pixels, spp, seed):
        radiance = path_traced(
            scene_view,
            ray,
            part_seed,
            max_depth=max_depth,
            rr_depth=rr_depth,
            hide_emitters=hide_emitters,
        )
        image[part] = np.stack([_pixel_means(c, spp) for c in radiance], -1)
        if done is not None:
            done(part.stop / pixels)
    return image


@carrying()
def render_one_bounce(
    scene_view: SceneView,
    radiance: RadianceField,
    through: RayGenerator,
    pixels: int,
    spp: int,
    *,
    seed: int,
    hide_emitters: bool,
) -> np.ndarray:
    """Render pixels with one bounce that ends in the radiance field, E + T(L_θ) (box filter).

    Returns:
        Linear RGB, float32, shape (pixels, 3).

    Paper: Eq. 12.
    """
    needed = Requirements(1, constant=frozenset([2]))
    image = np.zeros((pixels, 3), np.float32)
    sampler = mi.load_dict({"type": "independent"})
    for part, ray, part_seed in parts_of(through, pixels, spp, seed):
        sampler.seed(dr.opaque(mi.UInt32, part_seed), dr.width(ray))
        with dr.suspend_grad():
            sample = trace(scene_view, radiance, ray, sampler, needed, hide_emitters=hide_emitters)
            value = rhs(sample, sample.radiance[1])
            image[part] = np.stack([_pixel_means(c, spp) for c in value], -1)
    return image


@carrying()
def render_materials(
    scene_view: SceneView, through: RayGenerator, pixels: int, spp: int, *, seed: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The materials of the surfaces that pixels see (cut-outs let rays pass).

    Returns:
        The unknown quantities by name, each (pixels, channels), or where no material is unknown the
        scene's own albedo; and coverage (pixels,), the fraction of samples that see a material that
        is optimized: not an emitter, nor any other BSDF, nor background. Quantities are means over
        those samples, zero where there are none.
    """
    values: dict[str, np.ndarray] = {}
    coverage = np.zeros(pixels, np.float32)
    sampler = mi.load_dict({"type": "independent"})
    for part, ray, part_seed in parts_of(through, pixels, spp, seed):
        sampler.seed(dr.opaque(mi.UInt32, part_seed), dr.width(ray))
        with dr.suspend_grad():
            v = attach_material(scene_view, find_vertex(scene_view, ray, mi.Bool(True), sampler))
            counted = v.valid & v.direct_view & scene_view.is_optimized(v.si.shape)
            material = {"albedo": v.albedo}
            if scene_view.materials is not None:
                material = read_carried(v.si, scene_view.materials)
            weighted = {
                name: [
                    dr.select(counted, x, 0) for x in ([value] if dr.depth_v(value) == 1 else value)
                ]
                for name, value in material.items()
            }
            weight = dr.select(counted, mi.Float(1), 0)
            dr.eval(weighted, weight)
        coverage[part] = _pixel_means(weight, spp)
        share = np.maximum(coverage[part], 1e-6)
        for name, channels in weighted.items():
            shape = (pixels, len(channels))
            whole = values.setdefault(name, np.zeros(shape, np.float32))
            whole[part] = np.stack([_pixel_means(x, spp) / share for x in channels], -1)
    return values, coverage


def path_integrator(scene: mi.Scene) -> str:
    """The name of Mitsuba's path tracer for a scene: `path`, or `volpath` where `path` is wrong.

    Where a cut-out's opacity is a fraction, `path` of Mitsuba 3.9.1 multiplies the light of emitter
    sampling by it twice: a leaf of opacity 0.5 is half as bright as it should be. Lights without
    size do not shine through thin panes in it, as no ray meets them.
    """
    return "volpath" if has_cut_outs(scene) or lights_pierce(scene) else "path"


def parts_of(
    through: RayGenerator, pixels: int, spp: int, seed: int
) -> Iterator[tuple[slice, mi.Ray3f, int]]:
    """Runs of pixels that fit the wavefront, with the rays of all their samples."""
    step = max(1, WAVEFRONT // spp)
    sampler = mi.load_dict({"type": "independent"})
    for first in range(0, pixels, step):
        last = min(first + step, pixels)
        part_seed = int(np.random.SeedSequence([seed, first]).generate_state(1)[0])
        sampler.seed(dr.opaque(mi.UInt32, part_seed ^ 0x5BD1E995), (last - first) * spp)
        lane = dr.arange(mi.UInt32, (last - first) * spp)
        pixel = lane // dr.opaque(mi.UInt32, spp) + dr.opaque(mi.UInt32, first)
        ray = through(pixel, sampler.next_2d())
        dr.eval(ray)
        yield slice(first, last), ray, part_seed


def _pixel_means(samples: mi.Float, spp: int) -> np.ndarray:
    return np.array(dr.block_sum(samples, spp)) / spp
