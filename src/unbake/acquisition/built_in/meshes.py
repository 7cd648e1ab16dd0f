"""Triangle meshes of the built-in scenes: quads, boxes, surfaces of revolution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from ...scene.triangles import write_mesh

Vec3 = Sequence[float] | np.ndarray


@final
@dataclass(frozen=True)
class Mesh:
    """An indexed triangle mesh whose faces wind counter-clockwise seen from outside.

    `positions` (n, 3) in world units, `uv` (n, 2), `faces` (m, 3) indices, `normals` (n, 3) of
    unit length for smooth shading or None for facets.
    """

    positions: np.ndarray
    uv: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None

    def write(self, path: Path) -> None:
        """Write the mesh as binary PLY; needs a Mitsuba variant to be set."""
        write_mesh(path, self.positions, self.faces, self.normals, self.uv)


def merge(*meshes: Mesh) -> Mesh:
    """Join meshes into one; either all of them are smooth or none is."""
    offsets = np.cumsum([0] + [len(m.positions) for m in meshes[:-1]])
    normals = [m.normals for m in meshes if m.normals is not None]
    return Mesh(
        np.concatenate([m.positions for m in meshes]),
        np.concatenate([m.uv for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)]),
        np.concatenate(normals) if normals else None,
    )


def quad(corner: Vec3, u: Vec3, v: Vec3, *, overlap: float = 0.0, unit_uv: bool = False) -> Mesh:
    """A parallelogram with normal u x v.

    UVs are metres along `u` and `v` from `corner`, or [0, 1] with `unit_uv`. `overlap` lets the
    quad stick out at every side by that many metres, so that walls leave no slit between them.
    """
    origin, u, v = (np.asarray(a, dtype=np.float64) for a in (corner, u, v))
    lengths = np.array([np.linalg.norm(u), np.linalg.norm(v)])
    ends = np.stack([-overlap / lengths, 1 + overlap / lengths], axis=1)
    st = np.array([[ends[0, i], ends[1, j]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    positions = origin + st[:, :1] * u + st[:, 1:] * v
    uv = st if unit_uv else st * lengths
    return Mesh(positions, uv, np.array([[0, 1, 2], [0, 2, 3]]))


def box(low: Vec3, high: Vec3, *, omit: Sequence[str] = (), unit_uv: bool = False) -> Mesh:
    """An axis-aligned box; `omit` names the faces to leave out, as in ("-z", "+y").

    Faces that rest on other surfaces can be left out: no camera sees them.
    UVs are metres from the lower corner of each face, or [0, 1] with `unit_uv`.
    """
    corner = np.asarray(low, dtype=np.float64)
    x, y, z = np.diag(np.asarray(high, dtype=np.float64) - corner)
    sides = {
        "-x": (corner + y, -y, z),
        "+x": (corner + x, y, z),
        "-y": (corner, x, z),
        "+y": (corner + x + y, -x, z),
        "-z": (corner + y, x, -y),
        "+z": (corner + z, x, y),
    }
    return merge(*(quad(*side, unit_uv=unit_uv) for n, side in sides.items() if n not in omit))


def rotate_z(mesh: Mesh, degrees: float, centre: Vec3) -> Mesh:
    """The mesh turned about the vertical axis through `centre`."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    centre = np.asarray(centre, dtype=np.float64)
    normals = None if mesh.normals is None else mesh.normals @ turn.T
    return Mesh((mesh.positions - centre) @ turn.T + centre, mesh.uv, mesh.faces, normals)


def lathe(base: Vec3, profile: Sequence[tuple[float, float]], *, segments: int = 48) -> Mesh:
    """A smooth surface of revolution about the vertical axis through `base`.

    `profile` holds (radius, height above base) from the start to the end of the outline; walked
    upwards, the outside is on the right. Repeat a point to get a crease. u is the angle / 2 pi,
    v the length along the outline / its whole length.
    """
    outline = np.asarray(profile, dtype=np.float64)
    steps = np.linalg.norm(np.diff(outline, axis=0), axis=1)
    v = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    angle = np.linspace(0.0, 2 * np.pi, segments + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    slopes = _outline_normals(outline)
    rows, columns = len(outline), segments + 1
    positions = np.zeros((rows, columns, 3))
    positions[..., :2] = outline[:, None, :1] * ring
    positions[..., 2] = outline[:, None, 1]
    normals = np.zeros_like(positions)
    normals[..., :2] = slopes[:, None, :1] * ring
    normals[..., 2] = slopes[:, None, 1]
    uv = np.stack(np.broadcast_arrays(angle / (2 * np.pi), v[:, None]), axis=-1)
    faces = _lathe_faces(outline, columns)
    return Mesh(
        positions.reshape(-1, 3) + np.asarray(base, dtype=np.float64),
        uv.reshape(-1, 2),
        faces,
        normals.reshape(-1, 3),
    )


def _outline_normals(outline: np.ndarray) -> np.ndarray:
    """Unit normals (n, 2) of an outline: the mean of both sides, one-sided at repeated points."""
    edges = np.diff(outline, axis=0)
    lengths = np.linalg.norm(edges, axis=1, keepdims=True)
    sides = edges[:, ::-1] * (1, -1) / np.where(lengths > 0, lengths, 1.0)
    total = np.zeros_like(outline)
    total[:-1] += sides
    total[1:] += sides
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def _lathe_faces(outline: np.ndarray, columns: int) -> np.ndarray:
    """Triangles between neighbouring rings, without those that shrink to a line."""
    faces = []
    for row in range(len(outline) - 1):
        if np.allclose(outline[row], outline[row + 1]):
            continue
        a = row * columns + np.arange(columns - 1)
        b, c, d = a + 1, a + 1 + columns, a + columns
        if outline[row, 0] > 0:
            faces.append(np.stack([a, b, c], axis=1))
        if outline[row + 1, 0] > 0:
            faces.append(np.stack([a, c, d], axis=1))
    return np.concatenate(faces)


def ball(centre: Vec3, radius: float, *, rows: int = 24) -> Mesh:
    """A sphere, as a surface of revolution."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rows + 1)
    radii = np.cos(angle)
    radii[[0, -1]] = 0.0
    outline = np.stack([radius * radii, radius * np.sin(angle)], axis=1)
    return lathe(centre, [tuple(p) for p in outline])


def cylinder(base: Vec3, radius: float, height: float, *, segments: int = 48) -> Mesh:
    """An upright cylinder with a lid and without a bottom."""
    outline = [(radius, 0.0), (radius, height), (radius, height), (0.0, height)]
    return lathe(base, outline, segments=segments)
