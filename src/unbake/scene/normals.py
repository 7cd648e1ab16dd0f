"""Vertex normals that are not numbers, or not those of the surface.

Simplified scans have vertices whose triangles have no area. Programs that make normals of them
divide zero by zero, and Mitsuba takes what a file holds. A ray that hits a triangle there has a
shading frame of NaN: one such sample makes the loss of a whole step useless.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..fields.shapes import met_shapes
from .triangles import doubled_normals, normal_sums, triangles_of, unit

#: Lengths of normals may differ from 1 by this much.
_OFF = 0.1
#: Vertex normals are turned away from a triangle where they are so by this mean angle, in degrees:
#: those of a ball of twenty triangles are not, and those of a box that is smooth at its edges are.
TURNED = 40.0


def repair_normals(scene: mi.Scene) -> int:
    """Give vertices without a normal of length 1 the mean normal of their triangles, by area.

    Other normals stay as they are. A vertex that has only triangles without area, which no ray
    hits, gets +z.

    Args:
        scene: changed in place.

    Returns:
        How many there were.
    """
    count = 0
    for shape in met_shapes(scene):
        if not shape.is_mesh() or not shape.has_vertex_normals():
            continue
        normals = np.array(shape.vertex_normals_buffer(), np.float32).reshape(-1, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            length = np.linalg.norm(normals.astype(np.float64), axis=1)
        # OBJ files with normals for some faces alone leave the others as the memory was.
        broken = np.asarray(~(np.abs(length - 1) < _OFF))
        if not broken.any():
            continue
        positions, faces = triangles_of(shape)
        params = mi.traverse(shape)
        params["vertex_normals"] = repaired(normals, broken, positions, faces).ravel()
        params.update()
        count += int(broken.sum())
    return count


def turned_share(scene: mi.Scene) -> float:
    """The share of the surface whose vertex normals are turned away from it by `TURNED` or more.

    Mitsuba makes normals for meshes whose files have none, smooth across every edge: a box is
    shaded as if it were round.
    """
    turned = whole = 0.0
    for shape in met_shapes(scene):
        if not shape.is_mesh():
            continue
        positions, faces = triangles_of(shape)
        across = doubled_normals(positions, faces)
        area = np.linalg.norm(across, axis=1)
        whole += area.sum()
        if not shape.has_vertex_normals() or shape.has_face_normals():
            continue
        normals = np.array(shape.vertex_normals_buffer(), np.float64).reshape(-1, 3)[faces]
        along = np.abs(np.einsum("fi,fci->fc", across, normals))
        cosine = along / np.maximum(area, 1e-300)[:, None]
        angle = np.degrees(np.arccos(np.minimum(cosine, 1))).mean(1)
        turned += area[angle > TURNED].sum()
    return turned / max(whole, 1e-300)


def repaired(
    normals: np.ndarray, broken: np.ndarray, positions: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Normals with those of the triangles around vertices in the place of broken ones, (n, 3).

    Args:
        normals: (n, 3), of length 1 but for broken ones.
        broken: which are none, (n,) bool.
        positions: of the vertices, (n, 3).
        faces: (m, 3) indices.
    """
    sums, found = normal_sums(positions, faces), normals.copy()
    # Meshes may be turned inside out, their normals with them.
    inward = (sums[~broken] * normals[~broken]).sum() < 0
    found[broken] = unit(-sums[broken] if inward else sums[broken])
    return found
