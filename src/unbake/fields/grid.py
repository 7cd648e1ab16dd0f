"""A dense grid: the plain way to represent a function in space (Fig. 5)."""

from __future__ import annotations

import drjit as dr
import drjit.nn as nn
import mitsuba as mi

from .network import Engine


class DenseGrid:
    """A vector-valued function of a position in [0,1]³, trilinear between the corners of cells.

    It is called as a `Network` is, and starts at zero as well.

    Args:
        cells: cells along an axis.
        outputs: number of outputs.

    Paper: Sec. 6.2, Fig. 5.
    """

    def __init__(self, cells: int, *, outputs: int) -> None:
        self.outputs = outputs
        corners = cells + 1
        features = max(2, 1 << (outputs - 1).bit_length())
        # A hash grid of one level whose table has room for every corner hashes nothing.
        self.grid = nn.HashGridEncoding(
            mi.Float,
            3,
            n_levels=1,
            n_features_per_level=features,
            hashmap_size=features * corners**3,
            base_resolution=corners,
            align_corners=True,
        )
        self.grid.data = dr.zeros(mi.Float, self.grid.n_params)
        dr.make_opaque(self.grid.data)

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable array by name; `assign` takes it back."""
        return {"corners": self.grid.data}

    def assign(self, parameters: dict[str, mi.Float]) -> None:
        """Use this array from now on; gradients arrive in the very array given."""
        self.grid.data = parameters["corners"]

    def __call__(
        self, position: mi.Point3f, extra: list[mi.Float], engine: Engine | None = None
    ) -> list[mi.Float]:
        """Evaluate the grid.

        Args:
            position: points in [0,1]³; the caller masks points that lie outside or are not finite.
            extra: not used: a grid depends on the position alone.
            engine: not used: a grid is the same on both.

        Returns:
            One array for each output.
        """
        return list(self.grid(list(position)))[: self.outputs]
