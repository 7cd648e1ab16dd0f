"""The surfaces of a scene with so many vertices that colours can be given to each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..exports.observed import Views
from ..exports.parts import Part
from ..exports.tessellate import Triangles
from ..fields.arrays import from_numpy
from ..scene.triangles import normal_sums

#: Vertices, about; scenes that have more of their own keep them.
VERTICES = 120_000
#: Triangles of a part without normals whose corners get normals of their own.
_FLAT = 200_000
#: Of surfaces that no fit optimizes, 8-bit sRGB: of lamps, and of all else.
_LAMP, _OTHER = (255, 244, 214), (158, 158, 158)


@dataclass(frozen=True, eq=False)
class Surface:
    """All parts of a scene as one mesh, in world space; n vertices."""

    positions: np.ndarray  #: (n, 3) float32
    normals: np.ndarray  #: (n, 3) float32, unit; of surfaces with two sides on either of them
    faces: np.ndarray  #: (m, 3) uint32; counterclockwise on the side that is to be seen
    uv: np.ndarray  #: (n, 2) float32, the scene's texture coordinates; 0 where there are none
    materials: np.ndarray  #: (n,) uint32, numbers of materials as in `edit.material_names`
    optimized: np.ndarray  #: (n,) bool: a fit optimizes the material
    pieces: np.ndarray | None  #: (n, 3), as `Pieces.of` tells them, where parts do
    plain: np.ndarray  #: (n, 3) uint8 sRGB, colours of what is not optimized


@dataclass(frozen=True, eq=False)
class _Mesh:
    """A mesh whose vertices have rows of numbers."""

    rows: np.ndarray  # (n, 8) float64: position, normal, texture coordinates
    part: np.ndarray  # (n,) numbers of parts
    pieces: np.ndarray  # (n, 3), zeros where parts tell none
    faces: np.ndarray  # (m, 3) int64


def make_surface(
    parts: Sequence[Part], views: Views | None = None, vertices: int = VERTICES
) -> Surface:
    """The surfaces of all parts, divided until colours at vertices show textures.

    Of parts with two sides, triangles face the training views: those of a room can be looked
    through from outside. Where views see both sides, there is a triangle for each.

    Args:
        parts: of the scene.
        views: the training views; None: triangles stay as they are.
        vertices: how many there should be.
    """
    mesh = _joined(parts)
    corners = mesh.rows[mesh.faces][..., :3]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    ).sum()
    # Triangles have about 0.14 of the square of the longest edge, and there are two a vertex.
    mesh = _refined(mesh, float(np.sqrt(area / 2 / (0.14 * 2 * vertices))), 4 * vertices)
    faces = mesh.faces
    if views is not None:
        two_sided = np.array([part.two_sided for part in parts])
        faces = _facing(mesh, two_sided[mesh.part[faces[:, 0]]], views)
    optimized = np.array([part.is_optimized for part in parts])
    plain = np.array([_OTHER if p.emitter is None else _LAMP for p in parts], np.uint8)
    numbers = np.array([p.materials[0] if p.is_optimized else 0 for p in parts], np.uint32)
    normals = mesh.rows[:, 3:6]
    length = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return Surface(
        mesh.rows[:, :3].astype(np.float32),
        (normals / length).astype(np.float32),
        faces.astype(np.uint32),
        mesh.rows[:, 6:].astype(np.float32),
        numbers[mesh.part],
        optimized[mesh.part],
        None if any(p.pieces is None for p in parts) else mesh.pieces.astype(np.float32),
        plain[mesh.part],
    )


def _joined(parts: Sequence[Part]) -> _Mesh:
    rows, numbers, pieces, faces, first = [], [], [], [], 0
    for number, part in enumerate(parts):
        triangles, normals = _with_normals(part.triangles)
        count = len(triangles.positions)
        uv = np.zeros((count, 2)) if triangles.uv is None else triangles.uv
        rows.append(np.hstack([triangles.positions, normals, np.nan_to_num(uv)]))
        numbers.append(np.full(count, number))
        # A vertex between pieces is of one of them.
        of_vertex = np.zeros((count, 3))
        if part.pieces is not None:
            of_vertex[triangles.faces] = part.pieces[:, None]
        pieces.append(of_vertex)
        faces.append(triangles.faces.astype(np.int64) + first)
        first += count
    return _Mesh(
        np.concatenate(rows).astype(np.float64),
        np.concatenate(numbers),
        np.concatenate(pieces),
        np.concatenate(faces),
    )


def _with_normals(triangles: Triangles) -> tuple[Triangles, np.ndarray]:
    """The triangles and their normals.

    Where these are those of faces, faces get corners of their own, if they are not too many.
    """
    if triangles.normals is not None:
        return triangles, triangles.normals
    if len(triangles.faces) <= _FLAT:
        corners = triangles.faces.ravel()
        uv = None if triangles.uv is None else triangles.uv[corners]
        faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
        triangles = Triangles(triangles.positions[corners], faces, None, uv)
    normals = normal_sums(triangles.positions, triangles.faces)
    return triangles, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _refined(mesh: _Mesh, longest: float, most: int) -> _Mesh:
    """The mesh with edges of this length at most, or about so many triangles.

    Whether an edge is split depends on the edge alone, so that neighbours fit each other.
    """
    while longest > 0 and len(mesh.faces) < most:
        ends = mesh.rows[:, :3][mesh.faces]
        long = np.linalg.norm(ends - np.roll(ends, -1, axis=1), axis=2) > longest
        if not long.any():
            break
        mesh = _split(mesh, long)
    return mesh


def _split(mesh: _Mesh, long: np.ndarray) -> _Mesh:
    """The mesh with a new vertex in the middle of each long edge.

    Args:
        long: (m, 3) bool: the edges from corners 0, 1 and 2 to the next ones.
    """
    faces, count = mesh.faces, len(mesh.rows)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), axis=-1)
    keys, where = np.unique(edges[long] @ [count, 1], return_inverse=True)
    a, b = np.divmod(keys.astype(np.int64), count)
    middle = np.full(faces.shape, -1)
    middle[long] = count + where.ravel()
    pieces = [faces[~long.any(1)]]
    for n in (1, 2, 3):
        chosen = long.sum(1) == n
        # Turned so that the edge from corner 0 is long, and the one to it is not, if there is one.
        turn = np.argmax(long[chosen] & ~np.roll(long[chosen], 1, axis=1), axis=1)
        order = (turn[:, None] + np.arange(3)) % 3
        p, q, r = np.take_along_axis(faces[chosen], order, 1).T
        x, y, z = np.take_along_axis(middle[chosen], order, 1).T
        new = {
            1: [(p, x, r), (x, q, r)],
            2: [(x, q, y), (p, x, y), (p, y, r)],
            3: [(p, x, z), (x, q, y), (z, y, r), (x, y, z)],
        }[n]
        pieces += [np.stack(piece, -1) for piece in new]
    rows = np.concatenate([mesh.rows, (mesh.rows[a] + mesh.rows[b]) / 2])
    part = np.concatenate([mesh.part, mesh.part[a]])
    of_vertex = np.concatenate([mesh.pieces, mesh.pieces[a]])
    return _Mesh(rows, part, of_vertex, np.concatenate(pieces))


def _facing(mesh: _Mesh, two_sided: np.ndarray, views: Views) -> np.ndarray:
    """The triangles, those with two sides turned to where views see them from."""
    if not two_sided.any():
        return mesh.faces
    faces = mesh.faces[two_sided]
    a, b, c = np.moveaxis(mesh.rows[:, :3][faces], 1, 0)
    centre, normal = (a + b + c) / 3, np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    front, back = _seen(views, centre, normal), _seen(views, centre, -normal)
    # What no view sees goes with the rest of its part.
    part = mesh.part[faces[:, 0]]
    balance = np.bincount(part, back.astype(float) - front, minlength=part.max() + 1)
    unseen, turned = ~(front | back), balance[part] > 0
    shows_back, shows_front = back | (unseen & turned), front | (unseen & ~turned)
    return np.concatenate([mesh.faces[~two_sided], faces[shows_front], faces[shows_back][:, ::-1]])


def _seen(views: Views, positions: np.ndarray, normals: np.ndarray) -> np.ndarray:
    p, n = (mi.Point3f(*(from_numpy(mi.Float, x) for x in a.T)) for a in (positions, normals))
    width = len(positions)
    nothing, everything = dr.zeros(mi.Bool, width), dr.full(mi.Bool, True, width)
    return np.array(views.see(p, mi.Normal3f(n), nothing, everything))
