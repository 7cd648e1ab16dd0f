"""Where views stood that nothing was learned from: told by their photographs alone (ours)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..dataset.small_views import seen_along, seen_by, small_camera
from ..dataset.views import View, read_photograph
from ..fields.arrays import from_numpy
from ..training.cameras import Cameras
from ..training.poses import POSE, refined_view
from ..training.recovered import Recovered
from ..transport.render import render_radiance
from .settings import EvaluationSettings

#: Pixels that are compared, at most, samples of all and of each, at most, and rounds, at most.
_PIXELS, _SAMPLES, _OF_EACH, _ROUNDS = 4096, 1 << 16, 64, 12
#: A round that moves no number of a pose by more pixels is the last one.
_STILL = 0.01
#: Of a correction in pixels, to differentiate by.
_STEP = 1e-2
#: By how much the sum of errors may rise from one round to another by noise alone, as a share.
_NOISE = 0.02
#: Errors weigh less from this multiple of their root mean square on.
_LARGE = 3.0
#: Added to the squared photograph, as a share of its mean square, that errors are relative to.
_DARK = 0.01


def placed_view(
    recovered: Recovered, cameras: Cameras, view: View, settings: EvaluationSettings
) -> View:
    """A view with the camera that a fit found for it; as it is where nothing was unknown.

    Those of training views were fitted. Any other view is moved until the recovered scene looks
    like its photograph: by Gauss and Newton's method, on the slopes of the photograph. It is then
    compared at the place that suits it best, as photographs are after their own exposure.

    Args:
        cameras: exposures of the same run.
        settings: how the scene is rendered.
    """
    model, train = recovered.problem.poses, recovered.dataset.train
    view = refined_view(model, train, view)
    if model is None or not model.has_poses or view.name in {other.name for other in train}:
        return view
    pixels = _Pixels(recovered, cameras, view, settings)
    turn, shift = model.units_of(recovered.problem.scene_view.scene, view.camera)

    def moved(move: np.ndarray) -> Camera:
        return view.camera.moved(turn * move[:3], shift * move[3:])

    sigma = recovered.config.camera.pose_sigma
    return replace(view, camera=moved(_solved(moved, pixels, sigma)))


def told_of_place(scene: mi.Scene, given: Camera, found: Camera) -> dict[str, float]:
    """How far a camera was moved: numbers of `metrics.json`.

    Args:
        scene: that it looks at.
        given: as the data set tells.
        found: as it was refined.
    """
    (seen,) = seen_by(scene, [small_camera(found)])
    turn = found.to_world[:3, :3].T @ given.to_world[:3, :3]
    # Of a small angle the sine is exact, and the cosine is not.
    sine = 0.5 * np.linalg.norm((turn - turn.T)[[0, 0, 1], [1, 2, 2]])
    return {
        "pixels": found.pixels_from(given, seen.position[np.isfinite(seen.distance)]),
        "degrees": math.degrees(math.atan2(float(sine), 0.5 * float(np.trace(turn) - 1))),
        "shift": float(np.linalg.norm(found.origin - given.origin)),
    }


def _solved(moved: Callable[[np.ndarray], Camera], pixels: _Pixels, sigma: float) -> np.ndarray:
    """The correction in pixels, (6,), whose renderings are most like the photograph.

    Steps end where one makes it worse by more than noise can, and that one is taken back: slopes
    tell little of a place that is far off. What is not better than the given place is none.
    """
    move = found_at = np.zeros(POSE)
    costs: list[float] = []
    spread = 0.0
    for _ in range(_ROUNDS if pixels.count else 0):
        found = pixels.errors(moved(move))
        # All rounds are measured by the spread of the first one.
        spread = spread or found.variance
        cost = found.cost(spread) + spread / sigma**2 * float(move @ move)
        if costs and not cost <= (1 + _NOISE) * min(costs):
            break
        costs.append(cost)
        found_at = move
        error, slopes, points, variance = found.weighed()
        here = moved(move).project(points)
        columns = [
            (moved(move + unit).project(points) - here) / _STEP for unit in _STEP * np.eye(POSE)
        ]
        # What a pixel of the photograph shows changes by its slope times how far the point moves.
        # Points that a step would bring behind the camera tell nothing.
        known = np.nan_to_num(np.stack(columns))
        jacobian = np.einsum("nca,kna->nck", slopes, known).reshape(-1, POSE)
        matrix = jacobian.T @ jacobian + variance / sigma**2 * np.eye(POSE)
        right = jacobian.T @ error.ravel() - variance / sigma**2 * move
        step = np.linalg.solve(matrix, right)
        if np.abs(step).max() < _STILL:
            break
        move = move + step
    return found_at if len(costs) > 1 and costs[-1] < costs[0] else np.zeros(POSE)


@dataclass(frozen=True, eq=False)
class _Errors:
    """Errors of the rendering from a place.

    Args:
        values: of channels, shape (n, 3); not all are finite.
        slopes: of the photograph, of the same scale, shape (n, 3, 2).
        points: that the pixels see, shape (n, 3).
        known: whether there is such a point, and the error is finite, shape (n,).
    """

    values: np.ndarray
    slopes: np.ndarray
    points: np.ndarray
    known: np.ndarray

    @property
    def variance(self) -> float:
        """Of those that are known; 1 where none is."""
        return float((self.values[self.known] ** 2).mean()) if self.known.any() else 1.0

    def cost(self, variance: float) -> float:
        """Their sum, in which large ones count little (Cauchy); infinite where none is finite.

        Args:
            variance: of errors that are usual.
        """
        finite = np.isfinite(self.values).all(1)
        if not finite.any():
            return math.inf
        size = np.log1p(_sizes(self.values[finite], variance)).mean()
        return float(self.values.size * _LARGE**2 * variance * size)

    def weighed(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Errors and slopes with the weights of errors of that size, points and the variance.

        What is not known has no weight.
        """
        values = np.where(self.known[:, None], self.values, 0)
        weight = np.where(self.known, 1 / np.sqrt(1 + _sizes(values, self.variance)), 0)[:, None]
        return weight * values, weight[..., None] * self.slopes, self.points, self.variance


