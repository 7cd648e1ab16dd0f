"""Faces of more than three corners, divided into triangles that fill them and nothing else."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..errors import UserError

#: Twice the area that counts as none, as a share of that of a face.
_SLIVER = 1e-6
#: A face of an OBJ file, with four corners or more, and its corners; a vertex, and its place.
#: trimesh 5.2 takes lines alone that begin with `f` or `v`.
_FACE = re.compile(rb"(?m)^f((?:[ \t]+[-0-9/]+){4,})[^\r\n]*")
_VERTEX = re.compile(rb"(?m)^v([ \t]+\S+[ \t]+\S+[ \t]+\S+)")
#: What a corner says of its texture and normal.
_OTHERS = re.compile(rb"/\S*")


def beyond_fans(
    positions: np.ndarray, corners: np.ndarray, lengths: np.ndarray, file: Path
) -> dict[int, np.ndarray]:
    """The triangles of faces that a fan around their first corner does not fill.

    Triangles that all face the way of their face fill it, once, and nothing else: that is what is
    looked for. Quads that cross themselves, as scans have some, are left to a fan.

    Args:
        positions: (n, 3), of the vertices.
        corners: the vertices of all faces, one face after the other, (corners,).
        lengths: how many corners each face has, (faces,).
        file: for the error message.

    Returns:
        By the number of the face: (its corners - 2, 3), numbers of its corners.

    Raises:
        UserError: faces of more corners cross themselves.
    """
    firsts = np.cumsum(lengths) - lengths
    found, crossed = {}, 0
    for length in np.unique(lengths[lengths > 3]):
        numbers = np.flatnonzero(lengths == length)
        places = positions[corners[firsts[numbers, None] + np.arange(length)]]
        with np.errstate(all="ignore"):  # positions that are no numbers are told elsewhere
            beyond = np.flatnonzero(_beyond_fan(places))
        for face in beyond:
            triangles = ears(places[face])
            if triangles is not None:
                found[int(numbers[face])] = triangles
            elif length > 4:
                crossed += 1
    if crossed:
        what = f"faces of the mesh cross themselves ({crossed})"
        raise UserError(what, file, "Export it with triangulated faces, or as GLB")
    return found


def fan(corners: int) -> np.ndarray:
    """Triangles around the first corner of a face, (corners - 2, 3)."""
    second = np.arange(1, corners - 1)
    return np.stack([np.zeros_like(second), second, second + 1], 1)


def ears(corners: np.ndarray) -> np.ndarray | None:
    """Triangles that fill a flat face, by clipping ears.

    Args:
        corners: (n, 3), in order; a face with holes may go to them and back.

    Returns:
        (n - 2, 3) numbers of corners; None: the face crosses itself.
    """
    flat = _flattened(corners)
    if flat is None:
        return None
    least = _SLIVER * _doubled_areas(flat, np.roll(flat, -1, 0), flat.mean(0)).sum()
    left, triangles, start = np.arange(len(flat)), [], 0
    while len(left) > 2:
        around = np.stack([np.roll(left, 1), left, np.roll(left, -1)], 1)
        areas = _doubled_areas(*(flat[around[:, k]] for k in range(3)))
        order = np.roll(np.arange(len(left)), -start)
        ear = next((k for k in order if areas[k] > least and _is_ear(flat, left, around[k])), None)
        if ear is None:
            ear = int(np.argmin(np.abs(areas)))  # a corner on a straight line
            if abs(areas[ear]) > least:
                return None
        triangles.append(around[ear])
        left = np.delete(left, ear)
        start = ear % len(left)
    return np.array(triangles)


def obj_in_triangles(file: Path) -> bytes | None:
    """An OBJ file in which all faces are triangles that a fan would not fill.

    Corners keep their texture coordinates and normals, and faces their place in the file.

    Returns:
        None: fans fill all of them, or the file is none that can be read.

    Raises:
        UserError: faces cross themselves.
    """
    text = file.read_bytes().replace(b"\\\r\n", b"").replace(b"\\\n", b"")
    faces = _FACE.findall(text)
    if not faces:
        return None
    try:
        positions = np.array(list(map(float, b" ".join(_VERTEX.findall(text)).split())))
        positions = positions.reshape(-1, 3)
        corners = np.array(list(map(int, _OTHERS.sub(b"", b" ".join(faces)).split())))
        corners = np.where(corners > 0, corners - 1, corners + len(positions))
        lengths = np.array([len(face.split()) for face in faces])
        triangles = beyond_fans(positions, corners, lengths, file)
    except (ValueError, IndexError):
        return None  # trimesh tells what is wrong with it
    if not triangles:
        return None

    def lines() -> Iterator[bytes | None]:
        for number, face in enumerate(faces):
            own, words = triangles.get(number), face.split()
            yield (
                None
                if own is None
                else b"\n".join(
                    b"f " + b" ".join(words[corner] for corner in triangle) for triangle in own
                )
            )

    written = lines()
    return _FACE.sub(lambda match: next(written) or match.group(), text)


def _beyond_fan(corners: np.ndarray) -> np.ndarray:
    """Whether a triangle of the fan of a face turns its back, for faces (m, n, 3): (m,) bool."""
    edges = corners[:, 1:] - corners[:, :1]
    normals = np.cross(edges[:, :-1], edges[:, 1:])
    whole = normals.sum(1)
    along = np.einsum("mnk,mk->mn", normals, whole)
    limit = _SLIVER * np.einsum("mk,mk->m", whole, whole)
    return (along < -limit[:, None]).any(1)


def _flattened(corners: np.ndarray) -> np.ndarray | None:
    """A face (n, 3) in its plane, counterclockwise: (n, 2); None: it has no area."""
    edges = corners - corners[0]
    normal = np.cross(edges, np.roll(edges, -1, 0)).sum(0)
    if not normal.any():
        return None
    side = np.eye(3)[np.argmin(np.abs(normal))]
    x = np.cross(side, normal)
    y = np.cross(normal, x)
    return edges @ np.stack([x / np.linalg.norm(x), y / np.linalg.norm(y)], 1)


def _doubled_areas(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles of points (..., 2), positive where they are counterclockwise."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _is_ear(flat: np.ndarray, left: np.ndarray, ear: np.ndarray) -> bool:
    """Whether no corner of a face lies in a triangle of three of it, and no edge crosses the cut.

    Corners at one place with one of the triangle's do no harm, as where a face goes to a hole.
    """
    a, b, c = flat[ear]
    points = flat[left]
    apart = ~(points[:, None] == flat[ear]).all(2).any(1)
    sides = np.stack([_doubled_areas(p, q, points) for p, q in ((a, b), (b, c), (c, a))])
    if ((sides >= 0).all(0) & apart).any():
        return False
    after = np.roll(points, -1, 0)
    over = sides[2] * np.roll(sides[2], -1) < 0
    across = _doubled_areas(points, after, a) * _doubled_areas(points, after, c) < 0
    return not (over & across).any()
