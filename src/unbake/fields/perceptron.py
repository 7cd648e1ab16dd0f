"""A multilayer perceptron, evaluated by one of three engines.

The *cooperative vector* engine runs anywhere, also inside a BSDF or a symbolic loop, and is the
fast one on CUDA; on LLVM its gradients are slow. The other two need evaluated arrays. The *tensor*
engine multiplies matrices over all points at once, a layer after the other: the fast one for wide
layers on LLVM. The *fused* engine does narrow ones in one kernel, with gradients of its own.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import drjit as dr
import drjit.nn as nn
import mitsuba as mi
import numpy as np

from .arrays import first_value, from_numpy, sigmoid
from .field import Engine, FieldSpec

#: Neurons of a layer up to which the fused engine is the faster one.
_NARROW = 48


class Perceptron:
    """Layers of neurons with rectified linear activations, to stand behind any encoding.

    The last layer starts small, so that every output starts near zero, or near its initial value.

    Args:
        inputs: number of features.
        width: neurons of a hidden layer.
        hidden: number of hidden layers.
        spec: outputs and their bounds. In half precision matrices are multiplied so; weights and
            results stay single.
        rng: of the initial weights.
        leak: slope of activations below zero, less than 1. Where it is 0 and all neurons of a layer
            are below zero, outputs are constant and no gradient changes that.

    Paper: Sec. 5.3.
    """

    def __init__(
        self,
        inputs: int,
        width: int,
        hidden: int,
        spec: FieldSpec,
        rng: np.random.Generator,
        *,
        leak: float = 0.0,
    ) -> None:
        self.leak = leak
        self.half = spec.half
        self.bounded = spec.bounded
        self._least_slope = spec.least_slope
        self.outputs = spec.outputs
        self.layers: list[tuple[mi.TensorXf, mi.TensorXf]] = []
        for layer, (fan_in, fan_out) in enumerate(
            pairwise([inputs, *[width] * hidden, spec.outputs])
        ):
            bound = math.sqrt(6 / fan_in) * (0.1 if layer == hidden else 1)
            weights = from_numpy(mi.Float, rng.uniform(-bound, bound, fan_out * fan_in))
            weights = mi.TensorXf(weights, (fan_out, fan_in))
            self.layers.append((weights, dr.zeros(mi.TensorXf, (fan_out, 1))))
        if first_value(spec):
            weights, bias = self.layers[-1]
            self.layers[-1] = (weights, dr.full(mi.TensorXf, first_value(spec), bias.shape))
        self._packed: list | None = None

    @property
    def multiply_adds(self) -> int:
        """Products of one evaluation."""
        return sum(weights.shape[0] * weights.shape[1] for weights, _ in self.layers)

    def parameters(self) -> dict[str, mi.TensorXf]:
        """`weights` (outputs, inputs) and `bias` (outputs, 1) of each layer, after its number."""
        named = {}
        for i, (weights, bias) in enumerate(self.layers):
            named |= {f"{i}.weights": weights, f"{i}.bias": bias}
        return named

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; others than those of `parameters` are ignored."""
        self.layers = [
            (parameters[f"{i}.weights"], parameters[f"{i}.bias"]) for i in range(len(self.layers))
        ]
        self._packed = None

    def prepare(self) -> list:
        """Lay the layers out for cooperative vectors, and return them; see `Field.prepare`."""
        kind = mi.TensorXf16 if self.half else mi.TensorXf
        flat = [kind(a) for weights, bias in self.layers for a in (weights, _flat(bias))]
        if can_record_layout():
            views = [nn.view(a) for a in flat]
        else:
            views = nn.pack(*flat, layout="training")
        self._packed = list(zip(views[::2], views[1::2], strict=True))
        return self._packed

    def evaluate(self, features: list[mi.Float], engine: Engine | None = None) -> list[mi.Float]:
        """Evaluate the perceptron.

        Args:
            features: the inputs, finite.
            engine: see `Field.evaluate`.

        Returns:
            One array for each output, in (0, 1) where they are bounded.
        """
        outputs = self._outputs(features, engine or self._usual_engine())
        return [sigmoid(x, self._least_slope) for x in outputs] if self.bounded else outputs

    def _outputs(self, features: list[mi.Float], engine: Engine) -> list[mi.Float]:
        match engine:
            case "fused":
                if dr.grad_enabled(self.layers, features):
                    return dr.custom(_Fused, features, self.layers, self.leak)
                outputs = self._coopvec(features)  # there is nothing to keep
                dr.eval(outputs)
                return outputs
            case "tensor":
                return self._tensor(features)
            case "coopvec":
                return self._coopvec(features)
        raise ValueError(f"no engine named {engine!r}")

    def _usual_engine(self) -> Engine:
        narrow = max(weights.shape[0] for weights, _ in self.layers) <= _NARROW
        return "fused" if narrow and can_record_layout() and not self.half else "tensor"

    def _tensor(self, features: list[mi.Float]) -> list[mi.Float]:
        kind = mi.TensorXf16 if self.half else mi.TensorXf
        x = kind(mi.TensorXf(mi.ArrayXf(features)))
        for weights, bias in self.layers[:-1]:
            x = _activated(kind(weights) @ x + kind(bias), self.leak)
        weights, bias = self.layers[-1]
        x = mi.TensorXf(kind(weights) @ x + kind(bias))
        width = x.shape[1]
        lane = dr.arange(mi.UInt32, width)
        return [dr.gather(mi.Float, x.array, lane + i * width) for i in range(self.outputs)]

    def _coopvec(self, features: list[mi.Float]) -> list[mi.Float]:
        packed = self._packed or self.prepare()
        number = mi.Float16 if self.half else mi.Float
        x = nn.CoopVec([number(f) for f in features])
        for weights, bias in packed[:-1]:
            x = _activated(nn.matvec(weights, x, bias), self.leak)
        weights, bias = packed[-1]
        return [mi.Float(y) for y in nn.matvec(weights, x, bias)]


