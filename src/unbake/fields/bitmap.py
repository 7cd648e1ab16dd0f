"""Bitmaps in the texture coordinates of each material: what artists and game engines use."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from .domain import SurfacePoint
from .network import Engine, sigmoid


class Bitmaps:
    """A square bitmap for each of several materials, bilinear and repeated.

    Texels hold logits and are bounded before they are interpolated, so that Mitsuba's `bitmap` with
    the values of `to_arrays` is the same function. They start at 0.5.

    Args:
        size: texels along an edge.
        names: of the materials, in the order of `SurfacePoint.slot`.
        channels: 3 or 1.

    Raises:
        UserError: the texels are more than an array can hold.

    Paper: Sec. 8.
    """

    def __init__(self, size: int, names: list[str], *, channels: int) -> None:
        self.size = size
        self.names = names
        self.channels = channels
        count = len(names) * size * size * channels
        if count >= 1 << 32:
            raise UserError(
                f"{len(names)} bitmaps of {size} x {size} pixels are too many for an array",
                remedy="Lower the resolution in the table [bitmap] of the settings",
            )
        self.texels = dr.zeros(mi.Float, count)
        dr.make_opaque(self.texels)

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable array by name; `assign` takes it back."""
        return {"texels": self.texels}

    def assign(self, parameters: dict[str, mi.Float]) -> None:
        """Use this array from now on; gradients arrive in the very array given."""
        self.texels = parameters["texels"]

    def __call__(self, point: SurfacePoint, engine: Engine | None = None) -> list[mi.Float]:
        """Look the bitmaps up; the engine makes no difference.

        Returns:
            One array for each channel, [0,1].
        """
        # As in Mitsuba, texels are centred at (i + 1/2) / size and v grows with the row.
        left, right, u = self._neighbours(point.uv.x)
        above, below, v = self._neighbours(point.uv.y)
        return [
            dr.lerp(dr.lerp(a, b, u), dr.lerp(c, d, u), v)
            for a, b, c, d in zip(
                self._texel(point.slot, above, left),
                self._texel(point.slot, above, right),
                self._texel(point.slot, below, left),
                self._texel(point.slot, below, right),
                strict=True,
            )
        ]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The bitmaps by the names of their materials, float32, shape (size, size, channels)."""
        shape = (len(self.names), self.size, self.size, self.channels)
        values = np.array(sigmoid(dr.detach(self.texels))).reshape(shape)
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

    def _texel(self, slot: mi.UInt32, row: mi.UInt32, column: mi.UInt32) -> list[mi.Float]:
        texel = (slot * self.size + row) * self.size + column
        return [
            sigmoid(dr.gather(mi.Float, self.texels, texel * self.channels + c))
            for c in range(self.channels)
        ]
