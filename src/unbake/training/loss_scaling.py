"""A factor on the loss, without which small gradients would vanish in half precision.

It is as large as no gradient overflows; optimisers divide by it again (Micikevicius et al. 2018).
Dr.Jit's `GradScaler` does so for one optimiser; here two share a loss.
"""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

#: The factor at first, and what it grows by after each good step.
_FIRST, _GROWTH = 65536.0, 2 ** (1 / 2000)
#: The least factor. It is divided by.
_LEAST = 2.0**-16


def first_scale() -> mi.Float:
    """The factor of a fresh fit."""
    return dr.opaque(mi.Float, _FIRST)


def next_scale(scale: mi.Float, finite: mi.Bool) -> mi.Float:
    """The factor after a step: half of it where a gradient has overflowed.

    Args:
        finite: whether none has.
    """
    return dr.maximum(scale * dr.select(finite, _GROWTH, 0.5), _LEAST)


def gradients_are_finite(optimizers: Iterable[mi.ad.Adam]) -> mi.Bool:
    """Whether no gradient has overflowed."""
    good = mi.Bool(True)
    for optimizer in optimizers:
        for value in optimizer.values():
            good &= dr.all(dr.isfinite(dr.grad(value).array))
    return good
