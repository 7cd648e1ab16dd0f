"""The objective: the sum of a method's terms (Sec. 4.1)."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from .loss import RelativeL2
from .methods import Attached
from .path_sample import PathSample, Requirements
from .terms import TermInputs, term_named


def requirements(terms: Mapping[str, Attached], bounces: int = 1) -> Requirements:
    """What a method's path samples must hold, with k bounces of the image.

    Raises:
        UserError: there is no such term, or it has not all the edges that are attached.
    """
    residuals, attached, constant = 0, set(), set()
    differentiable: set[int] = set()
    image_attached = False
    for name, edges in terms.items():
        term = term_named(name)
        term.check(edges)
        if term.of_image:
            image_attached |= edges.rhs
            continue
        for numbers, live in ((term.lhs, edges.lhs), (term.rhs, edges.rhs)):
            (attached if live else constant).update(numbers)
        if edges.scene:
            differentiable |= set(term.scene)
        residuals = max((residuals, *term.scene, *(n - 1 for n in (*term.lhs, *term.rhs))))
    return Requirements(
        bounces,
        residuals,
        frozenset(attached),
        frozenset(constant - attached),
        image_attached,
        frozenset(differentiable),
    )


def objective(
    terms: Mapping[str, Attached],
    sample: PathSample,
    target: mi.Color3f,
    loss: RelativeL2,
    primal: mi.Color3f | None = None,
    bounces: int = 1,
) -> dict[str, mi.Float]:
    """Every term of the objective; their sum is what is minimised.

    Args:
        terms: of a `Method`.
        sample: path samples, as many consecutive lanes for each pixel; those that L_θ learns of,
            too.
        target: the photographs' pixels, linear RGB.
        loss: what errors are relative to.
        primal: an independent, detached estimate of the same pixels for the two-pass estimator;
            None: the split-halves estimator.
        bounces: k, after which the image takes L_θ.

    Paper: Eq. 5, Eq. 11, Eq. 14, Sec. 4.1.
    """
    values: dict[str, mi.Float] = {}
    for name, attached in terms.items():
        term = term_named(name)
        paths = sample if term.of_image else (sample.learned or sample)
        values[name] = term.value(
            TermInputs(
                paths if attached.scene else dr.detach(paths),
                [L if attached.lhs else dr.detach(L) for L in paths.radiance],
                [L if attached.rhs else dr.detach(L) for L in paths.radiance],
                target,
                loss,
                primal if term.of_image else None,
                bounces,
            )
        )
    return values
