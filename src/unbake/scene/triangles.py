"""Meshes of triangles, made by Mitsuba of arrays."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from ..io import write_atomically


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
    a, b, c = np.moveaxis(positions[faces].astype(np.float64), 1, 0)
    sums = np.zeros((len(positions), 3))
    for corner in faces.T:
        np.add.at(sums, corner, np.cross(b - a, c - a))
    return sums


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of length 1, float32; those of length 0 become +z."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    known = np.isfinite(length) & (length > 0)
    scaled = np.where(known, vectors, [0.0, 0.0, 1.0]) / np.where(known, length, 1)
    return scaled.astype(np.float32)
