"""The radiometric prior: the residual of the rendering equation (Eq. 3, 10)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from .operator import transported

if TYPE_CHECKING:
    from .path_sample import PathSample


def residual(sample: PathSample, number: int, L: mi.Color3f, L_next: mi.Color3f) -> mi.Color3f:
    """L_θ(xᵢ) − T(L_θ)(xᵢ) at a vertex of path samples.

    At x₁, the vertices that cameras see, it is the one bounce prior. At x₂ as well, the extra
    bounce prior, it reaches surfaces that no camera sees. Emission is on both sides and cancels.

    Args:
        sample: paths with the bounce at xᵢ.
        number: i, from 1.
        L: L_θ(xᵢ).
        L_next: L_θ(xᵢ₊₁).

    Paper: Eq. 3, Eq. 10, Sec. 4.2.
    """
    valid = sample.vertex(number).valid
    return dr.select(valid, L - transported(sample.bounces[number - 1], L_next), 0)


def residual_norm(
    residual: mi.Color3f,
    reference: mi.Color3f,
    epsilon: float,
    independent: mi.Color3f | None = None,
) -> mi.Float:
    """Relative squared norm of residuals, mean over samples and channels.

    Args:
        residual: of each sample, linear RGB.
        reference: the radiance that it is relative to; taken as a constant.
        epsilon: added to the squared reference.
        independent: the same residuals from other samples of T. The product of both is free of the
            variance that is part of the expected square of one; None: the square.

    Paper: Eq. 4, Eq. 10, Sec. 5.2, 5.4.
    """
    weight = dr.rcp(dr.square(dr.detach(reference)) + epsilon)
    squared = dr.square(residual) if independent is None else residual * independent
    return dr.mean(dr.mean(squared * weight))
