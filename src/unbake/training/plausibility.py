"""Whether photographs, cameras and lights of a fit can belong together."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.findings import noise_at_black
from ..dataset.hot_pixels import told_hot_pixels
from ..dataset.pixels import PixelSource
from ..dataset.poses import check_cameras, pose_warnings
from ..dataset.quick_check import quick_findings
from ..dataset.views import Dataset
from ..errors import UserError
from ..fields.arrays import from_numpy
from ..ranks import Ranks
from ..scene.emitters import (
    ENVIRONMENTS,
    STRENGTHS,
    lights_besides,
    named_emitters,
)
from ..scene.parse import parse
from ..transport.render import RayGenerator, render_radiance
from .problem import Problem

#: Photographs that are so many times brighter or darker than the scene's lights make grey surfaces
#: are in other units. Between black and white surfaces, and in corners that light reaches after
#: many reflections, there is less.
FACTOR = 50.0
_PIXELS, _SAMPLES, _DEPTH = 1024, 8, 8
_GREY = 0.5


def data_warnings(
    dataset: Dataset, pixels: PixelSource, problem: Problem, *, allow_doubtful: bool = True
) -> list[str]:
    """One line for each sign that something is wrong with the data of a fit.

    Processes that share the photographs all call this together.

    Args:
        dataset: of the fit.
        pixels: to train on.
        problem: with untrained fields.
        allow_doubtful: tell only where poses have other axes or units, or light turns with the
            cameras, instead of refusing it.

    Raises:
        UserError: no training view sees a surface of the scene, or what is not allowed.
    """
    share = pixels.photographs.share
    ranks = Ranks() if share is None else share.ranks
    with dr.suspend_grad():
        found = ranks.together(lambda: _doubts(dataset, pixels, problem, allow_doubtful))
        # As the first one found it: rays may differ between machines, and all look or none does.
        units = None if ranks.gather(bool(found))[0] else _other_units(pixels, problem)
    light, colour = _placeholder(dataset, problem), _open_colour(dataset, problem)
    hot_pixels = told_hot_pixels(pixels.photographs.hot_pixels)
    noise = noise_at_black(pixels.photographs.noise)
    told = (*found, units, light, colour, _pictures(dataset, problem), hot_pixels)
    told = (*told, noise and str(noise))
    return [line for line in told if line]


def _doubts(
    dataset: Dataset, pixels: PixelSource, problem: Problem, allow_doubtful: bool
) -> list[str]:
    """What rays and photographs tell of cameras, exposures and light; as of `data_warnings`."""
    scene = problem.scene_view.scene
    inside = check_cameras(scene, {v.name: v.camera for v in dataset.views})
    found = [f"{name}: the camera seems to stand inside geometry" for name in inside]
    hidden = dataset.background == "hidden"
    words = (scene, dataset.train, pixels.photographs, dataset.folder)
    found += pose_warnings(*words, hidden=hidden)
    quick = quick_findings(scene, dataset.train, pixels.photographs, lambda: _unmerged(dataset))
    # Of poses that see little of the scene, nothing else is told but what is surely wrong.
    quick = [finding for finding in quick if finding.level == "error" or not found]
    for finding in quick:
        if finding.level == "error" and not allow_doubtful:
            remedy = f"{finding.remedy}, or pass --allow-doubtful"
            raise UserError(finding.what, finding.where or dataset.folder, remedy)
    # Exposures that are fitted may differ, and so may what an unknown response makes of them.
    camera = problem.camera
    fitted = camera is not None and (camera.has_exposures or camera.has_response)
    found += (str(finding) for finding in quick if not (fitted and finding.check == "exposure"))
    return found


def _unmerged(dataset: Dataset) -> mi.Scene:
    """The scene of a data set, with all shapes that its file has."""
    return parse(dataset.scene, dataset.root).instantiate(merge=False, bitmaps=False)


def _placeholder(dataset: Dataset, problem: Problem) -> str | None:
    """A line if an environment that only stands for the unknown light is taken for the true one."""
    if dataset.light == "known" or problem.environment is not None:
        return None
    if problem.emission is not None and not lights_besides(
        parse(dataset.scene, dataset.root), (*STRENGTHS,)
    ):
        return None
    return (
        "the data set says that its light is unknown, and what stands for it in the scene is taken "
        "for the true light. Leave out --unknown, and lighting is recovered with the materials"
    )


def _open_colour(dataset: Dataset, problem: Problem) -> str | None:
    """A line if one white balance of all photographs is fitted, and no light is known."""
    if problem.camera is None or problem.camera.white_balance != "common":
        return None
    if not problem.light_is_unknown:
        return None
    fitted = ENVIRONMENTS if problem.environment is not None else ()
    fitted += () if problem.emission is None else tuple(STRENGTHS)
    if lights_besides(parse(dataset.scene, dataset.root), fitted):
        return None
    return (
        "the white balance of all photographs and the colour of unknown light cannot be told "
        "apart: leave out --white-balance"
    )


def _pictures(dataset: Dataset, problem: Problem) -> str | None:
    """A line if lamps whose strength is fitted differ over their surface, and no fit knows how."""
    if problem.emission is None:
        return None
    known = named_emitters(parse(dataset.scene, dataset.root))
    pairs = zip(known, problem.emission.patterns, strict=True)
    names = [emitter.name for emitter, pattern in pairs if emitter.varies and pattern is None]
    if not names:
        return None
    return (
        f"{', '.join(names)} will have one colour: pictures of lamps are left out, which spoils "
        "the strength of these lamps, and of others"
    )


def _other_units(pixels: PixelSource, problem: Problem) -> str | None:
    """A line if the photographs are too bright or too dark for lights that are known."""
    if problem.light_is_unknown:
        return None
    photographs = pixels.photographs
    places = np.random.default_rng(0).integers(0, photographs.count, _PIXELS)
    numbers = photographs.numbers(places)
    mean = float(photographs.radiance(numbers).mean(dtype=np.float64))
    table = from_numpy(mi.UInt32, numbers.astype(np.uint32))

    def through(pixel: mi.UInt32, offset: mi.Point2f) -> mi.Ray3f:
        return pixels.rays.through(dr.gather(mi.UInt32, table, pixel), offset)

    # Direct light is quickly compiled and most often enough; corners that it does not reach need
    # the whole paths.
    for estimate in (_direct_light, _all_light):
        expected = estimate(problem, through)
        if mean < FACTOR * expected and expected < FACTOR * mean:
            return None
    if expected <= 0:
        return "no light of the scene reaches what the training views see"
    told = "brighter" if mean > expected else "darker"
    ratio = max(mean / expected, expected / mean) if mean > 0 else np.inf
    return (
        f"the photographs are {ratio:.2g} times {told} than the scene's lights make grey surfaces. "
        "Are they in other units than the lights?"
    )


def _direct_light(problem: Problem, through: RayGenerator) -> float:
    """Mean radiance of the pixels if surfaces were grey and reflected direct light alone."""
    scene = problem.scene_view.scene
    count = _PIXELS * _SAMPLES
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    ray = through(dr.arange(mi.UInt32, count) // _SAMPLES, sampler.next_2d())
    si = scene.ray_intersect(ray)
    direction, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, si.is_valid())
    reflected = light * dr.abs(dr.dot(si.n, direction.d)) * (_GREY / dr.pi)
    seen = si.is_valid() | (not problem.hide_emitters)
    emitted = si.emitter(scene).eval(si)
    total = dr.select(si.is_valid(), reflected, 0) + dr.select(seen, emitted, 0)
    return float(np.nanmean(np.array(total)))


def _all_light(problem: Problem, through: RayGenerator) -> float:
    """Mean radiance of the pixels with untrained materials, which are grey."""
    image = render_radiance(
        problem.scene_view,
        through,
        _PIXELS,
        _SAMPLES,
        seed=0,
        max_depth=_DEPTH,
        rr_depth=_DEPTH,
        hide_emitters=problem.hide_emitters,
    )
    return float(image.mean(dtype=np.float64))
