"""Coordinates of fields: the unit cube, and points on surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from .pieces import Piece


@dataclass
class SurfacePoint:
    """Where a field is evaluated, in all coordinates that a representation may use."""

    position: mi.Point3f  # [0,1]³
    uv: mi.Point2f | None = None  # texture coordinates: without bounds, maybe not finite
    material: mi.UInt32 | None = None  # its number, where each material has a field of its own
    piece: Piece | None = None  # of surface, where fields ask for it
    albedo: mi.Color3f | None = None  # as it is fitted now, linear RGB; None where it is known


@dataclass(frozen=True)
class Domain:
    """Maps world positions into [0,1]³ by one uniform scale about the centre of the scene's box.

    A per-axis scale would stretch the grid's cells in long, thin rooms.
    """

    centre: tuple[float, float, float]
    extent: float  #: side of the cube, in world units

    @staticmethod
    def unit() -> Domain:
        """The unit cube itself."""
        return Domain((0.5, 0.5, 0.5), 1.0)

    @staticmethod
    def of(box: mi.BoundingBox3f) -> Domain:
        """The domain of a scene's bounding box, with a margin of one percent."""
        lower, upper = np.ravel(box.min).tolist(), np.ravel(box.max).tolist()
        centre = tuple((a + b) / 2 for a, b in zip(lower, upper, strict=True))
        return Domain(centre, 1.01 * max(b - a for a, b in zip(lower, upper, strict=True)))

    def told(self) -> str:
        """Its extent and its centre in a few words."""
        x, y, z = self.centre
        return f"{self.extent:.4g} around ({x:.3g}, {y:.3g}, {z:.3g})"

    def to_unit(self, p: mi.Point3f, valid: mi.Bool) -> mi.Point3f:
        """World positions to [0,1]³; lanes that are not valid get the centre.

        The position of a ray that hit nothing is infinite: its gradient would fill the grid with
        NaN.
        """
        unit = (mi.Point3f(p) - mi.Point3f(*self.centre)) / self.extent + 0.5
        return bounded(dr.select(valid, unit, 0.5), 0, 1)


def bounded(x: mi.Float | mi.Point3f | mi.Point2f, lower: float, upper: float):
    """The nearest number in [lower, upper]; `lower` for what is not a number.

    Dr.Jit 1.5's `clip`, `minimum` and `maximum` pass NaN on. As an index it would lie far outside
    of any table.
    """
    return dr.fmin(dr.fmax(x, lower), upper)
