"""Pieces of surface: what is connected without a crease, by geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .shapes import met_shapes, registry_number

#: Surfaces that meet at a larger angle, in degrees, are of two pieces.
CREASE = 40.0
#: A piece of this share of all surface, or more, has the full strength.
FULL_SHARE = 0.05
#: The attribute of a mesh's faces by which a hit finds its piece: number, strength, 0.
ATTRIBUTE = "face_piece"
#: Triangles whose height is no more than so many roundings of their corners are slivers.
_SLIVER = 4.0
_NONE = np.zeros((0, 3, 3), np.float32)


@dataclass
class Piece:
    """What a surface point is a part of; a PyTree."""

    number: mi.UInt32  # from 0, in the order of area
    strength: mi.Float  # in (0, 1]: how much photographs tell of it, beside a large piece


class Pieces:
    """The pieces of all surfaces of a scene.

    Two triangles that share an edge are of one piece unless the angle between them is a crease.
    Slivers, whose corners lie on a line, have no angles: what meets at one meets as at an edge.
    What a scene divides into shapes does not matter, nor what materials these have: triangles are
    known by where they are, also in another scene that holds them, such as one that is not merged
    or has other lights. Instances share the pieces of their group, and a shape that is no mesh is a
    piece. Pieces are numbered by area; where there are more than numbers, the smallest share the
    last number.

    The strength of a number is the root of its share of all surface, because so the signal to noise
    of what pixels tell of it grows; it is 1 from `FULL_SHARE` on.

    Args:
        scene: the scene.
        most: the number of numbers, 1 at least.
        across_slivers: whether what meets at a sliver meets; False: as in earlier versions.
    """

    def __init__(self, scene: mi.Scene, most: int, *, across_slivers: bool = True) -> None:
        shapes = met_shapes(scene)
        corners = [_corners(shape) for shape in shapes if shape.is_mesh()]
        others = sorted({_extent(shape) for shape in shapes if not shape.is_mesh()})
        keys, label, areas = _pieces(np.concatenate([_NONE, *corners]), across_slivers)
        areas = np.concatenate([areas, [extent[0] for extent in others]])
        rank = np.empty(len(areas), np.int64)
        rank[np.argsort(-areas, kind="stable")] = np.arange(len(areas))
        numbers = np.minimum(rank, most - 1)
        shares = np.bincount(numbers, areas) / max(areas.sum(), 1e-30)
        rows = np.zeros((len(areas), 3), np.float32)
        rows[:, 0], rows[:, 1] = numbers, np.sqrt(np.minimum(1, shares / FULL_SHARE))[numbers]
        first = len(areas) - len(others)
        self.most = most
        self.count = min(len(areas), most)  #: of numbers in use
        self._keys, self._rows = keys, rows[label]
        self._others = dict(zip(others, rows[first:], strict=True))
        # Of surfaces that the scene does not have: nothing was learned of them.
        self._unknown = np.array((most - 1, 0, 0), np.float32)
        self._single: dict[int, np.ndarray] = {}

    def of(self, shape: mi.Shape) -> np.ndarray:
        """Number, strength and 0: of each face of a mesh, (faces, 3); of other shapes, (1, 3)."""
        if not shape.is_mesh():
            return self._others.get(_extent(shape), self._unknown)[None]
        wanted, _ = _keys(_corners(shape))
        if not len(self._keys):
            return np.broadcast_to(self._unknown, (len(wanted), 3)).copy()
        order = np.argsort(wanted)  # in order, places are near to each other in memory
        at = np.empty(len(wanted), np.int64)
        at[order] = np.searchsorted(self._keys, wanted[order])
        at = np.minimum(at, len(self._keys) - 1)
        known = self._keys[at] == wanted
        return np.where(known[:, None], self._rows[at], self._unknown)

    def attach(self, scene: mi.Scene) -> None:
        """From now on `at` is asked at interactions with this scene, which gets attributes."""
        self._single = {}
        for shape in met_shapes(scene):
            rows = self.of(shape)
            if shape.is_mesh():
                shape.add_attribute(ATTRIBUTE, 3, mi.Float(rows.ravel()))
            else:
                self._single[registry_number(shape)] = rows[0]

    def at(self, si: mi.SurfaceInteraction3f, valid: mi.Bool) -> Piece:
        """The pieces at surface interactions with the scene that they are attached to."""

        def look_up(shape: mi.Shape, si: mi.SurfaceInteraction3f, valid: mi.Bool) -> mi.Color3f:
            row = self._single.get(registry_number(shape))
            if row is not None:
                return mi.Color3f(row.tolist())
            return shape.eval_attribute_3(ATTRIBUTE, si, valid)

        return decoded(dr.dispatch(si.shape, look_up, si, valid), valid)


def decoded(info: mi.Color3f, valid: mi.Bool) -> Piece:
    """Pieces from values of the attribute; the first where lanes are not valid."""
    info = dr.detach(info)
    return Piece(mi.UInt32(dr.select(valid, dr.round(info.x), 0)), dr.select(valid, info.y, 1))


def _extent(shape: mi.Shape) -> tuple[float, ...]:
    """About the area of a shape, then what tells it from others: its bounding box."""
    box = shape.bbox()
    lower, upper = (np.ravel(np.array(corner)).astype(np.float64) for corner in (box.min, box.max))
    x, y, z = np.where(np.isfinite(upper - lower), np.maximum(upper - lower, 0), 0)
    return float(x * y + y * z + z * x), *lower.tolist(), *upper.tolist()


def _corners(mesh: mi.Mesh) -> np.ndarray:
    """The corners of a mesh's triangles, (m, 3, 3) float32; negative zeros are zeros."""
    positions = np.array(mesh.vertex_positions_buffer(), np.float32).reshape(-1, 3)
    return positions[np.array(mesh.faces_buffer(), np.int64).reshape(-1, 3)] + np.float32(0)


