"""Dr.Jit arrays of fields: copies of NumPy's, and values that are bounded."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from .field import FieldSpec

#: How far from 0 numbers are let go by more than the slope of `sigmoid`: it is 0.0025 there.
_FAR = 6.0


def shaped_like(flat: mi.Float, like: mi.Float | mi.TensorXf) -> mi.Float | mi.TensorXf:
    """Numbers, one after the other, as an array of the kind and shape of another one."""
    return mi.TensorXf(flat, like.shape) if dr.is_tensor_v(like) else flat


def sigmoid(x: mi.Float, least_slope: float = 0.0) -> mi.Float:
    """1 / (1 + exp(−x)).

    Args:
        x: any number.
        least_slope: lower bound on the slope in backpropagation (ours), so that saturated values
            recover. Beyond ±6 it does not apply to gradients that would push a value further out.
    """
    if least_slope and dr.grad_enabled(x):
        return dr.custom(_Sigmoid, x, least_slope)
    return _sigmoid(x)


def _sigmoid(x: mi.Float) -> mi.Float:
    return dr.rcp(1 + dr.exp(-x))


class _Sigmoid(dr.CustomOp):
    """The function with a least slope, which is that of the backward direction alone."""

    def eval(self, x, least_slope):
        value = _sigmoid(x)
        self.x, self.least_slope, self.slope = x, least_slope, value * (1 - value)
        return value

    def forward(self):
        self.set_grad_out(self.slope * self.grad_in("x"))

    def backward(self):
        gradient = self.grad_out()
        away = (dr.abs(self.x) > _FAR) & (self.x * gradient < 0)
        slope = dr.select(away, self.slope, dr.maximum(self.slope, self.least_slope))
        self.set_grad_in("x", slope * gradient)

    def name(self):
        return "sigmoid"


def first_value(spec: FieldSpec) -> float:
    """The value before `sigmoid` at which the outputs of an untrained field start."""
    return math.log(spec.initial / (1 - spec.initial)) if spec.bounded else 0.0


def from_numpy(array_type: type, values: np.ndarray) -> mi.Float | mi.UInt32:
    """A flat copy of an array in Dr.Jit's own memory.

    The array type's constructor would map NumPy's memory, whose release no frozen function can
    record.
    """
    mapped = array_type(np.asarray(values).ravel())
    own = mapped * dr.opaque(array_type, 1)
    dr.eval(own)
    return own


def read_small(array: mi.Float, index: mi.UInt32, active: bool | mi.Bool = True) -> mi.Float:
    """Entries of a small array, an index a lane; 0 where a lane is not active.

    Dr.Jit 1.5 on LLVM now and then loses gradients in the buffers by which it adds to small arrays;
    `Local` has none.
    """
    return dr.gather(mi.Float, array, index, active, mode=dr.ReduceMode.Local)


def differences(values: mi.Float, here: mi.UInt32, apart: int) -> mi.Float:
    """Values so far behind others, less those."""
    return dr.gather(mi.Float, values, here + apart) - dr.gather(mi.Float, values, here)
