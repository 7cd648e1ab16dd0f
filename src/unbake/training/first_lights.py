"""Where unknown strengths of lights begin: at what photographs show of them (ours)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.pixels import PixelSource
from ..fields.arrays import from_numpy
from ..fields.emission import Emission
from ..fields.materials import carrying
from ..ranks import Ranks
from .problem import Problem

#: Random pixels of all views that are looked at, at most.
_PIXELS = 1 << 18
#: Places in a pixel that must all show the same light: its middle, and near its corners.
_PLACES = ((0.5, 0.5), (0.05, 0.05), (0.05, 0.95), (0.95, 0.05), (0.95, 0.95))
#: Pixels that must show a light.
_FEWEST = 1
#: A light begins no darker than this part of what it would have begun with: black ones could not
#: become brighter.
_DARKEST = 1e-3


def begin_lights(problem: Problem, pixels: PixelSource, ranks: Ranks | None = None) -> None:
    """Let lights that photographs show begin as bright as they are there.

    All others begin as they would, at the level of the photographs. Steps change a strength by a
    few percent: a lamp that is a thousandth of its neighbour would not get there. What a lamp
    reflects is in its pixels, too, and where they are clipped it is brighter: steps find that.

    Args:
        problem: of a fit that has not begun. Nothing happens where no strengths are unknown, where
            photographs do not show lights, or where something of the cameras is unknown that
            changes how bright they are.
        pixels: of the training views.
        ranks: that begin together; None: there is one.
    """
    emission = problem.emission
    if emission is None or problem.hide_emitters or problem.camera is not None:
        return
    ranks, begun = ranks or Ranks(), np.array(emission.values).T
    found = ranks.together(lambda: _seen(problem, emission, pixels))
    strengths = np.where(np.isfinite(found), np.maximum(found, _DARKEST * begun), begun)
    emission.start(ranks.as_first((strengths / emission.scale).astype(np.float32)))


def _seen(problem: Problem, emission: Emission, pixels: PixelSource) -> np.ndarray:
    """The strengths that photographs show, linear RGB, shape (lights, 3); NaN of no light in view.

    It leaves the strengths at something else.
    """
    count = pixels.photographs.count
    places = np.arange(count)
    if count > _PIXELS:
        places = np.unique(np.random.default_rng(0).integers(0, count, _PIXELS))
    numbers = pixels.photographs.numbers(places)
    codes = np.stack([np.ones(emission.count), np.arange(1, emission.count + 1)])
    shown = np.array([_shown(problem, emission, pixels, numbers, code) for code in codes])
    patterns, coded = shown  # (places, pixels, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        which = np.rint(np.nanmax(coded / patterns, axis=2, initial=0, where=patterns > 0))
    whole = (which[0] > 0) & (which == which[0]).all(0)
    light, pattern = which[0, whole].astype(np.int64) - 1, patterns.mean(0)[whole]
    radiance = pixels.photographs.radiance(numbers)[whole]
    found = np.full((emission.count, 3), np.nan)
    for number in np.flatnonzero(np.bincount(light, minlength=emission.count) >= _FEWEST):
        chosen = light == number
        for channel in range(3):
            told = chosen & (pattern[:, channel] > 0)
            if told.any():
                ratios = radiance[told, channel] / pattern[told, channel]
                found[number, channel] = np.median(ratios)
    return found


@carrying()
def _shown(
    problem: Problem,
    emission: Emission,
    pixels: PixelSource,
    numbers: np.ndarray,
    strengths: np.ndarray,
) -> np.ndarray:
    """The light that pixels show directly, by the strengths of lights, at each of `_PLACES`.

    Args:
        numbers: of the pixels, shape (n,).
        strengths: of the lights, shape (lights,).

    Returns:
        Linear RGB, shape (places, n, 3).
    """
    logs = np.repeat(np.log(strengths / emission.scale), 3).astype(np.float32)
    emission.assign({"log": from_numpy(mi.Float, logs)})
    emission.prepare()
    scene, found = problem.scene_view.scene, []
    pixel = from_numpy(mi.UInt32, numbers.astype(np.uint32))
    with dr.suspend_grad():
        for place in _PLACES:
            ray = pixels.rays.through(pixel, mi.Point2f(*place))
            si = scene.ray_intersect(ray)
            found.append(np.array(si.emitter(scene).eval(si)).T)
    return np.stack(found)
