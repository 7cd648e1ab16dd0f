"""Meshes with fewer triangles, as those of photogrammetry have, by COLMAP's quadric errors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..scene.triangles import creased, mesh_of, triangle_areas, triangles_of, write_mesh

#: Meshes with fewer triangles stay as they are: a box has no tenth.
FEWEST = 64
#: Positions, (n, 3), and faces, (m, 3) indices.
Mesh = tuple[np.ndarray, np.ndarray]
#: How much more moving an open border costs than moving the surface: enough for the outlines of
#: walls to stay, and for rims that nobody sees not to take the triangles of what is seen.
_BORDER = 10.0
#: Triangles and part of its area with which a mesh still is one, and those of each that COLMAP is
#: to leave at least.
_SOLID, _SHRUNK, _FEW = 8, 0.5, 2
#: Of the triangle that ends each mesh: how far away it is, and how large, in sizes of the scene.
_FAR, _LARGE = 10.0, 4.0


def decimated(meshes: Sequence[Mesh], share: float) -> list[mi.Mesh]:
    """Meshes of about so many triangles, together: where they are dense, they lose more of them.

    Args:
        meshes: of one scene, in units of their own places in the scene file; `FEWEST` triangles at
            least.
        share: of all triangles, in (0, 1].

    Returns:
        The meshes, with new normals, and without texture coordinates.

    Raises:
        UserError: pycolmap is missing.
    """
    if not meshes:
        return []
    joined = [_joined(*mesh) for mesh in meshes]
    kept = _simplified(joined, share)
    # What is small beside the errors of all others becomes a flake, or nothing.
    for i, (few, old) in enumerate(zip(kept, joined, strict=True)):
        if (
            len(few[1]) < _SOLID
            or triangle_areas(*few).sum() < _SHRUNK * triangle_areas(*old).sum()
        ):
            (alone,) = _simplified([old], share)
            kept[i] = alone if len(alone[1]) else old
    return [_creased(*mesh) for mesh in kept]


def _joined(positions: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh whose vertices differ in their positions."""
    joined, places = np.unique(positions.astype(np.float32), axis=0, return_inverse=True)
    return joined, places.reshape(-1)[faces]


def _together(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of several."""
    counts = np.cumsum([0, *(len(positions) for positions, _ in meshes)])
    faces = [faces + first for (_, faces), first in zip(meshes, counts, strict=False)]
    return np.concatenate([positions for positions, _ in meshes]), np.concatenate(faces)


def _simplified(meshes: Sequence[Mesh], share: float) -> list[Mesh]:
    """Meshes with so many of their triangles, together; they share an array of vertices."""
    every = np.concatenate([positions for positions, _ in meshes])
    low, size = every.min(0), np.ptp(every, axis=0).max()
    # Triangles stay in their order. One that is too large to go, far from all others, ends each
    # mesh.
    end = low + size * (np.array([[0, 0, 0], [_LARGE, 0, 0], [0, _LARGE, 0]]) - _FAR)
    ends = ((end, np.array([[0, 1, 2]])) for _ in meshes)
    positions, faces = _together([part for pair in zip(meshes, ends, strict=True) for part in pair])
    wanted = max(share * (len(faces) - len(meshes)), _FEW * len(meshes)) + len(meshes)
    positions, faces = _by_colmap(positions, faces, min(wanted / len(faces), 1))
    last = np.flatnonzero((positions[faces] < low - size).all((1, 2)))
    if len(last) != len(meshes):
        raise RuntimeError("COLMAP's simplification has lost the order of triangles")
    return [(positions, part[:-1]) for part in np.split(faces, last + 1)[:-1]]


def _by_colmap(positions: np.ndarray, faces: np.ndarray, share: float) -> Mesh:
    """A mesh with so many of its triangles, in their order."""
    try:
        import pycolmap
    except ImportError:
        remedy = "pip install 'unbake[import]'"
        raise UserError("fewer triangles need pycolmap", "--decimate", remedy) from None
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    options = pycolmap.MeshSimplificationOptions()
    options.target_face_ratio, options.num_threads = share, 1
    options.boundary_weight = _BORDER
    with TemporaryDirectory() as folder:
        before, after = Path(folder) / "before.ply", Path(folder) / "after.ply"
        write_mesh(before, positions, faces)
        pycolmap.simplify_mesh(before, after, options)
        return triangles_of(mi.load_dict({"type": "ply", "filename": str(after)}))


def _creased(positions: np.ndarray, faces: np.ndarray) -> mi.Mesh:
    """The mesh of some faces, with normals of its own."""
    used, faces = np.unique(faces, return_inverse=True)
    positions = positions[used]
    vertices, faces, normals = creased(positions, faces.reshape(-1, 3))
    return mesh_of(positions[vertices], faces, normals)
