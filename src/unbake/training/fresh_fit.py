"""A fit that writes nothing, for measurements and experiments."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr

from ..config import FitConfig
from ..dataset.pixels import PixelSource
from ..dataset.views import Dataset
from .defaults import with_defaults
from .first_gains import begin_cameras
from .first_lights import begin_lights
from .problem import Problem, pixels_of, problem_of
from .schedule import learning_rates
from .state import State, initial_state
from .step import TrainingStep

#: Steps after which nothing is compiled any more.
_COMPILING_STEPS = 3


@dataclass(frozen=True)
class FreshFit:
    """A fit before its first step."""

    config: FitConfig  #: with the defaults of the method
    problem: Problem
    pixels: PixelSource
    step: TrainingStep
    state: State


def begin_fit(dataset: Dataset, config: FitConfig, *, clip_negative: bool = False) -> FreshFit:
    """A fit of a data set that writes nothing."""
    config = with_defaults(config, dataset)
    pixels = pixels_of(dataset, config, clip_negative=clip_negative)
    problem = problem_of(dataset, config, pixels.photographs.level)
    begin_cameras(problem, dataset, pixels)
    begin_lights(problem, pixels)
    step = TrainingStep(problem, pixels, config)
    return FreshFit(config, problem, pixels, step, initial_state(problem))


def compile_kernels(
    dataset: Dataset, configs: Sequence[FitConfig], *, clip_negative: bool = False
) -> None:
    """Take the first steps of fits and drop them, so that their kernels are in Dr.Jit's cache.

    The time of a fit has the compilation of kernels in it that are not there. It is longest for
    methods that follow whole paths, and the first of several fits would pay for all.
    """
    for config in configs:
        fit = begin_fit(dataset, config, clip_negative=clip_negative)
        for number in range(_COMPILING_STEPS):
            fit.step(fit.state, number, learning_rates(fit.config, number, 0.0))
        dr.sync_thread()
        del fit
        gc.collect()
        dr.flush_malloc_cache()
