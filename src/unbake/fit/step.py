"""One training step, recorded once and replayed.

Tracing a step in Python takes longer than computing it. So it is a frozen function (`dr.freeze`):
all that changes from step to step comes in as an argument, and after the first steps nothing is
traced or compiled again.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..data.batches import PixelSource
from ..transport.image import PathSample, rhs, trace
from ..transport.objective import (
    METHODS,
    Live,
    RelativeL2,
    needs,
    objective,
    pixel_means,
)
from .problem import Problem


@dataclass
class State:
    """All that a step changes: the optimisers, which own φ and θ."""

    phi: mi.ad.Adam
    theta: mi.ad.Adam | None

    def optimizers(self) -> list[tuple[str, mi.ad.Adam]]:
        """The optimisers with their names, `phi` and `theta`."""
        both = [("phi", self.phi), ("theta", self.theta)]
        return [(name, optimizer) for name, optimizer in both if optimizer is not None]

    def set_learning_rates(self, phi_rate: float, theta_rate: float) -> None:
        """Set Adam's rates, as arrays: a changed Python number would be traced anew.

        Each parameter gets an array of its own because Dr.Jit's Adam multiplies it in place.
        """
        for (_, optimizer), rate in zip(self.optimizers(), (phi_rate, theta_rate), strict=False):
            optimizer.set_learning_rate({k: dr.opaque(mi.Float, rate) for k in optimizer})

    def publish(self, problem: Problem) -> None:
        """Let the problem's fields look at the present parameters."""
        problem.materials.assign(dict(self.phi.items()))
        if problem.radiance is not None:
            problem.radiance.assign(dict(self.theta.items()))


def initial_state(problem: Problem) -> State:
    """Optimisers that own the problem's parameters.

    Entries of the hash tables that a step does not touch keep their momentum (`mask_updates`).

    Paper: Sec. 5.4.
    """
    phi = mi.ad.Adam(1e-3, problem.materials.parameters(), mask_updates=True)
    theta = None
    if problem.radiance is not None:
        theta = mi.ad.Adam(1e-3, problem.radiance.parameters(), mask_updates=True)
    return State(phi, theta)


class TrainingStep:
    """The training step of a method on a problem.

    Paper: Eq. 11, Eq. 14, Sec. 4, 5.4.
    """

    def __init__(self, problem: Problem, pixels: PixelSource, config: FitConfig) -> None:
        self._problem = problem
        self._pixels = pixels
        self._config = config
        self._terms: Mapping[str, Live] = METHODS[config.method]
        self._sampler = mi.load_dict({"type": "independent"})
        self._frozen = dr.freeze(self._step)

    def __call__(
        self, state: State, step: int, phi_rate: float, theta_rate: float
    ) -> dict[str, mi.Float]:
        """Take a step; returns the loss terms and `skipped` (1 if a term was not finite).

        Args:
            step: number of the step; with the seed of the settings it decides all random numbers.
            phi_rate: Adam's learning rate for φ.
            theta_rate: the same for θ.
        """
        state.set_learning_rates(phi_rate, theta_rate)
        seed = np.random.SeedSequence([self._config.seed, step]).generate_state(1)[0]
        p, number = self._problem, dr.opaque(mi.UInt32, int(seed))
        with _no_garbage_collection():
            return self._frozen(p.world.scene, self._sampler, self._pixels, state, number)

    def recordings(self) -> int:
        """How often the step was traced."""
        return self._frozen.n_recordings

    def unfrozen(self, state: State, seed: mi.UInt32) -> dict[str, mi.Float]:
        """The same step traced anew, for measurements and tests."""
        p = self._problem
        return self._step(p.world.scene, self._sampler, self._pixels, state, seed)

    def _step(
        self,
        scene: mi.Scene,
        sampler: mi.Sampler,
        pixels: PixelSource,
        state: State,
        seed: mi.UInt32,
    ) -> dict[str, mi.Float]:
        p, config = self._problem, self._config
        state.publish(p)
        sampler.seed(seed, config.samples_per_step)
        batch = pixels.draw(seed, sampler, config.pixels, config.spp)
        primal = None
        if config.estimator == "two-pass":
            with dr.suspend_grad():
                again = pixels.draw(seed, sampler, config.pixels, config.spp)
                primal = self._image(self._trace(scene, again.ray, sampler))
        sample = self._trace(scene, batch.ray, sampler)
        smoothed = config.loss_reference == "smoothed"
        loss = RelativeL2(config.loss_epsilon, batch.smoothed if smoothed else None)
        terms = objective(self._terms, sample, batch.target, config.spp, loss, primal)
        total = sum(terms.values())
        dr.backward(total)

        finite = dr.isfinite(total)
        for _, optimizer in state.optimizers():
            _drop_broken_gradients(optimizer)
            optimizer.step(active=finite, eval=False)
        terms["skipped"] = dr.select(finite, mi.Float(0), mi.Float(1))
        dr.eval(state, terms)
        return terms

    def _trace(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> PathSample:
        p, wanted = self._problem, needs(self._terms)
        world = p.world.with_scene(scene)
        return trace(world, p.radiance, ray, sampler, wanted, p.see_environment)

    def _image(self, sample: PathSample) -> mi.Color3f:
        radiance = mi.Color3f(0) if sample.L2 is None else sample.L2
        return pixel_means(rhs(sample, radiance), self._config.spp)


@contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Put the garbage collector off.

    Were it to free a scene or a step of an earlier fit while this one is recorded, Dr.Jit would
    abort the process.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _drop_broken_gradients(optimizer: mi.ad.Adam) -> None:
    """Replace gradients that are not finite by zero, which masks those entries' update.

    A single NaN would stay in Adam's moments for good.
    """
    for value in optimizer.values():
        gradient = dr.grad(value)
        dr.set_grad(value, dr.select(dr.isfinite(gradient), gradient, 0))
