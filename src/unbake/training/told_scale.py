"""Whether photographs determine the scale of albedo and light, where both are unknown.

They do where they show unknown light itself, directly or in mirrors and glass, and are not clipped:
its radiance is then that of pixels. Where none shows any, the scale begins at a
convention (`regularizers.py`), and light between surfaces tells more of it.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.pixels import PixelSource
from ..dataset.spread import places
from ..dataset.views import Dataset, fitted_pixels
from ..fields.arrays import from_numpy
from ..scene import free_space
from ..scene.emitters import ENVIRONMENTS, STRENGTHS, lights_besides
from ..scene.parse import parse
from ..transport.vertex import find_vertex
from .problem import Problem

#: Pixels, at most, that are looked at.
_PIXELS = 1 << 16
#: The part of them, at least, that must show it: cracks of a mesh show the environment as well.
_LEAST = 1e-4
#: Pixels that are more than so many times as bright as the median one may be highlights.
_HIGHLIGHT = 8.0
#: What no channel of the mean albedo is above.
_MOST_ALBEDO = 0.8
#: How many times as much makes sure that it is so, by whatever pixels are looked at.
_SURELY = 4
#: Parts of a fit: until the first one is done, the mean albedo has its first weight, and from the
#: second one on, its last.
_HELD, _FREE = 0.1, 0.5
#: The last weight over the first one, at least: it falls evenly in its logarithm.
_LEAST_WEIGHT = 1e-6


def is_shared(problem: Problem) -> bool:
    """Whether albedo and all light are unknown, so that a factor is shared between them."""
    unknown = (problem.environment is not None) + len(problem.emitter_names)
    both = problem.light_is_unknown and "albedo" in (problem.materials or ())
    return both and len(problem.scene_view.scene.emitters()) == unknown


def shows_light(problem: Problem, config: FitConfig, pixels: PixelSource) -> bool | None:
    """Whether pixels to train on show unknown light, directly or in mirrors and glass.

    Where they are clipped they tell no scale, and are left out. Processes that share the
    photographs all call this together.

    Returns:
        None where that is not asked: the settings hold no mean albedo, or go by the background.
    """
    lighting = config.lighting
    if not lighting.anchor or lighting.scale_told_by == "background":
        return None
    if not is_shared(problem):
        return None
    found, own = pixels.photographs, _own_places(pixels)
    shown = found.joined(lambda: _shown(problem, pixels, found.own_numbers(own)))
    return bool(shown.mean() >= _LEAST)


def conventional_albedo(
    problem: Problem, config: FitConfig, pixels: PixelSource
) -> tuple[float, float, float]:
    """The mean albedo where it is a convention, linear RGB.

    With white light, surfaces have the colour of the photographs. So light has the colour that
    cameras took for white, and objects keep theirs.

    Args:
        pixels: to train on. Processes that share them are not asked: where the mean is held, each
            has all.
    """
    lighting = config.lighting
    mean = lighting.mean_albedo
    if lighting.mean_colour == "grey" or not is_shared(problem):
        return mean, mean, mean
    photographs = pixels.photographs
    rgb = photographs.own_rows(photographs.own_numbers(_own_places(pixels)))[:, :3]
    # Highlights have the colour of light.
    level = rgb.mean(1, dtype=np.float64)
    lit = level > 0
    if not lit.any():
        return mean, mean, mean
    plain = rgb[lit & (level <= _HIGHLIGHT * np.median(level[lit]))]
    colour = np.maximum(plain.mean(0, dtype=np.float64), 1e-30)
    colour *= mean / colour.mean()
    colour *= min(1.0, _MOST_ALBEDO / colour.max())
    red, green, blue = (float(x) for x in colour)
    return red, green, blue


def weigh_convention(problem: Problem, config: FitConfig, done: float) -> None:
    """Give the mean albedo the weight that it has at a point of a fit.

    At first it alone keeps albedo from running into its bounds. Later, light between surfaces
    tells the scale, if weakly: bright ones return more of it to each other.

    Args:
        done: fraction of the fit that is done, [0,1].
    """
    if not config.shares_scale:
        return
    first = config.lighting.anchor
    last = min(first, max(config.lighting.final_anchor, _LEAST_WEIGHT * first))
    part = min(1.0, max(0.0, (done - _HELD) / (_FREE - _HELD)))
    problem.anchor = first ** (1 - part) * last**part


def told_convention(problem: Problem) -> str:
    """A line of what the mean albedo is taken for, in a fit where it is a convention."""
    mean = " ".join(f"{x:.2f}" for x in problem.mean_albedo)
    why = "no photograph shows the light itself, unclipped"
    if problem.hide_emitters:
        why = "the data set hides the background, and no mirror shows the light"
    told = "brightness and colour of albedo begin at a convention, a mean of"
    return f"{why}: {told} {mean}, and only light between surfaces tells more"


def _own_places(pixels: PixelSource) -> np.ndarray:
    """Places of pixels to look at, of those that this process holds."""
    found = pixels.photographs
    chosen = places(found.count, _PIXELS)
    return chosen[(chosen >= found.places.start) & (chosen < found.places.stop)]


def may_be_untold(config: FitConfig, dataset: Dataset) -> bool:
    """Whether a fit may have to fix the mean albedo, judged from the data set alone.

    Mirrors and glass are not looked at.

    Raises:
        UserError: the scene or a mask cannot be read.
    """
    hidden, lighting = dataset.background == "hidden", config.lighting
    if not (config.shares_scale and lighting.anchor > 0):
        return False
    if hidden or lighting.scale_told_by == "background":
        return hidden
    parsed = parse(dataset.scene, dataset.root)
    unknown = ENVIRONMENTS * config.learns_environment + (*STRENGTHS,) * config.learns_emission
    if lights_besides(parsed, unknown):
        return False
    if config.learns_emission:  # whether lamps are seen, and not clipped, is not looked at
        return True
    scene, looked, shown = parsed.instantiate(), 0, 0
    views = dataset.train
    each = max(1, _PIXELS // len(views))
    for view in views:
        counted, camera = fitted_pixels(view, dataset.background), view.camera
        size = camera.width * camera.height
        numbers = None if counted is None else np.flatnonzero(counted)
        count = size if numbers is None else len(numbers)
        if not count:
            continue
        chosen = places(count, each)
        row, column = np.divmod(chosen if numbers is None else numbers[chosen], camera.width)
        hits = free_space.trace(scene, *camera.rays(column + 0.5, row + 0.5))
        looked += len(chosen)
        shown += int(np.isinf(hits.distance).sum())
        if shown >= _SURELY * _LEAST * len(views) * each:  # whatever the others show
            return False
    return shown < _SURELY * _LEAST * looked


def _shown(problem: Problem, pixels: PixelSource, numbers: np.ndarray) -> np.ndarray:
    """Whether pixels show light, all of which is unknown, and are not clipped, (n,) bool."""
    if not len(numbers):
        return np.zeros(0, bool)
    clipped = np.zeros(len(numbers), bool)
    if (limits := pixels.limits_of(numbers)) is not None:
        colours = pixels.photographs.own_rows(numbers)[:, :3]
        # One channel that is clipped leaves its factor open.
        clipped = (colours >= limits[:, None]).any(1)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(numbers))
    with dr.suspend_grad():
        ray = pixels.rays.through(from_numpy(mi.UInt32, numbers.astype(np.uint32)), mi.Point2f(0.5))
        vertex = find_vertex(
            problem.scene_view,
            ray,
            dr.full(mi.Bool, True, len(numbers)),
            sampler,
            hide_emitters=problem.hide_emitters,
        )
        return np.array(dr.max(vertex.emitted) > 0) & ~clipped
