"""A hash grid with a perceptron on top: the representation of the paper (Sec. 5.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from .arrays import first_value, from_numpy, sigmoid
from .domain import SurfacePoint
from .field import Cost, Engine, Field, FieldSpec
from .grid_sizes import USUAL, sized_grid
from .guide import Guide
from .perceptron import Perceptron, can_record_layout
from .settings import NetworkConfig


class Network(Field):
    """A vector-valued function of a position in [0,1]³ and of further inputs.

    With a guide (ours), what surfaces near each other and of equal albedo share is added.

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
        # A guide adds to the outputs before they are bounded.
        self.guide = Guide(settings.guide, spec.outputs) if settings.guide.levels else None
        self._share = settings.guide.network
        self._bounded = spec.bounded and self.guide is not None
        self._first = first_value(spec) if self._bounded else 0.0
        of_layers = replace(spec, bounded=False) if self._bounded else spec
        self.perceptron = Perceptron(inputs, settings.width, settings.hidden, of_layers, rng)
        self.prepare_recordable = can_record_layout()

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """Names: `grid`, those of the perceptron, and those of the guide."""
        guide = {} if self.guide is None else self.guide.parameters()
        return {"grid": self.grid.data, **self.perceptron.parameters(), **guide}

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self.grid.data = parameters["grid"]
        self.perceptron.assign(parameters)
        if self.guide is not None:
            self.guide.assign(parameters)

    def prepare(self) -> None:
        """Lay the layers out for cooperative vectors."""
        self.perceptron.prepare()

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Evaluate the network; the caller masks points outside of [0,1]³ or not finite."""
        outputs = self.perceptron.evaluate([*self.grid(list(point.position)), *extra], engine)
        if self.guide is None:
            return outputs
        shared = self.guide.evaluate(point)
        outputs = [
            dr.fma(self._share, x, y + self._first) for x, y in zip(outputs, shared, strict=True)
        ]
        return [sigmoid(x) for x in outputs] if self._bounded else outputs

    def cost(self) -> Cost:
        """The products of all layers, and eight corners of each level of the grids."""
        features = self.grid.n_output_features + (self.guide.features if self.guide else 0)
        return Cost(self.perceptron.multiply_adds, 4 * 8 * features)