def _mixed(*columns: np.ndarray) -> np.ndarray:
    """A number of 64 bits for each row of columns of integers (n,), by all of its bits."""
    keys = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        keys = (keys ^ column) * np.uint64(0x9E3779B97F4A7C15)
        keys ^= keys >> np.uint64(29)
    return keys


def _keys(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys of triangles (m, 3, 3) and of their corners (m, 3), by where they are."""
    bits = np.ascontiguousarray(corners).reshape(-1, 3).view(np.uint32)
    of_corners = _mixed(*bits.T).reshape(-1, 3)
    return _mixed(*np.sort(of_corners, axis=1).T), of_corners


def _pieces(corners: np.ndarray, across_slivers: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pieces of triangles (m, 3, 3).

    Returns:
        Sorted keys of triangles, the piece of each, and the areas of the pieces. Everything is
        numbered in the order of keys, which does not depend on how the triangles are stored.
    """
    keys, of_corners = _keys(corners)
    order = np.argsort(keys)
    keys = keys[order]
    new = np.ones(len(keys), bool)
    new[1:] = keys[1:] != keys[:-1]
    keys, first = keys[new], order[new]
    if len(keys) < len(corners):  # some are there twice
        kept = np.sort(first)
        corners, of_corners = corners[kept], of_corners[kept]
        first = np.searchsorted(kept, first)
    rank = np.empty(len(keys), np.int64)
    rank[first] = np.arange(len(keys))
    # From here on triangles are as they are stored: neighbours are near to each other in memory.
    within = np.argsort(of_corners, axis=1) + 3 * np.arange(len(keys))[:, None]
    a, b, c = (corners.reshape(-1, 3).take(corner, 0).astype(float).T for corner in within.T)
    x, y = b - a, c - a
    normals = np.stack(
        [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]], -1
    )
    double = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(double, 1e-300)[:, None]
    # By places, not by vertices: those differ where normals or texture coordinates do.
    places = [of_corners.ravel().take(corner) for corner in within.T]
    one, other = _neighbours(places, rank)
    joined = np.zeros(0, np.int64), np.zeros(0, np.int64)
    if across_slivers and (sliver := slivers(np.stack([a, b, c]), double)).any():
        one, other, joined = _across(sliver, one, other, places, rank)
    # Neighbouring triangles may be turned to opposite sides.
    cosine = np.abs((normals.take(one, 0) * normals.take(other, 0)).sum(1))
    smooth = cosine > np.cos(np.radians(CREASE))
    one, other = (
        np.append(pair[smooth], extra) for pair, extra in zip((one, other), joined, strict=True)
    )
    label = connected(len(keys), rank[one], rank[other])
    return keys, label, np.bincount(label, double[first] / 2)


