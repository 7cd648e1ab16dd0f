"""The objective: the sum of a method's terms (Sec. 4.1)."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi

from .loss import RelativeL2
from .methods import Attached, Method
from .path_sample import PathSample, Requirements
from .terms import TermInputs, term_named


def requirements(terms: Mapping[str, Attached], bounces: int = 1) -> Requirements:
    """The pieces of path samples that a method's terms read, with k bounces of the image.

    Raises:
        UserError: a term does not exist, or lacks an edge that is attached.
    """
    residuals, attached, constant = 0, set(), set()
    differentiable: set[int] = set()
    image_attached = pair = pair_attached = False
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
        pair |= term.pair
        pair_attached |= term.pair and edges.rhs
        residuals = max((residuals, *term.scene, *(n - 1 for n in (*term.lhs, *term.rhs))))
    return Requirements(
        bounces,
        residuals,
        frozenset(attached),
        frozenset(constant - attached),
        image_attached,
        frozenset(differentiable),
        pair,
        pair_attached,
    )


def has_radiance(method: Method) -> bool:
    """Whether a method has an L_θ: whether one of its terms reads or trains it.

    Raises:
        UserError: a term does not exist, or lacks an edge that is attached.
    """
    return requirements(method.terms).radiance


def objective(
    terms: Mapping[str, Attached],
    sample: PathSample,
    target: mi.Color3f,
    loss: RelativeL2,
    primal: mi.Color3f | None = None,
    bounces: int = 1,
) -> dict[str, mi.Float]:
    """The terms of the objective by name; a fit minimises their sum.

    Args:
        terms: of a `Method`.
        sample: path samples, the same number of consecutive lanes for each pixel.
        target: pixels of the photographs, linear RGB, one lane a pixel.
        loss: the relative L2 loss.
        primal: an independent, detached estimate of the same pixels for the two-pass estimator;
            None: one of a single pass.
        bounces: k, after which the image takes L_θ.

    Paper: Eq. 5, Eq. 11, Eq. 14, Sec. 4.1.
    """
    values: dict[str, mi.Float] = {}
    for name, attached in terms.items():
        term = term_named(name)
        paths = sample if term.of_image else (sample.learned or sample)
        pair = paths.pair.radiance if paths.pair is not None else []
        values[name] = term.value(
            TermInputs(
                paths if attached.scene else dr.detach(paths),
                [L if attached.lhs else dr.detach(L) for L in paths.radiance],
                [L if attached.rhs else dr.detach(L) for L in paths.radiance],
                target,
                loss,
                primal if term.of_image else None,
                bounces,
                [L if attached.rhs else dr.detach(L) for L in pair],
            )
        )
    return values
