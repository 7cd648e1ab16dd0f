"""What differs in roughness from place to place on a piece of surface (ours).

Most pieces have one roughness, or one for each of their colours. Where a texture of roughness has
a pattern of its own, photographs tell it in patches of many pixels. So after a descent each piece
gets numbers on lattices over the scene's cube: those that are most probable where they are expected
to differ by some spread, and less on finer lattices. Or roughness goes gently from one end of a
piece to the other. Many pixels tell such a change by few numbers: those at the corners of a cube
around the piece. Both kinds are sought beside what the descent has found, and beside its mean over
the piece: colours have taken up what they could of the pattern.

Noise of the photographs looks like such a pattern, too. So the pixels are dealt into two halves,
and what one half says of a piece, in each way and with each spread, is asked of the other one, and
held against no change and against one shift of the whole piece, beside either of the two, whichever
is best. A pixel that was drawn twice is in one half, with the noise of its photograph; factors of
albedo are of each half by itself. With this evidence, and with `no_places`, follows how probable
each of them is, and the numbers that are to be expected. Few pieces need numbers; the others have
none.

Within a patch roughness may be what it is in no other one, and albedo has adapted to it: so it has
its factors in smaller cells here than for the descent (`place_cells`).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import RoughnessSearchConfig
from ..fields.arrays import from_numpy
from ..fields.field import Field, PlaceNumbers
from ..fields.settings import PLACES_LOG2
from .piece_levels import errors_of
from .roughness_curves import Curves, cubic, pieces_of, points
from .seen_pieces import SeenPieces, as_one, chances, normalized

#: By how much outputs before their bounds are changed on trial.
SHIFTS = np.linspace(-3, 3, 25)
#: How much numbers of the coarsest lattice are expected to differ, and those of each further one,
#: as a part of that of the one before.
SPREADS, _FINER = np.array([0.25, 0.6, 1.5]), 0.6
#: Cells along the cube, in each of which pixels of a piece are taken together.
_CELLS = 32
#: A smaller piece, by the edge of the cube around it, has one roughness from end to end.
_LEAST_SIZE = 1 / 8
#: Corners of a cell.
_CORNERS = np.array(list(product((0, 1), repeat=3)))
#: Steps of Adam, their rate, and the part of it that is left at the end.
_STEPS, _RATE, _FINAL_RATE = 60, 0.2, 0.05
#: Pieces whose numbers are less probable than that have none.
_SURE = 0.01
#: Corners that have numbers, at most: of more, some would share a place in the table.
_MOST_CORNERS = 1 << (PLACES_LOG2 - 4)
#: Tells the halves from other random numbers.
_SEED = 0x504C4143


def expected_places(
    field: Field,
    rows: np.ndarray,
    found: dict[str, Any],
    settings: RoughnessSearchConfig,
    *,
    albedo: bool,
) -> dict[str, Any]:
    """What is to differ in roughness from place to place, as far as photographs tell.

    Args:
        field: of roughness, with numbers of pieces.
        rows: of `row_type`, whose weights are inverse variances, from all ranks.
        found: numbers that points share, in the place of the field's; none differs by place yet.
        settings: how probable that is, and how many pixels tell as much as one.
        albedo: whether it is unknown.

    Returns:
        Of `Field.placed`.
    """
    if not field.place_cells or not len(rows):
        return field.placed(())
    first = _first_half(rows)
    if first.all() or not first.any():
        return field.placed(())
    seen = SeenPieces(field, points(rows, albedo), pieces_of(rows), found)
    (outputs,) = seen.outputs
    where = rows["position"].astype(np.float64)
    cells = _Cells.of(seen.piece_of, where, field.place_cells)
    # Factors of albedo are of each half by itself, or one would know of the other.
    parts = [
        (chosen, Curves.of(rows[chosen], settings.place_cells, settings.colours, albedo))
        for chosen in (first, ~first, np.ones_like(first))
    ]
    bases = [outputs]
    if "variation" in found:  # what is beside the mean can be taken away
        bases.append(cells.means(outputs))
    numbers, changes = cells.told(parts, bases, as_one(seen.pixels, settings))
    prior = np.full(1 + changes.shape[1], (1 - settings.no_places) / changes.shape[1])
    prior[0] = settings.no_places
    evidence = np.concatenate([np.zeros((len(changes), 1)), changes], 1)  # in units of `as_one`
    probable = normalized(chances(evidence, seen.pixels, settings) * prior)[:, 1:]
    # A number that pieces share stands for none of them.
    sure = (probable.sum(1) > _SURE) & (np.array(seen.pieces.strength) > 0)
    sure &= cells.fitting(np.where(sure, changes.min(1), np.inf))
    if not sure.any():
        return field.placed(())
    number = np.array(seen.pieces.number)
    expected = [
        (probable[lattice.piece] * values.T).sum(1)
        for lattice, values in zip(cells.lattices, numbers, strict=True)
    ]
    told = zip(cells.lattices, expected, strict=True)
    return field.placed([lattice.told(values, number, sure) for lattice, values in told])


def _first_half(rows: np.ndarray) -> np.ndarray:
    """Whether pixels are of the first of two random halves, shape (n,).

    A pixel is known by its photograph: drawn twice, it is in the same half.
    """
    pixels, of_pixel = np.unique(rows["target"], axis=0, return_inverse=True)
    return np.random.default_rng(_SEED).random(len(pixels))[of_pixel.ravel()] < 1 / 2


def _shares(part: np.ndarray) -> np.ndarray:
    """How much each corner of a cell has of points in it (n, 3), from 0 to 1, shape (n, 8)."""
    return np.where(_CORNERS, part[:, None], 1 - part[:, None]).prod(2)


def _at(table: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Rows of a table (cells, shifts) at shifts (…, cells), linear between `SHIFTS`."""
    place = np.clip((shift - SHIFTS[0]) / (SHIFTS[1] - SHIFTS[0]), 0, len(SHIFTS) - 1)
    left = np.minimum(place.astype(int), len(SHIFTS) - 2)
    rows = np.arange(len(table))
    low, high = table[rows, left], table[rows, left + 1]
    return low + (place - left) * (high - low)


