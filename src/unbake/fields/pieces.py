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
_NONE = np.zeros((0, 3, 3), np.float32)


@dataclass
class Piece:
    """What a surface point is a part of; a PyTree."""

    number: mi.UInt32  # from 0, in the order of area
    strength: mi.Float  # in (0, 1]: how much photographs tell of it, beside a large piece


class Pieces:
    """The pieces of all surfaces of a scene.

    Two triangles that share an edge are of one piece unless the angle between them is a crease.
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
    """

    def __init__(self, scene: mi.Scene, most: int) -> None:
        shapes = met_shapes(scene)
        corners = [_corners(shape) for shape in shapes if shape.is_mesh()]
        others = sorted({_extent(shape) for shape in shapes if not shape.is_mesh()})
        keys, label, areas = _pieces(np.concatenate([_NONE, *corners]))
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
        at = np.minimum(np.searchsorted(self._keys, wanted), len(self._keys) - 1)
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


def _mixed(columns: np.ndarray) -> np.ndarray:
    """A number of 64 bits for each row of integers (n, k), by all of its bits."""
    keys = np.zeros(len(columns), np.uint64)
    for column in columns.T:
        keys = (keys ^ column) * np.uint64(0x9E3779B97F4A7C15)
        keys ^= keys >> np.uint64(29)
    return keys


def _keys(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys of triangles (m, 3, 3) and of their corners (m, 3), by where they are."""
    bits = np.ascontiguousarray(corners).reshape(-1, 3).view(np.uint32)
    of_corners = _mixed(bits).reshape(-1, 3)
    return _mixed(np.sort(of_corners, axis=1)), of_corners


def _pieces(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pieces of triangles (m, 3, 3).

    Returns:
        Sorted keys of triangles, the piece of each, and the areas of the pieces. Everything is
        computed in the order of keys, which does not depend on how the triangles are stored.
    """
    keys, of_corners = _keys(corners)
    keys, first = np.unique(keys, return_index=True)
    corners, of_corners = corners[first], of_corners[first]
    order = np.argsort(of_corners, axis=1)
    a, b, c = np.moveaxis(np.take_along_axis(corners, order[..., None], 1).astype(float), 1, 0)
    normals = np.cross(b - a, c - a)
    double = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(double, 1e-300)[:, None]
    # Meshes have several vertices at a place where normals or texture coordinates differ.
    _, places = np.unique(np.take_along_axis(of_corners, order, 1), return_inverse=True)
    one, other = _neighbours(places.reshape(-1, 3))
    # Neighbouring triangles may be turned to opposite sides.
    smooth = np.abs((normals[one] * normals[other]).sum(1)) > np.cos(np.radians(CREASE))
    label = connected(len(keys), one[smooth], other[smooth])
    return keys, label, np.bincount(label, double / 2)


def _neighbours(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of triangles, of sorted corners (n, 3), that share an edge."""
    edges = triangles[:, [[0, 1], [1, 2], [0, 2]]].reshape(-1, 2)
    edge = edges[:, 0] * (int(edges.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(edge, kind="stable")
    same = edge[order][1:] == edge[order][:-1]
    return order[:-1][same] // 3, order[1:][same] // 3


def connected(count: int, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The component of each of `count` nodes in the graph of edges (one, other).

    Components are numbered from 0, in the order of their first nodes.
    """
    label = np.arange(count)
    while True:
        a, b = label[one], label[other]
        apart = a != b
        if not apart.any():
            return np.unique(label, return_inverse=True)[1]
        low, high = np.minimum(a, b)[apart], np.maximum(a, b)[apart]
        np.minimum.at(label, high, low)
        while (label != label[label]).any():
            label = label[label]
