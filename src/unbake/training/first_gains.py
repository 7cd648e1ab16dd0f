"""Where unknown exposures and responses begin: at what photographs of the same points say."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.pair_ratios import PairRatios, levels
from ..dataset.pixels import PixelSource
from ..dataset.views import Dataset, View
from ..fields.arrays import from_numpy
from ..fields.camera import CameraModel
from ..ranks import Ranks
from .cameras import Cameras, radius2
from .first_response import SeenPoints, first_response, log_falloff
from .problem import Problem

#: Pixels that are looked for in other views: of all views, or more, if that is less of each.
_PIXELS, _OF_EACH = 1 << 16, 256
#: The most views that a pixel is looked for in.
_PARTNERS = 24
#: Views that are tried for that, at most: of many views, most show other things.
_LOOKED_AT = 240
#: Points of a view that are tried in another one, about, and the share that must be in its picture.
_TRIED, _INSIDE = 32, 0.15
#: Points that two views must share.
_FEWEST = 8
#: Weight of what two photographs say as a whole, in points that they share: where they share none.
_PRIOR = 0.1
#: Pixels count where they are brighter than this part of the photograph's mean.
_DARK = 0.01
_UNTOLD = (
    "the response of the camera is unknown, and no photographs of the same surfaces with exposures "
    "that differ tell it: it is taken as known. Take photographs of several exposures, or leave "
    "out --response"
)


@final
@dataclass(frozen=True, eq=False)
class SharedPoints:
    """Light of the same points in two photographs each.

    Args:
        point: number of a point, shape (n,).
        first, second: training views that see it, of the same shape. The first one is the same for
            all pairs of a point.
        radius2: squared distance from the middle of the photograph, 1 in a corner, shape (2, n).
        logs: of its radiance in the two, linear RGB, shape (2, n, 3); where it is clipped or dark,
            of what it is at least or at most.
        bound: 1 where it is clipped, -1 where it is dark, else 0; of the same shape.
        whole: logs of each view as a whole, relative to the first one, shape (views, 3).
    """

    point: np.ndarray
    first: np.ndarray
    second: np.ndarray
    radius2: np.ndarray
    logs: np.ndarray
    bound: np.ndarray
    whole: np.ndarray

    @property
    def views(self) -> np.ndarray:
        """`first` and `second`, shape (2, n)."""
        return np.stack([self.first, self.second])

    def seen(self, told: np.ndarray, gains: np.ndarray, falloff: np.ndarray) -> list[SeenPoints]:
        """The same, photograph by photograph, of each channel.

        Args:
            told: logs of exposures that photographs were divided by, by view.
            gains: logs of exposures and white balances, shape (views, 3).
            falloff: as `log_falloff` has it.
        """
        alone = np.unique(self.point, return_index=True)[1]

        def flat(pairs: np.ndarray) -> np.ndarray:
            return np.concatenate([pairs[0, alone], pairs[1]])

        view, radius2 = flat(self.views), flat(self.radius2)
        point = np.concatenate([self.point[alone], self.point])
        logs, bound = flat(self.logs) + told[view, None], flat(self.bound)
        known = gains[view] + log_falloff(falloff, radius2)[:, None]
        columns = zip(logs.T, known.T, bound.T, strict=True)
        return [SeenPoints(point, view, radius2, *column) for column in columns]


def shared_points(scene: mi.Scene, views: Sequence[View], pixels: PixelSource) -> SharedPoints:
    """Random points that photographs see, with their light in all other ones that do.

    Processes that share the photographs all call this together: the first one looks where the
    points are seen, and each tells the light of its own photographs.

    Args:
        scene: of known geometry.
        views: the training views.
        pixels: of these.
    """
    share, rng = pixels.photographs.share, np.random.default_rng(0)
    ranks = Ranks() if share is None else share.ranks
    wanted = max(_PIXELS, _OF_EACH * len(views))
    places = rng.integers(0, pixels.photographs.count, wanted)
    numbers = np.unique(pixels.photographs.numbers(places)).astype(np.uint32)
    numbers, source, target, place = of_first(
        ranks, lambda: _matches(scene, views, pixels, numbers, rng)
    )
    numbers = numbers.astype(np.uint32)
    own = pixels.views_of(numbers)
    firsts = np.cumsum([0, *(view.camera.width * view.camera.height for view in views)])
    # Masked pixels show something else, and those beside a hidden background nothing.
    clear = pixels.photographs.counts(firsts[target] + place)
    source, target, place = source[clear], target[clear], place[clear]

    start, partner = own[source], firsts[target] + place
    logs, bound = _logs(pixels, views, numbers, own)
    there = _logs(pixels, views, partner, target)
    known = np.ma.masked_array(logs, bound != 0)
    whole = [np.ma.median(known[own == i], 0) for i in range(len(views))]
    whole = np.ma.filled(np.ma.array(whole) - whole[0], 0.0)
    logs, bound = (
        np.stack([here[source], x]) for here, x in zip((logs, bound), there, strict=True)
    )
    pairs = (numbers[source], start), (partner, target)
    away = np.stack([_radius2(views, firsts, *each) for each in pairs])
    return SharedPoints(source, start, target, away, logs, bound, whole)


def _matches(
    scene: mi.Scene,
    views: Sequence[View],
    pixels: PixelSource,
    numbers: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, ...]:
    """Where points that pixels see are in other views, whatever photographs show there.

    Args:
        numbers: of the pixels.

    Returns:
        Numbers of the pixels that see a point. Then for each match the place of the pixel among
        these, the other view, and the place of the pixel there, (n,) each.
    """
    own = pixels.views_of(numbers)
    points, normals, valid = _points(scene, pixels, numbers)
    numbers, own, points, normals = (x[valid] for x in (numbers, own, points, normals))
    origins = np.array([view.camera.origin for view in views])

    cameras = [view.camera for view in views]
    sources, targets, found = [], [], []
    for i in range(len(views)):
        mine = np.flatnonzero(own == i)
        for j in _partners(i, cameras, points[mine], rng):
            place = views[j].camera.pixel_of(points[mine])
            inside = place >= 0
            seen, place = mine[inside], place[inside]
            sources.append(seen)
            targets.append(np.full(len(seen), j))
            found.append(place)
    source, target, place = map(np.concatenate, (sources, targets, found))
    # Of a surface that is seen from both sides, each has light of its own.
    side = [((origins[v] - points[source]) * normals[source]).sum(1) for v in (own[source], target)]
    clear = np.sign(side[0]) == np.sign(side[1])
    clear &= _visible(scene, points[source], normals[source], origins[target])
    return numbers, source[clear], target[clear], place[clear]


def of_first(ranks: Ranks, look: Callable[[], Sequence[np.ndarray]]) -> Sequence[np.ndarray]:
    """Whole numbers that the first process finds, on all: rays may differ between machines."""
    if ranks.size == 1:
        return look()
    found = ranks.together(lambda: look() if ranks.leads else (), math.inf)
    shapes = ranks.gather([array.shape for array in found])[0]
    mine = found if ranks.leads else [np.empty(shape, np.int64) for shape in shapes]
    return [ranks.as_first(array.astype(np.int64, copy=False)) for array in mine]


def first_gains(shared: SharedPoints) -> np.ndarray:
    """How much brighter each photograph is than the first one where both see the same points.

    The ratio of two photographs is the median over the points that they share. It is that of their
    exposures where surfaces are about as bright from both sides; shine and what the mesh lacks are
    few of the points. The gains of all views then are the least squares ones.

    Returns:
        Linear RGB over what the data set tells of the exposures, shape (views, 3); the first is 1.
    """
    logs = np.where(shared.bound == 0, shared.logs, np.nan)
    pairs = PairRatios.of(shared.first, shared.second, logs[1] - logs[0], _FEWEST)
    views = np.arange(1, len(shared.whole))
    found = levels(
        np.concatenate([pairs.first, np.zeros_like(views)]),
        np.concatenate([pairs.second, views]),
        np.concatenate([pairs.logs, shared.whole[1:]]),
        np.concatenate([pairs.counts, np.full(len(views), _PRIOR)]),
    )
    return np.exp(found - found[0])


def begin_cameras(
    problem: Problem, dataset: Dataset, pixels: PixelSource, ranks: Ranks | None = None
) -> str | None:
    """Let unknown exposures, white balances and responses begin where photographs say.

    Beside an unknown response, vignetting does so, too, if it is unknown.

    Args:
        problem: has the cameras, which are changed.
        dataset: of the fit.
        pixels: of its training views.
        ranks: processes that all call this together; None: this one is alone.

    Returns:
        A line if a response is unknown that photographs do not tell. Each point of a surface has an
        albedo of its own: photographs of one exposure are explained by any response, each with
        another albedo; two photographs of a point with exposures that differ are not.
    """
    camera, views = problem.camera, dataset.train
    solves = Cameras(camera, views).solves
    if camera is None or not (solves or camera.has_response):
        return None
    if len(views) == 1:  # there is no other photograph of its points
        return _UNTOLD if camera.has_response else None
    ranks = ranks or Ranks()
    shared = ranks.together(lambda: shared_points(problem.scene_view.scene, views, pixels))
    untold = ranks.together(lambda: _begin(camera, views, shared, solves))
    if ranks.size > 1:  # sums may differ between machines in their last bits
        begun = {key: ranks.as_first(x.numpy()) for key, x in camera.parameters().items()}
        camera.assign({key: from_numpy(mi.Float, numbers) for key, numbers in begun.items()})
    return untold


def _begin(
    camera: CameraModel, views: Sequence[View], shared: SharedPoints, solves: bool
) -> str | None:
    """Let cameras begin where shared points say; as of `begin_cameras`.

    Args:
        solves: whether there are exposures or white balances of single views to be found.
    """
    gains = np.log(first_gains(shared)) if solves else np.zeros((len(views), 3))
    if not camera.has_response:
        camera.start(np.exp(gains))
        return None
    # Green tells what all channels have in common. Where each photograph has gains of red and blue
    # of its own, these are told by any response of red and blue: all have that of green.
    told, balanced = np.log([view.exposure for view in views]), camera.white_balance == "per-image"
    common = told + (gains[:, 1] if camera.has_exposures else 0)
    falloff, vignetted = np.zeros(3), camera.vignetting() is not None
    seen = shared.seen(told, np.repeat(common[:, None], 3, 1), falloff)
    green = first_response(seen[1], len(views) * camera.has_exposures, vignetted)
    if green.falloff is not None:
        falloff = green.falloff
        camera.start_vignetting(lambda radius2: np.exp(log_falloff(falloff, radius2)))
    if green.gains is not None:
        common = common + green.gains
    gains = np.repeat((common - told)[:, None], 3, 1)
    curve = green.curve
    if curve is not None:
        # With what is known now, photographs tell the response once more, and of each channel.
        seen = shared.seen(told, gains + told[:, None], falloff)
        if green.gains is not None or green.falloff is not None:
            curve = _or(first_response(seen[1]).curve, curve)
        channels = [curve] * 3
        for i in () if balanced else (0, 2):
            channels[i] = _or(first_response(seen[i]).curve, curve)
        camera.start_response(np.stack(channels))
    if balanced:
        exposure = told[shared.views][..., None]
        light = np.log(camera.light(np.exp(shared.logs + exposure))) - exposure
        light -= log_falloff(falloff, shared.radius2)[..., None]
        gains = np.log(first_gains(replace(shared, logs=light)))
        if camera.has_exposures:
            gains += (common - told - gains[:, 1])[:, None]
    camera.start(np.exp(gains))
    return None if curve is not None else _UNTOLD


def _or(curve: np.ndarray | None, other: np.ndarray) -> np.ndarray:
    """A curve, or another where photographs do not tell it."""
    return other if curve is None else curve


def _partners(
    view: int, cameras: Sequence[Camera], points: np.ndarray, rng: np.random.Generator
) -> list[int]:
    """Views to look for points in: all, or random ones of those that have some in the picture.

    Where these are few, others are among them: what hides or leaves out a point is not known yet.

    Args:
        view: that sees the points.
        cameras: of all views.
        points: positions, shape (n, 3).
    """
    others = [j for j in range(len(cameras)) if j != view]
    if len(others) <= _PARTNERS:
        return others
    some = points[:: max(1, len(points) // _TRIED)]
    near, far = [], []
    for j in rng.permutation(others)[:_LOOKED_AT].tolist():
        inside = (cameras[j].pixel_of(some) >= 0).mean() if len(some) else 0.0
        (near if inside >= _INSIDE else far).append(j)
        if len(near) == _PARTNERS:
            break
    return sorted([*near, *far][:_PARTNERS])


def _logs(
    pixels: PixelSource, views: Sequence[View], numbers: np.ndarray, of: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Logs of the radiance of pixels, and where they are bounds; see `SharedPoints`, (n, 3) each.

    Args:
        numbers: of the pixels.
        of: the view of each.
    """
    light = pixels.photographs.radiance(numbers).astype(np.float64)
    sums = np.bincount(of, light.mean(1), len(views))
    least = _DARK * sums / np.maximum(np.bincount(of, minlength=len(views)), 1)
    # A photograph without light is as dark as can be.
    least = np.maximum(least, np.finfo(np.float32).tiny)[of, None]
    limit = np.array([view.limit for view in views])[of, None]
    bound = (light >= limit).astype(np.int8) - (light <= least)
    return np.log(np.clip(light, least, limit)), bound


