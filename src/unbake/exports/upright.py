"""Which way is up by the cameras, and the turn that makes it an axis of a format."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..dataset.camera import Camera, rotation_of, up_of

#: Degrees between up by the cameras and an axis of the scene that is taken as up all the same.
_LEVEL = 10.0


@dataclass(frozen=True, eq=False)
class Up:
    """What is up by the cameras."""

    direction: np.ndarray  #: (3,), a unit vector: an axis of the scene where one is near
    axis: str  #: the nearest axis of the scene, such as "+z"
    tilt: float  #: degrees between that and up by the cameras; 0 where it is taken as up

    @staticmethod
    def of(cameras: Sequence[Camera]) -> Up:
        """Up by the cameras."""
        up = up_of(cameras)
        number = int(np.abs(up).argmax())
        nearest = np.sign(up[number]) * np.eye(3)[number]
        axis = f"{'−' if up[number] < 0 else '+'}{'xyz'[number]}"
        tilt = math.degrees(math.acos(min(abs(float(up[number])), 1.0)))
        return Up(up, axis, tilt) if tilt > _LEVEL else Up(nearest, axis, 0.0)

    @property
    def of_usd(self) -> str:
        """The axis that a stage of OpenUSD has as up: "Y" or "Z", whichever is nearer."""
        return "Z" if abs(self.direction[2]) > abs(self.direction[1]) else "Y"

    def quaternion(self, axis: str) -> np.ndarray:
        """The shortest turn from up to "Y" or "Z", (4,) as x, y, z, w; (0, 0, 0, 1): none."""
        target = np.eye(3)["XYZ".index(axis)]
        half = np.array([*np.cross(self.direction, target), 1 + self.direction @ target])
        if not half.any():  # the opposite: half a turn about x
            half = np.array([1.0, 0.0, 0.0, 0.0])
        return half / np.linalg.norm(half)

    def rotation(self, axis: str) -> np.ndarray:
        """The same turn as a matrix (3, 3)."""
        return rotation_of(self.quaternion(axis))

    def is_turned(self, axis: str) -> bool:
        """Whether up is another direction."""
        return bool(self.quaternion(axis)[3] < 1)

    def told(self) -> str:
        """Up in words."""
        return f"{self.tilt:.0f}° from {self.axis}" if self.tilt else self.axis
