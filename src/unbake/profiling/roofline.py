"""A lower bound of the time of a training step, from measured rates of the machine."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..config import FitConfig
from ..dataset.pixels import PixelSource
from ..fields.field import Field
from ..training.problem import Problem
from ..training.state import State
from ..transport.objective import requirements
from ..transport.path_sample import Requirements
from .phases import kernel_history, milliseconds

#: Adam reads a parameter, its gradient and both moments, and writes all but the gradient.
_ADAM_FLOATS = 7
#: A product for the value, and for the gradient one for the inputs and one for the weights.
_WITH_GRADIENT = 3
#: Measurements of each rate after a warm-up; the median counts.
_TIMES = 5


@dataclass(frozen=True)
class Work:
    """The least work of a step, or of a part of it."""

    rays: float
    multiply_adds: float
    bytes: float

    def __add__(self, other: Work) -> Work:
        return Work(
            self.rays + other.rays,
            self.multiply_adds + other.multiply_adds,
            self.bytes + other.bytes,
        )

    def times(self, factor: float) -> Work:
        """This work, so many times."""
        return Work(self.rays * factor, self.multiply_adds * factor, self.bytes * factor)


@dataclass(frozen=True)
class Rates:
    """Work that this machine does per second."""

    rays: float
    multiply_adds: float
    bytes: float


def roofline(problem: Problem, pixels: PixelSource, state: State, config: FitConfig) -> dict | None:
    """The roofline of a step: its rays, multiply-adds and bytes at the machine's measured rates.

    Rays are measured in the scene of the problem, multiply-adds with one large product of matrices,
    bytes with the sum of two large arrays. The rest of a step (BSDFs, emitter sampling, losses)
    counts as free. All three use the same cores, so that their times add up.

    Returns:
        `work`, `rates` and `milliseconds`; None for methods that follow paths to their end, because
        their number of rays depends on the scene.
    """
    if config.follows_paths:
        return None
    work, rates = _work(problem, state, config), _rates(problem, pixels, config)
    each = {
        "rays": 1e3 * work.rays / rates.rays,
        "multiply_adds": 1e3 * work.multiply_adds / rates.multiply_adds,
        "bytes": 1e3 * work.bytes / rates.bytes,
    }
    return {
        "work": vars(work),
        "rates": vars(rates),
        "milliseconds": each | {"all": sum(each.values())},
    }


# -------------------------------------------------------------------------------------------- Work


def _work(problem: Problem, state: State, config: FitConfig) -> Work:
    needs = requirements(config.chosen_method.terms, config.chosen_bounces)
    arrays = [a for _, adam in state.optimizers() for a in adam.values()]
    adam = Work(0, 0, 4 * _ADAM_FLOATS * sum(dr.width(a) for a in arrays))
    work = adam + _of_the_image(problem, needs).times(config.samples_per_pass)
    if config.two_passes:  # the first one is of values alone
        first = _of_the_image(problem, needs, gradient=False)
        work += first.times(config.samples_per_pass)
    if not needs.radiance:
        return work
    each = config.radiance_samples
    learning = _of_learning(problem, needs, all_samples=each == config.spp)
    return work + learning.times(config.pixels * each)


def _of_the_image(problem: Problem, needs: Requirements, *, gradient: bool = True) -> Work:
    """Work of one camera sample, if every vertex is on a surface."""
    # A camera ray, then at each vertex a shadow ray and a BSDF sample.
    work = Work(1 + 2 * needs.bounces, 0, 0)
    for _ in range(needs.bounces):
        work += _materials(problem, gradient=gradient)
    if needs.radiance:
        attached = gradient and needs.image_attached
        work += _albedo(problem) + _radiance(problem, gradient=attached)
    return work


def _of_learning(problem: Problem, needs: Requirements, *, all_samples: bool) -> Work:
    """Further work of a camera sample that trains L_θ."""
    bounces = max(0, needs.residuals - needs.bounces)
    work = Work(2 * bounces, 0, 0)
    for number in range(needs.bounces + 1, needs.residuals + 1):
        work += _materials(problem, gradient=number in needs.differentiable)
    learned, constant = needs.attached, needs.constant
    for number in learned | constant:
        work += _radiance(problem, gradient=number in learned)
    if not all_samples:
        return work + _albedo(problem) if bounces else work
    # If training needs L_θ where the image does, it is evaluated once for both.
    shared = needs.bounces + 1 in learned | constant
    image = _radiance(problem, gradient=needs.image_attached)
    return work + image.times(-1) if shared else work


def _materials(problem: Problem, *, gradient: bool) -> Work:
    work = Work(0, 0, 0)
    if problem.materials is not None:
        for field in problem.materials.values():
            work += _evaluation(field, gradient=gradient)
    return work


def _albedo(problem: Problem) -> Work:
    if problem.materials is None or "albedo" not in problem.materials:
        return Work(0, 0, 0)
    return _evaluation(problem.materials["albedo"], gradient=False)


def _radiance(problem: Problem, *, gradient: bool) -> Work:
    if problem.radiance is None:
        return Work(0, 0, 0)
    return _evaluation(problem.radiance.function, gradient=gradient)


def _evaluation(field: Field, *, gradient: bool) -> Work:
    """Work of one evaluation of a field, and of its gradient."""
    cost = field.cost()
    # The gradient of a lookup reads and writes the entries of the lookup.
    once = Work(0, cost.multiply_adds, cost.bytes)
    return once.times(_WITH_GRADIENT if gradient else 1)


# ------------------------------------------------------------------------------------------- Rates


def _rates(problem: Problem, pixels: PixelSource, config: FitConfig) -> Rates:
    return Rates(_ray_rate(problem.scene_view.scene, pixels, config), _product_rate(), _bandwidth())


def _ray_rate(scene: mi.Scene, pixels: PixelSource, config: FitConfig) -> float:
    """Closest hits per second, of diffusely scattered rays from the visible surfaces."""
    count = (1 << 18) // config.spp * config.spp
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, 0), count)
    with dr.suspend_grad():
        pixel_batch = pixels.draw(1, count // config.spp)
        camera = pixel_batch.batch(pixels.rays, sampler, config.spp).ray
        si = scene.ray_intersect(camera)
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        local.z = dr.copysign(local.z, si.wi.z)
        away = si.spawn_ray(si.to_world(local))
        valid = si.is_valid()
        dr.eval(away, valid)

        def trace() -> None:
            dr.eval(scene.ray_intersect_preliminary(away, False, valid).t)

        # Lanes whose camera ray hits nothing trace nothing.
        return float(dr.count(valid)[0]) / _seconds(trace)


def _product_rate() -> float:
    """Multiply-adds per second of a product of large matrices, float32."""
    size, width = 256, 1 << 14
    a = dr.full(mi.TensorXf, 0.5, (size, size))
    b = dr.full(mi.TensorXf, 0.5, (size, width))
    dr.make_opaque(a, b)
    return size * size * width / _seconds(lambda: dr.eval(a @ b))


def _bandwidth() -> float:
    """Bytes per second of memory traffic, with arrays far larger than the caches."""
    count = 1 << 25
    a, b = dr.full(mi.Float, 1, count), dr.full(mi.Float, 2, count)
    dr.make_opaque(a, b)
    return 3 * 4 * count / _seconds(lambda: dr.eval(a + b))


def _seconds(work: Callable[[], None]) -> float:
    """Median time of the kernels of some work."""
    times = []
    for _ in range(_TIMES + 1):
        with kernel_history() as kernels:
            work()
        times.append(milliseconds(kernels) / 1e3)
    return statistics.median(times[1:])
