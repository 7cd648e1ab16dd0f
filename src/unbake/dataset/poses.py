"""Whether cameras see the scene where their photographs do, and what may be wrong if not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import UserError, named
from ..scene import free_space
from .camera import Camera, spread_rays
from .mistakes import usual_mistakes
from .photographs import Photographs
from .views import View

#: Pixels that are looked through, of all views.
_PIXELS = 4096
#: Shares of the pixels below which poses are doubtful. Where the background is hidden, or black as
#: in a scene without environment, all others show surfaces; else many may show the sky.
_DOUBTFUL, _DOUBTFUL_WITH_SKY = 0.8, 0.02
#: A view counts as blind if as many of its pixels or more see nothing.
_BLIND = 16
#: A mistake is named if as large a share of the pixels that see nothing would see surfaces.
_CONVINCING = 0.5
#: Masks seem inverted if a larger share than this of the pixels that they leave out see surfaces,
#: and a smaller one of those that count.
_LEFT_OUT, _COUNTED = 0.75, 0.1


def pose_warnings(
    scene: mi.Scene, views: Sequence[View], photographs: Photographs, where: Path, *, hidden: bool
) -> list[str]:
    """One line for each sign that poses do not belong to the scene; arguments as below.

    Raises:
        UserError: no pixel sees a surface of the scene. It names the mistake that explains that, if
            there is one.
    """
    problems = pose_problems(scene, views, photographs, where, hidden=hidden)
    if any(problem.where == str(where) for problem in problems):
        raise problems[0]
    return [str(problem) for problem in problems]


def pose_problems(
    scene: mi.Scene, views: Sequence[View], photographs: Photographs, where: Path, *, hidden: bool
) -> list[UserError]:
    """What is wrong where poses do not belong to the scene, with the likely mistake.

    Args:
        scene: that the photographs show.
        views: to train on.
        photographs: of these views.
        where: the data set's folder, which is named where no pixel sees a surface of the scene.
        hidden: whether the background is, so that all pixels to train on show surfaces.
    """
    if not photographs.count:
        return []
    cameras = [view.camera for view in views]
    places = np.random.default_rng(0).integers(0, photographs.count, _PIXELS)
    numbers = photographs.numbers(places)
    sky = not hidden and scene.environment() is not None
    if not hidden and not sky:
        numbers = numbers[(photographs.radiance(numbers) > 0).any(axis=1)]
        if not len(numbers):  # all are black
            return []
    seen = _seen(scene, cameras, numbers)
    share = float(seen.mean()) if len(seen) else 1.0
    left_out = _seen_by_left_out(scene, views, photographs) if share < _COUNTED else 0.0
    if left_out > _LEFT_OUT:
        what = (
            f"masks seem to be inverted: {100 * left_out:.0f} % of the pixels that they leave out "
            f"see a surface of the scene, and {100 * share:.2g} % of those that count"
        )
        remedy = "Masks are white where pixels count: invert them"
        return [UserError(what, where if share == 0 else None, remedy)]
    if share < (_DOUBTFUL_WITH_SKY if sky else _DOUBTFUL):
        remedy = _likely(scene, cameras, numbers, share)
        if share == 0:
            return [UserError("no training view sees a surface of the scene", where, remedy)]
        what = f"only {100 * share:.2g} % of the pixels to train on see a surface of the scene"
        return [UserError(what, None, remedy)]
    view = _views_of(cameras, numbers)
    count = np.bincount(view, minlength=len(views))
    hits = np.bincount(view, seen, len(views))
    blind = [views[i].name for i in np.flatnonzero((count >= _BLIND) & (hits == 0)).tolist()]
    if not blind:
        return []
    remedy = _likely(scene, cameras, numbers, share)
    what = "the view sees no surface of the scene"
    return [UserError(what, named(blind), remedy)]


def check_cameras(scene: mi.Scene, cameras: Mapping[str, Camera]) -> list[str]:
    """The names of the cameras that stand inside geometry or with their nose on it.

    A camera is named when its position is inside an object (the rule is that of
    `free_space.inside_geometry`), or when over half of 256 rays spread over its image hit something
    nearer than 0.1 % of the scene's diagonal. Both are signs of a wrong pose, not proof of one.

    Args:
        scene: the scene that the cameras look at.
        cameras: name to camera.
    """
    if not cameras:
        return []
    inside = free_space.inside_geometry(scene, np.array([c.origin for c in cameras.values()]))
    near = free_space.CONTACT * free_space.extent(scene)[2]
    touching = free_space.trace(scene, *spread_rays([*cameras.values()], 16)).distance < near
    nosy = touching.reshape(len(cameras), -1).mean(axis=1) > 0.5
    return [name for name, bad in zip(cameras, inside | nosy, strict=True) if bad]


def _likely(scene: mi.Scene, cameras: Sequence[Camera], numbers: np.ndarray, share: float) -> str:
    """What to correct, as a sentence: the simplest of the mistakes that explain what is seen."""
    found = [
        (mistake, float(_seen(scene, [mistake.corrected(c) for c in cameras], numbers).mean()))
        for mistake in usual_mistakes(_scales(scene, cameras))
    ]
    best = max(value for _, value in found)
    if best < share + _CONVINCING * (1 - share):
        return "Check the axes and the units of the poses, and that they are of this scene"
    mistake, value = next((m, v) for m, v in found if v >= 0.97 * best)
    return f"Are poses {mistake.told}? Without that {100 * value:.0f} % would"


def _scales(scene: mi.Scene, cameras: Sequence[Camera]) -> list[float]:
    """Scales that positions may need, by how they lie: scaled down, any camera is in the middle."""
    low, high, diagonal = free_space.extent(scene)
    origins = np.array([camera.origin for camera in cameras])
    away = np.median(np.linalg.norm(origins - (low + high) / 2, axis=1))
    apart = np.linalg.norm(np.ptp(origins, axis=0))
    larger = [100.0, 1000.0] if apart < 0.1 * diagonal else []
    return [1.0, *([1e-3, 1e-2] if away > 10 * diagonal else larger)]


def _seen_by_left_out(scene: mi.Scene, views: Sequence[View], photographs: Photographs) -> float:
    """The share of the pixels that masks leave out, and that see a surface.

    Masks that were drawn from the mesh count as none: they are right for the poses as they are.
    """
    if all(view.mask is None or view.mask_from_mesh for view in views):
        return 0.0
    cameras = [view.camera for view in views]
    count = sum(camera.width * camera.height for camera in cameras)
    numbers = np.random.default_rng(0).integers(0, count, _PIXELS)
    numbers = numbers[~photographs.counts(numbers)]
    return float(_seen(scene, cameras, numbers).mean()) if len(numbers) else 0.0


def _views_of(cameras: Sequence[Camera], numbers: np.ndarray) -> np.ndarray:
    """The view of each pixel, all views' pixels being numbered one after the other."""
    return np.searchsorted(np.cumsum([c.width * c.height for c in cameras]), numbers, "right")


def _seen(scene: mi.Scene, cameras: Sequence[Camera], numbers: np.ndarray) -> np.ndarray:
    """Whether pixels see a surface, (n,) bool."""
    view = _views_of(cameras, numbers)
    first = np.cumsum([0, *(c.width * c.height for c in cameras)])
    origins, directions = np.empty((2, len(numbers), 3))
    for i in np.unique(view):
        here = view == i
        row, column = np.divmod(numbers[here].astype(np.int64) - first[i], cameras[i].width)
        origins[here], directions[here] = cameras[i].rays(column + 0.5, row + 0.5)
    return np.isfinite(free_space.trace(scene, origins, directions).distance)
