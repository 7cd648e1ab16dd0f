"""A fit that writes nothing, for measurements and experiments."""

from __future__ import annotations

from dataclasses import dataclass

from ..config import FitConfig
from ..dataset.pixels import PixelSource
from ..dataset.views import Dataset
from .defaults import with_defaults
from .problem import Problem, make_problem, training_pixels
from .state import State, initial_state
from .step import TrainingStep


@dataclass(frozen=True)
class FreshFit:
    """A fit before its first step."""

    config: FitConfig  #: with the defaults of the method
    problem: Problem
    pixels: PixelSource
    step: TrainingStep
    state: State


def begin_fit(dataset: Dataset, config: FitConfig) -> FreshFit:
    """A fit of a data set that writes nothing."""
    config = with_defaults(config, dataset)
    smoothed = config.loss_reference == "smoothed"
    pixels = training_pixels(dataset, clip_negative=False, smoothed=smoothed)
    mean = pixels.photographs.mean
    problem = make_problem(dataset.scene, dataset.background, config, mean)
    step = TrainingStep(problem, pixels, config)
    return FreshFit(config, problem, pixels, step, initial_state(problem))
