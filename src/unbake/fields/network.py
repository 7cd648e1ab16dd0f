"""A hash grid with a perceptron on top: the representation of the paper (Sec. 5.3)."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from .arrays import first_value, from_numpy, sigmoid
from .domain import SurfacePoint
from .field import Cost, Engine, Field, FieldSpec, PlaceNumbers
from .grid_sizes import USUAL, sized_grid
from .perceptron import Perceptron, can_record_layout
from .piece_values import PieceValues
from .pieces import Piece
from .settings import NetworkConfig


class Network(Field):
    """A vector-valued function of a position in [0,1]³ and of further inputs.

    What the points of a piece of surface share is added, where the settings say so (ours).

    Paper: Sec. 5.3.
    """

    def __init__(self, settings: NetworkConfig, spec: FieldSpec) -> None:
        rng = np.random.default_rng(spec.seed)
        g = sized_grid(settings.grid, USUAL)
        self.grid = nn.HashGridEncoding(
            mi.Float,
            3,
            n_levels=g.levels,
            n_features_per_level=g.features,
            hashmap_size=2**g.table_log2,
            base_resolution=g.base_resolution,
            per_level_scale=g.growth,
        )
        self.grid.data = from_numpy(mi.Float, rng.uniform(-1e-4, 1e-4, self.grid.n_params))
        inputs = self.grid.n_output_features + spec.extra
        # Values of pieces are added to the outputs before these are bounded.
        pieces = settings.pieces
        self.pieces = PieceValues(pieces, spec.outputs) if pieces.most else None
        self.most_pieces = pieces.most
        self.place_cells = self.pieces.place_cells if self.pieces is not None else ()
        self._pace, self._learned = pieces.network, pieces.learned
        self._bounded = spec.bounded and self.pieces is not None
        self._least_slope = spec.least_slope
        self._first = first_value(spec) if self._bounded else 0.0
        of_layers = replace(spec, bounded=False) if self._bounded else spec
        self.perceptron = Perceptron(
            inputs, settings.width, settings.hidden, of_layers, rng, leak=settings.leak
        )
        self.prepare_recordable = can_record_layout()

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """Names: `grid`, those of the perceptron, and those of the pieces."""
        pieces = {} if self.pieces is None else self.pieces.parameters()
        return {"grid": self.grid.data, **self.perceptron.parameters(), **pieces}

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self.grid.data = parameters["grid"]
        self.perceptron.assign(parameters)
        if self.pieces is not None:
            self.pieces.assign(parameters)

    def prepare(self) -> None:
        """Lay the layers out for cooperative vectors."""
        self.perceptron.prepare()

    def shared(self) -> Set[str]:
        """The numbers and factors of pieces and those of colours, if steps learn them."""
        if self.pieces is None or not self._learned:
            return frozenset()
        by_place = self.pieces.by_place()
        # In the order of `parameters`, which is the same in all processes; that of a set is not.
        return {key: None for key in self.pieces.parameters() if key not in by_place}.keys()

    def deviations(self, point: SurfacePoint) -> dict[str, mi.Float]:
        """Those of the numbers of pieces and colours, if there are any."""
        return {} if self.pieces is None else self.pieces.deviations(point)

    def raised(self, piece: Piece, by: mi.Float) -> dict[str, mi.Float | mi.TensorXf]:
        """The numbers of pieces, if there are any."""
        return {} if self.pieces is None else dict(self.pieces.raised(piece, by))

    def varied(
        self, piece: Piece, about: Sequence[mi.Float], factor: mi.Float
    ) -> dict[str, mi.Float | mi.TensorXf]:
        """The numbers and factors of pieces, if there are any."""
        return {} if self.pieces is None else dict(self.pieces.varied(piece, about, factor))

    def placed(self, levels: Sequence[PlaceNumbers]) -> dict[str, mi.Float | mi.TensorXf]:
        """The numbers of pieces by place, if there are any."""
        return {} if self.pieces is None else dict(self.pieces.placed(levels))

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Evaluate the network; the caller masks points outside of [0,1]³ or not finite."""
        features = [*self.grid(list(point.position)), *extra]
        return self._with_shared(self.perceptron.evaluate(features, engine), point)

    def beside_shared(self, point: SurfacePoint) -> list[mi.Float]:
        """The network's part."""
        return self.perceptron.evaluate(self.grid(list(point.position)))

    def with_shared(self, beside: list[mi.Float], point: SurfacePoint) -> list[mi.Float]:
        """The network's part and the numbers of pieces and colours."""
        return self._with_shared(beside, point, searching=True)

    def _with_shared(
        self, beside: list[mi.Float], point: SurfacePoint, *, searching: bool = False
    ) -> list[mi.Float]:
        if self.pieces is None:
            return beside
        beside = [dr.fma(self._pace, x, self._first) for x in beside]
        outputs = self.pieces.evaluate(point, beside, searching=searching)
        return [sigmoid(x, self._least_slope) for x in outputs] if self._bounded else outputs

    def cost(self) -> Cost:
        """The products of all layers, and eight corners of each level of the grid."""
        numbers = 8 * self.grid.n_output_features + (self.pieces.features if self.pieces else 0)
        return Cost(self.perceptron.multiply_adds, 4 * numbers)
