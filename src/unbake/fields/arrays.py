"""Dr.Jit arrays of fields: copies of NumPy's, and values that are bounded."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from .field import FieldSpec


def sigmoid(x: mi.Float) -> mi.Float:
    """1 / (1 + exp(−x))."""
    return dr.rcp(1 + dr.exp(-x))


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
