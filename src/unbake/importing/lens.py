"""Lenses of other programs, and photographs as a pinhole camera would have taken them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from ..dataset.camera import Camera
from ..errors import UserError

#: Maps points of the plane in front of a camera to pixels: (n, 2) to (n, 2), both x to the right
#: and y down; the plane lies at distance 1, pixels count from the upper left corner.
Projection = Callable[[np.ndarray], np.ndarray]

#: Focal lengths that differ by no more than this, relative, make square pixels.
_SQUARE = 1e-4
#: Points of an edge of the image that must come from inside of the photograph.
_EDGE = 128
#: How far the focal length may change: from the longest to the shortest, relative, in equal steps.
_LONGEST, _SHORTEST, _STEPS = 4.0, 0.25, 1200
#: The widest picture that a pinhole camera takes here, from edge to edge, in degrees: of wider ones
#: nearly all pixels would show what a fisheye lens has in few of them.
WIDEST = 120
#: Rows that are resampled at a time.
_ROWS = 128


@final
@dataclass(frozen=True)
class Lens:
    """What maps directions to pixels of a photograph.

    Args:
        width, height: of the photograph, in pixels.
        fl_x, fl_y: focal lengths in pixels; of a distorted lens those in its middle.
        cx, cy: principal point in pixels from the upper left corner.
        project: of a distorted lens; None: a pinhole.
        scale: of the photograph, relative to the one that the camera was made for.
    """

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    project: Projection | None = None
    scale: float = 1.0

    @property
    def straight(self) -> bool:
        """Whether photographs can stay as they are: a pinhole with square pixels."""
        return self.project is None and abs(self.fl_x / self.fl_y - 1) <= _SQUARE

    def scaled(self, width: int, height: int) -> Lens:
        """The lens of the same photograph with other numbers of pixels, as a whole.

        Sizes are rounded to whole pixels: square ones stay square, which moves no point by more
        than half of that rounding.
        """
        across, down = width / self.width, height / self.height
        scale = self.scale * math.sqrt(across * down)
        project = self.project
        if project is None:
            if self.straight:
                both = math.sqrt(across * down)
                focal = (self.fl_x * both, self.fl_y * both)
            else:
                focal = (self.fl_x * across, self.fl_y * down)
            middle = self.cx * across, self.cy * down
            return Lens(width, height, *focal, *middle, scale=scale)

        def smaller(points: np.ndarray) -> np.ndarray:
            return project(points) * (across, down)

        return Lens(
            width,
            height,
            self.fl_x * across,
            self.fl_y * down,
            self.cx * across,
            self.cy * down,
            smaller,
            scale,
        )

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Where points (n, 2) of the plane at distance 1 are seen, (n, 2); see `Projection`."""
        if self.project is not None:
            return self.project(points)
        return points * (self.fl_x, self.fl_y) + (self.cx, self.cy)

    def camera(self, to_world: np.ndarray) -> Camera:
        """The pinhole camera that photographs belong to after `straightened`.

        It has as many pixels and the same principal point. Its focal length is the shortest with
        which all of its image lies inside the photograph and is no wider than `WIDEST`. No image
        does where the principal point lies outside of the photograph: see `shown`.

        Args:
            to_world: (4, 4), OpenGL axes.

        Raises:
            UserError: the pose or the lens is none, or no such camera sees what the lens does.
        """
        focal = None if self.straight else self._fitted[0]
        fl_x, fl_y = (self.fl_x, self.fl_y) if focal is None else (focal, focal)
        return Camera(to_world, fl_x, fl_y, self.cx, self.cy, self.width, self.height)

    def straightened(self, image: np.ndarray, focal: float) -> np.ndarray:
        """The image (H, W, C) of the pinhole camera with this focal length, sampled bilinearly."""
        straight = np.empty(image.shape, np.float32)
        for rows, at in self._seen(focal):
            straight[rows] = _bilinear(image, at - 0.5).reshape(len(rows), self.width, -1)
        return straight

    def shown(self, focal: float) -> np.ndarray | None:
        """Which pixels of `straightened` show what is within the photograph's edge.

        Returns:
            (H, W) bool; None: all do.
        """
        if not self.beyond:
            return None
        inside = np.empty((self.height, self.width), bool)
        for rows, at in self._seen(focal):
            within = ((at >= 0) & (at <= (self.width, self.height))).all(1)
            inside[rows] = within.reshape(len(rows), self.width)
        return None if inside.all() else inside

    @property
    def beyond(self) -> bool:
        """Whether `camera` sees places beyond the photograph's edge; errors as there."""
        return not self.straight and self._fitted[2]

    @property
    def narrowed(self) -> bool:
        """Whether the photograph is wider than `camera` may be; errors as there."""
        return not self.straight and self._fitted[1]

    def _seen(self, focal: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Some rows of the pinhole camera at a time, (r,), and where the photograph has them.

        Yields:
            The rows, and places in pixels from the photograph's upper left corner, (r * W, 2).
        """
        for top in range(0, self.height, _ROWS):
            rows = np.arange(top, min(top + _ROWS, self.height))
            x, y = np.meshgrid(np.arange(self.width) + 0.5 - self.cx, rows + 0.5 - self.cy)
            yield rows, self.pixels(np.stack([x.ravel(), y.ravel()], 1) / focal)

    @cached_property
    def _fitted(self) -> tuple[float, bool, bool]:
        """The focal length of `camera`, and whether it is `narrowed` and sees `beyond`.

        It comes from long ones, as distortions of high order turn back outside of the photograph.
        """
        w, h = self.width, self.height
        along = np.linspace(0, 1, _EDGE)
        sides = [(along * w, 0 * along + v) for v in (0.0, h)]
        sides += [(0 * along + u, along * h) for u in (0.0, w)]
        edge = np.concatenate([np.stack(side, 1) for side in sides]) - (self.cx, self.cy)
        middle = self.pixels(np.zeros((1, 2)))
        start = max(self.fl_x, self.fl_y)
        focals = start * np.geomspace(_LONGEST, _SHORTEST, _STEPS)
        across = [
            np.arctan((size - centre) / focals) + np.arctan(centre / focals)
            for size, centre in ((w, self.cx), (h, self.cy))
        ]
        allowed = focals[(np.degrees(across) <= WIDEST).all(0)]
        if not len(allowed):
            told = f"its focal length of {start:.3g} pixels is too short for {w} x {h} pixels"
            raise UserError(told, None, "Check the focal length of its camera")
        found, reach = None, np.zeros(len(edge))
        for focal in allowed:
            seen = self.pixels(edge / focal)
            further = np.linalg.norm(seen - middle, axis=1)
            inside = (seen >= -1e-6).all() and (seen <= (w + 1e-6, h + 1e-6)).all()
            if not (inside and (further >= reach).all()):
                break
            found, reach = float(focal), further
        if found is not None:
            return found, len(allowed) < _STEPS and found == allowed[-1], False
        found = float(max(start, allowed[-1]))
        shares = np.linspace(0, 1, _EDGE)[:, None, None]
        seen = self.pixels((shares * edge / found).reshape(-1, 2)).reshape(_EDGE, -1, 2)
        if not (np.diff(np.linalg.norm(seen - middle, axis=2), axis=0) >= 0).all():
            told = "its lens cannot be straightened: it turns back within the photograph"
            raise UserError(told, None, "Undistort it with the program that posed it")
        return found, False, True


def opencv(
    focal: tuple[float, float], centre: tuple[float, float], radial: np.ndarray, *tangential: float
) -> Projection:
    """OpenCV's lens with k1, k2, k3 (`radial`) and p1, p2 (`tangential`).

    Args:
        focal: fx, fy in pixels.
        centre: cx, cy in pixels.
    """
    p1, p2 = tangential

    def project(points: np.ndarray) -> np.ndarray:
        x, y = points.T
        r2 = x * x + y * y
        scale = 1 + r2 * (radial[0] + r2 * (radial[1] + r2 * radial[2]))
        u = x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * scale + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
        return np.stack([u, v], 1) * focal + centre

    return project


def fisheye(
    focal: tuple[float, float], centre: tuple[float, float], radial: np.ndarray
) -> Projection:
    """OpenCV's fisheye lens with k1, k2, k3, k4 (`radial`); arguments as in `opencv`."""

    def project(points: np.ndarray) -> np.ndarray:
        r = np.linalg.norm(points, axis=1, keepdims=True)
        angle = np.arctan(r)
        t = angle * angle
        bent = angle * (1 + t * (radial[0] + t * (radial[1] + t * (radial[2] + t * radial[3]))))
        return points * np.where(r > 0, bent / np.where(r > 0, r, 1), 1) * focal + centre

    return project


def _bilinear(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Values (n, C) of an image (H, W, C) at (n, 2), pixel centres at whole numbers."""
    height, width = image.shape[:2]
    x = np.clip(at[:, 0], 0, width - 1)
    y = np.clip(at[:, 1], 0, height - 1)
    left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
    left, top = np.maximum(left, 0), np.maximum(top, 0)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = (x - left)[:, None].astype(np.float32), (y - top)[:, None].astype(np.float32)
    above = image[top, left] * (1 - u) + image[top, right] * u
    below = image[bottom, left] * (1 - u) + image[bottom, right] * u
    return above * (1 - v) + below * v
