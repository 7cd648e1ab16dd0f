"""Whole paths, differentiated with all of them in memory, in a wavefront that becomes narrower.

Russian roulette and paths that leave the scene empty lanes. A recorded step (`dr.freeze`) cannot
have widths that depend on data: products of matrices and packed rows keep the width that they were
traced with (Dr.Jit 1.5; a recorded `dr.compress` is traced anew in every step where small arrays
take gradients). So widths are planned once, from the survivors of a first batch, and in a step the
paths that go on are moved into that many lanes. Should there be more of them than lanes, all are
less likely to survive, and count as much more: no plan makes an image or a gradient biased.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from .operator import attach_material, bounce
from .vertex import SceneView, Vertex, evaluate, find_vertex

#: Headroom for batches with more survivors than the first, as factors on the lanes: without Russian
#: roulette, where geometry decides, and with it, where brighter materials add survivors.
_RESERVE, _RESERVE_OF_ROULETTE = 1.1, 1.5
#: Widths are the first one divided by powers of this number's square root: few sizes, few kernels.
_STEPS_AN_OCTAVE = 2
#: The narrowest half of a wavefront.
_FEWEST = 8
#: Probabilities to survive are multiples of 1 / _UNIT, so that their sums are exact.
_UNIT = 1 << 24
#: The largest probability to survive Russian roulette; Mitsuba's integrators have the same.
_MOST_LIKELY = 0.95
#: Smaller ones are this multiple of the throughput; Mitsuba's are the throughput itself. A product
#: of n factors has a derivative of n terms, so that long paths count more in gradients than in
#: images. On the demo, with 14 bounces and an albedo of 0.5, Mitsuba's doubles the variance of
#: gradients, and this adds a quarter; variance times lanes falls to 0.78 and 0.53 of what it is
#: without roulette, and with an albedo of 0.7 to 0.99 and 0.84.
_FAVOUR = 3.0

#: How often the wavefront has been narrowed by √2 in all before each bounce. Not its widths: the
#: batch that plans may be smaller than that of a step.
Plan = tuple[int, ...]


@dataclass(frozen=True)
class PathLimits:
    """How far paths are followed.

    Args:
        max_depth: number of bounces followed, plus one (Mitsuba's meaning: 1 is emission only).
            Specular interactions are not counted.
        rr_depth: bounces that no path loses to Russian roulette: with 5, the sixth interaction is
            the first that it may take away. (With Mitsuba's `prb`, 3.9.1, it is the seventh.)
        hide_emitters: whether cameras see neither environment nor area emitters.
    """

    max_depth: int
    rr_depth: int
    hide_emitters: bool


@dataclass
class _Survivors:
    """Paths that go on, in a narrower wavefront."""

    parent: mi.UInt32  # the lane that each came from
    taken: mi.Bool  # whether there is a path in a lane of the narrower wavefront
    slot: mi.UInt32  # the lane that each of the former lanes goes on in
    kept: mi.Bool  # whether it goes on
    weight: mi.Float  # of those that go on: 1 / probability


@dataclass
class _Segment:
    """One bounce of all paths that get so far; see `Bounce`."""

    survivors: _Survivors | None  # None: nothing was narrowed before this bounce
    direct: mi.Color3f
    weight: mi.Color3f
    emitted: mi.Color3f  # at the next vertex
    throughput: mi.Color3f  # of the specular chain to it


def path_light(
    scene_view: SceneView,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    spp: int,
    limits: PathLimits,
    plan: Plan,
) -> mi.Color3f:
    """Radiance along camera rays, by whole paths; differentiable in materials and lights.

    Sampling is detached, and so is the probability to survive. The two halves of each pixel's
    samples share no random decision.

    Args:
        ray: world space rays, `spp` consecutive lanes a pixel.
        sampler: seeded for as many lanes; it is advanced.
        spp: samples a pixel, an even number.
        plan: from `plan_widths`; any plan gives the same expectation.

    Returns:
        Linear RGB radiance, one lane a ray.

    Paper: Eq. 1, Eq. 2, Sec. 6.
    """
    lanes = dr.width(ray)

    def light(ray: mi.Ray3f) -> mi.Color3f:
        return _gathered_light(
            *_follow(scene_view, ray, sampler, limits, lambda n, _: _width(plan[n - 1], lanes))
        )

    if not any(plan):
        return light(ray)
    order, back = _by_halves(lanes, spp)
    found = light(dr.gather(type(ray), ray, order))
    return dr.gather(mi.Color3f, found, back, mode=dr.ReduceMode.NoConflicts)


def plan_widths(
    scene_view: SceneView,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    spp: int,
    limits: PathLimits,
    gain: float,
) -> Plan:
    """Widths of the wavefront for each bounce, from the paths along these rays.

    Roulette that would not narrow it is left out: it would only add noise.

    Args:
        scene_view: with the materials of the first step.
        ray: world space rays, `spp` consecutive lanes a pixel.
        sampler: seeded for as many lanes; it is advanced.
        spp: samples a pixel, an even number.
        limits: how far paths are followed.
        gain: how many times as much as now surfaces may come to reflect, 1 or more. Narrower
            wavefronts than that would need make gradients of bright rooms noisy.
    """
    lanes = dr.width(ray)
    plan: list[int] = []

    def choose(number: int, survival: mi.Float) -> int:
        reserve = _RESERVE_OF_ROULETTE if number > limits.rr_depth else _RESERVE
        need = reserve * float(dr.max(dr.block_sum(survival, dr.width(survival) // 2))[0])
        level = plan[-1] if plan else 0
        while _width(level + 1, lanes) < _width(level, lanes) and _half(level + 1, lanes) >= need:
            level += 1
        plan.append(level)
        return _width(level, lanes)

    with dr.suspend_grad():
        ray = dr.gather(type(ray), ray, _by_halves(lanes, spp)[0])
        _follow(scene_view, ray, sampler, limits, choose, gain)
    return tuple(plan)


def _half(level: int, lanes: int) -> float:
    return lanes / 2 * 2 ** (-level / _STEPS_AN_OCTAVE)


def _width(level: int, lanes: int) -> int:
    """Lanes of a wavefront that was narrowed so often."""
    return min(lanes, 2 * max(_FEWEST, round(_half(level, lanes))))


def _by_halves(lanes: int, spp: int) -> tuple[mi.UInt32, mi.UInt32]:
    """Sort lanes by half of their pixel's samples: the permutation, and its inverse.

    Roulette treats the halves separately, so they stay independent, as split halves require.
    """
    half = spp // 2
    lane = dr.arange(mi.UInt32, lanes)
    second = lane >= lanes // 2
    place = lane - dr.select(second, lanes // 2, 0)
    order = place // half * spp + place % half + dr.select(second, half, 0)
    sample = lane % spp
    back = lane // spp * half + sample % half + dr.select(sample >= half, lanes // 2, 0)
    dr.eval(order, back)
    return order, back


def _follow(
    scene_view: SceneView,
    ray: mi.Ray3f,
    sampler: mi.Sampler,
    limits: PathLimits,
    choose: Callable[[int, mi.Float], int],
    gain: float = 1.0,
) -> tuple[Vertex, list[_Segment]]:
    """Follow paths to their end.

    Args:
        choose: gives the width for a bounce (from 1), from the probabilities to survive until then.
        gain: what a bounce reflects counts so many times in these probabilities.
    """
    x = x1 = find_vertex(
        scene_view, ray, mi.Bool(True), sampler, hide_emitters=limits.hide_emitters
    )
    β = dr.detach(x.throughput)
    segments: list[_Segment] = []
    for number in range(1, limits.max_depth):
        alive = x.valid & (dr.max(β) > 0)
        likely = mi.Float(1)
        if number > limits.rr_depth:
            likely = dr.minimum(_FAVOUR * dr.max(β) * gain ** (number - 1), _MOST_LIKELY)
        survival = dr.select(alive, likely, 0)
        width = choose(number, survival)
        survivors = None
        if width < dr.width(x.valid):
            survivors = _roulette(survival, width, sampler)
            x, β = _moved(x, β, survivors)
            sampler = _reseeded(sampler, width)
            evaluate(sampler, x, β)
        x = attach_material(scene_view, x)
        step = bounce(scene_view, x, sampler)
        x = step.next
        segments.append(_Segment(survivors, step.direct, step.weight, x.emitted, x.throughput))
        β *= dr.detach(step.weight) * x.throughput
        dr.eval(β)
    return x1, segments


def _roulette(survival: mi.Float, width: int, sampler: mi.Sampler) -> _Survivors:
    """Decide which paths go on, by systematic sampling in each half of the wavefront.

    A path goes on if a whole number lies between the sums of probabilities before and after it,
    from a random start. As many go on as are expected, rounded up or down, and all are numbered.

    Args:
        survival: probability to survive, in [0, 1], one lane a path.
        width: lanes of the narrower wavefront.
    """
    lanes, half, room = dr.width(survival), dr.width(survival) // 2, width // 2
    lane = dr.arange(mi.UInt32, lanes)
    second = dr.select(lane >= half, mi.UInt32(1), 0)
    start = mi.UInt32(sampler.next_1d() * _UNIT)
    share = mi.UInt32(survival * _UNIT)
    evaluate(sampler, start, share)
    # Where there is no room for as many as are expected, all are less likely to survive. Some room
    # is left for rounding: of the quotient, and of shares to one unit at least.
    total = dr.block_sum(mi.UInt64(share), half)
    fits = mi.Float(room * (_UNIT - 16) - half) / mi.Float(total)
    fits = dr.gather(mi.Float, dr.select(total > room * _UNIT, fits, 1), second)
    less = dr.maximum(mi.UInt32(mi.Float(share) * fits), 1)
    share = dr.select((share > 0) & (fits < 1), less, share)
    dr.eval(share)
    before = dr.block_prefix_sum(mi.UInt64(share), half)
    before += mi.UInt64(dr.gather(mi.UInt32, start, second * half))
    first, last = before // _UNIT, (before + mi.UInt64(share)) // _UNIT
    kept = last > first
    slot = mi.UInt32(first) + second * room
    weight = dr.select(kept, _UNIT / mi.Float(share), 0)

    source = dr.zeros(mi.UInt32, width)
    dr.scatter(source, lane + 1, slot, kept, mode=dr.ReduceMode.Permute)
    taken = source > 0
    survivors = _Survivors(dr.select(taken, source - 1, 0), taken, slot, kept, weight)
    dr.eval(survivors)
    return survivors


def _moved(x: Vertex, β: mi.Color3f, survivors: _Survivors) -> tuple[Vertex, mi.Color3f]:
    """Paths in the lanes that they go on in; their emission so far stays behind."""
    with dr.suspend_grad():
        moved = replace(x, emitted=dr.zeros(mi.Color3f)).gathered(survivors.parent)
        moved.valid &= survivors.taken
        return moved, dr.gather(mi.Color3f, β * survivors.weight, survivors.parent)


def _reseeded(sampler: mi.Sampler, width: int) -> mi.Sampler:
    """A sampler for another number of lanes, whose seed is drawn from this one."""
    a, b = sampler.next_2d()
    evaluate(sampler, a, b)
    first = mi.UInt32(0)
    high, low = (mi.UInt32(dr.gather(mi.Float, x, first) * (1 << 16)) for x in (a, b))
    narrower = sampler.fork()
    narrower.seed((high << 16) | low, width)
    return narrower


def _gathered_light(x1: Vertex, segments: list[_Segment]) -> mi.Color3f:
    """The light of all segments, from the last to the camera."""
    radiance = mi.Color3f(0)
    for number in range(len(segments), 0, -1):
        s = segments[number - 1]
        radiance = s.direct + s.weight * (s.emitted + s.throughput * radiance)
        if number > 1 or s.survivors is not None:
            radiance = dr.custom(_Returned, radiance, s.survivors)
    return x1.emitted + x1.throughput * radiance


class _Returned(dr.CustomOp):
    """Radiance of paths in the lanes that they came from; zero where they did not go on.

    Its value is evaluated, and on the way back its gradient, so that each bounce has a kernel of
    its own. Both ways are gathers: adding up in memory would be slower.
    """

    def eval(self, radiance, survivors):
        self.survivors = survivors
        dr.eval(radiance)
        if survivors is None:
            return mi.Color3f(radiance)
        s = survivors
        returned = s.weight * dr.gather(mi.Color3f, radiance, s.slot, s.kept)
        dr.eval(returned)
        return returned

    def backward(self):
        gradient, s = self.grad_out(), self.survivors
        if s is None:
            dr.eval(gradient)
        else:
            gradient = s.weight * gradient
            dr.eval(gradient)
            gradient = dr.gather(mi.Color3f, gradient, s.parent, s.taken)
            dr.eval(gradient)
        self.set_grad_in("radiance", gradient)

    def name(self):
        return "radiance of a bounce"
