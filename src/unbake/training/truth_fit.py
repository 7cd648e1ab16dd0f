"""Fields trained on the true maps instead of photographs: the best that they can represent.

A surface point that a pixel of a training view sees, the fields there, and the pixel of the true
map: no light is transported, so that nothing but the representation limits what is learned.
"""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import CameraConfig, FitConfig, ObjectiveConfig, with_method
from ..dataset.ground_truth import GroundTruth
from ..dataset.pixels import CameraRays
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..fields.arrays import from_numpy
from ..quantities import QUANTITIES, channels_of
from ..transport.vertex import find_vertex
from .problem import Problem, problem_of
from .state import State
from .step import without_garbage_collection

#: Pixels of a step, and camera samples of each half of a pixel.
PIXELS, HALF = 4096, 1
#: Multiple of the fields' own learning rates, which are for noisy gradients, and the rate beyond
#: which none is raised: bitmaps and feature planes have large ones already, and do not learn at 6
#: times these.
RATE, LARGEST_RATE = 6.0, 0.06
#: Fraction of these rates that is left at the end.
FINAL_RATE = 0.02


@dataclass(frozen=True)
class TrueMaps:
    """The pixels of the training views whose true materials are known.

    Args:
        views: those that have the maps.
        names: of the quantities, in the order of the table.
        numbers: of the pixels among those of all `views`, shape (n,).
        values: of the quantities, one after the other, shape (n, channels).
    """

    views: tuple[View, ...]
    names: tuple[str, ...]
    numbers: np.ndarray
    values: np.ndarray

    @staticmethod
    def load(dataset: Dataset, quantities: Sequence[str]) -> TrueMaps:
        """The true maps of a data set.

        Args:
            quantities: the unknown ones. Those that no training view has a map of are left out.

        Raises:
            UserError: there is none of any of them, or an image cannot be read.
        """
        names = known_quantities(dataset, quantities)
        views = tuple(view for view in dataset.train if view.truth.keys() >= set(names))
        numbers, values, first = [], [], 0
        for view in views if names else ():
            truth = GroundTruth.of(view, names)
            assert truth is not None
            known = np.flatnonzero(truth.known)
            rows = np.concatenate([truth.values[name] for name in names], -1)
            numbers.append((first + known).astype(np.uint32))
            values.append(rows.reshape(-1, rows.shape[-1])[known].astype(np.float32))
            first += truth.known.size
        if not sum(map(len, numbers)):
            raise UserError(
                f"no training view has true maps of {' or '.join(quantities)}",
                dataset.folder,
                "A ceiling needs them: unbake capture SCENE --out DATA makes them",
            )
        return TrueMaps(views, names, np.concatenate(numbers), np.concatenate(values))


def true_means(dataset: Dataset, quantities: Sequence[str]) -> dict[str, np.ndarray]:
    """The mean of each quantity over what its true maps of training views show, (channels,).

    Those that no pixel of any map shows are left out.

    Raises:
        UserError: an image cannot be read.
    """
    found = {}
    for name in known_quantities(dataset, quantities):
        total, count = np.zeros(QUANTITIES[name].channels), 0
        for view in dataset.train:
            truth = GroundTruth.of(view, [name])
            if truth is not None:
                total += truth.values[name][truth.known].sum(0, dtype=np.float64)
                count += int(truth.known.sum())
        if count:
            found[name] = total / count
    return found


def known_quantities(dataset: Dataset, quantities: Sequence[str]) -> tuple[str, ...]:
    """Those of the quantities that some training view has a true map of."""
    return tuple(name for name in quantities if any(name in v.truth for v in dataset.train))


@dataclass
class _Inputs:
    """The arguments of a frozen step; a PyTree."""

    scene: mi.Scene
    rays: CameraRays
    pixels: mi.UInt32  # numbers of all known pixels
    values: mi.Float  # of the quantities there, row by row
    chosen: mi.UInt32  # rows of the step
    sampler: mi.Sampler
    seed: mi.UInt32


