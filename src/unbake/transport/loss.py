"""The relative L2 loss on pixels, with unbiased gradients (Sec. 5.2, 5.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi


def as_weight(loss: mi.Float, least: float, largest: float) -> mi.Float:
    """A loss between bounds, to multiply a term by: no gradients, and 0 where it is not finite.

    The step reports a loss that is not finite itself, so the weight need not.
    """
    loss = dr.detach(loss)
    return dr.select(dr.isfinite(loss), dr.clip(loss, least, largest), 0)


@dataclass(frozen=True)
class RelativeL2:
    """The relative L2 loss: squared errors divided by a squared reference plus ε.

    The paper divides by the photograph. A photograph that is too dark by chance then weighs more
    than one that is too bright, and the optimum is darker than the scene: with noisy photographs a
    few percent, which is as much as roughness does. A smoothed photograph has next to no such
    noise. Where it is noisy it must be larger, or else a firefly outweighs all other pixels: see
    `dataset/decoding.py`.

    Args:
        epsilon: added to the squared reference.
        reference: linear RGB, one lane a pixel; None: the photograph itself.
        clipped: channels of pixels whose photograph says "at least that much"; None: no channel.
        gain: by which renderings are multiplied before they are compared, linear RGB, one lane a
            pixel; None: 1. ε is of radiance, so that it is multiplied by the squared gain: with the
            true gains errors are the same as if photographs had been divided by them.
        trust: by which errors are multiplied, one lane a pixel; it may pass gradients; None: 1.
        pairs: see `squared_error`.

    Paper: Sec. 5.4.
    """

    epsilon: float
    reference: mi.Color3f | None = None
    clipped: mi.Bool | None = None
    gain: mi.Color3f | None = None
    trust: mi.Float | None = None
    pairs: bool = True

    def of_known_camera(self) -> RelativeL2:
        """The same loss without gradients to the gain and to what errors are multiplied by."""
        if self.gain is None and self.trust is None:
            return self
        gain, trust = (None if x is None else dr.detach(x) for x in (self.gain, self.trust))
        return replace(self, gain=gain, trust=trust)

    def error(
        self,
        samples: mi.Color3f,
        target: mi.Color3f,
        spp: int,
        primal: mi.Color3f | None = None,
    ) -> mi.Float:
        """The relative squared error of pixels; arguments as of `squared_error`."""
        weight = self.weight(target)
        if self.trust is not None:
            weight *= self.trust
        return squared_error(
            samples, target, spp, weight, primal, self.clipped, self.gain, pairs=self.pairs
        )

    def weight(self, target: mi.Color3f) -> mi.Color3f:
        """1 / (reference² + ε) of each pixel, a constant."""
        reference = target if self.reference is None else self.reference
        reference = dr.detach(reference)
        if self.gain is None:
            return dr.rcp(dr.square(reference) + self.epsilon)
        gain = dr.detach(self.gain)
        return dr.rcp(dr.square(reference) + self.epsilon * dr.square(gain))


def squared_error(
    samples: mi.Color3f,
    target: mi.Color3f,
    spp: int,
    weight: mi.Color3f,
    primal: mi.Color3f | None = None,
    clipped: mi.Bool | None = None,
    gain: mi.Color3f | None = None,
    *,
    pairs: bool = True,
) -> mi.Float:
    """Weighted squared error of pixels, w (I − G)², whose gradient is unbiased.

    The gradient 2 (I − G) ∂I of a squared error is biased if both factors come from the same noisy
    samples. Without `primal` no sample of a pixel is multiplied by itself: the expectation of
    (Iᵢ − G)(Iⱼ − G) for two independent samples is the squared error of the expected image, and so
    for its gradient. With `primal`, an estimate from other random numbers, the value is the product
    of the errors of the two estimates, and the factors of the gradient are that one's error and ∂I.
    The two play the parts of halves where a channel is clipped.

    Of a clipped channel only a shortfall counts: an estimate above G has no error and no gradient.
    Single samples fall short of G too often, so that such channels always have halves, whose
    expectation is the square of the expected shortfall, E[min(I_A − G, 0)]², and the gradient
    unbiased in turn. Where noise is as large as the distance to G it is more than zero although I
    is above G.

    Args:
        samples: linear RGB, `spp` consecutive lanes a pixel, two or more. All of a pixel are
            independent, or its two halves if not `pairs`.
        target: G, linear RGB, one lane a pixel.
        weight: of each pixel and channel, a constant.
        primal: I from an independent pass, one lane a pixel.
        clipped: channels of pixels for which G is the least that they can be; None: no channel.
        gain: takes the place of I by gain · I, one lane a pixel; it may pass gradients, as G may.
        pairs: without `primal`, whether the mean product of all n (n - 1) pairs of different
            samples is taken, or the product of their halves' means, which has n² / 2 of them and
            more noise.

    Returns:
        Mean over pixels and channels.

    Paper: Sec. 5.2.
    """
    if primal is not None:
        image = pixel_means(samples, spp)
        if gain is not None:
            image, primal = image * gain, primal * dr.detach(gain)
        error = one_sided(dr.detach(primal) - target, clipped)
        # The value is the product of the errors of both passes, the gradient 2 (primal − G) ∂I. Of
        # clipped channels, ∂I counts where I falls short as well: E[min(I − G, 0)]² is learned.
        product = error * one_sided(dr.detach(image) - target, clipped)
        shown = image if clipped is None else dr.select(clipped & (image > target), 0, image)
        squared = product + 2 * dr.detach(error) * (shown - dr.detach(shown))
    elif not pairs:
        squared = _of_halves(samples, target, spp, clipped, gain)
    else:
        squared = _of_pairs(samples, target, spp, gain)
        if clipped is not None:
            halves = _of_halves(samples, target, spp, clipped, gain)
            squared = dr.select(clipped, halves, squared)
    return dr.mean(dr.mean(squared * weight))


def _of_pairs(
    samples: mi.Color3f, target: mi.Color3f, spp: int, gain: mi.Color3f | None
) -> mi.Color3f:
    """The mean product of the errors of two different samples, by pixel."""
    pixel = dr.arange(mi.UInt32, dr.width(samples)) // spp
    shown = samples if gain is None else samples * dr.gather(mi.Color3f, gain, pixel)
    errors = shown - dr.gather(mi.Color3f, target, pixel)
    # Samples as well: what follows, and the halves of clipped channels, shall not trace them anew.
    dr.eval(samples, errors)

    def products(c: mi.Float) -> mi.Float:
        with_own = dr.square(dr.block_sum(c, spp))
        return (with_own - dr.block_sum(dr.square(c), spp)) / (spp * (spp - 1))

    return mi.Color3f([products(c) for c in errors])


def _of_halves(
    samples: mi.Color3f,
    target: mi.Color3f,
    spp: int,
    clipped: mi.Bool | None,
    gain: mi.Color3f | None,
) -> mi.Color3f:
    """The product of the errors of the two halves' means, by pixel."""
    halves = pixel_means(samples, spp // 2)
    even = 2 * dr.arange(mi.UInt32, dr.width(target))
    a, b = dr.gather(mi.Color3f, halves, even), dr.gather(mi.Color3f, halves, even + 1)
    if gain is not None:
        a, b = a * gain, b * gain
    return one_sided(a - target, clipped) * one_sided(b - target, clipped)


def one_sided(error: mi.Color3f, clipped: mi.Bool | None) -> mi.Color3f:
    """Errors of pixels, without those of clipped channels that are too bright."""
    if clipped is None:
        return error
    return dr.select(clipped & (error > 0), 0, error)


def pixel_means(samples: mi.Color3f, spp: int) -> mi.Color3f:
    """Mean of each run of `spp` lanes: pixels from their camera samples. Paper: Eq. 2."""
    dr.eval(samples)
    return mi.Color3f([dr.block_sum(c, spp) / spp for c in samples])
