"""Where views stood that nothing was learned from: told by their photographs alone (ours)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

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
    """The correction in pixels, (6,), whose renderings are most like the photograph."""
    move = np.zeros(POSE)
    for _ in range(_ROUNDS if pixels.count else 0):
        error, slopes, points, variance = pixels.errors(moved(move))
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
        move = move + step
        if np.abs(step).max() < _STILL:
            break
    return move


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

    def errors(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """Errors of the rendering from a place, weighed.

        Returns:
            Errors (n, 3), slopes of the photograph with the same weights (n, 3, 2), points that the
            pixels see (n, 3), and the variance of the errors.
        """
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
        variance = float((error[known] ** 2).mean()) if known.any() else 1.0
        size = (error**2).mean(1) / max(_LARGE**2 * variance, 1e-24)
        weight = np.where(known, 1 / np.sqrt(1 + size), 0)[:, None]
        return weight * error, (weight * self._weight)[..., None] * self._slopes, points, variance