def _neighbours(corners: list[np.ndarray], rank: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles that share an edge.

    Args:
        corners: the sorted keys of the three corners, (n,) each.
        rank: of each triangle, (n,). Where more than two share an edge, those are pairs that follow
            each other by it.
    """
    a, b, c = corners
    edge = np.concatenate([_mixed(a, b), _mixed(b, c), _mixed(a, c)])
    order = np.argsort(edge)
    edge = edge[order]
    same = edge[1:] == edge[:-1]
    triangle = order % max(len(a), 1)
    crowded = np.zeros(len(edge), bool)
    for shift in range(3) if len(edge) > 2 else ():
        crowded[shift : len(edge) - 2 + shift] |= same[1:] & same[:-1]
    several = triangle[crowded]
    triangle[crowded] = several[np.lexsort((rank[several], edge[crowded]))]
    return triangle[:-1][same], triangle[1:][same]


def slivers(corners: np.ndarray, double: np.ndarray) -> np.ndarray:
    """Whether triangles are as thin as single precision rounds, so that their normals say nothing.

    Args:
        corners: (3 corners, 3 coordinates, n).
        double: twice the areas, (n,).
    """
    if not len(double):
        return np.zeros(0, bool)
    edges = corners - corners[[1, 2, 0]]
    longest = np.sqrt((edges**2).sum(1).max(0))
    rounding = np.abs(corners).max((0, 1)) * np.finfo(np.float32).eps
    return double <= _SLIVER * rounding * longest


def _across(
    sliver: np.ndarray,
    one: np.ndarray,
    other: np.ndarray,
    corners: list[np.ndarray],
    rank: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Pairs of triangles that share an edge, or a corner at a sliver.

    Slivers may go round a whole floor. So what meets at them shares a corner, too.

    Args:
        sliver: of each triangle, (n,).
        one, other: pairs that share an edge.
        corners: the keys of the three corners, (n,) each.
        rank: of each triangle, (n,).

    Returns:
        The pairs without slivers; and pairs that belong together whatever their normals are: of
        each sliver and what meets there, a neighbour or another sliver.
    """
    both = sliver[one] & sliver[other]
    group = connected(len(sliver), one[both], other[both])  # of slivers that meet
    mixed = sliver[one] != sliver[other]
    thin = np.where(sliver[one], one, other)[mixed]
    beside = np.where(sliver[one], other, one)[mixed]
    order = np.lexsort((rank[beside], group[thin]))
    thin, beside = thin[order], beside[order]
    _, first = np.unique(group[thin], return_index=True)
    # A sliver is of the piece of one of its neighbours.
    joined = (
        np.concatenate([one[both], thin[first]]),
        np.concatenate([other[both], beside[first]]),
    )
    # Those of each corner are pairs in a ring: three of them are all pairs.
    meeting = np.tile(beside, 3)
    corner = _mixed(
        np.tile(group[thin], 3).astype(np.uint64), np.concatenate([c.take(beside) for c in corners])
    )
    order = np.lexsort((rank[meeting], corner))
    meeting, corner = meeting[order], corner[order]
    first = np.searchsorted(corner, corner)
    last = np.searchsorted(corner, corner, "right") - 1
    place = np.arange(len(corner))
    following = np.where(place == last, first, place + 1)
    plain = ~(sliver[one] | sliver[other])
    pairs = np.append(one[plain], meeting), np.append(other[plain], meeting[following])
    return *pairs, joined


def connected(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The component of each of `count` nodes in the graph of edges (one, other).

    Components are numbered from 0, in the order of their first nodes.
    """
    kind = np.int32 if count < 1 << 31 else np.int64
    label = np.arange(count, dtype=kind)
    one, other = one.astype(kind), other.astype(kind)
    while len(one):
        a, b = label.take(one), label.take(other)
        apart = np.flatnonzero(a != b)  # edges within what is connected already are done with
        a, b = a.take(apart), b.take(apart)
        one, other = np.minimum(a, b), np.maximum(a, b)
        np.minimum.at(label, other, one)
        while ((further := label.take(label)) != label).any():
            label = further
    first = label == np.arange(count, dtype=kind)
    return (np.cumsum(first) - 1)[label]
