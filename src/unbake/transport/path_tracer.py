"""The Neumann series Σ Tⁱ(E): path tracing with the operator of `operator.py`.

It renders recovered materials with full global illumination. Mitsuba's `path` gives the same image
(a test compares them), but would evaluate the networks inside BSDFs, an order of magnitude slower.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .operator import attach_material, bounce
from .vertex import SceneView, Vertex, find_vertex


def path_traced(
    scene_view: SceneView,
    ray: mi.Ray3f,
    seed: int,
    *,
    max_depth: int,
    rr_depth: int,
    hide_emitters: bool,
) -> mi.Color3f:
    """Radiance along rays, by path tracing; no gradients.

    Paths that have ended are taken out of the wavefront whenever they are half of it.

    Args:
        ray: world space rays.
        seed: of all random numbers.
        max_depth: number of bounces followed, plus one (Mitsuba's meaning: 1 is emission only).
            Specular interactions are not counted.
        rr_depth: number of the first bounce, from 1, that Russian roulette may take away.

    Returns:
        Linear RGB radiance, one lane a ray.

    Paper: Sec. 3, Sec. 6.
    """
    with dr.suspend_grad():
        total = dr.zeros(mi.Color3f, dr.width(ray))
        for step in _follow(
            scene_view, ray, seed, max_depth, rr_depth, 0.95, hide_emitters=hide_emitters
        ):
            dr.scatter_add(total, step.light, step.lane)
            dr.eval(total)
    return total


def path_lengths(
    scene_view: SceneView,
    ray: mi.Ray3f,
    seed: int,
    *,
    max_depth: int,
    rr_depth: int,
    most_likely: float = 1.0,
) -> mi.Float:
    """Surface interactions of paths along rays, followed as `path_traced` does.

    Args:
        max_depth: paths end at that many interactions.
        rr_depth: the first interaction that Russian roulette may take away.
        most_likely: largest probability to survive it.

    Returns:
        One lane a ray; zero where nothing was hit.

    Paper: Table 1, Table 2.
    """
    with dr.suspend_grad():
        length = dr.zeros(mi.Float, dr.width(ray))
        # One bounce more than there are interactions to count: its own start is the last of them.
        depth = max_depth + 1
        for step in _follow(
            scene_view, ray, seed, depth, rr_depth, most_likely, hide_emitters=False
        ):
            dr.scatter_add(length, 1, step.lane, step.scattered)
            dr.eval(length)
    return length


@dataclass
class _Step:
    """Paths that are followed by one bounce, or just begun."""

    lane: mi.UInt32  # the rays that they belong to
    scattered: mi.Bool  # whether they have bounced, rather than ended before or begun
    light: mi.Color3f  # what arrives at the cameras of it


def _follow(
    scene_view: SceneView,
    ray: mi.Ray3f,
    seed: int,
    max_depth: int,
    rr_depth: int,
    most_likely: float,
    *,
    hide_emitters: bool,
) -> Iterator[_Step]:
    """Follow paths to their end; all that is yielded is evaluated."""
    sampler = mi.load_dict({"type": "independent"})
    lane = dr.arange(mi.UInt32, dr.width(ray))
    _reseed(sampler, seed, 0, dr.width(ray))
    v = find_vertex(scene_view, ray, mi.Bool(True), sampler, hide_emitters=hide_emitters)
    β = mi.Color3f(v.throughput)
    yield _evaluated(_Step(lane, dr.zeros(mi.Bool, dr.width(ray)), mi.Color3f(v.emitted)))

    for depth in range(1, max_depth):
        keep = v.valid & (dr.max(β) > 0)
        if depth >= rr_depth:
            survival = dr.minimum(dr.max(β), most_likely)
            keep &= sampler.next_1d() < survival
            β *= dr.select(keep, dr.rcp(survival), 0)
        alive = dr.compress(keep)
        if len(alive) == 0:
            break
        v = replace(v, valid=keep)
        if 2 * len(alive) <= dr.width(lane):
            v, β, lane = _compacted(alive, v, β, lane)
        _reseed(sampler, seed, depth, dr.width(lane))

        step = bounce(scene_view, attach_material(scene_view, v), sampler)
        light = β * (step.direct + step.weight * step.next.emitted)
        β *= step.weight * step.next.throughput
        dr.eval(β)
        yield _evaluated(_Step(lane, v.valid, light))
        v = step.next


def _evaluated(step: _Step) -> _Step:
    dr.eval(step)
    return step


def _reseed(sampler: mi.Sampler, seed: int, depth: int, lanes: int) -> None:
    sampler.seed(dr.opaque(mi.UInt32, (seed * 0x9E3779B1 + depth) & 0xFFFFFFFF), lanes)


def _compacted(
    alive: mi.UInt32, v: Vertex, β: mi.Color3f, lane: mi.UInt32
) -> tuple[Vertex, mi.Color3f, mi.UInt32]:
    """Gather the lanes that are alive into a wavefront of half, a quarter, … of the size.

    Kernels with matrix products are compiled for one size, so that there must be few sizes.
    """
    count, size = len(alive), dr.width(lane)
    while 2 * count <= size and size > 1:
        size = (size + 1) // 2
    slot = dr.arange(mi.UInt32, size)
    chosen = dr.gather(mi.UInt32, alive, dr.minimum(slot, dr.opaque(mi.UInt32, count - 1)))
    v = v.gathered(chosen)
    v.valid &= slot < dr.opaque(mi.UInt32, count)
    return v, dr.gather(mi.Color3f, β, chosen), dr.gather(mi.UInt32, lane, chosen)
