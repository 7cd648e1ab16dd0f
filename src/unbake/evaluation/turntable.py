"""Cameras on a circle around what the training cameras look at, or turning on the spot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera, up_of
from ..errors import UserError
from ..scene import free_space

#: Radii that are tried, as shares of the training cameras' distance.
_SHRUNK = (1.0, 0.85, 0.7, 0.55, 0.4)
#: Points of a circle that are tried, at least.
_TRIED = 48
#: View axes are taken as parallel where the smallest eigenvalue of their mean projector is less.
_PARALLEL = 1e-3
_REMEDY = "Give a camera file with --cameras"


@dataclass(frozen=True, eq=False)
class Turntable:
    """Cameras one after another, counterclockwise as seen from above."""

    cameras: list[Camera]
    kind: Literal["circle", "pan"]
    centre: np.ndarray  #: (3,) of the circle and what it looks at; of a pan: where it stands
    radius: float  #: world units; 0 of a pan
    up: np.ndarray  #: (3,) unit vector

    def told(self) -> str:
        """One line for people."""
        x, y, z = self.centre
        if self.kind == "pan":
            return (
                f"turntable: turning on the spot at ({x:.3g}, {y:.3g}, {z:.3g}), for lack of room"
            )
        return f"turntable: a circle of radius {self.radius:.3g} around ({x:.3g}, {y:.3g}, {z:.3g})"


def turntable(
    scene: mi.Scene, cameras: Sequence[Camera], count: int, width: int, height: int, room: bool
) -> Turntable:
    """Cameras on a circle around what other cameras look at.

    The circle lies as far and as high as those stand in the median, and shrinks until all of it is
    free, and connected with one of them by a free line. Where no circle is, rooms get cameras that
    turn on the spot where the one nearest to the mean of all stands.

    Args:
        scene: that they stand in.
        cameras: of the training views; the first one tells the field of view and where to begin.
        count: of cameras on the circle.
        width, height: of their images, in pixels.
        room: whether the scene encloses its cameras.

    Raises:
        UserError: an object has no free circle around it.
    """
    up = up_of(cameras)
    fov = 2 * math.degrees(math.atan(0.5 * cameras[0].width / cameras[0].fl_x))
    eyes = np.array([camera.origin for camera in cameras])
    centre = _looked_at(scene, cameras)
    start = cameras[0].origin - centre
    side = _perpendicular(start, up, -_forward(cameras[0]))
    front = np.cross(up, side)
    away = eyes - centre
    rise = float(np.median(away @ up))
    radius = float(np.median(np.linalg.norm(away - np.outer(away @ up, up), axis=1)))

    def circle(radius: float, rise: float, number: int) -> np.ndarray:
        angle = 2 * math.pi * np.arange(number)[:, None] / number
        around = np.cos(angle) * side + np.sin(angle) * front
        return centre + rise * up + radius * around

    for share in _SHRUNK:
        tried = circle(share * radius, share * rise, max(count, _TRIED))
        if radius > 0 and _is_free(scene, tried, eyes):
            places = circle(share * radius, share * rise, count)
            made = [Camera.look_at(eye, centre, up, fov, width, height) for eye in places]
            return Turntable(made, "circle", centre, share * radius, up)
    if not room:
        raise UserError("no circle around the scene is free for a turntable", None, _REMEDY)
    nearest = cameras[int(np.argmin(np.linalg.norm(eyes - eyes.mean(0), axis=1)))]
    eye, first = nearest.origin, _perpendicular(_forward(nearest), up, side)
    second = np.cross(up, first)
    angles = 2 * math.pi * np.arange(count) / count
    made = [
        Camera.look_at(
            eye, eye + math.cos(a) * first + math.sin(a) * second, up, fov, width, height
        )
        for a in angles
    ]
    return Turntable(made, "pan", eye, 0.0, up)


def _looked_at(scene: mi.Scene, cameras: Sequence[Camera]) -> np.ndarray:
    """The point nearest to all view axes, (3,), inside the scene's bounding box."""
    eyes = np.array([camera.origin for camera in cameras])
    ahead = np.array([_forward(camera) for camera in cameras])
    low, high, diagonal = free_space.bounds(scene)
    projectors = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]
    total = projectors.mean(0)
    if np.linalg.eigvalsh(total)[0] > _PARALLEL:
        point = np.linalg.solve(total, np.einsum("nij,nj->i", projectors, eyes) / len(eyes))
    else:
        depth = free_space.trace(scene, eyes, ahead).distance
        depth = np.median(np.where(np.isfinite(depth), depth, 0.5 * diagonal))
        point = eyes.mean(0) + depth * ahead.mean(0)
    return np.clip(point, low, high)


def _is_free(scene: mi.Scene, circle: np.ndarray, eyes: np.ndarray) -> bool:
    """Whether a camera can go around a circle (n, 3), to which one of the eyes (m, 3) sees."""
    directions = free_space.sphere_directions(64)
    origins = np.repeat(circle, len(directions), axis=0)
    near = free_space.trace(scene, origins, np.tile(directions, (len(circle), 1))).distance
    if near.min() < free_space.CLEARANCE * free_space.extent(scene)[2]:
        return False
    if not free_space.unoccluded(scene, circle, np.roll(circle, -1, axis=0)).all():
        return False
    starts = np.repeat(eyes, len(circle), axis=0)
    return bool(free_space.unoccluded(scene, starts, np.tile(circle, (len(eyes), 1))).any())


def _forward(camera: Camera) -> np.ndarray:
    return -camera.to_world[:3, 2]


def _perpendicular(vector: np.ndarray, up: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The unit vector along the part of a vector that is perpendicular to `up`.

    Args:
        other: stands for the vector where that is parallel to `up`.
    """
    for one in (vector, other):
        level = one - (one @ up) * up
        if np.linalg.norm(level) > 1e-3 * np.linalg.norm(one):
            return level / np.linalg.norm(level)
    across = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    return across / np.linalg.norm(across)