@dataclass(frozen=True)
class _Lattice:
    """The corners of a lattice of so many cells along the cube that cells of pieces are between.

    `piece` and `corner` are of each corner; `place` and `share`, both (cells, 8), tell by which
    corners a cell is, and how much of each it has.
    """

    cells: int
    piece: np.ndarray
    corner: np.ndarray
    place: np.ndarray
    share: np.ndarray

    @staticmethod
    def of(piece: np.ndarray, where: np.ndarray, cells: int) -> _Lattice:
        """That of cells of pieces (n,) at points of the unit cube (n, 3)."""
        at = np.clip(where, 0, 1) * cells
        below = np.minimum(np.floor(at), cells - 1)
        part = at - below
        keys = [
            np.concatenate([piece[:, None], below + offset], 1).astype(np.int64)
            for offset in _CORNERS
        ]
        every, place = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
        place = place.reshape(len(keys), -1).T
        return _Lattice(cells, every[:, 0], every[:, 1:], place, _shares(part))

    def told(self, values: np.ndarray, number: np.ndarray, chosen: np.ndarray) -> PlaceNumbers:
        """Numbers of its corners (n,), of the chosen pieces, for `Field.placed`.

        Args:
            number: of each piece in the field.
            chosen: whether a piece has numbers.
        """
        here = chosen[self.piece]
        corner = [from_numpy(mi.UInt32, x.astype(np.uint32)) for x in self.corner[here].T]
        of_piece = from_numpy(mi.UInt32, number[self.piece[here]].astype(np.uint32))
        one = from_numpy(mi.Float, values[here].astype(np.float32))
        return PlaceNumbers(of_piece, mi.Point3u(corner), [one])


