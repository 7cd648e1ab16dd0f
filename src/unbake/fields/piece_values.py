"""Tables of values by piece of surface and by colour of the albedo, beside a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import drjit as dr
import mitsuba as mi

from .arrays import differences
from .domain import SurfacePoint, bounded
from .field import FieldSpec, PlaceNumbers
from .grid import DenseGrid
from .pieces import Piece
from .settings import PLACE_LEVELS, PLACES_LOG2, DenseGridConfig, PieceConfig

#: Factors of a hash of a corner's coordinates, of its piece and of its lattice.
_FACTORS = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D, 0x27D4EB2F, 0x165667B1)
_CORNERS = tuple(product((0, 1), repeat=3))


class PieceValues:
    """Numbers that are added to the outputs of a field before their bounds (ours).

    Photographs tell little of roughness at a point. What is connected and equally bright is mostly
    of one material, and here it shares a number: gradients of many pixels meet in each. The
    network, which learns slower beside it, adds what differs within.

    Each piece has a number for each of some brightnesses, and is linear between them. Brightness is
    the square root of the mean of linear RGB albedo, in which steps look alike. The albedo is a
    constant: it is not pulled to where roughness would have it.

    Numbers of small pieces count less, by their `strength`, and so learn slower: Adam moves every
    number at one pace, however little is known of it. What they have instead is a table by colour
    that all pieces share: what is of one colour is often of one material, too. It is a grid over
    the square roots of linear RGB albedo, linear between its corners. Numbers of pieces are added
    to it, for what differs between pieces of one colour.

    For what differs between colours of a piece, such as those of stripes, each piece may have
    such a grid of its own, too. These are many numbers, and steps would fill them with noise: only
    searches of roughness move them, which say what is to be expected of them.

    What differs from place to place on a piece, whatever its colour, may have numbers, too, which
    searches find: on lattices over the scene's cube, linear between corners, each with twice the
    cells of the one before. A table has them all, by a hash of piece and corner; a piece that no
    search gave any reads nothing of it.

    What differs within a piece may be noise. So a piece may have a factor of all that it has beside
    its numbers by brightness. No gradient reaches it: searches find it. Where numbers are not
    learned, either, a piece is as it would be without until a search changes it.

    Args:
        settings: sizes.
        outputs: of the field.
    """

    def __init__(self, settings: PieceConfig, outputs: int) -> None:
        self._settings = settings
        count = settings.most * settings.brightnesses
        self._values = [dr.opaque(mi.Float, 0, count) for _ in range(outputs)]
        self._colours = None
        if settings.colours:
            self._colours = DenseGrid(DenseGridConfig(settings.colours), FieldSpec(outputs))
        self._factors = dr.opaque(mi.Float, 1, settings.most) if settings.variation else None
        self._own_colours = [
            dr.opaque(mi.Float, 0, settings.most * settings.own_corners) for _ in range(outputs)
        ]
        #: Cells of each lattice by place.
        self.place_cells = tuple(
            settings.places << level for level in range(PLACE_LEVELS) if settings.places
        )
        if self.place_cells:
            self._set_places(self.placed(()))

    def parameters(self) -> dict[str, mi.Float]:
        """The numbers of each output, `pieces.0`, …; what there is of others.

        Those are `colours`, the factors `variation`, `own_colours.0`, … of each output, and by
        place `places.0`, … of each output with `placed`, which is above zero for pieces that have
        any.
        """
        found = {f"pieces.{i}": values for i, values in enumerate(self._values)}
        if self._colours is not None:
            found["colours"] = self._colours.parameters()["corners"]
        if self._factors is not None:
            found["variation"] = self._factors
        if self._settings.own_colours:
            found |= {f"own_colours.{i}": values for i, values in enumerate(self._own_colours)}
        if self.place_cells:
            found |= {f"places.{i}": values for i, values in enumerate(self._places)}
            found["placed"] = self._placed
        return found

    def by_place(self) -> set[str]:
        """Names of the parameters that tell what differs from place to place."""
        names = [f"places.{i}" for i in range(len(self._values))]
        return {*names, "placed"} if self.place_cells else set()

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; others than those of `parameters` are ignored."""
        self._values = [parameters[f"pieces.{i}"] for i in range(len(self._values))]
        if self._colours is not None:
            self._colours.assign({"corners": parameters["colours"]})
        if self._factors is not None:
            self._factors = parameters["variation"]
        if self._settings.own_colours:
            numbers = range(len(self._own_colours))
            self._own_colours = [parameters[f"own_colours.{i}"] for i in numbers]
        if self.place_cells:
            self._set_places(parameters)

    def _set_places(self, parameters: Mapping[str, mi.Float | mi.TensorXf]) -> None:
        self._places = [parameters[f"places.{i}"] for i in range(len(self._values))]
        self._placed = parameters["placed"]

    def evaluate(
        self,
        point: SurfacePoint,
        beside: Sequence[mi.Float] | None = None,
        *,
        searching: bool = False,
    ) -> list[mi.Float]:
        """One number for each output; where the albedo is not told, all are taken as mid-grey.

        Args:
            point: where.
            beside: what outputs are without pieces and colours, to which these are added. The
                factor of a piece is of that, too.
            searching: whether gradients reach what only searches move.

        Raises:
            ValueError: the piece is not told.
        """
        if point.piece is None:
            raise ValueError("a field with values of pieces is asked at a point without its piece")
        albedo = mi.Color3f(0.25) if point.albedo is None else dr.detach(point.albedo)
        number = dr.minimum(point.piece.number, self._settings.most - 1)
        others = list(beside or [mi.Float(0)] * len(self._values))
        colour = mi.Point3f([dr.sqrt(bounded(channel, 0, 1)) for channel in albedo])
        tables = []
        if self._colours is not None:
            tables.append(self._colours.evaluate(SurfacePoint(colour)))
        if self._settings.own_colours:
            known = point.piece.strength > 0
            of_piece = self._of_colour(number, colour, searching=searching)
            tables.append([dr.select(known, x, 0) for x in of_piece])
        gain = self._settings.gain
        for table in tables:
            others = [dr.fma(gain, x, y) for x, y in zip(table, others, strict=True)]
        if self._factors is not None:
            factor = dr.gather(mi.Float, dr.detach(self._factors), number)
            factor = dr.select(point.piece.strength > 0, factor, 1)  # 0: nothing is known of it
            others = [factor * x for x in others]
        own = self._own(number, dr.mean(albedo))
        weight = gain * point.piece.strength
        found = [dr.fma(weight, x, y) for x, y in zip(own, others, strict=True)]
        if self.place_cells:
            of_place = self._of_place(number, point)
            found = [x + y for x, y in zip(found, of_place, strict=True)]
        return found

    def _own(self, number: mi.UInt32, mean: mi.Float) -> list[mi.Float]:
        """The numbers of pieces where the mean of linear RGB albedo is so much, an output each."""
        bins, tables = self._settings.brightnesses, self._values
        if not self._settings.learned:
            tables = [dr.detach(values) for values in tables]
        if bins == 1:
            return [dr.gather(mi.Float, values, number) for values in tables]
        at = dr.sqrt(bounded(mean, 0, 1)) * (bins - 1)
        below = dr.minimum(mi.UInt32(at), bins - 2)
        share, first = at - mi.Float(below), number * bins + below
        found = []
        for values in tables:
            low, high = (dr.gather(mi.Float, values, first + i) for i in (0, 1))
            found.append(dr.fma(share, high - low, low))
        return found

    def _of_colour(
        self, number: mi.UInt32, colour: mi.Point3f, *, searching: bool
    ) -> list[mi.Float]:
        """The numbers of pieces for a colour, as square roots of linear RGB, an output each."""
        cells, tables = self._settings.own_colours, self._own_colours
        if not searching:
            tables = [dr.detach(values) for values in tables]
        side, at = cells + 1, colour * cells
        below = dr.minimum(mi.Point3u(at), cells - 1)
        share = at - mi.Point3f(below)
        first = ((number * side + below.z) * side + below.y) * side + below.x
        apart = [(z * side + y) * side + x for z, y, x in _CORNERS]
        found = []
        for values in tables:
            corners = [dr.gather(mi.Float, values, first + offset) for offset in apart]
            found.append(_trilinear(corners, share))
        return found

    def _of_place(self, number: mi.UInt32, point: SurfacePoint) -> list[mi.Float]:
        """The numbers of pieces for a place, an output each; no gradient reaches them."""
        assert point.piece is not None
        has = dr.gather(mi.Float, dr.detach(self._placed), number) > 0
        has &= point.piece.strength > 0
        found = [mi.Float(0)] * len(self._values)
        for level, cells in enumerate(self.place_cells):
            at = bounded(dr.detach(point.position), 0, 1) * cells
            below = dr.minimum(mi.Point3u(at), cells - 1)
            share = at - mi.Point3f(below)
            where = [_hashed(number, below + mi.Point3u(x, y, z), level) for z, y, x in _CORNERS]
            for i, values in enumerate(self._places):
                corners = [dr.gather(mi.Float, dr.detach(values), k, has) for k in where]
                found[i] = found[i] + _trilinear(corners, share)
        return found

    def placed(self, levels: Sequence[PlaceNumbers]) -> dict[str, mi.Float]:
        """See `Field.placed`."""
        if not self.place_cells:
            return {}
        tables = [dr.zeros(mi.Float, 1 << PLACES_LOG2) for _ in self._values]
        placed = dr.zeros(mi.Float, self._settings.most)
        often = dr.zeros(mi.UInt32, 1 << PLACES_LOG2)
        numbers = [dr.minimum(each.piece, self._settings.most - 1) for each in levels]
        places = [
            _hashed(number, each.corner, level)
            for level, (number, each) in enumerate(zip(numbers, levels, strict=True))
        ]
        for where in places:
            dr.scatter_add(often, mi.UInt32(1), where)
        for number, where, each in zip(numbers, places, levels, strict=True):
            # What two corners would share is of neither.
            alone = dr.gather(mi.UInt32, often, where) == 1
            for table, value in zip(tables, each.values, strict=True):
                dr.scatter(table, value, where, alone)
            dr.scatter(placed, dr.ones(mi.Float, dr.width(number)), number)
        dr.make_opaque(tables, placed)
        return {f"places.{i}": table for i, table in enumerate(tables)} | {"placed": placed}

    def deviations(self, point: SurfacePoint) -> dict[str, mi.Float]:
        """See `Field.deviations`."""
        assert point.piece is not None
        bins, gain = self._settings.brightnesses, self._settings.gain
        strength = dr.zeros(mi.Float, self._settings.most)
        number = dr.minimum(point.piece.number, self._settings.most - 1)
        dr.scatter(strength, gain * point.piece.strength, number)
        every = dr.arange(mi.UInt32, self._settings.most * bins)
        of_pieces = [
            values * dr.gather(mi.Float, strength, every // bins) for values in self._values
        ]
        found = {"pieces": of_pieces}
        if bins > 1:
            here = dr.arange(mi.UInt32, self._settings.most * (bins - 1))
            here += here // (bins - 1)  # all but the last one of a piece
            found["brightnesses"] = [differences(v, here, 1) for v in of_pieces]
        if self._colours is not None:
            found["colours"] = [gain * x for x in self._colours.differences()]
        if self._settings.own_colours:
            corners = self._settings.own_corners
            here = dr.arange(mi.UInt32, self._settings.most * corners) // corners
            seen = dr.gather(mi.Float, strength, here) > 0
            found["own_colours"] = [dr.select(seen, gain * x, 0) for x in self._own_colours]
        return {name: dr.concat(arrays) for name, arrays in found.items()}

    def raised(self, piece: Piece, by: mi.Float) -> dict[str, mi.Float]:
        """See `Field.raised`."""
        one = dr.full(mi.Float, 1, dr.width(piece.number))
        return self._changed(piece, one, [by] * len(self._values))

    def varied(
        self, piece: Piece, about: Sequence[mi.Float], factor: mi.Float
    ) -> dict[str, mi.Float]:
        """See `Field.varied`."""
        if self._factors is None:
            return {}
        number = dr.minimum(piece.number, self._settings.most - 1)
        before = dr.gather(mi.Float, self._factors, number)
        factor = dr.select(piece.strength > 0, factor, before)
        times = factor / before
        factors = mi.Float(dr.detach(self._factors))
        dr.scatter(factors, factor, number)
        plus = [(1 - times) * x for x in about]
        return self._changed(piece, times, plus) | {"variation": factors}

    def _changed(
        self, piece: Piece, times: mi.Float, plus: Sequence[mi.Float]
    ) -> dict[str, mi.Float]:
        """The numbers of pieces with a factor, and then with more in units of each output."""
        bins = self._settings.brightnesses
        every = dr.arange(mi.UInt32, dr.width(piece.number) * bins)
        own = every // bins
        number = dr.minimum(dr.gather(mi.UInt32, piece.number, own), self._settings.most - 1)
        strength = self._settings.gain * piece.strength
        times = dr.gather(mi.Float, times, own)
        here = number * bins + every % bins
        found = {}
        for i, (values, more) in enumerate(zip(self._values, plus, strict=True)):
            changed = mi.Float(dr.detach(values))
            more = dr.gather(mi.Float, dr.select(strength > 0, more / strength, 0), own)
            dr.scatter(changed, dr.fma(times, dr.gather(mi.Float, values, here), more), here)
            found[f"pieces.{i}"] = changed
        return found

    @property
    def features(self) -> int:
        """Numbers that are looked up at a point."""
        outputs = len(self._values)
        grids = (self._colours is not None) + bool(self._settings.own_colours)
        own = min(self._settings.brightnesses, 2) + 8 * (grids + len(self.place_cells))
        return own * outputs + (self._factors is not None) + bool(self.place_cells)


def _trilinear(corners: list[mi.Float], share: mi.Point3f) -> mi.Float:
    """The value between those at the corners of a cell, which are in the order of `_CORNERS`."""
    for part in share:
        pairs = zip(corners[::2], corners[1::2], strict=True)
        corners = [dr.lerp(low, high, part) for low, high in pairs]
    return corners[0]


def _hashed(piece: mi.UInt32, corner: mi.Point3u, level: int) -> mi.UInt32:
    """Where the table of all lattices has the number of a piece at a corner."""
    parts = [*corner, piece, mi.UInt32(level)]
    found = mi.UInt32(0)
    for part, factor in zip(parts, _FACTORS, strict=True):
        found = (found ^ part) * mi.UInt32(factor)
        found ^= found >> 15
    return found & ((1 << PLACES_LOG2) - 1)
