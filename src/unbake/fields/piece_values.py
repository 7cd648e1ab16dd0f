"""A table of values by piece of surface and brightness of the albedo, beside a network."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .domain import SurfacePoint, bounded
from .settings import PieceConfig


class PieceValues:
    """Numbers that are added to the outputs of a field before their bounds (ours).

    Photographs tell little of roughness at a point. What is connected and equally bright is mostly
    of one material, and here it shares a number: gradients of many pixels meet in each. The
    network, which learns slower beside it, adds what differs within.

    Each piece has a number for each of some brightnesses, and is linear between them. Brightness is
    the square root of the mean of linear RGB albedo, in which steps look alike. The albedo is a
    constant: it is not pulled to where roughness would have it.

    Numbers of small pieces count less, by their `strength`, and so learn slower: Adam moves every
    number at one pace, however little is known of it.

    Args:
        settings: sizes.
        outputs: of the field.
    """

    def __init__(self, settings: PieceConfig, outputs: int) -> None:
        self._settings = settings
        count = settings.most * settings.brightnesses
        self._values = [dr.opaque(mi.Float, 0, count) for _ in range(outputs)]

    def parameters(self) -> dict[str, mi.Float]:
        """`pieces.0`, …: the numbers of each output."""
        return {f"pieces.{i}": values for i, values in enumerate(self._values)}

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; others than those of `parameters` are ignored."""
        self._values = [parameters[name] for name in self.parameters()]

    def evaluate(self, point: SurfacePoint) -> list[mi.Float]:
        """One number for each output; where the albedo is not told, all are taken as mid-grey.

        Raises:
            ValueError: the piece is not told.
        """
        if point.piece is None:
            raise ValueError("a field with values of pieces is asked at a point without its piece")
        bins = self._settings.brightnesses
        mean = mi.Float(0.25) if point.albedo is None else dr.mean(dr.detach(point.albedo))
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
        return found

    @property
    def features(self) -> int:
        """Numbers that are looked up at a point."""
        return 2 * len(self._values)
