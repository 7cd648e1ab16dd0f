"""The radiometric prior: the residual of the rendering equation (Eq. 3, 10)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .operator import transported


def first_residual(sample, L1: mi.Color3f, L2: mi.Color3f) -> mi.Color3f:
    """L_θ(x₁) − T(L_θ)(x₁) at the vertices that cameras see: the one bounce prior.

    Emission is on both sides and cancels.

    Paper: Eq. 3, Eq. 10, Sec. 4.2.
    """
    return dr.select(sample.x1.valid, L1 - transported(sample.bounce1, L2), 0)


def second_residual(sample, L2: mi.Color3f, L3: mi.Color3f) -> mi.Color3f:
    """L_θ(x₂) − T(L_θ)(x₂) one bounce further: with it, the extra bounce prior.

    It reaches surfaces that no camera sees.

    Paper: Sec. 4.2.
    """
    x2 = sample.bounce1.next
    return dr.select(x2.valid, L2 - transported(sample.bounce2, L3), 0)


def residual_norm(residual: mi.Color3f, reference: mi.Color3f, epsilon: float) -> mi.Float:
    """Relative squared norm of residuals, mean over samples and channels.

    Args:
        residual: of each sample, linear RGB.
        reference: the radiance that it is relative to; taken as a constant.
        epsilon: added to the squared reference.

    Paper: Eq. 4, Eq. 10, Sec. 5.4.
    """
    weight = dr.rcp(dr.square(dr.detach(reference)) + epsilon)
    return dr.mean(dr.mean(dr.square(residual) * weight))
