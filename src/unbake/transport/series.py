"""The Neumann series Σ Tⁱ(E): path tracing with the operator of `operator.py`.

It renders recovered materials with full global illumination. Mitsuba's `path` gives the same image
(a test compares them), but would evaluate the networks inside BSDFs, an order of magnitude slower.
"""

from __future__ import annotations

from dataclasses import fields, replace

import drjit as dr
import mitsuba as mi

from .operator import attach_material, bounce
from .vertex import Vertex, World, find_vertex


def path_traced(
    world: World,
    ray: mi.Ray3f,
    seed: int,
    *,
    max_depth: int,
    rr_depth: int,
    see_lights: bool,
) -> mi.Color3f:
    """Radiance along rays, by path tracing; no gradients.

    Paths that have ended are taken out of the wavefront whenever they are half of it.

    Args:
        ray: world space rays.
        seed: of all random numbers.
        max_depth: number of bounces followed, plus one (Mitsuba's meaning: 1 is emission only).
            Specular interactions are not counted.
        rr_depth: bounces after which Russian roulette may end a path.

    Returns:
        Linear RGB radiance, one lane a ray.

    Paper: Sec. 3, Sec. 6.
    """
    sampler = mi.load_dict({"type": "independent"})
    lanes = dr.width(ray)
    with dr.suspend_grad():
        _reseed(sampler, seed, 0, lanes)
        v = find_vertex(world, ray, mi.Bool(True), sampler, see_lights=see_lights)
        total = mi.Color3f(v.emitted)
        lane = dr.arange(mi.UInt32, lanes)
        β = mi.Color3f(v.throughput)

        for depth in range(1, max_depth):
            keep = v.valid & (dr.max(β) > 0)
            if depth >= rr_depth:
                survival = dr.minimum(dr.max(β), 0.95)
                keep &= sampler.next_1d() < survival
                β *= dr.select(keep, dr.rcp(survival), 0)
            alive = dr.compress(keep)
            if len(alive) == 0:
                break
            v = replace(v, valid=keep)
            if 2 * len(alive) <= dr.width(lane):
                v, β, lane = _compacted(alive, v, β, lane)
            _reseed(sampler, seed, depth, dr.width(lane))

            step = bounce(world, attach_material(world, v), sampler)
            dr.scatter_add(total, β * (step.direct + step.weight * step.next.emitted), lane)
            β *= step.weight * step.next.throughput
            v = step.next
            dr.eval(total, β, lane)
    return total


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
    values = {f.name: getattr(v, f.name) for f in fields(Vertex)}
    v = Vertex(**{name: dr.gather(type(x), x, chosen) for name, x in values.items()})
    v.valid &= slot < dr.opaque(mi.UInt32, count)
    return v, dr.gather(mi.Color3f, β, chosen), dr.gather(mi.UInt32, lane, chosen)
