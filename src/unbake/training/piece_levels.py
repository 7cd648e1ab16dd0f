"""The roughness that is to be expected of each piece of surface, by empirical Bayes (ours).

A descent ends at the most probable numbers. Photographs tell next to nothing of a small matt piece:
its curve is nearly flat, and noise decides where it is least. The mean over all roughnesses, each
as often as it is probable, has the least squared error there. How probable they are before any
photograph is seen, the pieces tell: many are of few materials, and those of like colours more
often of one. So the distribution is found together with them, about as the one under which what
photographs show is most probable (nonparametric maximum likelihood, Laird 1978; by expectation
maximization with smoothing, Silverman et al. 1990). For each piece it is that of the others: a
piece by itself would confirm its own noise. It would do so through the others, too: for pieces that
are odd it is found once more, without them. A piece may also be of a material that no other one is
of, with any level: the fewer others there are, the more probable that is, as in a Dirichlet process
(Ferguson 1973). A piece that no pixel shows by itself has no curve: it goes to what is to be
expected of its colour.

Each piece moves as a whole: how its roughness varies with brightness and place stays as it is.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import RoughnessSearchConfig
from ..fields.arrays import from_numpy
from ..fields.domain import SurfacePoint
from ..fields.field import Field
from ..ranks import Ranks
from .roughness_curves import NODES, Curves, in_range, of_roughness
from .seen_pieces import SeenPieces, chances, normalized, values_of

#: By how much pieces are moved on trial, in units of the field's outputs before their bounds.
SHIFTS = np.linspace(-5, 5, 61)
#: The levels that a distribution knows, as values of the field: where curves are known.
LEVELS = np.linspace(of_roughness(NODES[0]), of_roughness(NODES[-1]), 48)
#: So many pieces of a like colour count as much as what all pieces have in common.
_AS_MANY = 1.0
#: And so many count as much as that a piece is of a material of its own, of any level.
_NEW = 0.25
#: Steps of expectation maximization.
_STEPS = 40
#: A piece is odd if what it shows is less probable than this, by what the others show, as a part of
#: the most that it could be; and so many are looked at, those that are the most odd.
_ODD, _MOST_ODD = 0.5, 32
#: Weights by which neighbouring levels are mixed.
_MIXED = (0.25, 0.5, 0.25)


def with_expected_levels(
    field: Field,
    curves: Curves,
    found: dict[str, Any],
    settings: RoughnessSearchConfig,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Move each piece to the roughness that is to be expected of it.

    Args:
        field: of roughness, with numbers of pieces.
        curves: of errors in units of their variance.
        found: numbers that points share, in the place of the field's.
        settings: how many pixels tell as much as one, and which colours are alike.
        ranks: that have a part of the curves each; None: there is one.

    Returns:
        What was found, with the numbers of pieces moved.
    """
    seen = SeenPieces(field, curves.point, curves.pieces, found, ranks)
    (outputs,) = seen.outputs
    error = seen.sums(errors_of(curves, outputs + shift) for shift in SHIFTS)
    value = seen.means(values_of(outputs + shift) for shift in SHIFTS)
    colours = seen.means(_brightness(curves.point))
    without = seen.pixels == 0
    if without.any():
        (middle,) = seen.middles(curves.shown)
        value[without] = values_of(middle[without, None] + SHIFTS)
        colours[without] = seen.medians(curves.shown, _brightness(curves.shown)).T[without]
    levels = np.stack([np.interp(LEVELS, x, y) for x, y in zip(value, error, strict=True)])
    wanted = expected(levels, seen.pixels, colours, settings)
    by = np.array([np.interp(level, x, SHIFTS) for level, x in zip(wanted, value, strict=True)])
    # Curves know nothing of what is smoother than their first node or rougher than their last one:
    # it stays as it is.
    now = value[:, len(SHIFTS) // 2]
    by[(now < LEVELS[0]) & (wanted < LEVELS[2])] = 0
    by[(now > LEVELS[-1]) & (wanted > LEVELS[-3])] = 0
    return found | seen.raised(by)


def _brightness(point: SurfacePoint) -> np.ndarray:
    """Square roots of the albedo at points, shape (3, n); 0 where it is known."""
    assert point.piece is not None
    if point.albedo is None:
        return np.zeros((3, dr.width(point.piece.number)))
    return np.sqrt(np.clip(np.array(point.albedo), 0, 1))


def errors_of(curves: Curves, outputs: np.ndarray) -> np.ndarray:
    """The errors of pixels with other outputs of the field before their bounds, both (n,)."""
    values = from_numpy(mi.Float, values_of(outputs).astype(np.float32))
    return curves.at(in_range([values])).numpy()


def expected(
    errors: np.ndarray, pixels: np.ndarray, colours: np.ndarray, settings: RoughnessSearchConfig
) -> np.ndarray:
    """The levels that are to be expected of pieces.

    Args:
        errors: sums of the squared errors of each piece, in units of their variance, at each of
            `LEVELS`, shape (pieces, levels).
        pixels: of each piece, shape (pieces,); some have none, and no errors.
        colours: the mean of the square roots of albedo, linear RGB, shape (pieces, 3).
        settings: how many pixels tell as much as one, and which colours are alike.

    Returns:
        Between 0 and 1, shape (pieces,).
    """
    chance = chances(errors, pixels, settings)
    # Pieces of one cell of colours are alike, and those of near cells are by their distance.
    cell = np.floor(colours / (settings.like_colours / 2))
    kinds, kind = np.unique(cell, axis=0, return_inverse=True)
    kind = kind.ravel()
    square = (kinds**2).sum(1)
    near = np.exp((2 * kinds @ kinds.T - square[:, None] - square) / 8).astype(np.float32)
    # Large pieces tell more of what there is, but each is one piece of one material.
    weight = np.sqrt(pixels)
    weight = weight / weight[pixels > 0].mean()
    prior = _prior(chance, weight, near, kind)
    # What an odd piece tells the others they tell each other, and then it: so it is left out.
    usual = (chance * prior).sum(1) / chance.max(1)
    seen = np.flatnonzero(pixels > 0)
    of_seen, kind = np.unique(kind[seen], return_inverse=True)
    near = near[np.ix_(of_seen, of_seen)]
    order = np.argsort(usual[seen], kind="stable")
    for number in order[usual[seen][order] < _ODD][:_MOST_ODD]:
        others = weight[seen]
        others[number] = 0
        prior[seen[number]] = _prior(chance[seen], others, near, kind)[number]
    return normalized(chance * prior) @ LEVELS


def _prior(
    chance: np.ndarray, weight: np.ndarray, near: np.ndarray, kind: np.ndarray
) -> np.ndarray:
    """How probable levels of each piece are by what the others show.

    Args:
        chance: of photographs at each of `LEVELS`, shape (pieces, levels).
        weight: of what each piece tells the others, shape (pieces,); some tell nothing.
        near: how much alike kinds of colours are, shape (kinds, kinds).
        kind: of each piece, shape (pieces,).
    """
    telling = np.flatnonzero(weight)
    own = np.zeros_like(chance)
    prior = np.ones_like(chance)
    for step in range(_STEPS):
        last = step == _STEPS - 1  # that is the one of all pieces
        wanted = slice(None) if last else telling
        probable = normalized(chance[telling] * prior[telling])
        own[telling] = weight[telling, None] * _mixed(probable)
        of_kinds = np.zeros((len(near), len(LEVELS)), np.float32)
        np.add.at(of_kinds, kind[telling], own[telling].astype(np.float32))
        of_others = own[telling].sum(0) - own[wanted]
        found = (near @ of_kinds)[kind[wanted]] - own[wanted] + _AS_MANY * normalized(of_others)
        prior[wanted] = normalized(np.maximum(found, 0) + _NEW / len(LEVELS))
    return prior


def _mixed(distributions: np.ndarray) -> np.ndarray:
    """Distributions, one a row, with neighbouring levels mixed."""
    padded = np.pad(distributions, ((0, 0), (1, 1)), mode="edge")
    a, b, c = _MIXED
    return a * padded[:, :-2] + b * padded[:, 1:-1] + c * padded[:, 2:]
