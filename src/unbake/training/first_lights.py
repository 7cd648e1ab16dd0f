"""Where unknown strengths of lights begin: at what photographs show of them (ours)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.pixels import PixelSource
from ..dataset.spread import places
from ..fields.arrays import from_numpy
from ..fields.emission import Emission
from ..fields.materials import carrying
from ..ranks import Ranks
from .first_gains import of_first
from .problem import Problem

#: Pixels of all views that are looked at, at most, evenly spread.
_PIXELS = 1 << 18
#: Places in a pixel that must all show the same light: its middle, and near its corners.
_PLACES = ((0.5, 0.5), (0.05, 0.05), (0.05, 0.95), (0.95, 0.05), (0.95, 0.95))
#: Pixels that must show a light as a whole; and where poses are not known, so that some of them
#: show what is beside it.
_FEWEST, _FEWEST_OF_POSES = 1, 16
#: Pixels that must show a light whose strength is held: one alone may be blurred, or beside it.
_FEWEST_TO_HOLD = 8
#: Strengths that photographs show are held until this part of a fit with unknown albedo is done;
#: and to its end where lights are so many times as bright as the photographs: what they reflect is
#: nothing beside that.
WAITS, SURE = 0.3, 10.0
#: A light begins no darker than this part of what it would have begun with: black ones could not
#: become brighter.
_DARKEST = 1e-3


def begin_lights(problem: Problem, pixels: PixelSource, ranks: Ranks | None = None) -> None:
    """Let lights that photographs show begin as bright as they are there.

    All others begin as they would, at the level of the photographs. Steps change a strength by a
    few percent: a lamp that is a thousandth of its neighbour would not get there. What a lamp
    reflects is in its pixels, too, and where they are clipped it is brighter: steps find that.
    Behind panes no light is found.

    Where albedo is unknown as well, it is far from the truth at first, and steps would make lights
    as much darker as it is too bright. What photographs show of lights is held meanwhile, and what
    is surely right stays as it is: most pixels tell of lights with the noise and the error of L_θ,
    those that show them with neither.

    Args:
        problem: of a fit that has not begun. Nothing happens where no strengths are unknown, where
            lights are hidden in photographs, or where exposures, white balances, vignetting or
            a response are unknown.
        pixels: of the training views.
        ranks: that begin together; None: there is one.
    """
    emission = problem.emission
    if emission is None or problem.hide_emitters or problem.camera is not None:
        return
    ranks, begun = ranks or Ranks(), np.array(emission.values).T
    found, surely = _seen(problem, emission, pixels)
    strengths = np.where(np.isfinite(found), np.maximum(found, _DARKEST * begun), begun)
    emission.start(ranks.as_first((strengths / emission.scale).astype(np.float32)))
    if "albedo" in (problem.materials or ()):
        bright = strengths.max(1, keepdims=True) >= SURE * pixels.photographs.level
        seen, sure = (ranks.as_first(x.astype(np.float32)) > 0 for x in (surely, surely & bright))
        emission.hold(seen, lastly=sure)


def release_lights(problem: Problem, done: float) -> None:
    """Let go of strengths that `begin_lights` holds, once albedo is near where it belongs.

    Args:
        done: fraction of the fit that is done, [0,1].
    """
    if problem.emission is not None and done >= WAITS:
        problem.emission.release()


def _seen(
    problem: Problem, emission: Emission, pixels: PixelSource
) -> tuple[np.ndarray, np.ndarray]:
    """The strengths that photographs show, linear RGB, shape (lights, 3); NaN of no light in view.

    And whether these are no mere bounds, as of pixels that are clipped. It leaves the strengths at
    something else. Processes that share the photographs all call this together.
    """
    photographs = pixels.photographs
    ranks = Ranks() if photographs.share is None else photographs.share.ranks
    numbers = photographs.numbers(places(photographs.count, _PIXELS)).astype(np.uint32)
    whole, light = of_first(ranks, lambda: _lights(problem, emission, pixels, numbers))
    numbers = numbers[whole]
    radiance = photographs.radiance(numbers)
    if not len(numbers):
        return np.full((emission.count, 3), np.nan), np.zeros((emission.count, 3), bool)
    pattern = _shown(problem, emission, pixels, numbers, np.ones(emission.count)).mean(0)
    fewest = _FEWEST if problem.poses is None else _FEWEST_OF_POSES
    found = np.full((emission.count, 3), np.nan)
    surely = np.zeros((emission.count, 3), bool)
    limits = pixels.limits_of(numbers)
    limits = np.full(len(numbers), np.inf) if limits is None else limits
    for number in np.flatnonzero(np.bincount(light, minlength=emission.count) >= fewest):
        for channel in range(3):
            weight = pattern[light == number, channel]
            # Where a picture is dark, pixels show what the lamp reflects.
            told = weight > 0
            if told.any():
                values = radiance[light == number, channel][told]
                found[number, channel] = _median(values / weight[told], weight[told])
                clipped = values >= limits[light == number][told]
                surely[number, channel] = weight[told][clipped].sum() < 0.5 * weight[told].sum()
        surely[number] &= (light == number).sum() >= _FEWEST_TO_HOLD
    return found, surely


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    """The value below and above which there is as much weight."""
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order], dtype=np.float64)
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])


def _lights(
    problem: Problem, emission: Emission, pixels: PixelSource, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels show nothing but an unknown light, as places among them, and which one.

    Light that is known is the same, however strong the unknown ones are.
    """
    ones = np.ones(emission.count)
    once, coded = (
        _shown(problem, emission, pixels, numbers, strengths)
        for strengths in (ones, ones + 1 + np.arange(emission.count))
    )
    ratios = np.divide(coded, once, out=np.zeros_like(coded), where=once > 0)
    which = np.rint(ratios.max(2)).astype(np.int64) - 2
    whole = np.flatnonzero((which[0] >= 0) & (which == which[0]).all(0))
    return whole, which[0, whole]


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
    emission.start(strengths / emission.scale)
    scene, found = problem.scene_view.scene, []
    pixel = from_numpy(mi.UInt32, numbers)
    with dr.suspend_grad():
        for place in _PLACES:
            ray = pixels.rays.through(pixel, mi.Point2f(*place))
            si = scene.ray_intersect(ray)
            found.append(np.array(si.emitter(scene).eval(si)).T)
    return np.stack(found)
