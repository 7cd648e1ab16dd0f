"""Bitmaps in the texture coordinates of each material: what artists and game engines use."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from .arrays import first_value, sigmoid
from .domain import SurfacePoint
from .field import Cost, Engine, Field, FieldSpec
from .settings import BitmapConfig


class Bitmaps(Field):
    """A square bitmap for each of several materials, bilinear and repeated.

    Texels of bounded bitmaps hold logits and are bounded before they are interpolated, so that
    Mitsuba's `bitmap` with the values of `to_arrays` is the same function. They depend on texture
    coordinates alone, not on further inputs.

    Raises:
        UserError: the texels are more than an array can hold.

    Paper: Sec. 8.
    """

    def __init__(self, settings: BitmapConfig, spec: FieldSpec) -> None:
        self.size = size = settings.resolution
        self.names = spec.materials
        self.channels = spec.outputs
        self.bounded = spec.bounded
        self._least_slope = spec.least_slope
        count = len(self.names) * size * size * self.channels
        if count >= 1 << 32:
            raise UserError(
                f"{len(self.names)} bitmaps of {size} x {size} pixels are too many for an array",
                remedy="Lower the resolution in the tables [materials.*.bitmap] of the settings",
            )
        self.texels = dr.full(mi.Float, first_value(spec), count)
        dr.make_opaque(self.texels)

    def parameters(self) -> dict[str, mi.Float]:
        """Its one name is `texels`."""
        return {"texels": self.texels}

    def assign(self, parameters: dict[str, mi.Float]) -> None:
        """Use these arrays from now on."""
        self.texels = parameters["texels"]

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Look the bitmaps up."""
        if point.uv is None:
            raise ValueError("bitmaps need texture coordinates")
        # As in Mitsuba, texels are centred at (i + 1/2) / size and v grows with the row.
        left, right, u = self._neighbours(point.uv.x)
        above, below, v = self._neighbours(point.uv.y)
        return [
            dr.lerp(dr.lerp(a, b, u), dr.lerp(c, d, u), v)
            for a, b, c, d in zip(
                self._texel(point.material, above, left),
                self._texel(point.material, above, right),
                self._texel(point.material, below, left),
                self._texel(point.material, below, right),
                strict=True,
            )
        ]

    def cost(self) -> Cost:
        """Four texels."""
        return Cost(0, 4 * 4 * self.channels)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The bitmaps by the names of their materials, float32, shape (size, size, channels)."""
        shape = (len(self.names), self.size, self.size, self.channels)
        values = np.array(self._bound(dr.detach(self.texels))).reshape(shape)
        return dict(zip(self.names, values, strict=True))

    def _neighbours(self, x: mi.Float) -> tuple[mi.UInt32, mi.UInt32, mi.Float]:
        """The two texels next to a coordinate, repeated, and the weight of the second."""
        x = dr.select(dr.isfinite(x), x, 0)
        position = (x - dr.floor(x)) * self.size - 0.5
        first = dr.floor(position)
        before = mi.Int32(first)
        after = before + 1
        before = dr.select(before < 0, self.size - 1, before)
        after = dr.select(after >= self.size, 0, after)
        return mi.UInt32(before), mi.UInt32(after), position - first

    def _texel(self, material: mi.UInt32, row: mi.UInt32, column: mi.UInt32) -> list[mi.Float]:
        texel = (material * self.size + row) * self.size + column
        return [
            self._bound(dr.gather(mi.Float, self.texels, texel * self.channels + c))
            for c in range(self.channels)
        ]

    def _bound(self, x: mi.Float) -> mi.Float:
        return sigmoid(x, self._least_slope) if self.bounded else x
