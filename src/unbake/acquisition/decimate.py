"""Meshes with fewer triangles, as those of photogrammetry have, by COLMAP's quadric errors."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..scene.triangles import creased, mesh_of, write_mesh

#: Meshes with fewer triangles stay as they are: a box has no tenth.
FEWEST = 64


def decimated(positions: np.ndarray, faces: np.ndarray, share: float) -> mi.Mesh:
    """A mesh of about so many of its triangles; it has new normals, and no texture coordinates.

    Args:
        positions: (n, 3).
        faces: (m, 3) indices, `FEWEST` at least.
        share: of the triangles, in (0, 1].

    Raises:
        UserError: pycolmap is missing.
    """
    try:
        import pycolmap
    except ImportError:
        remedy = "pip install 'unbake[import]'"
        raise UserError("fewer triangles need pycolmap", "--decimate", remedy) from None
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    # Vertices that differ in their normals or texture coordinates alone are one.
    joined, places = np.unique(positions.astype(np.float32), axis=0, return_inverse=True)
    options = pycolmap.MeshSimplificationOptions()
    options.target_face_ratio, options.num_threads = share, 1
    with TemporaryDirectory() as folder:
        before, after = Path(folder) / "before.ply", Path(folder) / "after.ply"
        write_mesh(before, joined, places.reshape(-1)[faces])
        pycolmap.simplify_mesh(before, after, options)
        params = mi.traverse(mi.load_dict({"type": "ply", "filename": str(after)}))
    positions = np.array(params["vertex_positions"]).reshape(-1, 3)
    vertices, faces, normals = creased(positions, np.array(params["faces"]).reshape(-1, 3))
    return mesh_of(positions[vertices], faces, normals)
