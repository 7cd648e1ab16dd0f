"""A hash grid with a multilayer perceptron on top, evaluated by either of two engines.

The *tensor* engine multiplies matrices over all points at once. It is the fast one on LLVM,
forward and backward, but needs evaluated arrays: it cannot run inside virtual calls or symbolic
loops. The *cooperative vector* engine runs anywhere, also inside a BSDF, and is the fast one on
CUDA.
"""

from __future__ import annotations

import math
from typing import Literal

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from ..config import NetworkConfig

Engine = Literal["tensor", "coopvec"]


class Network:
    """A vector-valued function of a position in [0,1]³ and of further inputs.

    Args:
        config: sizes of grid and perceptron.
        extra: number of inputs besides the position's encoding.
        outputs: number of outputs.
        seed: seed of the initial weights.

    The last layer starts small, so that every output starts near zero.

    Paper: Sec. 5.3.
    """

    def __init__(self, config: NetworkConfig, *, extra: int, outputs: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        g = config.grid
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
        self.inputs = self.grid.n_output_features + extra
        self.outputs = outputs

        sizes = [self.inputs, *[config.width] * config.hidden, outputs]
        self.layers: list[tuple[mi.TensorXf, mi.TensorXf]] = []
        for layer, (fan_in, fan_out) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
            bound = math.sqrt(6 / fan_in) * (0.1 if layer == config.hidden else 1)
            weights = from_numpy(mi.Float, rng.uniform(-bound, bound, fan_out * fan_in))
            weights = mi.TensorXf(weights, (fan_out, fan_in))
            self.layers.append((weights, dr.zeros(mi.TensorXf, (fan_out, 1))))
        self._packed: list | None = None

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays by name; `assign` takes them back."""
        named = {"grid": self.grid.data}
        for i, (weights, bias) in enumerate(self.layers):
            named |= {f"{i}.weights": weights, f"{i}.bias": bias}
        return named

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; gradients arrive in the very arrays given."""
        self.grid.data = parameters["grid"]
        self.layers = [
            (parameters[f"{i}.weights"], parameters[f"{i}.bias"]) for i in range(len(self.layers))
        ]
        self._packed = None

    def __call__(
        self, position: mi.Point3f, extra: list[mi.Float], engine: Engine = "tensor"
    ) -> list[mi.Float]:
        """Evaluate the network.

        Args:
            position: points in [0,1]³; the caller masks points that lie outside or are not finite.
            extra: the further inputs, as many as the constructor was told.
            engine: `tensor` outside of virtual calls and loops, `coopvec` anywhere.

        Returns:
            One array for each output.
        """
        features = [*self.grid(list(position)), *extra]
        return self._tensor(features) if engine == "tensor" else self._coopvec(features)

    def _tensor(self, features: list[mi.Float]) -> list[mi.Float]:
        x = mi.TensorXf(mi.ArrayXf(features))
        for weights, bias in self.layers[:-1]:
            x = dr.maximum(weights @ x + bias, 0)
        weights, bias = self.layers[-1]
        x = weights @ x + bias
        width = x.shape[1]
        lane = dr.arange(mi.UInt32, width)
        return [dr.gather(mi.Float, x.array, lane + i * width) for i in range(self.outputs)]

    def _coopvec(self, features: list[mi.Float]) -> list[mi.Float]:
        if self._packed is None:
            self.pack()
        x = nn.CoopVec(features)
        for weights, bias in self._packed[:-1]:
            x = dr.maximum(nn.matvec(weights, x, bias), 0)
        weights, bias = self._packed[-1]
        return list(nn.matvec(weights, x, bias))

    def pack(self) -> None:
        """Lay the layers out for cooperative vectors.

        Needed once after `assign`, and before any evaluation inside a virtual call or loop, where
        it can no longer be done.
        """
        flat = [a if a.shape[1] > 1 else mi.TensorXf(a.array) for pair in self.layers for a in pair]
        if can_record_layout():
            views = [nn.view(a) for a in flat]
        else:
            views = nn.pack(*flat, layout="training")
        self._packed = list(zip(views[::2], views[1::2], strict=True))


def can_record_layout() -> bool:
    """Whether a frozen function can lay layers out for cooperative vectors.

    LLVM takes them as they are. The layout that CUDA wants is made by a call that is not recorded.
    """
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM


def sigmoid(x: mi.Float) -> mi.Float:
    """1 / (1 + exp(−x))."""
    return dr.rcp(1 + dr.exp(-x))


def from_numpy(array_type: type, values: np.ndarray) -> mi.Float | mi.UInt32:
    """A flat copy of an array in Dr.Jit's own memory.

    The array type's constructor would map NumPy's memory, whose release no frozen function can
    record.
    """
    mapped = array_type(np.asarray(values).ravel())
    own = mapped * dr.opaque(array_type, 1)
    dr.eval(own)
    return own
