"""Photometric losses of pixels as functions of roughness, from what searches sample (ours)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.arrays import from_numpy
from ..fields.domain import SurfacePoint
from ..fields.field import Field
from ..fields.pieces import Piece
from ..quantities import QUANTITIES
from ..ranks import Ranks

#: Values of roughness at which pixels are known; curves are cubic between them, in their logarithm.
NODES = (0.1, 0.16, 0.24, 0.33, 0.43, 0.55, 0.7, 0.8, 0.9)
#: The part of a mean group's knowledge of its albedo that says: it is as it is.
_CAUTION = 1e-3
#: Brightnesses of pixels, in each of which errors have one variance.
_BRIGHTNESSES = 32
#: The squared error of a pixel is no less, in units of its variance.
_LEAST = -1.0
#: Factors of albedo are no larger, and no larger than brings the mean of a group to 1; by the
#: second one albedo may always rise.
_LARGEST_FACTOR, _RISE = 4.0, 1.05
#: Less albedo than this is not told from it.
_BLACK = 1e-3


@dataclass(frozen=True)
class Curves:
    """Photometric losses of pixels as functions of the roughness at a point of each.

    Args:
        point: of each pixel.
        losses: at the nodes, pixel by pixel, each with the albedo that is the best one there.
        slopes: by the logarithm of roughness, the same.
        nodes: their logarithms.
        total: how many pixels all ranks have.
        pieces: of surface that any pixels of all ranks show, in the order of their numbers.
        known: those of the pixels that have a curve, of all ranks.
        shown: what any pixels of all ranks show, whether they have a curve or not.
    """

    point: SurfacePoint
    losses: mi.Float
    slopes: mi.Float
    nodes: mi.Float
    total: int
    pieces: Piece
    known: Piece
    shown: SurfacePoint

    @staticmethod
    def of(
        rows: np.ndarray,
        cells: int,
        colours: int,
        albedo: bool,
        ranks: Ranks | None = None,
        shown: np.ndarray | None = None,
    ) -> Curves:
        """The curves of sampled pixels.

        Args:
            rows: of `row_type`, of those of all ranks.
            cells: along an edge of the unit cube, in each of which albedo has its own factor.
            colours: along each channel of albedo, the same.
            albedo: whether it is unknown.
            ranks: that have an equal part of the curves each; None: this one has them all.
            shown: what any pixels of all ranks show, of `PLACE`; None: those of the rows.
        """
        ranks, total, every = ranks or Ranks(), len(rows), rows if shown is None else shown
        # A squared error is not below zero. What is far below has few samples of a sharp lobe.
        losses = np.maximum(losses_by_roughness(rows, groups(rows, cells, colours)), _LEAST)
        piece = np.unique(rows["piece"], return_inverse=True)[1]
        pieces, known = pieces_of(rows, every), pieces_of(rows)
        slopes = _slopes(losses, piece.ravel())
        here = slice(ranks.rank, None, ranks.size)
        rows, losses, slopes = rows[here], losses[here], slopes[here]
        flat = [from_numpy(mi.Float, x.astype(np.float32)) for x in (losses, slopes, np.log(NODES))]
        of_every = points(every, albedo)
        at = points(rows, albedo)
        return Curves(at, flat[0], flat[1], flat[2], total, pieces, known, of_every)

    def at(self, roughness: mi.Float) -> mi.Float:
        """The loss of each pixel at its roughness; beyond the nodes it stays as it is."""
        inside = dr.clip(roughness, NODES[0], NODES[-1])
        span = mi.UInt32(0)
        for node in NODES[1:-1]:
            span += dr.select(dr.detach(roughness) >= node, mi.UInt32(1), mi.UInt32(0))
        left, right = (dr.gather(mi.Float, self.nodes, span + i) for i in (0, 1))
        first = dr.arange(mi.UInt32, dr.width(roughness)) * len(NODES) + span
        a, b = (dr.gather(mi.Float, self.losses, first + i) for i in (0, 1))
        width = right - left
        p, q = (width * dr.gather(mi.Float, self.slopes, first + i) for i in (0, 1))
        t = (dr.log(inside) - left) / width
        return cubic(a, b, p, q, t)


def cubic(a: mi.Float, b: mi.Float, p: mi.Float, q: mi.Float, t: mi.Float) -> mi.Float:
    """The cubic with values a, b and slopes p, q at 0 and 1, at t between them."""
    return a + t * (p + t * (3 * (b - a) - 2 * p - q + t * (2 * (a - b) + p + q)))


def _slopes(losses: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """Slopes of curves at nodes, by the logarithm of roughness.

    Sums over a piece of one roughness do not turn between two nodes of a fall or a rise (Fritsch
    and Carlson 1980): beside a cliff there would be a hollow that no photograph shows. Between two
    nodes of which one is on a fall and the other on a rise, they may turn.

    Args:
        losses: at nodes, shape (n, nodes).
        piece: of each pixel, from 0, shape (n,).
    """
    nodes = np.log(NODES)

    def sums(of_pixels: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(piece, column) for column in of_pixels.T], 1)

    places = np.arange(len(nodes))
    left, right = np.maximum(places - 1, 0), np.minimum(places + 1, places[-1])
    slopes = (losses[:, right] - losses[:, left]) / (nodes[right] - nodes[left])
    secants = np.diff(sums(losses)) / np.diff(nodes)
    beyond = np.pad(secants, ((0, 0), (1, 1)))
    a, b = secants[:, :-1], secants[:, 1:]
    sides = [
        np.where(outer * opposite < 0, np.maximum(np.abs(near), np.abs(outer)), np.abs(near))
        for near, outer, opposite in ((a, beyond[:, :-3], b), (b, beyond[:, 3:], a))
    ]
    part = np.ones((len(secants), len(nodes)))
    steep = np.maximum(np.abs(sums(slopes[:, 1:-1])), 1e-30)
    part[:, 1:-1] = np.minimum(1, 3 * np.minimum(*sides) / steep)
    return part[piece] * slopes


def points(rows: np.ndarray, albedo: bool) -> SurfacePoint:
    """Where pixels are seen.

    Args:
        rows: of `row_type`, or of `PLACE`.
        albedo: whether it is unknown, and so told.
    """

    def arrays(name: str) -> list[mi.Float]:
        return [from_numpy(mi.Float, column) for column in rows[name].T]

    return SurfacePoint(
        mi.Point3f(arrays("position")),
        piece=_pieces(rows["piece"], rows["strength"]),
        albedo=mi.Color3f(arrays("albedo")) if albedo else None,
    )


def pieces_of(*rows: np.ndarray) -> Piece:
    """The different pieces of surface that pixels see, in the order of their numbers."""
    number, strength = (np.concatenate([x[name] for x in rows]) for name in ("piece", "strength"))
    number, first = np.unique(number, return_index=True)
    return _pieces(number, strength[first])


def _pieces(number: np.ndarray, strength: np.ndarray) -> Piece:
    return Piece(from_numpy(mi.UInt32, number), from_numpy(mi.Float, strength))


def roughness_of(field: Field, point: SurfacePoint) -> mi.Float:
    """What a field says of points."""
    return in_range(field.evaluate(point))


def in_range(values: list[mi.Float]) -> mi.Float:
    """Roughness of the values of its field."""
    quantity = QUANTITIES["roughness"]
    return dr.fma(values[0], quantity.upper - quantity.lower, quantity.lower)


def of_roughness(roughness: float) -> float:
    """The value of the field that stands for a roughness."""
    quantity = QUANTITIES["roughness"]
    return (roughness - quantity.lower) / (quantity.upper - quantity.lower)


def precision(rows: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Factors of weights with which errors of pixels have the variance 1, however bright they are.

    Pixels with about the same weight are of one brightness: weights are those of smoothed
    photographs, by default, and do not follow their noise. The variance is the mean squared error
    in each of `_BRIGHTNESSES` such sets of equal size.

    Args:
        rows: of `row_type`.
        roughness: of pixels as it is by now, shape (n,).

    Returns:
        Shape (n, 3). Where a weight is zero it is 1.
    """
    every = np.arange(len(rows))
    nearest = np.abs(np.log(NODES) - np.log(np.maximum(roughness, 1e-6))[:, None]).argmin(1)
    image = rows["gain"] * (rows["plain"] + rows["coloured"])[every, nearest]
    errors = rows["weight"] * (image - rows["target"]) ** 2
    found = np.ones_like(errors)
    for channel in range(3):
        counted = np.flatnonzero(rows["weight"][:, channel] > 0)
        order = counted[np.argsort(rows["weight"][counted, channel], kind="stable")]
        for chosen in np.array_split(order, _BRIGHTNESSES):
            if len(chosen):
                found[chosen, channel] = 1 / max(errors[chosen, channel].mean(), 1e-12)
    return found


