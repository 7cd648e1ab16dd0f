"""The checks of a data set that are quick enough for every fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mitsuba as mi
import numpy as np

from .agreement import exposures, shared_points, turning_light
from .alignment import FEWEST_VIEWS, SHORTEST_SIDE
from .decoding import stretch
from .findings import Finding, light_that_turns, misaligned, unequal_exposures
from .own_poses import compared
from .photographs import Photographs
from .small_views import SmallView, seen_by, small_camera, small_view
from .spread import evenly
from .views import View

#: Views that are looked at, spread evenly.
_MOST_VIEWS = 16
#: Of a small view: linear RGB, coverage and clipped share.
_CHANNELS = 5


def quick_findings(
    scene: mi.Scene,
    views: Sequence[View],
    photographs: Photographs,
    unmerged: Callable[[], mi.Scene] | None = None,
) -> list[Finding]:
    """Look for poses, exposures and light that do not belong together.

    Args:
        scene: that the photographs show.
        views: to train on.
        photographs: of these views.
        unmerged: makes the same scene, whose shapes tell a ground from what stands on it; asked for
            where poses seem to be wrong. None: the scene is such.

    Returns:
        Nothing where views are too few or too small to tell.
    """
    chosen = evenly(range(len(views)), _MOST_VIEWS)
    large = [i for i in chosen if _shorter_side(views[i]) >= SHORTEST_SIDE]
    if len(large) < FEWEST_VIEWS:
        return []
    small = _small_views(views, photographs, large)
    cameras = [small_camera(view.camera) for view in views]
    aligned = compared(scene, small, cameras)
    better = misaligned(aligned)
    if better is not None and unmerged is not None:
        aligned = compared(unmerged(), small, cameras)
        better = misaligned(aligned)
    if better is not None and not (aligned and aligned.plausible):
        return [better]
    points = shared_points(small, seen_by(scene, [view.camera for view in small]))
    found = exposures(points, len(small))
    names = [view.name for view in small]
    every = better, unequal_exposures(found, names), light_that_turns(turning_light(points, found))
    return [finding for finding in every if finding is not None]


def _shorter_side(view: View) -> int:
    return min(view.camera.width, view.camera.height)


def _small_views(
    views: Sequence[View], photographs: Photographs, numbers: Sequence[int]
) -> list[SmallView]:
    """Views in rising order, each made small by the process that holds it."""
    # Numbers of Python: whether one of NumPy is in a range is found by counting all that it has.
    first = np.cumsum([0, *(view.camera.width * view.camera.height for view in views)]).tolist()

    def own() -> np.ndarray:
        found = [np.zeros((0, _CHANNELS), np.float32)]
        for i in numbers:
            if first[i] in photographs.pixels:
                view = _small_view(views[i], photographs, first[i], first[i + 1])
                rows = np.dstack([view.rgb, view.alpha, view.clipped]).reshape(-1, _CHANNELS)
                found.append(rows.astype(np.float32))
        return np.concatenate(found)

    rows, small = photographs.joined(own), []
    for i in numbers:
        camera = small_camera(views[i].camera)
        count = camera.width * camera.height
        picture = rows[:count].reshape(camera.height, camera.width, _CHANNELS)
        alpha, clipped, drawn = picture[..., 3], picture[..., 4], views[i].mask_from_mesh
        small.append(SmallView(views[i].name, camera, picture[..., :3], alpha, clipped, drawn))
        rows = rows[count:]
    return small


def _small_view(view: View, photographs: Photographs, start: int, stop: int) -> SmallView:
    """A view that this process holds.

    Args:
        start, stop: numbers of its first pixel and of that of the next view.
    """
    first, alpha = photographs.pixels.start, None
    if photographs.chosen is not None:
        inside = photographs.chosen[stretch(photographs.chosen, start, stop)]
        alpha = np.zeros(stop - start, np.float32)
        alpha[inside.astype(np.int64) - start] = 1
    rgb = np.array(photographs.table[start - first : stop - first, :3])
    return small_view(view.name, view.camera, rgb, alpha, limit=view.limit)
