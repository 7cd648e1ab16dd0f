"""One training step, recorded once and replayed.

Tracing a step in Python takes longer than computing it. So the step is a frozen function
(`dr.freeze`) where the path sampler allows it: everything that changes from step to step is an
argument, and after the first steps nothing is traced or compiled again.
"""

from __future__ import annotations

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.pixels import CameraRays, PixelBatch, PixelSource, largest_crop
from ..errors import UserError
from ..fields.arrays import from_numpy
from ..memory import free_bytes, lacks_memory, require_memory, reserved_counts
from ..ranks import Ranks
from .batch_loss import BatchLoss, Inputs
from .gradients import flat_gradients, set_gradients
from .loss_scaling import gradients_are_finite, next_scale
from .memory import MOST_BYTES_A_SAMPLE, Forecast, forecast
from .problem import Problem
from .state import State
from .told_scale import conventional_albedo, shows_light

#: Pixels from which the loss of all-black images is estimated.
_OF_BLACK = 1 << 15
#: The largest gradient whose square is finite in single precision, with some room.
_LARGEST_GRADIENT = 1e18


@final
@dataclass(frozen=True, eq=False)
class Replay:
    """A step taken apart."""

    terms: dict[str, float]
    broken: list[str]  #: parameters whose gradient is not finite
    numbers: np.ndarray  #: of the pixels, shape (n,)
    image: np.ndarray  #: as the step sees it, linear RGB, shape (n, 3)
    photograph: np.ndarray  #: the same
    errors: np.ndarray  #: squared, the same