def groups(rows: np.ndarray, cells: int, colours: int) -> np.ndarray:
    """The group of each pixel in which albedo has one factor, from 0, shape (n,)."""
    bright = np.sqrt(np.clip(rows["albedo"], 0, 1))
    columns = [
        np.floor(rows["position"] * cells),
        rows["piece"][:, None],
        np.minimum(np.floor(bright * colours), colours - 1),
    ]
    every = np.concatenate(columns, 1).astype(np.int64)
    return np.unique(every, axis=0, return_inverse=True)[1].ravel()


def losses_by_roughness(rows: np.ndarray, group: np.ndarray) -> np.ndarray:
    """The squared errors of pixels at each node, with the best albedo for it.

    In each group and channel the factor of the albedo is the one with the smallest sum of errors,
    as far as steps could reach it: albedo is 1 at most.

    Args:
        rows: of `row_type`.
        group: of each pixel, from 0, shape (n,).

    Returns:
        As of `squared_errors`.
    """
    count = group.max() + 1
    target, weight, gain = (
        rows[name][:, None].astype(np.float64) for name in ("target", "weight", "gain")
    )

    def sums(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        found = np.stack([np.bincount(group, column, count) for column in flat.T], 1)
        return found.reshape(count, *values.shape[1:])

    square = weight * gain**2
    wanted = sums(weight * gain * target * rows["coloured"] - square * rows["mixed"])
    known = sums(square * rows["coloured2"])
    caution = _CAUTION * np.maximum(known.mean(0, keepdims=True), 0) + 1e-30
    factor = (wanted + caution) / np.maximum(known + caution, caution)
    albedo = np.maximum(sums(rows["albedo"]) / np.bincount(group, minlength=count)[:, None], 1e-3)
    largest = np.clip(1 / albedo, _RISE, _LARGEST_FACTOR)[:, None]
    return squared_errors(rows, np.clip(factor, 0, largest)[group])


def squared_errors(rows: np.ndarray | dict[str, np.ndarray], factor: np.ndarray) -> np.ndarray:
    """The squared errors of pixels at each node, with albedo times a factor g.

    The error of a pixel is w (γ (S + g · D) − I)², without bias: squares are products of different
    samples.

    Args:
        rows: of `row_type`.
        factor: float64, of a shape that broadcasts to (n, nodes, 3).

    Returns:
        Means over channels, shape (n, nodes).
    """
    target, weight, gain = (
        rows[name][:, None].astype(np.float64) for name in ("target", "weight", "gain")
    )
    image = gain * (rows["plain"] + factor * rows["coloured"])
    image2 = gain**2 * (rows["plain2"] + factor * (2 * rows["mixed"] + factor * rows["coloured2"]))
    return (weight * (image2 - target * (2 * image - target))).mean(2)


def at_roughness(
    rows: np.ndarray, roughness: np.ndarray, names: Iterable[str]
) -> dict[str, np.ndarray]:
    """What rows say of nodes, each at its roughness, shape (n, 3).

    Args:
        rows: of `row_type`; between nodes they are linear in the logarithm of roughness, and beyond
            them they stay as they are.
        roughness: shape (n,).
        names: of numbers that rows have at nodes.
    """
    places, every = np.log(NODES), np.arange(len(rows))
    place = np.log(np.clip(roughness, NODES[0], NODES[-1]))
    left = np.clip(np.searchsorted(places, place) - 1, 0, len(places) - 2)
    part = ((place - places[left]) / np.diff(places)[left])[:, None]
    ends = {name: (rows[name][every, left], rows[name][every, left + 1]) for name in names}
    return {name: a + part * (b - a) for name, (a, b) in ends.items()}


def albedo_errors(rows: np.ndarray, roughness: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """The squared errors of pixels with another albedo than they have by now.

    Args:
        rows: of `row_type`.
        roughness: shape (n,).
        albedo: linear RGB, shape (n, 3).

    Returns:
        Means over channels, no less than curves have them, shape (n,).
    """
    names = ("plain", "coloured", "plain2", "mixed", "coloured2")
    single = {name: rows[name] for name in ("target", "weight", "gain")}
    single |= {name: x[:, None] for name, x in at_roughness(rows, roughness, names).items()}
    factor = np.maximum(albedo, _BLACK) / np.maximum(rows["albedo"], _BLACK)
    return np.maximum(squared_errors(single, factor[:, None])[:, 0], _LEAST)
