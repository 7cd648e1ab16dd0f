"""Where unknown exposures and responses begin: at what photographs of the same points say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.pixels import PixelSource
from ..dataset.views import Dataset, View
from ..fields.arrays import from_numpy
from .cameras import Cameras
from .first_response import first_response
from .problem import Problem

#: Pixels of a view that are looked for in other views, and the most of these.
_PIXELS, _PARTNERS = 256, 24
#: Points that two views must share.
_FEWEST = 8
#: Weight of what two photographs say as a whole, in points that they share: where they share none.
_PRIOR = 0.1
#: Pixels count where they are brighter than this part of the photograph's mean.
_DARK = 0.01


@final
@dataclass(frozen=True, eq=False)
class SharedPoints:
    """Light of the same points in two photographs each.

    Args:
        first, second: training views that see a point, shape (n,).
        logs: of its radiance in the two, linear RGB, shape (2, n, 3); NaN where dark or clipped.
        whole: of each view as a whole, relative to the first one, shape (views, 3).
    """

    first: np.ndarray
    second: np.ndarray
    logs: np.ndarray
    whole: np.ndarray


def shared_points(scene: mi.Scene, views: Sequence[View], pixels: PixelSource) -> SharedPoints:
    """Random points that photographs see, with their light in all other ones that do.

    Processes that share the photographs look for them together.

    Args:
        scene: of known geometry.
        views: the training views.
        pixels: of these.
    """
    rng = np.random.default_rng(0)
    places = rng.integers(0, pixels.photographs.count, _PIXELS * len(views))
    numbers = np.unique(pixels.photographs.numbers(places)).astype(np.uint32)
    own = pixels.views_of(numbers)
    points, normals, valid = _points(scene, pixels, numbers)
    numbers, own, points, normals = (x[valid] for x in (numbers, own, points, normals))
    firsts = np.cumsum([0, *(view.camera.width * view.camera.height for view in views)])
    origins = np.array([view.camera.origin for view in views])

    sources, targets, found = [], [], []
    for i in range(len(views)):
        others = [j for j in range(len(views)) if j != i]
        if len(others) > _PARTNERS:
            others = sorted(rng.choice(others, _PARTNERS, replace=False))
        mine = np.flatnonzero(own == i)
        for j in others:
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
    source, target, place = source[clear], target[clear], place[clear]

    start = own[source]
    logs = _logs(pixels, views, numbers, own)
    there = _logs(pixels, views, firsts[target] + place, target)
    whole = [np.ma.median(np.ma.masked_invalid(logs[own == i]), 0) for i in range(len(views))]
    whole = np.ma.filled(np.ma.array(whole) - whole[0], 0.0)
    return SharedPoints(start, target, np.stack([logs[source], there]), whole)


def first_gains(shared: SharedPoints) -> np.ndarray:
    """How much brighter each photograph is than the first one where both see the same points.

    The ratio of two photographs is the median over the points that they share. It is that of their
    exposures where surfaces are about as bright from both sides; shine and what the mesh lacks are
    few of the points. The gains of all views then are the least squares ones.

    Returns:
        Linear RGB over what the data set tells of the exposures, shape (views, 3); the first is 1.
    """
    ratios = shared.logs[1] - shared.logs[0]
    known = []
    for i, j in sorted(set(zip(shared.first.tolist(), shared.second.tolist(), strict=True))):
        ratio = ratios[(shared.first == i) & (shared.second == j)]
        count = int(np.isfinite(ratio).sum(0).min())
        if count >= _FEWEST:
            known.append((i, j, float(count), np.nanmedian(ratio, 0)))
    return np.exp(_solved(shared.whole, known))


def begin_cameras(problem: Problem, dataset: Dataset, pixels: PixelSource) -> None:
    """Let unknown exposures and responses begin where photographs say.

    Exposures that are unknown beside a response are those of f(P) = P at first.
    """
    camera, views = problem.camera, dataset.train
    solves = Cameras(camera, views).solves
    if camera is None or not (solves or camera.has_response):
        return
    shared = shared_points(problem.scene_view.scene, views, pixels)
    gains = first_gains(shared) if solves else np.ones((len(views), 3))
    if solves:
        camera.start(gains)
    if not camera.has_response:
        return
    told, pair = np.log([view.exposure for view in views])[:, None], [shared.first, shared.second]
    photographs, exposures = shared.logs + told[pair], np.log(gains) + told
    if camera.white_balance != "per-image":
        ratios = exposures[shared.second] - exposures[shared.first]
        camera.start_response(first_response(photographs, ratios))
        return
    # Where each photograph has gains of red and blue of its own, any response of these explains
    # them. Green tells the response of all channels, and photographs through it tell their gains.
    green = exposures[:, [1]] if camera.has_exposures else told
    ratios = green[shared.second] - green[shared.first]
    curve = first_response(photographs[..., [1]], ratios)
    camera.start_response(np.repeat(curve, 3, 0))
    light = np.log(camera.light(np.exp(photographs))) - told[pair]
    camera.start(first_gains(replace(shared, logs=light)))


def _solved(whole: np.ndarray, known: Sequence[tuple[int, int, float, np.ndarray]]) -> np.ndarray:
    """Logs of gains, shape (views, 3), of which the first is zero.

    Args:
        whole: what photographs say as a whole.
        known: two views, the weight of their ratio, and its log, (3,).
    """
    count = len(whole)
    matrix, right = np.zeros((count, count)), np.zeros((count, 3))
    pairs = [*known, *((0, j, _PRIOR, whole[j]) for j in range(1, count))]
    for i, j, weight, ratio in pairs:
        matrix[[i, j], [i, j]] += weight
        matrix[[i, j], [j, i]] -= weight
        right[j] += weight * ratio
        right[i] -= weight * ratio
    logs = np.zeros((count, 3))
    if count > 1:
        logs[1:] = np.linalg.solve(matrix[1:, 1:], right[1:])
    return logs


def _logs(
    pixels: PixelSource, views: Sequence[View], numbers: np.ndarray, of: np.ndarray
) -> np.ndarray:
    """Logs of the radiance of pixels, (n, 3); NaN where they are dark or clipped.

    Args:
        numbers: of the pixels.
        of: the view of each.
    """
    light = pixels.photographs.radiance(numbers).astype(np.float64)
    sums = np.bincount(of, light.mean(1), len(views))
    least = _DARK * sums / np.maximum(np.bincount(of, minlength=len(views)), 1)
    limits = np.array([view.limit for view in views])
    told = (light > least[of, None]) & (light < limits[of, None])
    return np.log(np.where(told, light, np.nan))


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
