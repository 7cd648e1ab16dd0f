"""The checks of a data set that are quick enough for every fit."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from .agreement import exposures, shared_points, turning_light
from .alignment import FEWEST_VIEWS, SHORTEST_SIDE, alignment
from .findings import Finding, light_that_turns, misaligned, unequal_exposures
from .photographs import Photographs
from .small_views import SmallView, seen_by, small_view
from .views import View

#: Views that are looked at, spread evenly.
_MOST_VIEWS = 16


def quick_findings(
    scene: mi.Scene, views: Sequence[View], photographs: Photographs
) -> list[Finding]:
    """Look for poses, exposures and light that do not belong together.

    Args:
        scene: that the photographs show.
        views: to train on.
        photographs: of these views.

    Returns:
        Nothing where views are too few or too small to tell.
    """
    chosen = np.linspace(0, len(views) - 1, min(len(views), _MOST_VIEWS)).round().astype(int)
    large = [i for i in chosen.tolist() if _shorter_side(views[i]) >= SHORTEST_SIDE]
    if len(large) < FEWEST_VIEWS:
        return []
    small = _small_views(views, photographs, large)
    better = misaligned(alignment(scene, small))
    if better is not None:
        return [better]
    points = shared_points(small, seen_by(scene, [view.camera for view in small]))
    found = exposures(points, len(small))
    names = [view.name for view in small]
    both = unequal_exposures(found, names), light_that_turns(turning_light(points, found))
    return [finding for finding in both if finding is not None]


def _shorter_side(view: View) -> int:
    return min(view.camera.width, view.camera.height)


def _small_views(
    views: Sequence[View], photographs: Photographs, numbers: Sequence[int]
) -> list[SmallView]:
    first = np.cumsum([0, *(view.camera.width * view.camera.height for view in views)])
    small = []
    for i in numbers:
        part, alpha = slice(first[i], first[i + 1]), None
        if photographs.chosen is not None:
            inside = slice(*np.searchsorted(photographs.chosen, (part.start, part.stop)))
            alpha = np.zeros(part.stop - part.start, np.float32)
            alpha[photographs.chosen[inside].astype(np.int64) - part.start] = 1
        rgb = np.array(photographs.table[part, :3])
        small.append(small_view(views[i].name, views[i].camera, rgb, alpha))
    return small
