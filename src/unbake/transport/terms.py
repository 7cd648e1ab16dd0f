"""The terms of the objective: the parts of a path sample that each reads, and its value.

A term of your own is a `Term` given to `register_term`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import drjit as dr
import mitsuba as mi

from ..errors import UserError, require_name
from .loss import RelativeL2
from .methods import EXTRA, LHS, PHOTOMETRIC, PRIOR, PRIOR_PAIR, Attached
from .path_sample import PathSample, lhs, rhs
from .prior import residual, residual_norm

#: Numbers that stand beside the terms in a line of the log: no term may have such a name.
LOGGED = frozenset(
    [
        *("step", "seconds", "samples", "samples_per_second", "memory_mb", "learning_rate"),
        *("skipped", "held_aside", "guide"),
    ]
)


@dataclass(frozen=True)
class TermInputs:
    """The inputs of a term's value; those that the method does not attach are constants.

    Args:
        sample: path samples, `spp` consecutive lanes a pixel.
        lhs: L_θ at x₁, x₂, … on left-hand sides, linear RGB; zero where no term reads it.
        rhs: the same on right-hand sides.
        target: pixels of the photographs, linear RGB, one lane a pixel.
        loss: the relative L2 loss.
        primal: an independent, detached estimate of the same pixels for the two-pass estimator;
            None: one of a single pass. For terms of the image alone.
        bounces: k, after which the image takes L_θ.
        pair_rhs: as `rhs`, on `sample.pair`; empty where the method has no term that reads it.
    """

    sample: PathSample
    lhs: list[mi.Color3f]
    rhs: list[mi.Color3f]
    target: mi.Color3f
    loss: RelativeL2
    primal: mi.Color3f | None
    bounces: int
    pair_rhs: list[mi.Color3f] = field(default_factory=list)

    @property
    def spp(self) -> int:
        """Lanes of the path samples a pixel."""
        return dr.width(self.sample.x1.valid) // dr.width(self.target)


@dataclass(frozen=True)
class Term:
    """A term of the objective.

    Vertices are given by number: 1 is x₁. Only the pieces that a term lists are computed for it and
    can be attached.

    Args:
        name: of methods' tables and of the log.
        value: the term's value, one lane; smaller is better.
        scene: vertices at which it reads how light scatters.
        lhs: vertices at which it reads L_θ for a left-hand side.
        rhs: vertices at which it reads L_θ for a right-hand side.
        of_image: whether it reads the image: all camera samples, of k bounces and L_θ at the vertex
            after those. All other terms read the samples that L_θ learns from.
        title: of its curve in reports; empty: its name.
        pair: whether it reads a second, independent bounce from x₁ (`TermInputs.sample.pair`).
    """

    name: str
    value: Callable[[TermInputs], mi.Float]
    scene: tuple[int, ...] = ()
    lhs: tuple[int, ...] = ()
    rhs: tuple[int, ...] = ()
    of_image: bool = False
    title: str = ""
    pair: bool = False

    def __post_init__(self) -> None:
        if self.name in LOGGED:
            raise ValueError(f"{self.name} is a number of the log: a term cannot have its name")
        if self.of_image and (self.scene or self.lhs or self.rhs or self.pair):
            raise ValueError(f"{self.name}: a term of the image has no vertices of its own")
        if min((*self.scene, *self.lhs, *self.rhs, 1)) < 1:
            raise ValueError(f"{self.name}: vertices are numbered from 1")

    def check(self, attached: Attached) -> None:
        """Check that the term reads each attached input: one that it does not read trains nothing.

        Raises:
            UserError: it lacks one.
        """
        for flag in ("scene", "lhs", "rhs"):
            has = flag != "lhs" if self.of_image else getattr(self, flag)
            if getattr(attached, flag) and not has:
                raise UserError(f"the term {self.name} has no {flag} that could be attached")


_TERMS: dict[str, Term] = {}
#: All terms by name.
TERMS: Mapping[str, Term] = MappingProxyType(_TERMS)


def register_term(term: Term) -> Term:
    """Add a term to the table; methods may name it from then on.

    Raises:
        ValueError: there is another term of this name.
    """
    if TERMS.get(term.name, term) != term:
        raise ValueError(f"there is another term named {term.name}")
    _TERMS[term.name] = term
    return term


def term_named(name: str) -> Term:
    """The term of this name.

    Raises:
        UserError: there is none.
    """
    require_name(name, TERMS, "term")
    return TERMS[name]


def photometric(x: TermInputs) -> mi.Float:
    """The squared error of the image.

    Paper: Eq. 5, Eq. 12.
    """
    pixels = rhs(x.sample, x.rhs[x.bounces], x.bounces)
    return x.loss.error(pixels, x.target, x.spp, x.primal)


def prior(x: TermInputs) -> mi.Float:
    """The squared residual at x₁, of one sample of T(L_θ).

    Its expectation is the squared residual plus the variance of the sample of T(L_θ). With the
    scene and the right-hand side detached, as in `ours`, the variance is a constant and the
    gradient is unbiased. With the scene attached the gradient has that of the variance in it,
    which pulls materials and lights to where paths are less noisy; see `prior_pair`.

    Paper: Eq. 10, Sec. 5.2.
    """
    return residual_norm(residual(x.sample, 1, x.lhs[0], x.rhs[1]), x.lhs[0], x.loss.epsilon)


def prior_pair(x: TermInputs) -> mi.Float:
    """The squared residual at x₁, as the product of two residuals.

    Each has a sample of T(L_θ) of its own. These are independent, so that the expectation is the
    square of the expected residual, and its gradients are unbiased whichever edges are attached.
    The value of few samples can be negative.

    Paper: Eq. 10, Sec. 5.2.
    """
    assert x.sample.pair is not None
    first = residual(x.sample, 1, x.lhs[0], x.rhs[1])
    second = residual(x.sample.pair, 1, x.lhs[0], x.pair_rhs[1])
    return residual_norm(first, x.lhs[0], x.loss.epsilon, second)


def prior_extra(x: TermInputs) -> mi.Float:
    """The residual at x₂.

    Paper: Eq. 10, Sec. 4.2.
    """
    return residual_norm(residual(x.sample, 2, x.lhs[1], x.rhs[2]), x.lhs[1], x.loss.epsilon)


def lhs_loss(x: TermInputs) -> mi.Float:
    """The squared error of the radiance field seen directly.

    L_θ is scene radiance. The camera's unknowns are constants here: only the photometric term
    trains them.

    Paper: Eq. 14, Sec. 4.3.
    """
    pixels, target = lhs(x.sample, x.lhs[0]), dr.detach(x.target)
    return x.loss.of_known_camera().error(pixels, target, x.spp)


for _term in (
    Term(PHOTOMETRIC, photometric, of_image=True, title="Photometric loss"),
    Term(PRIOR, prior, scene=(1,), lhs=(1,), rhs=(2,), title="Prior loss"),
    Term(
        PRIOR_PAIR,
        prior_pair,
        scene=(1,),
        lhs=(1,),
        rhs=(2,),
        title="Prior loss, of two samples",
        pair=True,
    ),
    Term(EXTRA, prior_extra, scene=(2,), lhs=(2,), rhs=(3,), title="Prior loss, extra bounce"),
    Term(LHS, lhs_loss, lhs=(1,), title="LHS loss"),
):
    register_term(_term)
