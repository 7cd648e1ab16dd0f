"""A BSDF that samples as one material and evaluates as another, for finite differences.

Gradients detach sampling: the estimator is f(φ)/p(φ₀), where only the value moves with φ. So their
finite differences need a BSDF that samples with φ₀ and evaluates with φ.
"""

from __future__ import annotations

import mitsuba as mi


class Held(mi.BSDF):
    """Samples as the BSDF `sampled`, with its weights, and evaluates as `evaluated`."""

    def __init__(self, props):
        super().__init__(props)
        self.sampled, self.evaluated = props["sampled"], props["evaluated"]
        count = self.sampled.component_count()
        self.m_components = [self.sampled.flags(i) for i in range(count)]
        self.m_flags = self.sampled.flags()

    def sample(self, ctx, si, sample1, sample2, active=True):
        return self.sampled.sample(ctx, si, sample1, sample2, active)

    def eval(self, ctx, si, wo, active=True):
        return self.evaluated.eval(ctx, si, wo, active)

    def pdf(self, ctx, si, wo, active=True):
        return self.sampled.pdf(ctx, si, wo, active)

    def eval_pdf(self, ctx, si, wo, active=True):
        return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)
