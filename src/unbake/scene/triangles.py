"""Meshes of triangles, made by Mitsuba of arrays."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from ..fields.pieces import slivers
from ..io import write_atomically

#: Triangles whose normals are less than this angle apart, in degrees, are of one smooth surface.
SMOOTH = 50.0
#: Corners whose normals are found at once.
_AT_ONCE = 1 << 20
#: Normals that are equal in so many decimals are one.
_DECIMALS = 5


def mesh_of(
    positions: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    *,
    name: str = "mesh",
) -> mi.Mesh:
    """A mesh; needs a Mitsuba variant to be set.

    Args:
        positions: (n, 3).
        faces: (m, 3) indices.
        normals: (n, 3) of unit length; None: facets.
        uv: (n, 2), v downwards: 0 is the first row of an image; None: there are none.
        name: its id.
    """
    mesh = mi.Mesh(
        name,
        len(positions),
        len(faces),
        has_vertex_normals=normals is not None,
        has_vertex_texcoords=uv is not None,
    )
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.ravel(positions).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    if normals is not None:
        params["vertex_normals"] = np.ravel(normals).astype(np.float32)
    if uv is not None:
        params["vertex_texcoords"] = np.ravel(uv).astype(np.float32)
    params.update()
    return mesh


def triangles_of(mesh: mi.Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Positions, (n, 3) float64, and faces, (m, 3) indices, of a mesh of Mitsuba."""
    positions = np.array(mesh.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    return positions, np.array(mesh.faces_buffer()).reshape(-1, 3)


def write_mesh(
    file: Path,
    positions: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
) -> None:
    """Write a mesh as binary PLY; see `mesh_of`.

    Raises:
        UserError: the file cannot be written.
    """
    save_mesh(file, mesh_of(positions, faces, normals, uv, name=file.stem))


def save_mesh(file: Path, mesh: mi.Mesh) -> None:
    """Write a mesh of Mitsuba as binary PLY, wholly or not at all.

    Raises:
        UserError: the file cannot be written.
    """
    write_atomically(file, lambda path: mesh.write_ply(str(path)), what="mesh")


def normal_sums(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The normals of the triangles at each vertex, times twice their areas, added up; (n, 3).

    Args:
        positions: (n, 3).
        faces: (m, 3) indices.
    """
    sums, normals = np.zeros((len(positions), 3)), doubled_normals(positions, faces)
    for corner in faces.T:
        np.add.at(sums, corner, normals)
    return sums


def triangle_areas(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas of triangles, (m,)."""
    return np.linalg.norm(doubled_normals(positions, faces), axis=1) / 2


def doubled_normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of triangles, as long as twice their areas; (m, 3) float64.

    Args:
        positions: (n, 3).
        faces: (m, 3) indices.
    """
    a, b, c = np.moveaxis(positions[faces].astype(np.float64), 1, 0)
    return np.cross(b - a, c - a)


def creased(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, ...]:
    """Normals for a mesh that has none: smooth, but at creases.

    A corner of a triangle has the mean normal of those triangles at its place whose normals are
    less than `SMOOTH` apart from its own one, weighted by their angles there (Thürmer and Wüthrich
    1998). Vertices at one place are taken as one, and a vertex with several normals becomes several
    ones. Neighbours that face opposite sides meet at a crease. Slivers have no say.

    Args:
        positions: (n, 3).
        faces: (m, 3) indices.

    Returns:
        Of each new vertex the number of its old one, (k,); faces (m, 3), indices of new ones; and
        their normals, (k, 3) float32 of length 1.
    """
    positions = np.asarray(positions, np.float32)
    of_faces, angles = _normals_and_angles(positions, faces)
    place = numbered(*positions.T)[1][faces].ravel()
    normals = np.zeros((faces.size, 3), np.float32)
    # Corners that count, in the order of their places; those of a place are in one part.
    order = np.flatnonzero(np.repeat(of_faces.any(1), 3))
    order = order[np.argsort(place[order], kind="stable")]
    starts = np.flatnonzero(np.diff(place[order], prepend=-1))
    cuts = np.searchsorted(starts, np.arange(_AT_ONCE, len(order), _AT_ONCE)) - 1
    for part in np.split(order, np.unique(starts[cuts])):
        own, unit_normals = angles[part, None] * of_faces[part // 3], of_faces[part // 3]
        sums, first, apart = own.copy(), np.arange(len(part)), 0
        while len(first):
            apart += 1
            first = first[: np.searchsorted(first, len(part) - apart)]
            first = first[place[part[first + apart]] == place[part[first]]]
            cosine = (unit_normals[first] * unit_normals[first + apart]).sum(1)
            near = first[cosine > np.cos(np.radians(SMOOTH))]
            sums[near] += own[near + apart]
            sums[near + apart] += own[near]
        normals[part] = sums
    normals = unit(normals)
    kept, new = numbered(*np.round(normals.T, _DECIMALS), faces.ravel())
    return faces.ravel()[kept], new.reshape(faces.shape), normals[kept]


def _normals_and_angles(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normals of triangles, (m, 3), zero of slivers, and angles at their corners, (3 m,)."""
    corners = [positions[column].astype(np.float64) for column in faces.T]
    sides = [corners[(i + 1) % 3] - corners[i] for i in range(3)]
    across = np.cross(sides[0], sides[1])
    area = np.linalg.norm(across, axis=1)
    known = ~slivers(np.stack([corner.T for corner in corners]), area)
    normals = np.where(known[:, None], across, 0) / np.where(known, area, 1)[:, None]
    dots = [-(sides[i] * sides[i - 1]).sum(1) for i in range(3)]
    return normals, np.arctan2(area, np.stack(dots)).T.ravel()


def numbered(*columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Kinds of equal rows.

    Args:
        columns: of the rows, (n,) each; kinds are in the order of the last one, then of others.

    Returns:
        The first row of each kind, and the kind of each row, (n,).
    """
    order = np.lexsort(columns)
    new = np.ones(len(order), bool)
    new[1:] = np.any([column[order][1:] != column[order][:-1] for column in columns], axis=0)
    kind = np.empty(len(order), np.int64)
    kind[order] = np.cumsum(new) - 1
    return order[new], kind


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of length 1, float32; those of length 0 become +z."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    known = np.isfinite(length) & (length > 0)
    scaled = np.where(known, vectors, [0.0, 0.0, 1.0]) / np.where(known, length, 1)
    return scaled.astype(np.float32)
