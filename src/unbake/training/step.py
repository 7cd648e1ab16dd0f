"""One training step, recorded once and replayed.

Tracing a step in Python takes longer than computing it. So it is a frozen function (`dr.freeze`)
wherever it can be one: all that changes from step to step comes in as an argument, and after the
first steps nothing is traced or compiled again.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.pixels import CameraRays, PixelBatch, PixelSource, RayBatch
from ..errors import UserError
from ..fields.network import can_record_layout
from ..transport.objective import (
    METHODS,
    PHOTOMETRIC,
    RelativeL2,
    objective,
    pixel_means,
    requirements,
    squared_error,
)
from ..transport.path_sample import PathSample, SampleSubset, rhs, trace
from ..transport.prb import materials_along_paths, path_radiance, path_replay
from .memory import free_bytes, peak_bytes
from .problem import Problem
from .regularizers import regularization_terms


@dataclass
class State:
    """All that a step changes: the optimisers, which own φ and θ, and the scale of the loss.

    In half precision small gradients would vanish. So the loss is multiplied by a factor, which
    steps divide by again: as large as no gradient overflows (Micikevicius et al. 2018). Dr.Jit's
    `GradScaler` does so for one optimiser; here two share a loss.
    """

    phi: mi.ad.Adam
    theta: mi.ad.Adam | None
    scale: mi.Float | None = None  # None: single precision, not scaled

    def optimizers(self) -> list[tuple[str, mi.ad.Adam]]:
        """The optimisers with their names, `phi` and `theta`."""
        both = [("phi", self.phi), ("theta", self.theta)]
        return [(name, optimizer) for name, optimizer in both if optimizer is not None]

    def set_learning_rates(self, rates: Mapping[str, float]) -> None:
        """Set Adam's rates, as arrays: a changed Python number would be traced anew.

        Each parameter gets an array of its own because Dr.Jit's Adam multiplies it in place.

        Args:
            rates: see `learning_rates`.
        """
        named = {key: rates[key.partition(".")[0]] for key in self.phi}
        self.phi.set_learning_rate({k: dr.opaque(mi.Float, r) for k, r in named.items()})
        if self.theta is not None:
            rate = rates["radiance"]
            self.theta.set_learning_rate({k: dr.opaque(mi.Float, rate) for k in self.theta})

    def publish(self, problem: Problem) -> None:
        """Let the problem's fields look at the present parameters."""
        problem.assign(dict(self.phi.items()))
        if problem.radiance is not None:
            problem.radiance.assign(dict(self.theta.items()))


def initial_state(problem: Problem) -> State:
    """Optimisers that own the problem's parameters.

    Entries of the hash tables that a step does not touch keep their momentum (`mask_updates`).

    Paper: Sec. 5.4.
    """
    phi = mi.ad.Adam(1e-3, problem.parameters(), mask_updates=True)
    theta = None
    if problem.radiance is not None:
        theta = mi.ad.Adam(1e-3, problem.radiance.parameters(), mask_updates=True)
    scale = dr.opaque(mi.Float, _FIRST_SCALE) if problem.half_precision else None
    return State(phi, theta, scale)


@dataclass
class Inputs:
    """What a step works on; a PyTree, since a frozen function must be handed all that changes."""

    scene: mi.Scene
    rays: CameraRays
    pixels: PixelBatch
    sampler: mi.Sampler  # of all camera samples
    second: mi.Sampler  # of those that L_θ learns of, if these are fewer
    seed: mi.UInt32


