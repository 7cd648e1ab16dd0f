"""Three feature planes with a perceptron on top (Chan et al. 2022)."""

from __future__ import annotations

from collections.abc import Sequence

import drjit.nn as nn
import mitsuba as mi
import numpy as np

from .arrays import from_numpy
from .domain import SurfacePoint
from .field import Cost, Engine, Field, FieldSpec
from .perceptron import Perceptron, can_record_layout
from .settings import TriPlaneConfig

#: The planes with their two axes.
_PLANES = {"xy": (0, 1), "yz": (1, 2), "zx": (2, 0)}


class TriPlane(Field):
    """A vector-valued function of a position in [0,1]³ and of further inputs.

    A position has features in each of three planes, of several resolutions and bilinear between the
    corners of cells. The sum over the planes, and the further inputs, go to a perceptron. Unlike a
    hash grid it is dense, and grows with the square of the resolution.
    """

    def __init__(self, settings: TriPlaneConfig, spec: FieldSpec) -> None:
        rng = np.random.default_rng(spec.seed)
        self.planes: dict[str, nn.HashGridEncoding] = {}
        for name in _PLANES:
            plane = nn.HashGridEncoding(
                mi.Float,
                2,
                n_levels=settings.levels,
                n_features_per_level=settings.features,
                # Room for the corners of the finest level: nothing is hashed.
                hashmap_size=settings.features * (settings.finest + 1) ** 2,
                base_resolution=settings.base_resolution,
                per_level_scale=2,
                align_corners=True,
            )
            plane.data = from_numpy(mi.Float, rng.uniform(-1e-4, 1e-4, plane.n_params))
            self.planes[name] = plane
        inputs = settings.levels * settings.features + spec.extra
        self.perceptron = Perceptron(
            inputs, settings.width, settings.hidden, spec, rng, leak=settings.leak
        )
        self.prepare_recordable = can_record_layout()

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """Names: `xy`, `yz` and `zx`, and those of the perceptron."""
        planes = {name: plane.data for name, plane in self.planes.items()}
        return {**planes, **self.perceptron.parameters()}

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        for name, plane in self.planes.items():
            plane.data = parameters[name]
        self.perceptron.assign(parameters)

    def prepare(self) -> None:
        """Lay the layers out for cooperative vectors."""
        self.perceptron.prepare()

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Evaluate the field; the caller masks points outside of [0,1]³ or not finite."""
        p = point.position
        looked_up = [self.planes[name]([p[i], p[j]]) for name, (i, j) in _PLANES.items()]
        features = [a + b + c for a, b, c in zip(*looked_up, strict=True)]
        return self.perceptron.evaluate([*features, *extra], engine)

    def cost(self) -> Cost:
        """The products of all layers, and four corners of each level of the planes."""
        features = sum(plane.n_output_features for plane in self.planes.values())
        return Cost(self.perceptron.multiply_adds, 4 * 4 * features)
