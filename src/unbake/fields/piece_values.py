"""Tables of values by piece of surface and by colour of the albedo, beside a network."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .arrays import differences
from .domain import SurfacePoint, bounded
from .field import FieldSpec
from .grid import DenseGrid
from .pieces import Piece
from .settings import DenseGridConfig, PieceConfig


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

    def parameters(self) -> dict[str, mi.Float]:
        """`pieces.0`, …: the numbers of each output; `colours`, if there are any."""
        found = {f"pieces.{i}": values for i, values in enumerate(self._values)}
        if self._colours is not None:
            found["colours"] = self._colours.parameters()["corners"]
        return found

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; others than those of `parameters` are ignored."""
        self._values = [parameters[f"pieces.{i}"] for i in range(len(self._values))]
        if self._colours is not None:
            self._colours.assign({"corners": parameters["colours"]})

    def evaluate(self, point: SurfacePoint) -> list[mi.Float]:
        """One number for each output; where the albedo is not told, all are taken as mid-grey.

        Raises:
            ValueError: the piece is not told.
        """
        if point.piece is None:
            raise ValueError("a field with values of pieces is asked at a point without its piece")
        bins = self._settings.brightnesses
        albedo = mi.Color3f(0.25) if point.albedo is None else dr.detach(point.albedo)
        mean = dr.mean(albedo)
        at = dr.sqrt(bounded(mean, 0, 1)) * (bins - 1)
        below = dr.minimum(mi.UInt32(at), bins - 2)
        share = at - mi.Float(below)
        number = dr.minimum(point.piece.number, self._settings.most - 1)
        first = number * bins + below
        gain = self._settings.gain * point.piece.strength
        found = []
        for values in self._values:
            low, high = (dr.gather(mi.Float, values, first + i) for i in (0, 1))
            found.append(gain * dr.fma(share, high - low, low))
        if self._colours is None:
            return found
        colour = mi.Point3f([dr.sqrt(bounded(channel, 0, 1)) for channel in albedo])
        shared = self._colours.evaluate(SurfacePoint(colour))
        return [dr.fma(self._settings.gain, x, y) for x, y in zip(shared, found, strict=True)]

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
        here = dr.arange(mi.UInt32, self._settings.most * (bins - 1))
        here += here // (bins - 1)  # all but the last one of a piece
        found = {"pieces": of_pieces, "brightnesses": [differences(v, here, 1) for v in of_pieces]}
        if self._colours is not None:
            found["colours"] = [gain * x for x in self._colours.differences()]
        return {name: dr.concat(arrays) for name, arrays in found.items()}

    def raised(self, piece: Piece, by: mi.Float) -> dict[str, mi.Float]:
        """See `Field.raised`."""
        bins = self._settings.brightnesses
        every = dr.arange(mi.UInt32, dr.width(piece.number) * bins)
        own = every // bins
        number = dr.minimum(dr.gather(mi.UInt32, piece.number, own), self._settings.most - 1)
        strength = self._settings.gain * piece.strength
        each = dr.gather(mi.Float, dr.select(strength > 0, by / strength, 0), own)
        found = {}
        for i, values in enumerate(self._values):
            raised = mi.Float(dr.detach(values))
            here = number * bins + every % bins
            dr.scatter(raised, dr.gather(mi.Float, values, here) + each, here)
            found[f"pieces.{i}"] = raised
        return found

    @property
    def features(self) -> int:
        """Numbers that are looked up at a point."""
        outputs = len(self._values)
        return (2 + (8 if self._colours is not None else 0)) * outputs
