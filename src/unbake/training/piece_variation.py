"""How much roughness varies within each piece of surface, as far as photographs tell (ours).

What differs within a piece is what its network, its brightnesses and the colours of the albedo say:
where photographs tell little, that is noise. Most pieces are of one material, and have one
roughness. So that is taken to be probable beforehand (`one_roughness`), and any part of what was
found as probable as any other. Errors of pixels tell how probable each part is afterwards, and the
mean over all parts has the least squared error.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ..config import RoughnessSearchConfig
from ..fields.arrays import from_numpy
from ..fields.field import Field
from ..ranks import Ranks
from .roughness_curves import Curves
from .seen_pieces import SeenPieces, normalized

#: Parts of the variation. Of the least one, which stands for none, all can be had back.
PARTS = np.array([1 / 64, *np.arange(1, 9) / 8])


def with_expected_variation(
    field: Field,
    curves: Curves,
    found: dict[str, Any],
    settings: RoughnessSearchConfig,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Let each piece vary as much as is to be expected of it.

    Args:
        field: of roughness.
        curves: of errors in units of their variance.
        found: numbers that points share, in the place of the field's; all of the variation.
        settings: how probable one roughness is, and how many pixels tell as much as one.
        ranks: that have a part of the curves each; None: there is one.

    Returns:
        What was found, with the numbers and factors of pieces changed, if they have factors.
    """
    seen = SeenPieces(field, curves, found, settings, ranks)
    (middle,) = seen.means([seen.outputs]).T
    here = middle[seen.piece_of]
    errors = seen.sums(seen.errors(here + x * (seen.outputs - here)) for x in PARTS)
    prior = np.full(len(PARTS), (1 - settings.one_roughness) / (len(PARTS) - 1))
    prior[0] = settings.one_roughness
    parts = normalized(seen.chances(errors) * prior) @ PARTS
    return found | _varied(field, found, seen, middle, parts)


def with_all_variation(
    field: Field, curves: Curves, settings: RoughnessSearchConfig, ranks: Ranks | None = None
) -> dict[str, Any]:
    """What a field has where earlier searches took nothing from what differs within pieces.

    Args and returns as of `with_expected_variation`; the field's own numbers are those found.
    """
    numbers = {key: field.parameters()[key] for key in field.shared()}
    seen = SeenPieces(field, curves, numbers, settings, ranks)
    (middle,) = seen.means([seen.outputs]).T
    return numbers | _varied(field, numbers, seen, middle, np.ones(len(middle)))


def _varied(
    field: Field, numbers: dict[str, Any], seen: SeenPieces, middle: np.ndarray, parts: np.ndarray
) -> dict[str, Any]:
    """The numbers with which outputs of pieces differ from a middle by a part of all there is."""
    before = dict(field.parameters())
    field.assign(before | numbers)
    about, factor = (from_numpy(mi.Float, x.astype(np.float32)) for x in (middle, parts))
    found = field.varied(seen.pieces, about, factor)
    field.assign(before)
    return found
