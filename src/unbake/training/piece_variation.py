"""How much materials vary within each piece of surface, as far as photographs tell (ours).

What differs within a piece is what a network, brightnesses and colours of the albedo say of it:
where photographs tell little, that is noise. Most pieces are of one material. So it is taken to be
probable beforehand that one has one roughness, or one albedo (`one_roughness`, `one_albedo`), and
any larger part of what was found is as probable as any other. Errors of pixels tell how probable
each part is afterwards. The mean over all parts has the least squared error, of outputs before
their bounds.

A piece varies about its median over any pixels that show it. A search can use those alone that show
nothing else, which of a leaf are its broad parts: towards their mean the whole leaf would go. What
is astray at edges moves a mean, but no median.

What varies was fitted to the same photographs, noise included, albedo more so than roughness: so
they ask for more than there is. What is taken away is that of which even they show nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..config import RoughnessSearchConfig
from ..fields.field import Field
from ..ranks import Ranks
from .piece_levels import errors_of
from .roughness_curves import Curves, albedo_errors, pieces_of, points
from .seen_pieces import SeenPieces, chances, differ_by_place, normalized, values_of

#: Parts of the variation. Of the least one, which stands for none, all can be had back.
PARTS = np.array([1 / 64, *np.arange(1, 9) / 8])
#: By how much levels may move where something differs by place, of outputs before their bounds.
SHIFTS = np.arange(-4, 5) / 5
#: The same of albedo, of what it has by now: steps go on to learn it, its level by what is left.
ALBEDO_PARTS = np.arange(1, 9) / 8
#: A piece whose albedo has less of its variation keeps that: two searches have taken away the rest,
#: and others, of a fit that was made longer, know no more of it.
_LITTLE = 0.99 * ALBEDO_PARTS[0]


def with_expected_variation(
    field: Field,
    curves: Curves,
    found: dict[str, Any],
    settings: RoughnessSearchConfig,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Let each piece vary in its roughness as much as is to be expected of it.

    Args and returns as of `with_expected_levels`. What was found has all of the variation; it stays
    where pieces have no factors.
    """
    if "variation" not in found:
        return found
    everywhere = found | field.placed(())
    seen = SeenPieces(field, curves.point, curves.pieces, everywhere, ranks)
    (outputs,), about = seen.outputs, seen.middles(curves.shown)
    here, apart, shifts = about[0, seen.piece_of], 0.0, np.zeros(1)
    # No factor is of what differs from place to place. That may stand for what is taken away: each
    # part counts with the level that suits it, to which pieces are moved later on.
    if differ_by_place(found):
        apart = SeenPieces(field, curves.point, curves.pieces, found, ranks).outputs[0] - outputs
        shifts = SHIFTS
    varied = (here + part * (outputs - here) + apart for part in PARTS)
    errors = seen.sums(errors_of(curves, x + shift) for x in varied for shift in shifts)
    best = errors.reshape(-1, len(PARTS), len(shifts)).min(2)
    parts = _expected(seen, best, PARTS, settings.one_roughness, settings)
    return found | seen.varied(about, parts)


def with_all_variation(field: Field, curves: Curves, ranks: Ranks | None = None) -> dict[str, Any]:
    """The numbers of pieces, as if no search had taken anything from what differs.

    Nothing differs from place to place.

    Args:
        field: of roughness.
        curves: of the pieces that are asked for.
        ranks: that have a part of the curves each; None: there is one.
    """
    numbers = {key: field.parameters()[key] for key in field.shared()} | field.placed(())
    if "variation" not in numbers:
        return numbers
    seen = SeenPieces(field, curves.point, curves.pieces, numbers, ranks)
    return numbers | seen.varied(seen.middles(curves.shown), np.ones(len(seen.pixels)))


def expected_albedo(
    field: Field,
    rows: np.ndarray,
    roughness: np.ndarray,
    settings: RoughnessSearchConfig,
    shown: np.ndarray | None = None,
) -> dict[str, Any]:
    """Let each piece vary in its albedo as much as is to be expected of it, about its median.

    Another search takes its part of what is left, down to a 64th of all.

    Args:
        field: of albedo.
        rows: of `row_type`, whose weights are inverse variances, from all ranks.
        roughness: of these pixels, shape (n,).
        settings: how probable one albedo is, and how many pixels tell as much as one.
        shown: what any pixels show, of `PLACE`; None: that of the rows.

    Returns:
        The numbers and factors of pieces that change; none where pieces have no factors.
    """
    factors = field.parameters().get("variation")
    if factors is None:
        return {}
    seen = SeenPieces(field, points(rows, albedo=False), pieces_of(rows), {})
    about = seen.middles(points(rows if shown is None else shown, albedo=False))
    here = about[:, seen.piece_of]
    errors = (
        albedo_errors(rows, roughness, values_of(here + part * (seen.outputs - here)).T)
        for part in ALBEDO_PARTS
    )
    parts = _expected(seen, seen.sums(errors), ALBEDO_PARTS, settings.one_albedo, settings)
    present = np.array(factors)[np.array(seen.pieces.number)]
    return seen.varied(about, np.where(present < _LITTLE, present, parts * present))


def _expected(
    seen: SeenPieces,
    errors: np.ndarray,
    parts: np.ndarray,
    none: float,
    settings: RoughnessSearchConfig,
) -> np.ndarray:
    """The part of its variation that is to be expected of each piece, shape (pieces,).

    Args:
        errors: of pieces with each part, shape (pieces, parts).
        none: how probable the first part is beforehand.
        settings: how many pixels tell as much as one.
    """
    prior = np.full(len(parts), (1 - none) / (len(parts) - 1))
    prior[0] = none
    return normalized(chances(errors, seen.pixels, settings) * prior) @ parts
