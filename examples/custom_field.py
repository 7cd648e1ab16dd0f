"""A representation of its own for the materials: Fourier features with a perceptron behind them.

    python examples/custom_field.py DATA --out run --steps 300

The features are sines and cosines of random directions (Tancik et al. 2020), which are not trained.
All that a representation needs is here: settings, a class and a name.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import unbake

unbake.activate()

import drjit as dr  # noqa: E402 (importing Dr.Jit loads LLVM, which activate() finds)
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402


@dataclass(frozen=True)
class FourierConfig:
    """Fourier features and the perceptron behind them."""

    count: int = 16  #: directions, with two features each
    frequency: float = 4.0  #: standard deviation, in periods along an edge of the scene's cube
    width: int = 32  #: neurons of a hidden layer
    learning_rate: float = 0.01  #: Adam

    def __post_init__(self) -> None:
        if self.count < 1:
            raise unbake.UserError(f"must be 1 or more, not {self.count}", "count")


class Fourier(unbake.Field):
    """A function of the position, by random Fourier features."""

    def __init__(self, settings: FourierConfig, spec: unbake.FieldSpec) -> None:
        rng = np.random.default_rng(spec.seed)
        directions = rng.normal(0, 2 * np.pi * settings.frequency, (settings.count, 3))
        self.directions = [mi.ScalarVector3f(d) for d in directions]
        inputs = 2 * settings.count + spec.extra
        self.perceptron = unbake.Perceptron(inputs, settings.width, 2, spec, rng)

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """Those of the perceptron; the directions follow from the seed."""
        return self.perceptron.parameters()

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self.perceptron.assign(parameters)

    def prepare(self) -> None:
        """Lay the layers out for cooperative vectors."""
        self.perceptron.prepare()

    def evaluate(
        self,
        point: unbake.SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: str | None = None,
    ) -> list[mi.Float]:
        """Evaluate features and perceptron, which bounds the outputs where they are bounded."""
        waves = [x for d in self.directions for x in dr.sincos(dr.dot(point.position, d))]
        return self.perceptron.evaluate([*waves, *extra], engine)

    def cost(self) -> unbake.Cost:
        """The products of all layers."""
        return unbake.Cost(self.perceptron.multiply_adds, 0)


unbake.register_representation(
    unbake.Representation("fourier", "Fourier features", FourierConfig(), make=Fourier)
)


def main() -> None:
    """Fit the materials of a data set with it, and tell how near they are to the truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="data set, as `unbake capture` writes it")
    parser.add_argument("--out", type=Path, required=True, help="folder to write the run to")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--pixels", type=int, default=512)
    args = parser.parse_args()

    config = dataclasses.replace(
        unbake.preset("cpu"),
        representation="fourier",
        materials={"albedo": {"fourier": FourierConfig(count=32)}},  # roughness keeps the defaults
        steps=args.steps,
        pixels=args.pixels,
        warm_up=20,
    )
    unbake.fit(args.data, args.out, config)
    settings = unbake.EvaluationSettings(spp=16, max_depth=8, train_views=0, material_spp=4)
    scores = unbake.evaluate(args.out, settings)["heldout"]
    print(f"Fourier features: albedo {scores['albedo_psnr']:.1f} dB on views kept apart")


if __name__ == "__main__":
    main()
