"""Derivatives of pixels by one parameter of a material, as estimated by each method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.radiance import RadianceField
from ..transport.operator import Bounce, attach_albedo, attach_material, bounce
from ..transport.path_sample import reflected_radiance
from ..transport.render import RayGenerator, parts_of
from ..transport.vertex import SceneView, Vertex, find_vertex

#: Bounces before Russian roulette.
RR_DEPTH = 3


@final
@dataclass(frozen=True)
class Estimates:
    """Pixels and their derivatives: linear RGB, shape (pixels, 3).

    Args:
        image: with all light.
        derivative: of the image.
        cut: image and derivative by maximum path length, as Mitsuba counts (2 is direct light).
        attached: derivative by the number k of differentiable bounces, followed by the exact L. The
            image that belongs to it is the exact one.
        cached: image and derivative by k, with L_θ after k bounces; empty without L_θ.
    """

    image: np.ndarray
    derivative: np.ndarray
    cut: dict[int, tuple[np.ndarray, np.ndarray]]
    attached: dict[int, np.ndarray]
    cached: dict[int, tuple[np.ndarray, np.ndarray]]


def estimate(
    scene_view: SceneView,
    assign: Callable[[mi.Float], None],
    value: float,
    through: RayGenerator,
    pixels: int,
    spp: int,
    *,
    seed: int,
    max_depth: int,
    cut: Sequence[int],
    attached: Sequence[int],
    radiance: RadianceField | None = None,
) -> Estimates:
    """Estimate pixels and derivatives along the same paths for all methods.

    Each bounce is differentiated by itself in forward mode. The product rule along a path then
    gives the estimates of all methods: of those that end paths early, and of those that
    differentiate the first k bounces and take the incident radiance after them as constant: the
    exact one, found by following the same path further, or L_θ.

    Args:
        assign: sets the parameter of the scene.
        value: value of the parameter.
        through: makes the camera rays.
        pixels: number of pixels.
        spp: samples per pixel.
        seed: of all samples. Paths of other values get the same random numbers with the same seed,
            so that the difference of two images has little noise.
        max_depth: maximum path length that counts as all light.
        cut: maximum path lengths of methods that end paths earlier.
        attached: numbers k of differentiable bounces.
        radiance: L_θ of the scene with this value; it is constant.

    Paper: Fig. 4, Sec. 6.3.
    """
    names = ["image", "derivative"]
    names += [f"{what} {depth}" for depth in cut for what in ("cut", "cut'")]
    names += [f"attached {k}" for k in attached]
    if radiance is not None:
        names += [f"{what} {k}" for k in attached for what in ("cached", "cached'")]
    sums = {name: np.zeros((pixels, 3)) for name in names}
    for part, ray, part_seed in parts_of(through, pixels, spp, seed):
        estimates = _along(
            scene_view,
            assign,
            value,
            ray,
            part_seed,
            max_depth,
            set(cut),
            tuple(attached),
            radiance,
        )
        for name, samples in estimates.items():
            means = [np.array(dr.block_sum(c, spp)) / spp for c in samples]
            sums[name][part] = np.stack(means, -1)
    return Estimates(
        sums["image"],
        sums["derivative"],
        {depth: (sums[f"cut {depth}"], sums[f"cut' {depth}"]) for depth in cut},
        {k: sums[f"attached {k}"] for k in attached},
        {k: (sums[f"cached {k}"], sums[f"cached' {k}"]) for k in attached if radiance is not None},
    )


def _along(
    scene_view: SceneView,
    assign: Callable[[mi.Float], None],
    value: float,
    ray: mi.Ray3f,
    seed: int,
    max_depth: int,
    cut: set[int],
    attached: tuple[int, ...],
    radiance: RadianceField | None,
) -> dict[str, mi.Color3f]:
    """The estimates of each sample."""
    estimates: dict[str, mi.Color3f] = {}
    lanes = dr.width(ray)
    lane = dr.arange(mi.UInt32, lanes)
    sampler = _LaneSampler.of(lane, seed, 0)
    with dr.suspend_grad():
        x = find_vertex(scene_view, ray, mi.Bool(True), sampler)
    total, β = mi.Color3f(x.emitted), mi.Color3f(x.throughput)
    # Derivatives of throughput and sum: by all bounces, and by the first k bounces.
    ks = (max_depth, *attached)
    dβ = {k: dr.zeros(mi.Color3f, lanes) for k in ks}
    dtotal = {k: dr.zeros(mi.Color3f, lanes) for k in ks}
    for number in range(1, max_depth):
        keep = x.valid & (dr.max(β) > 0)
        if number >= RR_DEPTH:
            survival = dr.minimum(dr.max(β), 0.95)
            keep &= sampler.next_1d() < survival
            β *= dr.rcp(survival)
            dβ = {k: v * dr.rcp(survival) for k, v in dβ.items()}
        alive = dr.compress(keep)
        if len(alive) == 0:
            break
        x = x.gathered(alive)
        β, lane = dr.gather(mi.Color3f, β, alive), dr.gather(mi.UInt32, lane, alive)
        dβ = {k: dr.gather(mi.Color3f, v, alive) for k, v in dβ.items()}
        sampler = _LaneSampler.of(lane, seed, number)

        step, (d, w), (dd, dw) = _differentiated(scene_view, assign, value, x, sampler)
        x, e, t = step.next, dr.detach(step.next.emitted), dr.detach(step.next.throughput)
        light, dlight = d + w * e, dd + dw * e
        for k in ks:
            on = number <= k
            dr.scatter_add(dtotal[k], dβ[k] * light + (β * dlight if on else 0), lane)
            dβ[k] = (dβ[k] * w + (β * dw if on else 0)) * t
        dr.scatter_add(total, β * light, lane)
        β *= w * t
        dr.eval(total, β, dβ, dtotal, lane)
        if number + 1 in cut:
            estimates[f"cut {number + 1}"] = mi.Color3f(total)
            estimates[f"cut' {number + 1}"] = mi.Color3f(dtotal[max_depth])
        if radiance is not None and number in attached:
            before = {"cached": (total, β), "cached'": (dtotal[number], dβ[number])}
            ended = _ended(scene_view, radiance, x, lane, before)
            estimates |= {f"{name} {number}": image for name, image in ended.items()}
    assign(mi.Float(value))
    # What all paths ended before is complete.
    complete = {"image": total, "derivative": dtotal[max_depth]}
    complete |= {f"cut {depth}": total for depth in cut}
    complete |= {f"cut' {depth}": dtotal[max_depth] for depth in cut}
    complete |= {f"attached {k}": dtotal[k] for k in attached}
    if radiance is not None:
        complete |= {f"cached {k}": total for k in attached}
        complete |= {f"cached' {k}": dtotal[k] for k in attached}
    return complete | estimates


def _differentiated(
    scene_view: SceneView,
    assign: Callable[[mi.Float], None],
    value: float,
    x: Vertex,
    sampler: mi.Sampler,
) -> tuple[Bounce, tuple[mi.Color3f, mi.Color3f], tuple[mi.Color3f, mi.Color3f]]:
    """A bounce, with its direct light and weight, and the derivatives of both."""
    parameter = mi.Float(value)
    dr.enable_grad(parameter)
    assign(parameter)
    step = bounce(scene_view, attach_material(scene_view, x), sampler)
    dr.forward(parameter)
    pair = step.direct, step.weight
    return step, dr.detach(pair), dr.grad(pair)


def _ended(
    scene_view: SceneView,
    radiance: RadianceField,
    x: Vertex,
    lane: mi.UInt32,
    before: Mapping[str, tuple[mi.Color3f, mi.Color3f]],
) -> dict[str, mi.Color3f]:
    """Sums over paths that are ended at `x` by L_θ, from the sums before and factors of L_θ."""
    with dr.suspend_grad():
        (L,) = reflected_radiance(radiance, attach_albedo(scene_view, x))
        ended = {}
        for name, (total, factor) in before.items():
            ended[name] = mi.Color3f(total)
            dr.scatter_add(ended[name], factor * L, lane)
        dr.eval(ended)
    return ended


@dataclass
class _LaneSampler:
    """Random numbers that belong to a camera sample and a bounce, whichever other paths go on.

    With the same seed, paths for two values of a parameter then get the same random numbers, and
    what is no matter of the parameter cancels in the difference of two images. Mitsuba's samplers
    number their lanes by position, which changes with every path that ends.
    """

    rng: mi.PCG32

    @staticmethod
    def of(lane: mi.UInt32, seed: int, number: int) -> _LaneSampler:
        """The random numbers of a bounce."""
        (word,) = np.random.SeedSequence([seed, number]).generate_state(1)
        state, sequence = mi.sample_tea_32(lane, dr.opaque(mi.UInt32, int(word)))
        rng = mi.PCG32()
        rng.seed(mi.UInt64(state), mi.UInt64(sequence))
        return _LaneSampler(rng)

    def next_1d(self) -> mi.Float:
        """A number in [0,1)."""
        return self.rng.next_float32()

    def next_2d(self) -> mi.Point2f:
        """Two numbers in [0,1)."""
        x = self.next_1d()
        return mi.Point2f(x, self.next_1d())

    def schedule_state(self) -> None:
        """Have the state evaluated with what is evaluated next."""
        dr.schedule(self.rng)