def _radius2(
    views: Sequence[View], firsts: np.ndarray, numbers: np.ndarray, of: np.ndarray
) -> np.ndarray:
    """Squared distances of pixels from the middle of their photographs, as `radius2` has them.

    Args:
        firsts: the number of the first pixel of each view, and of all pixels.
        numbers: of the pixels.
        of: the view of each.
    """
    found, order = np.empty(len(numbers)), np.argsort(of, kind="stable")
    ends = np.searchsorted(of[order], np.arange(len(views) + 1)).tolist()
    for view, first, (start, stop) in zip(views, firsts[:-1].tolist(), pairwise(ends), strict=True):
        here = order[start:stop]
        found[here] = radius2(view.camera, numbers[here].astype(np.int64) - first)
    return found


def _points(
    scene: mi.Scene, pixels: PixelSource, numbers: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and normals that the centres of pixels see, and whether they see any."""
    with dr.suspend_grad():
        ray = pixels.rays.through(from_numpy(mi.UInt32, numbers), mi.Point2f(0.5))
        hit = scene.ray_intersect(ray)
        dr.eval(hit.p, hit.n, hit.is_valid())
        return np.array(hit.p).T, np.array(hit.n).T, np.array(hit.is_valid())


def _visible(
    scene: mi.Scene, points: np.ndarray, normals: np.ndarray, origins: np.ndarray
) -> np.ndarray:
    """Whether nothing lies between points and the places that they are seen from."""
    if not len(points):
        return np.zeros(0, bool)
    with dr.suspend_grad():
        si = dr.zeros(mi.SurfaceInteraction3f, len(points))
        si.p = mi.Point3f([from_numpy(mi.Float, x) for x in points.T])
        si.n = mi.Normal3f([from_numpy(mi.Float, x) for x in normals.T])
        towards = mi.Point3f([from_numpy(mi.Float, x) for x in origins.T])
        return ~np.array(scene.ray_test(si.spawn_ray_to(towards)))
