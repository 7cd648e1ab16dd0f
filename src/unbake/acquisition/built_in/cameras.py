"""Camera placement shared by the built-in scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict

import numpy as np

Vec3 = Sequence[float] | np.ndarray
UP = (0.0, 0.0, 1.0)


class Camera(TypedDict):
    """A pinhole camera: points in world units, horizontal field of view in degrees."""

    origin: list[float]
    target: list[float]
    up: list[float]
    fov: float
    split: str


def camera(origin: Vec3, target: Vec3, fov: float, split: str = "train") -> Camera:
    """A camera with z up; the view direction must not be vertical."""
    return {
        "origin": [float(v) for v in origin],
        "target": [float(v) for v in target],
        "up": list(UP),
        "fov": float(fov),
        "split": split,
    }


def halton(index: int, base: int) -> float:
    """The `index`-th (from 1) number of the van der Corput sequence in `base`, in (0, 1)."""
    value, weight = 0.0, 1.0
    while index:
        weight /= base
        value += weight * (index % base)
        index //= base
    return value


def scattered(index: int, free: tuple[Vec3, Vec3], room: tuple[Vec3, Vec3]) -> tuple[list, list]:
    """The `index`-th (from 1) low-discrepancy (origin, target): in the box `free`, on `room`."""
    u = np.array([halton(index, b) for b in (2, 3, 5)])
    origin = np.asarray(free[0]) + u * (np.asarray(free[1]) - np.asarray(free[0]))
    angle = 2 * np.pi * halton(index, 7)
    low, high = np.asarray(room[0]), np.asarray(room[1])
    reach = 0.5 * (high - low)[:2]
    heading = np.array([np.cos(angle), np.sin(angle)])
    flat = 0.5 * (low + high)[:2] + heading * np.min(reach / np.maximum(np.abs(heading), 1e-9))
    height = low[2] + halton(index, 11) * (high - low)[2]
    return list(origin), [*flat, height]