class TrainingStep:
    """The training step of a method on a problem.

    With several ranks each takes an equal share of the batch, with random numbers of its own.
    Gradients and loss terms are averaged, so that all take the same step. With `sync_every` > 1
    each takes so many steps by itself, and then their states are averaged (local SGD, Stich 2019).

    Where ranks hold some views each, a rank draws from its own. Its loss terms and gradients weigh
    as its pixels are of all (`Share.weight`). So the expectation of the mean is that of a batch of
    all pixels for every term that is a mean over pixels. Two kinds of terms differ a little, as
    each rank has its own number in them: means over surface points, of which a view may show
    fewer, and weights that are a multiple of the photometric loss.

    Args:
        problem: what is learned; the same on all ranks.
        pixels: to draw batches from; they may be the views of this rank.
        config: says the batch of all ranks together.
        ranks: that take the step, and make it, together; None: there is one.

    Raises:
        UserError: the batch cannot be shared equally, or crops cannot have its pixels.
        ValueError: the loss needs smoothed photographs, and there are none.

    Paper: Sec. 4, 5.4.
    """

    def __init__(
        self,
        problem: Problem,
        pixels: PixelSource,
        config: FitConfig,
        ranks: Ranks | None = None,
    ) -> None:
        self._ranks = ranks or Ranks()
        config = with_share(config, self._ranks.size)
        crops = config.pixel_sampling == "one-view-crop"
        if crops:
            pixels.require_crops(config.pixels, self._ranks.size)
        # Dr.Jit 1.5 aborts if objects of an earlier fit are freed while this one is recorded.
        gc.collect()
        if problem.materials is not None:
            problem.materials.carried = True  # a run that was read back may stand alone
        # As the first one has it: rays may differ between machines, and terms must not.
        shown = self._ranks.together(lambda: shows_light(problem, config, pixels))
        problem.shows_light = self._ranks.gather(shown)[0]
        albedo = self._ranks.together(lambda: conventional_albedo(problem, config, pixels))
        problem.mean_albedo = self._ranks.gather(albedo)[0]
        self._problem = problem
        self.pixels = pixels
        self.config = config  #: of this process, with its share of each batch
        #: Of its batches, for what is measured beside the steps as well.
        self.batch_loss = BatchLoss(problem, pixels, config, self._ranks.rank)
        self._path_sampler = self.batch_loss.path_sampler
        recordable = self.batch_loss.recordable
        self._frozen = dr.freeze(self._step) if recordable else None
        self._own = dr.freeze(self._own_gradients) if recordable else self._own_gradients
        self._common = dr.freeze(self._step_by) if recordable else self._step_by
        self._terms: list[str] = []  # names of the loss terms, once a step was traced
        self._weight = pixels.weight(crops=crops)  # of this rank's gradients in their mean
        self._apart = False  # whether ranks have taken steps by themselves since they were united
        self._probe = dr.freeze(self._halves) if recordable else self._halves
        self._fits_memory = False  # as far as is known
        self._planned = not self._path_sampler.keeps_paths

    def __call__(
        self, state: State, number: int, rates: Mapping[str, float]
    ) -> dict[str, mi.Float]:
        """Take a step; returns the loss terms and `skipped` (1 if a term was not finite).

        Args:
            number: of the step; with the seed of the settings it decides all random numbers.
            rates: Adam's learning rates; see `learning_rates`.

        Raises:
            UserError: the step needs more memory than there is.
        """
        self.plan(state)
        self.require_memory(state)
        step = self._step if self._frozen is None else self._frozen
        alone = self._ranks.size == 1 or self.config.sync_every > 1
        try:
            with without_garbage_collection():
                inputs = self.prepare(state, number, rates)
                terms = (step if alone else self._shared_step)(inputs, state)
        except (RuntimeError, MemoryError) as error:
            if not lacks_memory(error):
                raise
            paths = self.config.samples_per_pass
            raise UserError(
                f"no memory for a step of {paths} paths", None, self._smaller()
            ) from None
        self._apart = alone and self._ranks.size > 1
        if (number + 1) % self.config.sync_every == 0:
            self.unite(state)
        return terms

    def unite(self, state: State) -> None:
        """Give all ranks the mean of their states, if they have taken steps by themselves."""
        if self._apart:
            state.assign_numbers(self._ranks.mean(state.numbers()))
            self._apart = False

    def read(self, losses: Sequence[Mapping[str, mi.Float]]) -> list[dict[str, float]]:
        """The numbers of loss terms that steps returned, the same on all ranks."""
        read = [{term: float(x[0]) for term, x in terms.items()} for terms in losses]
        if self._ranks.size == 1 or self.config.sync_every == 1 or not read:
            return read
        own = np.array([list(row.values()) for row in read], np.float32)
        names, rows = read[0], self._ranks.mean(own)
        return [dict(zip(names, map(float, row), strict=True)) for row in rows]

    def plan(self, state: State) -> None:
        """Let the path sampler decide what it fixes for all steps, once.

        The first step does this by itself. A fit that may be resumed does it with the first state,
        so that it goes on as it would have without the interruption.
        """
        if not self._planned:
            self.batch_loss.plan(state)
        self._planned = True

    def require_memory(self, state: State) -> None:
        """Raise an error if a step would need more memory than there is free.

        This is checked once, where the method keeps whole paths in memory or the batch is large.
        Two smaller batches are measured, and their gradients dropped. Ranks on one machine share
        its memory.

        Raises:
            UserError: the step would need more; it names the batch that would fit.
        """
        if self._fits_memory:
            return
        paths, free, here = self.config.samples_per_pass, free_bytes(), self._ranks.here
        large = free is not None and here * paths * MOST_BYTES_A_SAMPLE > free
        found = self.forecast(state) if large or self._path_sampler.keeps_paths else None
        if found is not None:
            what = f"a step of {paths} paths by {self.config.method} needs"
            # Dr.Jit 1.5 rounds arrays up to powers of two, of which only a part is used
            factor = max(here, 2 if reserved_counts() else 1)
            need = factor * found.bytes(self.config.pixels)
            require_memory(need, what, lambda free: self._smaller(found.pixels(free / factor)))
        self._fits_memory = True

    def forecast(self, state: State) -> Forecast | None:
        """Memory that steps will take; None where it cannot be measured."""
        self.plan(state)

        def probe(pixels: int) -> None:
            terms = self.batch_loss.backward(self.batch_loss.inputs(0, pixels), state)
            for _, optimizer in state.optimizers():
                dr.eval(terms, [dr.grad(value) for value in optimizer.values()])
                dr.clear_grad(dict(optimizer.items()))

        return forecast(probe, self.config.pixels, self.config.spp)

    def _smaller(self, pixels: int | None = None) -> str:
        """The remedy where a step does not fit the memory.

        Args:
            pixels: of this rank's share of a batch that would fit, if it is known.
        """
        told, ranks = "Lower --batch or --spp", self._ranks.size
        if pixels is not None:
            whole = self.config.pixels * ranks
            if self.config.pixel_sampling == "one-view-crop":
                pixels = largest_crop(pixels)
            told = f"Lower --batch from {whole} to {pixels * ranks}, or --spp"
        if self._path_sampler.keeps_paths:
            told += " or path.max_depth, or use --method prb"
        return told

    @property
    def ranks(self) -> Ranks:
        """The processes that take the steps together."""
        return self._ranks

    @property
    def processes(self) -> int:
        """How many take the steps together."""
        return self._ranks.size

    @property
    def rate_names(self) -> tuple[str, ...]:
        """The names of learning rates that a step takes."""
        config = self.config
        outliers = ("outliers",) if self._problem.outliers is not None else ()
        return (*config.unknowns, *config.camera.unknowns, *outliers, "radiance")

    @property
    def epsilon(self) -> float:
        """What the relative loss adds to squared references."""
        return self.batch_loss.epsilon

    def loss_of_black(self) -> float:
        """An estimate of the photometric loss of all-black images."""
        _, colours = self.pixels.draw(self.config.seed, _OF_BLACK).read()
        target = colours[:, :3].astype(np.float64)
        smoothed = self.config.loss_reference == "smoothed"
        reference = colours[:, 3:] if smoothed else target
        loss = (target**2 / (reference**2 + self.epsilon)).mean()
        return float(self._ranks.mean(self._weighted(np.array([loss])))[0])

    def replay(self, state: State, number: int) -> Replay:
        """A step taken apart, for a diagnosis; the state stays as it is."""
        self.plan(state)
        inputs = self.batch_loss.inputs(number)
        terms = self.batch_loss.backward(inputs, state)
        gradients = {
            key: dr.grad(value)
            for _, optimizer in state.optimizers()
            for key, value in optimizer.items()
        }
        broken = [k for k, g in gradients.items() if not np.isfinite(np.array(g.array)).all()]
        for _, optimizer in state.optimizers():
            dr.clear_grad(dict(optimizer.items()))
        image = np.array(self.batch_loss.image(inputs, state)).T
        numbers, colours = inputs.pixels.read()
        photograph = colours[:, :3]
        with np.errstate(over="ignore", invalid="ignore"):
            errors = (image - photograph) ** 2
        return Replay(
            {name: float(value[0]) for name, value in terms.items()},
            broken,
            numbers,
            image,
            photograph,
            errors,
        )

    def probe(self, state: State, rays: CameraRays, pixels: PixelBatch, seed: int) -> np.ndarray:
        """Two independent estimates of some pixels, as steps see them; nothing is learned.

        Args:
            rays: through the pixels, and maybe others.
            pixels: as many as a step has, at most. The first call traces and compiles, and further
                ones with as many pixels and the same rays only replay.
            seed: decides the random numbers.

        Returns:
            Linear RGB, from half of the `spp` samples each, shape (pixels, 2, 3).
        """
        self.plan(state)
        inputs = self.batch_loss.inputs_of(rays, pixels, seed)
        with without_garbage_collection():
            halves = self._probe(inputs, state)
        return np.array(halves).T.reshape(-1, 2, 3)

    def _halves(self, inputs: Inputs, state: State) -> mi.Color3f:
        return self.batch_loss.image(inputs, state, self.config.spp // 2)

    def place(self, pixel: int) -> tuple[int, int, int]:
        """The training view of a pixel, from 0, and its column and row in it."""
        return self.pixels.place(pixel)

    @property
    def recordable(self) -> bool:
        """Whether `dr.freeze` can record the step."""
        return self._frozen is not None

    def recordings(self) -> int:
        """How often the step was traced to be replayed; 0 if it is traced each time."""
        if self._frozen is None:
            return 0
        frozen: Any = (self._frozen, self._own, self._common)
        return max(function.n_recordings for function in frozen)

    def unfrozen(self, state: State, number: int) -> dict[str, mi.Float]:
        """The same step traced anew, for measurements and tests."""
        self.plan(state)
        return self._step(self.batch_loss.inputs(number), state)

    def gradients(self, inputs: Inputs, state: State) -> dict[str, mi.Float | mi.TensorXf]:
        """The gradients of the unknowns φ, by name, without a step: for measurements.

        Args:
            inputs: from `prepare`.
        """
        self.plan(state)
        terms = self.batch_loss.backward(inputs, state)
        found = {name: dr.grad(value) for name, value in state.phi.items()}
        dr.eval(terms, found)
        for _, optimizer in state.optimizers():
            dr.clear_grad(dict(optimizer.items()))
        return found

    def prepare(self, state: State, number: int, rates: Mapping[str, float]) -> Inputs:
        """The part of a replayed step that runs in Python."""
        state.set_learning_rates(rates)
        return self.batch_loss.inputs(number)

    def _shared_step(self, inputs: Inputs, state: State) -> dict[str, mi.Float]:
        """The same step on all ranks, with the mean of their gradients."""
        own = self._weighted(self._own(inputs, state).numpy())
        return self._common(from_numpy(mi.Float, self._ranks.mean(own)), state)

    def _weighted(self, own: np.ndarray) -> np.ndarray:
        """Means over this rank's pixels, so that the mean over ranks is one over all pixels."""
        if self._weight == 1:
            return own
        return own * own.dtype.type(self._weight) if self._weight else np.zeros_like(own)

    def _own_gradients(self, inputs: Inputs, state: State) -> mi.Float:
        """This rank's loss terms, then its gradients, in one array."""
        terms = self.batch_loss.backward(inputs, state)
        self._terms = list(terms)
        parts = [mi.Float(value) for value in terms.values()]
        for _, optimizer in state.optimizers():
            parts += flat_gradients(optimizer)
            dr.clear_grad(dict(optimizer.items()))
        found = dr.concat(parts)
        dr.eval(found)
        return found

    def _step_by(self, mean: mi.Float, state: State) -> dict[str, mi.Float]:
        """Take a step with loss terms and gradients as `_own_gradients` gives them."""
        terms, first = {}, len(self._terms)
        for number, name in enumerate(self._terms):
            terms[name] = dr.gather(mi.Float, mean, mi.UInt32(number))
        for _, optimizer in state.optimizers():
            first = set_gradients(optimizer, mean, first)
        return self._move(terms, state)

    def _step(self, inputs: Inputs, state: State) -> dict[str, mi.Float]:
        return self._move(self.batch_loss.backward(inputs, state), state)

    def _move(self, terms: dict[str, mi.Float], state: State) -> dict[str, mi.Float]:
        """Move the parameters by their gradients, where all loss terms are finite."""
        known = finite = dr.isfinite(sum(terms.values()))
        factor = None
        if state.scale is not None:
            fits = gradients_are_finite(optimizer for _, optimizer in state.optimizers())
            factor, finite = dr.rcp(state.scale), known & fits
            # A loss that is no number says nothing of gradients that overflow.
            state.scale = dr.select(known, next_scale(state.scale, fits), state.scale)
        camera = self._problem.camera
        of_camera = [] if camera is None else camera.parameters()
        before = {key: mi.Float(dr.detach(state.phi[key])) for key in of_camera}
        for _, optimizer in state.optimizers():
            drop_broken_gradients(optimizer)
            optimizer.step(active=finite, grad_scale=factor, eval=False)
        if camera is not None:
            state.replace(camera.slowed(before, dict(state.phi.items())))
        terms["skipped"] = dr.select(finite, mi.Float(0), mi.Float(1))
        dr.eval(state, terms)
        return terms


def with_share(config: FitConfig, ranks: int) -> FitConfig:
    """Settings of one of several ranks, which takes an equal share of each batch.

    Raises:
        UserError: the pixels cannot be shared equally.
    """
    if config.pixels % ranks:
        fewer = max(config.pixels // ranks, 1) * ranks
        what = f"a batch of {config.pixels} pixels cannot be shared equally by {ranks} processes"
        raise UserError(what, "--batch", f"Use --batch {fewer}, or another number of processes")
    return replace(config, pixels=config.pixels // ranks)


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    """Disable the garbage collector.

    Dr.Jit 1.5 aborts the process if a scene or a step of an earlier fit is freed while a step is
    recorded.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def drop_broken_gradients(optimizer: mi.ad.Adam) -> None:
    """Replace gradients that Adam cannot square by zero, so that it does not update those entries.

    A single NaN, or an infinite square, would stay in Adam's moments for the rest of the fit.
    """
    for value in optimizer.values():
        gradient = dr.grad(value)
        dr.set_grad(value, dr.select(dr.abs(gradient) < _LARGEST_GRADIENT, gradient, 0))