class TrainingStep:
    """The training step of a method on a problem.

    Paper: Eq. 11, Eq. 14, Sec. 4, 5.4, 6.
    """

    def __init__(self, problem: Problem, pixels: PixelSource, config: FitConfig) -> None:
        # What is left of earlier problems would be found, half gone, by the recording of this one.
        gc.collect()
        self._problem = problem
        self._pixels = pixels
        self._config = config
        transport = _Paths if config.method == "prb" else _Bounces
        self._transport = transport(problem, config)
        self._sampler = mi.load_dict({"type": "independent"})
        self._second = mi.load_dict({"type": "independent"})
        self._frozen = dr.freeze(self._step) if _can_be_recorded(config) else None
        self._fits_memory = config.method != "ad-pt"

    def __call__(
        self, state: State, number: int, rates: Mapping[str, float]
    ) -> dict[str, mi.Float]:
        """Take a step; returns the loss terms and `skipped` (1 if a term was not finite).

        Args:
            number: of the step; with the seed of the settings it decides all random numbers.
            rates: Adam's learning rates; see `learning_rates`.

        Raises:
            UserError: `ad-pt` would need more memory than there is.
        """
        self.require_memory(state)
        step = self._step if self._frozen is None else self._frozen
        try:
            with _no_garbage_collection():
                return step(self.prepare(state, number, rates), state)
        except RuntimeError as error:
            if not lacks_memory(error):
                raise
            lanes = self._config.samples_per_step
            raise UserError(f"no memory for a step of {lanes} paths", None, _SMALLER) from None

    def require_memory(self, state: State) -> None:
        """Raise an error if a step would need more memory than there is, rather than be killed.

        Only `ad-pt` asks, and only once: smaller batches, whose gradients are dropped, tell.

        Raises:
            UserError: it would.
        """
        if self._fits_memory:
            return
        need, free = self._bytes_needed(state), free_bytes()
        if need is not None and free is not None and need > free:
            what = f"ad-pt needs about {need / 1e9:.1f} GB of memory for a step of"
            what += f" {self._config.samples_per_step} paths, {free / 1e9:.1f} GB are free"
            raise UserError(what, None, _SMALLER)
        self._fits_memory = True

    def recordings(self) -> int:
        """How often the step was traced to be replayed; 0 if it is traced each time."""
        return 0 if self._frozen is None else self._frozen.n_recordings

    def unfrozen(self, state: State, number: int) -> dict[str, mi.Float]:
        """The same step traced anew, for measurements and tests."""
        return self._step(self._inputs(number, self._config.pixels), state)

    def prepare(self, state: State, number: int, rates: Mapping[str, float]) -> Inputs:
        """All that is done in Python for a step that is replayed."""
        state.set_learning_rates(rates)
        return self._inputs(number, self._config.pixels)

    def _inputs(self, number: int, pixels: int) -> Inputs:
        seeds = np.random.SeedSequence([self._config.seed, number]).generate_state(2)
        return Inputs(
            scene=self._problem.scene_view.scene,
            rays=self._pixels.rays,
            pixels=self._pixels.draw(int(seeds[0]), pixels),
            sampler=self._sampler,
            second=self._second,
            seed=dr.opaque(mi.UInt32, int(seeds[1])),
        )

    def _step(self, inputs: Inputs, state: State) -> dict[str, mi.Float]:
        terms = self._gradients(inputs, state)
        finite = dr.isfinite(sum(terms.values()))
        factor = None
        if state.scale is not None:
            finite &= _all_finite(state)
            factor = dr.rcp(state.scale)
            state.scale = state.scale * dr.select(finite, _GROWTH, 0.5)
        for _, optimizer in state.optimizers():
            _drop_broken_gradients(optimizer)
            optimizer.step(active=finite, grad_scale=factor, eval=False)
        terms["skipped"] = dr.select(finite, mi.Float(0), mi.Float(1))
        dr.eval(state, terms)
        return terms

    def _gradients(self, inputs: Inputs, state: State) -> dict[str, mi.Float]:
        """The loss terms on the pixels drawn; their gradients are left in the state."""
        config, transport = self._config, self._transport
        scene, pixels, sampler = inputs.scene, inputs.pixels, inputs.sampler
        state.publish(self._problem)
        sampler.seed(inputs.seed, pixels.count * config.spp)
        batch = pixels.batch(inputs.rays, sampler, config.spp)
        with transport.prepared():
            primal = None
            if not config.halves:
                with dr.suspend_grad():
                    again = pixels.batch(inputs.rays, sampler, config.spp)
                    image = transport.image(scene, again.ray, sampler)
                    primal = pixel_means(image, config.spp)
            smoothed = config.loss_reference == "smoothed"
            loss = RelativeL2(config.loss_epsilon, batch.smoothed if smoothed else None)
            subset = _subset(config, inputs)
            terms = transport.terms(scene, batch, sampler, subset, loss, primal)
            terms |= regularization_terms(self._problem, config, scene, batch.ray, sampler)
            total = sum(terms.values())
            dr.backward(total if state.scale is None else total * state.scale)
        return terms

    def _bytes_needed(self, state: State) -> float | None:
        """What a step will need, judged by two smaller batches; None where nobody can tell."""
        config = self._config
        few = max(1, min(config.pixels // 4, _PROBED_PATHS // config.spp))

        def probe(count: int) -> None:
            terms = self._gradients(self._inputs(0, count), state)
            for _, optimizer in state.optimizers():
                dr.eval(terms, [dr.grad(value) for value in optimizer.values()])
                dr.clear_grad(dict(optimizer.items()))

        probe(few)  # compiles, which takes memory as well
        fewer, more = (peak_bytes(lambda n=n: probe(n)) for n in (few, 2 * few))
        if fewer is None or more is None:
            return None
        return more + max(0, more - fewer) * (config.pixels / few - 2)


def _subset(config: FitConfig, inputs: Inputs) -> SampleSubset | None:
    """The first camera samples of each pixel, if L_θ learns of them alone."""
    each = config.radiance_samples
    if each == config.spp:
        return None
    lanes = inputs.pixels.count * each
    inputs.second.seed(inputs.seed + 1, lanes)
    lane = dr.arange(mi.UInt32, lanes)
    chosen = lane // each * config.spp + lane % each
    # As an array in memory: a replayed kernel takes its size from arrays that it reads, and would
    # find none of this size.
    dr.eval(chosen)
    return SampleSubset(chosen, inputs.second)


#: Paths of the smaller one of two batches that tell how much memory a batch takes.
_PROBED_PATHS = 4096
#: What helps where paths do not fit the memory.
_SMALLER = "Lower --batch or --spp or path.max_depth, or use --method prb"


def lacks_memory(error: BaseException | None) -> bool:
    """Whether an error comes from Dr.Jit running out of memory, also while it records."""
    while error is not None and "out of memory" not in str(error):
        error = error.__cause__ or error.__context__
    return error is not None


def _can_be_recorded(config: FitConfig) -> bool:
    """Whether a method's step can be frozen: not with every layout of cooperative vectors."""
    if config.method == "prb" and config.learns_materials and config.representation == "neural":
        return can_record_layout()
    return True


class _Bounces:
    """A few bounces, then L_θ: the method of the paper and its ablations.

    Also `ad-pt`: many bounces, all kept in memory, and nothing after them. (Mitsuba's `path` would
    do, but asks textures, and so fields, inside virtual calls and several times a vertex: a step
    took 8 to 60 times as long. Without a loop there is no Russian roulette either, which would save
    nothing where all lanes wait for the longest path.)
    """

    def __init__(self, problem: Problem, config: FitConfig) -> None:
        self._problem = problem
        self._spp, self._bounces = config.spp, config.bounces
        if config.method == "ad-pt":
            self._bounces = config.path.max_depth - 1
        one_bounce = config.prior == "one-bounce"
        self._terms = METHODS["ours, one-bounce" if one_bounce else config.method]

    def prepared(self) -> AbstractContextManager:
        """A context that everything else needs."""
        return nullcontext()

    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Radiance of camera samples."""
        sample = self._trace(scene, ray, sampler)
        return rhs(sample, sample.radiance[self._bounces], self._bounces)

    def terms(
        self,
        scene: mi.Scene,
        batch: RayBatch,
        sampler: mi.Sampler,
        subset: SampleSubset | None,
        loss: RelativeL2,
        primal: mi.Color3f | None,
    ) -> dict[str, mi.Float]:
        """The terms of the objective."""
        sample = self._trace(scene, batch.ray, sampler, subset)
        target, bounces = batch.target, self._bounces
        return objective(self._terms, sample, target, self._spp, loss, primal, bounces)

    def _trace(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        sampler: mi.Sampler,
        subset: SampleSubset | None = None,
    ) -> PathSample:
        p, wanted = self._problem, requirements(self._terms, self._bounces)
        scene_view = p.scene_view.with_scene(scene)
        return trace(
            scene_view,
            p.radiance,
            ray,
            sampler,
            wanted,
            hide_emitters=p.hide_emitters,
            subset=subset,
        )


class _Paths:
    """Paths to their end, by Mitsuba's `prb`."""

    def __init__(self, problem: Problem, config: FitConfig) -> None:
        self._problem = problem
        self._spp = config.spp
        path = config.path
        self._integrator = path_replay(path.max_depth, path.rr_depth, problem.hide_emitters)

    def prepared(self) -> AbstractContextManager:
        """A context that everything else needs, backpropagation too."""
        return materials_along_paths(self._problem.scene_view.materials)

    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Radiance of camera samples."""
        arrays = self._problem.read_by_scene()
        return path_radiance(self._integrator, scene, sampler, ray, arrays)

    def terms(
        self,
        scene: mi.Scene,
        batch: RayBatch,
        sampler: mi.Sampler,
        subset: SampleSubset | None,
        loss: RelativeL2,
        primal: mi.Color3f | None,
    ) -> dict[str, mi.Float]:
        """The terms of the objective: the photometric one."""
        image = self.image(scene, batch.ray, sampler)
        weight = loss.weight(batch.target)
        return {PHOTOMETRIC: squared_error(image, batch.target, self._spp, weight, primal)}


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


#: Scale of the loss in half precision, at first and after each good step.
_FIRST_SCALE, _GROWTH = 65536.0, 2 ** (1 / 2000)


def _all_finite(state: State) -> mi.Bool:
    """Whether no gradient has overflowed."""
    good = mi.Bool(True)
    for _, optimizer in state.optimizers():
        for value in optimizer.values():
            good &= dr.all(dr.isfinite(dr.grad(value).array))
    return good


def _drop_broken_gradients(optimizer: mi.ad.Adam) -> None:
    """Replace gradients that are not finite by zero, which masks those entries' update.

    A single NaN would stay in Adam's moments for good.
    """
    for value in optimizer.values():
        gradient = dr.grad(value)
        dr.set_grad(value, dr.select(dr.isfinite(gradient), gradient, 0))