@dataclass(frozen=True)
class _Cells:
    """Cells of pieces, in each of which pixels are taken together.

    Args:
        piece: of each cell, from 0.
        of_pixel: the cell of each pixel.
        lattices: of the field, coarsest first.
        around: the corners of a cube around each piece.
        low, size: where that cube is, shape (pieces, 3), and how large, shape (pieces, 1).
    """

    piece: np.ndarray
    of_pixel: np.ndarray
    lattices: list[_Lattice]
    around: _Lattice
    low: np.ndarray
    size: np.ndarray

    @staticmethod
    def of(piece: np.ndarray, where: np.ndarray, lattices: tuple[int, ...]) -> _Cells:
        """Those of pixels of pieces (n,) at points of the unit cube (n, 3)."""
        cell = np.floor(np.clip(where, 0, 1) * _CELLS)
        key = np.concatenate([piece[:, None], cell], 1).astype(np.int64)
        every, of_pixel = np.unique(key, axis=0, return_inverse=True)
        of_pixel = of_pixel.ravel()
        middle = np.stack([np.bincount(of_pixel, x) for x in where.T], 1)
        middle /= np.bincount(of_pixel)[:, None]
        own = every[:, 0]
        low = np.full((own[-1] + 1, 3), np.inf)
        high = -low
        np.minimum.at(low, own, middle)
        np.maximum.at(high, own, middle)
        # Its edges are equal, or noise across a flat piece would look like a change along it.
        size = np.maximum((high - low).max(1, keepdims=True), 1 / _CELLS)
        low = (low + high - size) / 2
        around = _Lattice.of(own, (middle - low[own]) / size[own], 1)
        of_field = [_Lattice.of(own, middle, n) for n in lattices]
        return _Cells(own, of_pixel, of_field, around, low, size)

    def sums(self, columns: list[np.ndarray], chosen: np.ndarray) -> np.ndarray:
        """Sums over the chosen pixels of each cell, of columns of these pixels."""
        of, count = self.of_pixel[chosen], len(self.piece)
        return np.stack([np.bincount(of, column, count) for column in columns], 1)

    def of_pieces(self, columns: np.ndarray) -> np.ndarray:
        """Sums over the cells of each piece, shape (pieces, columns); columns (columns, cells)."""
        return np.stack([np.bincount(self.piece, column) for column in columns], 1)

    def told(
        self,
        parts: list[tuple[np.ndarray, Curves]],
        bases: list[np.ndarray],
        pixels_as_one: np.ndarray,
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """What two halves of the pixels tell of places, and how well.

        Args:
            parts: the first half, the other one, and all pixels: which they are, and their curves.
            bases: outputs of pixels before their bounds that numbers are beside, shape (n,) each.
            pixels_as_one: of each piece.

        Returns:
            Of each of the field's lattices the numbers by all pixels, shape (ways, corners), and
            by how much each way changes the error of each piece, shape (pieces, ways). A way is one
            of the bases, one of two kinds of corners, those of the lattices or those of `around`,
            and one of `SPREADS`. It is held against the best base with nothing by place.
        """
        numbers, errors, without = [], [], []
        for base in bases:
            *halves, both = (
                self.sums([errors_of(curves, base[chosen] + shift) for shift in SHIFTS], chosen)
                for chosen, curves in parts
            )
            without.append(self.without(halves))
            scaled = [table / pixels_as_one[self.piece, None] for table in (*halves, both)]
            by_lattices, shifts = _solved(self.lattices, scaled)
            (around,), gentle = _solved([self.around], scaled)
            numbers += [by_lattices, self.as_lattices(around)]
            # Beside what is small, corners of lattices are far away.
            small = np.where(self.size < _LEAST_SIZE, np.inf, 0)
            errors += [self.asked(halves, shifts), self.asked(halves, gentle) + small]
        every = [np.concatenate(each) for each in zip(*numbers, strict=True)]
        return every, np.concatenate(errors, 1) - np.min(without, 0)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Of each pixel the mean over its piece, shape (n,)."""
        piece = self.piece[self.of_pixel]
        return (np.bincount(piece, values) / np.bincount(piece))[piece]

    def asked(self, halves: list[np.ndarray], shifts: np.ndarray) -> np.ndarray:
        """Errors of pieces in each half, by what the other one has found, shape (pieces, spreads).

        Args:
            halves: errors of cells at `SHIFTS`, shape (cells, shifts).
            shifts: that halves have found, the first two of (tables, spreads, cells).
        """
        pairs = zip(halves[::-1], shifts[:2], strict=True)
        return self.of_pieces(np.sum([_at(other, by) for other, by in pairs], axis=0))

    def without(self, halves: list[np.ndarray]) -> np.ndarray:
        """Errors of pieces that differ by no place, shape (pieces, 1).

        Each half is asked of no change, and of the shift of the whole piece that the other one has
        found. The better one counts.

        Args:
            halves: errors of cells at `SHIFTS`, shape (cells, shifts).
        """
        pairs = zip(halves, halves[::-1], strict=True)
        shifts = [(other, self.level(own)) for own, other in pairs]
        errors = [(_at(other, by), _at(other, np.zeros_like(by))) for other, by in shifts]
        better = [self.of_pieces(np.array(each)).min(1, keepdims=True) for each in errors]
        return np.sum(better, axis=0)

    def as_lattices(self, numbers: np.ndarray) -> list[np.ndarray]:
        """Numbers at the corners of `around` as such of the field's lattices.

        What is trilinear over the whole of a piece is so between corners of any lattice. The finest
        one has it all: where two of its corners share a place in the table, little is lost.

        Args:
            numbers: shape (spreads, corners).
        """
        finest = self.lattices[-1]
        where = finest.corner / finest.cells
        share = _shares((where - self.low[finest.piece]) / self.size[finest.piece])
        found = (share * numbers.reshape(len(numbers), -1, 8)[:, finest.piece]).sum(2)
        return [*(np.zeros((len(numbers), len(x.piece))) for x in self.lattices[:-1]), found]

    def level(self, table: np.ndarray) -> np.ndarray:
        """By how much each cell is shifted if all of a piece are shifted alike, shape (cells,).

        Factors of albedo in smaller cells may prefer another roughness, but not by place.

        Args:
            table: errors of cells at `SHIFTS`, shape (cells, shifts).
        """
        errors = self.of_pieces(table.T)
        count, best = len(errors), errors.argmin(1)
        inner = np.clip(best, 1, len(SHIFTS) - 2)
        before, here, after = (errors[np.arange(count), inner + i] for i in (-1, 0, 1))
        bend = before - 2 * here + after
        part = np.divide(before - after, 2 * bend, out=np.zeros(count), where=bend > 0)
        step = SHIFTS[1] - SHIFTS[0]
        found = np.where(best == inner, SHIFTS[inner] + step * np.clip(part, -1, 1), SHIFTS[best])
        return found[self.piece]

    def fitting(self, changes: np.ndarray) -> np.ndarray:
        """Which pieces a table of numbers has room for, those first that tell the most of places.

        Args:
            changes: of the error of each piece, by numbers instead of none or one shift of it.
        """
        every = np.concatenate([lattice.piece for lattice in self.lattices])
        count = np.bincount(every, minlength=len(changes))
        order = np.argsort(changes, kind="stable")
        fits = np.zeros(len(changes), bool)
        fits[order[np.cumsum(count[order]) <= _MOST_CORNERS]] = True
        return fits


def _solved(
    lattices: list[_Lattice], tables: list[np.ndarray]
) -> tuple[list[np.ndarray], np.ndarray]:
    """The most probable numbers by errors of cells at `SHIFTS`, for each of `SPREADS`.

    Args:
        lattices: whose corners have numbers, coarsest first.
        tables: shape (cells, shifts), each of other pixels, in units of their variance.

    Returns:
        Of the last table, the numbers of each lattice, shape (spreads, corners); and how far
        cells are shifted, shape (tables, spreads, cells).
    """
    jobs, count = len(tables) * len(SPREADS), len(tables[0])
    every = np.concatenate(tables)
    table = [
        from_numpy(mi.Float, x.astype(np.float32)) for x in (every, np.gradient(every, axis=1))
    ]
    number = np.arange(jobs)[:, None]
    row = number // len(SPREADS) * count + np.arange(count)
    first = from_numpy(mi.UInt32, (row * len(SHIFTS)).astype(np.uint32))
    starts = [_one_by_one(lattices, *job) for job in product(tables, SPREADS)]
    corners, weights, places, shares = [], [], [], []
    for level, lattice in enumerate(lattices):
        size = len(lattice.piece)
        start = np.concatenate([found[level] for found in starts])
        corners.append(from_numpy(mi.Float, start.astype(np.float32)))
        spread = np.tile(SPREADS * _FINER**level, len(tables))
        weights.append(from_numpy(mi.Float, np.repeat(spread**-2.0, size).astype(np.float32)))
        place = [number * size + k for k in lattice.place.T]
        places.append([from_numpy(mi.UInt32, k.astype(np.uint32)) for k in place])
        share = [np.tile(k, jobs) for k in lattice.share.T]
        shares.append([from_numpy(mi.Float, k.astype(np.float32)) for k in share])
    optimizer = mi.ad.Adam(_RATE, {str(i): x for i, x in enumerate(corners)})

    def shift(numbers: Any) -> mi.Float:
        found = mi.Float(0)
        for level, (place, share) in enumerate(zip(places, shares, strict=True)):
            for k, part in zip(place, share, strict=True):
                found = dr.fma(part, dr.gather(mi.Float, numbers[str(level)], k), found)
        return found

    for step in range(_STEPS):
        rate = _RATE * _FINAL_RATE ** (step / _STEPS)
        optimizer.set_learning_rate({key: dr.opaque(mi.Float, rate) for key in optimizer})
        loss = dr.sum(_between(table, first, shift(optimizer)))
        for level, weight in enumerate(weights):
            loss += dr.sum(weight * dr.square(optimizer[str(level)]))
        dr.backward(loss)
        optimizer.step()
    numbers = {key: dr.detach(x) for key, x in optimizer.items()}
    shifts = np.array(shift(numbers)).reshape(len(tables), len(SPREADS), count)
    last = [
        np.array(numbers[str(i)]).reshape(len(tables), len(SPREADS), -1)[-1]
        for i in range(len(corners))
    ]
    return last, shifts


def _between(table: list[mi.Float], first: mi.UInt32, shift: mi.Float) -> mi.Float:
    """Errors at shifts, cubic between `SHIFTS`.

    Args:
        table: errors at all of them, and their slopes, row by row.
        first: where the row of each lane begins.
        shift: of each lane.
    """
    at = dr.clip((shift - SHIFTS[0]) / (SHIFTS[1] - SHIFTS[0]), 0, len(SHIFTS) - 1.001)
    left = mi.UInt32(dr.detach(at))
    t = at - mi.Float(left)
    (a, b), (p, q) = (
        [dr.gather(mi.Float, values, first + left + i) for i in (0, 1)] for values in table
    )
    return cubic(a, b, p, q, t)


def _one_by_one(lattices: list[_Lattice], table: np.ndarray, spread: float) -> list[np.ndarray]:
    """Numbers that a descent starts from, one lattice after the other, coarsest first.

    Curves may have several minima, and a descent ends at the nearest one. So each corner gets
    the best number of all, by the cells around it and what coarser lattices say of them.

    Args:
        lattices: whose corners have numbers, coarsest first.
        table: errors of cells at `SHIFTS`, shape (cells, shifts).
        spread: of the coarsest lattice; that of each further one is `_FINER` times as large.
    """
    shift, found = np.zeros(len(table)), []
    for level, lattice in enumerate(lattices):
        errors = np.empty((len(lattice.piece), len(SHIFTS)))
        for number, more in enumerate(SHIFTS):
            share = lattice.share * _at(table, shift + more)[:, None]
            errors[:, number] = np.bincount(
                lattice.place.ravel(), share.ravel(), len(lattice.piece)
            )
        prior = np.square(SHIFTS / (spread * _FINER**level))
        best = SHIFTS[(errors + prior).argmin(1)]
        shift = shift + (lattice.share * best[lattice.place]).sum(1)
        found.append(best)
    return found
