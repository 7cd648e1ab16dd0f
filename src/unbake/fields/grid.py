"""A dense grid: the plain way to represent a function in space (Fig. 5)."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import drjit.nn as nn
import mitsuba as mi

from .arrays import differences, first_value, sigmoid
from .domain import SurfacePoint
from .field import Cost, Engine, Field, FieldSpec
from .settings import DenseGridConfig, features_of

#: The largest number below 1 in single precision.
_LAST = 1 - 2.0**-24


class DenseGrid(Field):
    """A vector-valued function of a position in [0,1]³, trilinear between the corners of cells.

    It depends on the position alone, not on further inputs. Where it is bounded, that happens after
    the interpolation.

    Paper: Sec. 6.2, Fig. 5.
    """

    def __init__(self, settings: DenseGridConfig, spec: FieldSpec) -> None:
        self.outputs = spec.outputs
        self.bounded = spec.bounded
        self._least_slope = spec.least_slope
        self._corners = corners = settings.cells + 1
        features = features_of(spec.outputs)
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
        self.grid.data = dr.full(mi.Float, first_value(spec), self.grid.n_params)
        dr.make_opaque(self.grid.data)

    def parameters(self) -> dict[str, mi.Float]:
        """Its one name is `corners`."""
        return {"corners": self.grid.data}

    def assign(self, parameters: dict[str, mi.Float]) -> None:
        """Use these arrays from now on."""
        self.grid.data = parameters["corners"]

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Look the grid up; the caller masks points outside of [0,1]³ or not finite."""
        # At 1 the corners beyond the last weigh nothing, but are read: from outside of the array.
        inside = [dr.minimum(x, _LAST) for x in point.position]
        outputs = list(self.grid(inside))[: self.outputs]
        return [sigmoid(x, self._least_slope) for x in outputs] if self.bounded else outputs

    def differences(self) -> list[mi.Float]:
        """Values of outputs at corners less those of the neighbours before them, by axis."""
        corners, features = self._corners, self.grid.n_output_features
        values, found = mi.Float(self.grid.data), []
        for axis in range(3):
            apart = corners**axis
            here = dr.arange(mi.UInt32, corners * corners * (corners - 1))
            here += here // (apart * (corners - 1)) * apart  # all but the last ones of the axis
            found += [
                differences(values, here * features + output, apart * features)
                for output in range(self.outputs)
            ]
        return found

    def cost(self) -> Cost:
        """Eight corners."""
        return Cost(0, 4 * 8 * self.grid.n_output_features)
