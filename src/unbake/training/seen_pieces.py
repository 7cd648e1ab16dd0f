"""The pieces of surface that photographs show, and sums over what a search has sampled of them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import RoughnessSearchConfig
from ..fields.arrays import from_numpy
from ..fields.domain import SurfacePoint
from ..fields.field import Field, holding
from ..fields.pieces import Piece
from ..ranks import Ranks

#: A value of the field is no nearer to its bounds.
_NEAREST = 1e-6
#: Probability that a curve is meaningless, for errors that no variance accounts for.
_ASTRAY = 1e-6


class SeenPieces:
    """Pieces, and the pixels that see them; pixels are those of this rank, pieces those of all.

    Args:
        field: with numbers of pieces.
        point: of each pixel.
        pieces: in the order of their numbers; at least those that pixels of any rank see.
        numbers: that points share, in the place of the field's.
        ranks: that have a part of the pixels each; None: there is one.
    """

    def __init__(
        self,
        field: Field,
        point: SurfacePoint,
        pieces: Piece,
        numbers: dict[str, Any],
        ranks: Ranks | None = None,
    ) -> None:
        self._field, self._numbers, self._ranks = field, numbers, ranks or Ranks()
        assert point.piece is not None
        #: Of the field at pixels, before their bounds, shape (outputs, n).
        self.outputs = self._outputs_at(point)
        # A number that pieces share cannot stand for a level of all of them where it counts more
        # for some than for others, and is left as it is.
        own, strengths = self._numbered(pieces), np.array(pieces.strength)
        present, first, of_own = np.unique(own, return_index=True, return_inverse=True)
        alike = np.bincount(of_own, strengths != strengths[first[of_own]]) == 0
        strengths = np.where(alike, strengths[first], 0)
        self.pieces = Piece(from_numpy(mi.UInt32, present), from_numpy(mi.Float, strengths))
        #: The piece of each pixel, from 0, shape (n,).
        self.piece_of = np.searchsorted(present, self._numbered(point.piece))
        #: The pixels of each piece, shape (pieces,).
        self.pixels = self.sums([np.ones(len(self.piece_of))])[:, 0]

    def sums(self, columns: Iterable[np.ndarray]) -> np.ndarray:
        """Sums over the pixels of each piece, shape (pieces, columns); columns have shape (n,)."""
        count = dr.width(self.pieces.number)
        own = np.stack([np.bincount(self.piece_of, column, count) for column in columns], 1)
        return self._ranks.size * self._ranks.mean(own)

    def means(self, columns: Iterable[np.ndarray]) -> np.ndarray:
        """Means over the pixels of each piece, 0 where there are none; see `sums`."""
        return self.sums(columns) / np.maximum(self.pixels, 1)[:, None]

    def middles(self, shown: SurfacePoint) -> np.ndarray:
        """Medians of outputs over what photographs show of each piece, shape (outputs, pieces).

        Args:
            shown: what any pixels of all ranks show. A piece that is not among them has the mean
                over its pixels instead.
        """
        found = self.medians(shown, self._outputs_at(shown))
        return np.where(np.isnan(found), self.means(self.outputs).T, found)

    def medians(self, shown: SurfacePoint, columns: Iterable[np.ndarray]) -> np.ndarray:
        """Medians over what photographs show of each piece, shape (columns, pieces).

        Args:
            shown: as of `middles`. A piece that is not among them has NaN.
            columns: of each of them, shape (n,).
        """
        assert shown.piece is not None
        present, number = np.array(self.pieces.number), self._numbered(shown.piece)
        at = np.minimum(np.searchsorted(present, number), len(present) - 1)
        known = present[at] == number
        return np.stack([_medians(column[known], at[known], len(present)) for column in columns])

    def _numbered(self, pieces: Piece) -> np.ndarray:
        """The numbers of the field that are of pieces: the smallest may share the last one."""
        return np.minimum(pieces.number, self._field.most_pieces - 1)

    def _outputs_at(self, point: SurfacePoint) -> np.ndarray:
        """Outputs of the field before their bounds, shape (outputs, n)."""
        with holding(self._field, self._numbers):
            values = self._field.evaluate(point)
        return outputs_of(np.stack([np.array(x, float) for x in values]))

    def raised(self, by: np.ndarray) -> dict[str, Any]:
        """See `Field.raised`; shape (pieces,)."""
        with holding(self._field, self._numbers):
            return self._field.raised(self.pieces, _of_field(by))

    def varied(self, about: np.ndarray, factor: np.ndarray) -> dict[str, Any]:
        """See `Field.varied`; of shapes (outputs, pieces) and (pieces,)."""
        levels = [_of_field(level) for level in about]
        with holding(self._field, self._numbers):
            return self._field.varied(self.pieces, levels, _of_field(factor))


def differ_by_place(numbers: dict[str, Any]) -> bool:
    """Whether any piece has numbers by place, among those of a field of roughness."""
    return "placed" in numbers and bool(dr.any(numbers["placed"] > 0))


def _medians(values: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """The median of values (n,) in each group, from 0; NaN where there is none."""
    ordered = np.append(values[np.lexsort((values, group))], np.nan)
    size = np.bincount(group, minlength=count)
    end = np.cumsum(size)
    low, high = end - size + (size - 1) // 2, end - size + size // 2
    middle = (ordered[low] + ordered[high]) / 2
    return np.where(size > 0, middle, np.nan)


def _of_field(values: np.ndarray) -> mi.Float:
    return from_numpy(mi.Float, values.astype(np.float32))


def chances(errors: np.ndarray, pixels: np.ndarray, settings: RoughnessSearchConfig) -> np.ndarray:
    """How probable photographs are where pieces have errors, as a multiple of the highest.

    Errors of neighbouring pixels have a part in common, and those of L_θ all pixels of a piece.

    Args:
        errors: of all pixels of each piece, in units of their variance, for each of some
            possibilities, shape (pieces, possibilities).
        pixels: of each piece, shape (pieces,).
        settings: how many pixels tell as much as one.
    """
    above = errors - errors.min(1, keepdims=True)
    return np.exp(-above / (2 * as_one(pixels, settings)[:, None])) + _ASTRAY


def as_one(pixels: np.ndarray, settings: RoughnessSearchConfig) -> np.ndarray:
    """How many pixels of each piece tell as much as one would by itself, shape (pieces,).

    Args:
        pixels, settings: as of `chances`.
    """
    found = np.full(len(pixels), settings.pixels_as_one)
    if settings.pixels_at_most:
        found = np.maximum(found, pixels / settings.pixels_at_most)
    return found


def normalized(distributions: np.ndarray) -> np.ndarray:
    """Distributions, one a row, with the sum 1; an even one where all is zero."""
    positive = np.maximum(distributions, 0) + 1e-30
    return positive / positive.sum(1, keepdims=True)


def outputs_of(values: np.ndarray) -> np.ndarray:
    """Outputs of a field before their bounds, of values between 0 and 1."""
    inside = np.clip(values, _NEAREST, 1 - _NEAREST)
    return np.log(inside / (1 - inside))


def values_of(outputs: np.ndarray) -> np.ndarray:
    """Values between 0 and 1, of outputs of a field before their bounds."""
    return 1 / (1 + np.exp(-outputs))
