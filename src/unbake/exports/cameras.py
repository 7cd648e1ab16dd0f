"""The views of a data set as cameras of glTF and OpenUSD."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..dataset.camera import Camera
from .parts import Part

#: Views that become cameras; of more, as many are chosen evenly.
MOST = 1000
#: Where cameras see, over the extent of parts and cameras: more may be put around them.
_NEAR, _FAR = 1e-3, 100.0
#: Pixels by which a principal point is off the middle and told to be.
_OFF = 0.5


@dataclass(frozen=True)
class Shot:
    """Cameras by the names of their views, and where they see."""

    cameras: Mapping[str, Camera]
    near: float  #: world units
    far: float  #: world units

    @staticmethod
    def of(cameras: Mapping[str, Camera], parts: Sequence[Part]) -> Shot:
        """These cameras of these parts; evenly chosen ones where they are many."""
        names = [*cameras]
        places = np.linspace(0, len(names) - 1, min(len(names), MOST)).round().astype(int)
        chosen = {names[i]: cameras[names[i]] for i in places.tolist()}
        ends = [camera.origin for camera in chosen.values()]
        for positions in (part.triangles.positions for part in parts):
            ends += [positions.min(0), positions.max(0)]
        extent = float(np.linalg.norm(np.ptp(ends, axis=0))) if ends else 0.0
        extent = extent if extent > 0 else 1.0
        return Shot(chosen, _NEAR * extent, _FAR * extent)

    def off_centre(self) -> float:
        """Pixels from the middle of an image to its principal point, at most; 0 if it is few."""
        off = [(c.cx - c.width / 2, c.cy - c.height / 2) for c in self.cameras.values()]
        most = float(np.abs(off).max(initial=0))
        return most if most > _OFF else 0.0


#: No cameras.
NO_SHOT = Shot({}, 1.0, 2.0)