class TruthFit:
    """Trains the fields of some settings on the true maps of the training views.

    The error of a pixel is squared as the product of two independent errors, each of other points
    in the pixel: its expectation is the squared error of the pixel's mean, which scores measure.

    Args:
        dataset: has the maps.
        config: says the fields; its method, estimator and rates beside those of fields are ignored.

    Raises:
        UserError: there are no such maps, or no field of materials is unknown.

    Paper: Sec. 5.3.
    """

    def __init__(self, dataset: Dataset, config: FitConfig) -> None:
        if not config.learns_materials:
            what = f"settings whose unknown is {config.unknown} have no fields of materials"
            raise UserError(what, "unknown", "Set it to materials")
        self.maps = TrueMaps.load(dataset, config.quantities)
        # The cheapest method: none of its light is computed here.
        config = replace(
            config,
            unknown="materials",
            precision="single",
            camera=CameraConfig(),
            objective=ObjectiveConfig(),
        )
        config = with_method(config, "direct")
        self.problem: Problem = problem_of(dataset, config, 1.0)
        assert self.problem.materials is not None
        # Dr.Jit 1.5 aborts if objects of an earlier fit are freed while this one is recorded.
        gc.collect()
        self._config = config
        self._state = State(
            mi.ad.Adam(1e-3, self.problem.materials.parameters(), mask_updates=True), None
        )
        self._rays = CameraRays.of([view.camera for view in self.maps.views])
        self._pixels = from_numpy(mi.UInt32, self.maps.numbers)
        self._values = from_numpy(mi.Float, self.maps.values)
        self._sampler = mi.load_dict({"type": "independent"})
        recordable = all(field.recordable for field in self.problem.materials.values())
        self._frozen = dr.freeze(self._step) if recordable else self._step

    def train(self, steps: int) -> None:
        """Take all steps, and leave what was learned in the fields of `problem`."""
        settings = self._config.material_settings
        for number in range(steps):
            seeds = np.random.SeedSequence([self._config.seed, number]).generate_state(2)
            rows = np.random.default_rng(seeds[0]).integers(0, len(self.maps.numbers), PIXELS)
            decay = FINAL_RATE ** (number / steps)
            self._state.set_learning_rates(
                {name: decay * _rate(field.learning_rate) for name, field in settings.items()}
            )
            inputs = _Inputs(
                self.problem.scene_view.scene,
                self._rays,
                self._pixels,
                self._values,
                from_numpy(mi.UInt32, rows.astype(np.uint32)),
                self._sampler,
                dr.opaque(mi.UInt32, int(seeds[1])),
            )
            with without_garbage_collection():
                self._frozen(inputs, self._state)
        dr.sync_thread()
        self._state.publish(self.problem)

    def _step(self, inputs: _Inputs, state: State) -> None:
        maps, problem = self.maps, self.problem
        state.publish(problem)
        spp, columns = 2 * HALF, self.maps.values.shape[1]
        lanes = PIXELS * spp
        inputs.sampler.seed(inputs.seed, lanes)
        row = dr.gather(mi.UInt32, inputs.chosen, dr.arange(mi.UInt32, lanes) // spp)
        ray = inputs.rays.through(
            dr.gather(mi.UInt32, inputs.pixels, row), inputs.sampler.next_2d()
        )
        scene_view = problem.scene_view.with_scene(inputs.scene)
        v = find_vertex(scene_view, ray, mi.Bool(True), inputs.sampler)
        # A map counts a pixel all of whose samples see a material; others of its points may not.
        counted = v.valid & v.direct_view & scene_view.is_optimized(v.si.shape)
        assert problem.materials is not None
        found = problem.materials.evaluate(v.si, counted)
        loss = mi.Float(0)
        for name, part in channels_of(maps.names).items():
            value = found[name]
            for channel, x in zip(
                range(part.start, part.stop),
                list(value) if part.stop - part.start == 3 else [value],
                strict=True,
            ):
                true = dr.gather(mi.Float, inputs.values, row * columns + channel)
                error = dr.select(counted, x - true, 0)
                half = dr.block_sum(error, HALF) / HALF
                pair = dr.arange(mi.UInt32, PIXELS) * 2
                first, second = (dr.gather(mi.Float, half, pair + i) for i in (0, 1))
                loss += dr.mean(first * second)
        dr.backward(loss)
        state.phi.step(eval=False)
        dr.eval(state, loss)


def _rate(own: float) -> float:
    """The learning rate of a field at the start, from its own."""
    return max(own, min(RATE * own, LARGEST_RATE))