def _sizes(errors: np.ndarray, variance: float) -> np.ndarray:
    """Squares of errors (n, 3) over that of a large one, (n,)."""
    return (errors**2).mean(1) / max(_LARGE**2 * variance, 1e-24)


class _Pixels:
    """Pixels of a photograph that are compared with renderings from other places."""

    def __init__(
        self, recovered: Recovered, cameras: Cameras, view: View, settings: EvaluationSettings
    ) -> None:
        self._problem, self._cameras, self._view = recovered.problem, cameras, view
        self._settings = settings
        photograph = read_photograph(view, settings.clip_negative or recovered.clip_negative)
        height, width = photograph.shape[:2]
        counted = photograph[..., 3] > 0
        # Pixels at the edge have no slopes, and neither have those beside pixels without a meaning
        inner = np.zeros_like(counted)
        inner[1:-1, 1:-1] = (
            counted[1:-1, :-2] & counted[1:-1, 2:] & counted[:-2, 1:-1] & counted[2:, 1:-1]
        )
        numbers = np.flatnonzero(inner & counted)
        rng = np.random.default_rng(0)
        self._numbers = np.sort(rng.permutation(numbers)[:_PIXELS])
        rgb = photograph[..., :3].astype(np.float64)
        down, across = np.gradient(rgb, axis=(0, 1)) if min(height, width) > 1 else (rgb, rgb)
        self._rgb = rgb.reshape(-1, 3)[self._numbers]
        slopes = np.stack([across, down], -1).reshape(-1, 3, 2)[self._numbers]
        scale = self._rgb**2 + (slopes**2).sum(-1)
        self._weight = 1 / np.sqrt(scale + _DARK * max(float((rgb**2).mean()), 1e-12))
        self._slopes = slopes

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._numbers)

    def errors(self, camera: Camera) -> _Errors:
        """Errors of the rendering from a place, relative to the photograph."""
        rays, settings, view = CameraRays.of([camera]), self._settings, self._view
        table = from_numpy(mi.UInt32, self._numbers)
        radiance = render_radiance(
            self._problem.scene_view,
            lambda pixel, offset: rays.through(dr.gather(mi.UInt32, table, pixel), offset),
            self.count,
            min(_SAMPLES // self.count, _OF_EACH),
            seed=1,
            max_depth=settings.max_depth,
            rr_depth=settings.rr_depth,
            hide_emitters=self._problem.hide_emitters,
        )
        dimmed = self._cameras.dimmed(view, radiance, self._numbers)
        gain = self._cameras.gain(view, dimmed, self._rgb)
        shown = self._cameras.photographed(view, dimmed, gain)
        error = (shown - view.readable(self._rgb)) * self._weight
        y, x = np.divmod(self._numbers, camera.width)
        origins, directions = camera.rays(x + 0.5, y + 0.5)
        seen = seen_along(self._problem.scene_view.scene, origins, directions)
        known = np.isfinite(seen.distance)
        points = origins + directions * np.where(known, seen.distance, 1)[:, None]
        known &= np.isfinite(error).all(1)
        return _Errors(error, self._weight[..., None] * self._slopes, points, known)
