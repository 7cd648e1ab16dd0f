"""Gradients of an optimiser's parameters as flat arrays, which processes average."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..fields.arrays import shaped_like


def flat_gradients(optimizer: mi.ad.Optimizer) -> list[mi.Float]:
    """The gradients of all parameters, in their order."""
    return [mi.Float(dr.grad(value).array) for value in optimizer.values()]


def set_gradients(optimizer: mi.ad.Optimizer, flat: mi.Float, first: int = 0) -> int:
    """Give all parameters their gradients.

    Args:
        flat: what `flat_gradients` tells, one after the other.
        first: where they begin in it.

    Returns:
        Where they end.
    """
    for value in optimizer.values():
        count = dr.width(value.array)
        gradient = dr.gather(mi.Float, flat, first + dr.arange(mi.UInt32, count))
        dr.set_grad(value, shaped_like(gradient, value))
        first += count
    return first
