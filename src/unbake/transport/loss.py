"""The relative L2 loss on pixels, with unbiased gradients (Sec. 5.2, 5.4)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass(frozen=True)
class RelativeL2:
    """The relative L2 loss: squared errors divided by a squared reference plus ε.

    The paper divides by the photograph. A photograph that is too dark by chance then weighs more
    than one that is too bright, and the optimum is darker than the scene: with noisy photographs a
    few percent, which is as much as roughness does. A smoothed photograph has next to no such
    noise. Where it is noisy it must be larger, or else a firefly outweighs all other pixels: see
    `dataset/photographs.py`.

    Args:
        epsilon: added to the squared reference.
        reference: linear RGB, one lane a pixel; None: the photograph itself.

    Paper: Sec. 5.4.
    """

    epsilon: float
    reference: mi.Color3f | None = None

    def weight(self, target: mi.Color3f) -> mi.Color3f:
        """1 / (reference² + ε) of each pixel."""
        reference = target if self.reference is None else self.reference
        return dr.rcp(dr.square(reference) + self.epsilon)


def squared_error(
    samples: mi.Color3f,
    target: mi.Color3f,
    spp: int,
    weight: mi.Color3f,
    primal: mi.Color3f | None = None,
) -> mi.Float:
    """Weighted squared error of pixels, w (I − G)², whose gradient is unbiased.

    The gradient 2 (I − G) ∂I of a squared error is biased if both factors come from the same noisy
    samples. Without `primal` the samples of each pixel are split in halves A and B: the expectation
    of (I_A − G)(I_B − G) is the squared error of the expected image, and so for its gradient. With
    `primal`, an estimate from other random numbers, the factors are that one and ∂I.

    Args:
        samples: linear RGB, `spp` consecutive lanes a pixel.
        target: G, linear RGB, one lane a pixel.
        weight: of each pixel and channel, a constant.
        primal: I from an independent pass, one lane a pixel.

    Returns:
        Mean over pixels and channels.

    Paper: Sec. 5.2.
    """
    if primal is not None:
        image = pixel_means(samples, spp)
        error = dr.detach(primal) - target
        # The value is the squared error of the primal image, the gradient 2 (primal − G) ∂I.
        squared = dr.square(error) + 2 * error * (image - dr.detach(image))
    else:
        halves = pixel_means(samples, spp // 2)
        even = 2 * dr.arange(mi.UInt32, dr.width(target))
        a, b = dr.gather(mi.Color3f, halves, even), dr.gather(mi.Color3f, halves, even + 1)
        squared = (a - target) * (b - target)
    return dr.mean(dr.mean(squared * weight))


def pixel_means(samples: mi.Color3f, spp: int) -> mi.Color3f:
    """Mean of each run of `spp` lanes: pixels from their camera samples. Paper: Eq. 2."""
    dr.eval(samples)
    return mi.Color3f([dr.block_sum(c, spp) / spp for c in samples])