class _Fused(dr.CustomOp):
    """A narrow perceptron in one kernel each way, rather than several for each layer.

    Only the weights' gradients, sums over all lanes, are products of matrices. What they multiply
    is kept in memory: inputs of layers as (lanes, inputs), gradients of outputs as (outputs,
    lanes), so that neither needs to be transposed.
    """

    def eval(self, features, layers, leak):
        self.leak = leak
        self.layers = [(nn.view(weights), nn.view(_flat(bias))) for weights, bias in layers]
        x = nn.CoopVec(features)
        self.inputs = [_to_rows(list(x))]
        for weights, bias in self.layers[:-1]:
            x = _activated(nn.matvec(weights, x, bias), leak)
            self.inputs.append(_to_rows(list(x)))
        weights, bias = self.layers[-1]
        outputs = list(nn.matvec(weights, x, bias))
        dr.eval(self.inputs, outputs)
        return outputs

    def backward(self):
        lanes = self.inputs[0].shape[0]
        # An output that was not used has a gradient of a single zero.
        gradient = [g + dr.zeros(mi.Float, lanes) for g in self.grad_out()]
        dr.eval(gradient)
        kept: list[mi.TensorXf] = []
        for number in reversed(range(len(self.layers))):
            kept.insert(0, mi.TensorXf(mi.ArrayXf(gradient)))
            weights, _ = self.layers[number]
            gradient = list(nn.matvec(weights, nn.CoopVec(gradient), transpose=True))
            if number > 0:
                active = [x > 0 for x in _from_rows(self.inputs[number])]
                gradient = [
                    dr.select(on, g, self.leak * g) for on, g in zip(active, gradient, strict=True)
                ]
                # One kernel a layer: a longer one would run out of registers.
                dr.eval(kept, gradient)
        dr.eval(kept, gradient)
        self.set_grad_in("features", gradient)
        self.set_grad_in(
            "layers",
            [(g @ x, _lane_sums(g)) for g, x in zip(kept, self.inputs, strict=True)],
        )

    def name(self):
        return "perceptron"


def _activated(x: Any, leak: float) -> Any:
    """Neurons of a layer, as a tensor or a cooperative vector."""
    return dr.maximum(x, x * leak if leak else 0)


def _flat(bias: mi.TensorXf) -> mi.TensorXf:
    return mi.TensorXf(bias.array)


def _lane_sums(rows: mi.TensorXf) -> mi.TensorXf:
    outputs, lanes = rows.shape
    return mi.TensorXf(dr.block_sum(rows.array, lanes), (outputs, 1))


def _to_rows(values: list[mi.Float]) -> mi.TensorXf:
    """Arrays as the columns of a matrix with a row for each lane."""
    count, lanes = len(values), dr.width(values)
    size = _packet_size(count)
    rows = dr.empty(mi.Float, lanes * count)
    first = dr.arange(mi.UInt32, lanes) * (count // size)
    for i in range(count // size):
        packet = mi.ArrayXf(values[i * size : (i + 1) * size]) if size > 1 else values[i]
        dr.scatter(rows, packet, first + i, mode=dr.ReduceMode.Permute)
    return mi.TensorXf(rows, (lanes, count))


def _from_rows(rows: mi.TensorXf) -> list[mi.Float]:
    """The arrays that `_to_rows` was given."""
    lanes, count = rows.shape
    size = _packet_size(count)
    first = dr.arange(mi.UInt32, lanes) * (count // size)
    if size == 1:
        return [dr.gather(mi.Float, rows.array, first + i) for i in range(count)]
    packets = [
        dr.gather(mi.ArrayXf, rows.array, first + i, shape=(size, lanes))
        for i in range(count // size)
    ]
    return [packet[j] for packet in packets for j in range(size)]


def _packet_size(count: int) -> int:
    """Neighbouring floats that are read and written at once: a power of two that divides all."""
    return min(16, count & -count)


def can_record_layout() -> bool:
    """Whether a frozen function can lay layers out for cooperative vectors.

    LLVM takes them as they are. The layout that CUDA wants is made by a call that is not recorded.
    """
    return dr.backend_v(mi.Float) == dr.JitBackend.LLVM
