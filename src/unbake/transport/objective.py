"""The objective, and THE table of which of its terms trains what (Sec. 4.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import drjit as dr
import mitsuba as mi

from .path_sample import PathSample, Requirements, lhs, rhs
from .prior import residual, residual_norm


@dataclass(frozen=True)
class Attached:
    """Which edges of a term pass gradients."""

    scene: bool = False  #: materials at the first vertices, and lights, to φ
    lhs: bool = False  #: L_θ on the left-hand side, to θ
    rhs: bool = False  #: L_θ on the right-hand side, to θ


PHOTOMETRIC, PRIOR, EXTRA, LHS = "photometric", "prior", "prior_extra", "lhs"

#: Method → term → what it trains. A term that is absent is not part of the method.
#: Photometric: Eq. 5 with Eq. 12. Prior: Eq. 10. Extra: the same at x₂. LHS: Eq. 14.
#: From `direct` to `ours` the rows are the ablation of Fig. 7 and 8, each with one thing more.
METHODS: Mapping[str, Mapping[str, Attached]] = MappingProxyType(
    {
        "direct": {PHOTOMETRIC: Attached(scene=True)},
        "with-prior": {
            PHOTOMETRIC: Attached(scene=True),
            PRIOR: Attached(scene=True, lhs=True),
        },
        "with-stop-gradient": {
            PHOTOMETRIC: Attached(scene=True),
            PRIOR: Attached(lhs=True),
        },
        "with-second-bounce": {
            PHOTOMETRIC: Attached(scene=True),
            PRIOR: Attached(lhs=True),
            EXTRA: Attached(lhs=True),
        },
        "ours": {
            PHOTOMETRIC: Attached(scene=True),
            PRIOR: Attached(lhs=True),
            EXTRA: Attached(lhs=True),
            LHS: Attached(lhs=True),
        },
        "ours, one-bounce": {
            PHOTOMETRIC: Attached(scene=True),
            PRIOR: Attached(lhs=True),
            LHS: Attached(lhs=True),
        },
        "no-prior": {
            PHOTOMETRIC: Attached(scene=True),
            LHS: Attached(lhs=True),
        },
        # Paths are followed to their end: all light is in the image, and there is no cache.
        "ad-pt": {PHOTOMETRIC: Attached(scene=True)},
        "prb": {PHOTOMETRIC: Attached(scene=True)},
    }
)


@dataclass(frozen=True)
class RelativeL2:
    """The relative L2 loss: squared errors divided by a squared reference plus ε.

    The paper divides by the photograph. A photograph that is too dark by chance then weighs more
    than one that is too bright, and the optimum is darker than the scene: with noisy photographs a
    few percent, which is as much as roughness does. A smoothed photograph has next to no such
    noise. (The radiance field's own picture would have none, but its samples are the error's.)

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


def requirements(terms: Mapping[str, Attached], bounces: int = 1) -> Requirements:
    """What a method's path samples must hold, with so many differentiable bounces."""
    residuals = 2 if EXTRA in terms else 1 if PRIOR in terms else 0
    return Requirements(bounces, residuals, LHS in terms)


def objective(
    terms: Mapping[str, Attached],
    sample: PathSample,
    target: mi.Color3f,
    spp: int,
    loss: RelativeL2,
    primal: mi.Color3f | None = None,
    bounces: int = 1,
) -> dict[str, mi.Float]:
    """Every term of the objective; their sum is what is minimised.

    Args:
        terms: a row of `METHODS`.
        sample: path samples, as many consecutive lanes for each pixel; those that L_θ learns of,
            too.
        target: the photographs' pixels, linear RGB.
        spp: camera samples a pixel, of which `sample.learned` may hold fewer.
        loss: what errors are relative to.
        primal: an independent, detached estimate of the same pixels for the two-pass estimator;
            None: the split-halves estimator.
        bounces: k, after which the image takes L_θ.

    Paper: Eq. 5, Eq. 11, Eq. 14, Sec. 4.1.
    """
    values: dict[str, mi.Float] = {}
    weight = loss.weight(target)
    for term, attached in terms.items():
        paths = sample if term == PHOTOMETRIC else (sample.learned or sample)
        scattered = paths if attached.scene else dr.detach(paths)
        seen = [L if attached.lhs else dr.detach(L) for L in paths.radiance]
        incoming = [L if attached.rhs else dr.detach(L) for L in paths.radiance]
        match term:
            case "photometric":
                pixels = rhs(scattered, incoming[bounces], bounces)
                values[term] = squared_error(pixels, target, spp, weight, primal)
            case "prior":
                first = residual(scattered, 1, seen[0], incoming[1])
                values[term] = residual_norm(first, seen[0], loss.epsilon)
            case "prior_extra":
                second = residual(scattered, 2, seen[1], incoming[2])
                values[term] = residual_norm(second, seen[1], loss.epsilon)
            case "lhs":
                pixels = lhs(scattered, seen[0])
                subset = dr.width(scattered.x1.valid) // dr.width(target)
                values[term] = squared_error(pixels, target, subset, weight, None)
    return values


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
    """Mean of each run of `spp` lanes: pixels from their camera samples."""
    dr.eval(samples)
    return mi.Color3f([dr.block_sum(c, spp) / spp for c in samples])
