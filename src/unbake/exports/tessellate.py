"""Spheres, disks and cylinders as triangles, in Mitsuba's own texture coordinates."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ..scene.triangles import doubled_normals, triangle_areas, unit

#: Around a circle, and from pole to pole.
_AROUND, _ALONG = 128, 64
#: The share of its area by which a sheet faces one way, at least.
_SHEET = 0.01
#: Plugins that become triangles.
TESSELLATED = ("sphere", "disk", "cylinder")


@dataclass(frozen=True, eq=False)
class Triangles:
    """A triangle mesh: arrays of float32, and indices of corners."""

    positions: np.ndarray  #: (n, 3)
    faces: np.ndarray  #: (m, 3) uint32, counterclockwise seen from the side of the normal
    normals: np.ndarray | None  #: (n, 3), unit; None: faces are flat
    uv: np.ndarray | None  #: (n, 2), Mitsuba's texture coordinates; None: there are none
    #: Values stored in the mesh by their names: `vertex_…` (n, k), `face_…` (m, k).
    stored: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
        """All four, as functions for meshes take them."""
        return self.positions, self.faces, self.normals, self.uv

    def moved(self, matrix: np.ndarray) -> Triangles:
        """The same after an affine map (4, 4); a mirroring one turns the triangles around."""
        linear = matrix[:3, :3].astype(np.float64)
        positions = self.positions @ linear.T + matrix[:3, 3]
        normals = None
        if self.normals is not None:
            normals = unit(self.normals @ np.linalg.pinv(linear))
        moved = replace(self, positions=positions.astype(np.float32), normals=normals)
        return moved.reversed_faces() if np.linalg.det(linear) < 0 else moved

    def reversed_faces(self) -> Triangles:
        """The same with triangles of the other orientation; normals stay."""
        return replace(self, faces=np.ascontiguousarray(self.faces[:, ::-1]))

    def turned(self) -> Triangles:
        """The same seen from the other side: triangles and normals are turned around."""
        normals = None if self.normals is None else -self.normals
        return replace(self.reversed_faces(), normals=normals)

    def of_vertices(
        self, used: np.ndarray, faces: np.ndarray, kept: np.ndarray | None = None
    ) -> Triangles:
        """Triangles of some vertices of these.

        Args:
            used: (k,) numbers of vertices.
            faces: (j, 3) uint32, indices of `used`.
            kept: which triangles they are, (m,) bool; None: all.
        """
        stored = {}
        for name, values in self.stored.items():
            chosen = used if name.startswith("vertex_") else kept
            stored[name] = values if chosen is None else values[chosen]
        return Triangles(
            self.positions[used],
            faces,
            None if self.normals is None else self.normals[used],
            None if self.uv is None else self.uv[used],
            stored,
        )

    def areas(self) -> np.ndarray:
        """The areas of the triangles, (m,) float64."""
        return triangle_areas(self.positions, self.faces)

    @property
    def is_closed(self) -> bool:
        """Whether as much of it faces one way as the other: a solid, or a tube, but no sheet."""
        total = np.linalg.norm(doubled_normals(self.positions, self.faces).sum(0))
        return bool(total < _SHEET * 2 * self.areas().sum())


def tessellated(plugin: str) -> Triangles:
    """A shape of `TESSELLATED` in its own space, with the parameters that Mitsuba gives points.

    The vertices lie on the shape. Triangles of a sphere are inside of it by 0.03 % of its radius
    at most.
    """
    if plugin == "sphere":
        u, v = _lattice(_AROUND, _ALONG)
        sin, cos = np.sin(v * math.pi), np.cos(v * math.pi)
        across = 2 * math.pi * u
        positions = np.stack([sin * np.cos(across), sin * np.sin(across), cos], -1)
        return _mesh(positions, positions, np.stack([u, v], -1), _ALONG, turned=True)
    if plugin == "disk":
        v, u = _lattice(_AROUND, 8)  # Mitsuba: the first coordinate is the radius
        across = 2 * math.pi * v
        positions = np.stack([u * np.cos(across), u * np.sin(across), 0 * u], -1)
        normals = np.broadcast_to([0.0, 0.0, 1.0], positions.shape)
        return _mesh(positions, normals, np.stack([u, v], -1), 8, turned=True)
    u, v = _lattice(_AROUND, 1)
    across = 2 * math.pi * u
    normals = np.stack([np.cos(across), np.sin(across), 0 * u], -1)
    positions = np.stack([np.cos(across), np.sin(across), v], -1)
    return _mesh(positions, normals, np.stack([u, v], -1), 1, turned=False)


def _lattice(across: int, along: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(across + 1) / across, np.arange(along + 1) / along)
    return u.ravel(), v.ravel()


def _mesh(
    positions: np.ndarray, normals: np.ndarray, uv: np.ndarray, along: int, *, turned: bool
) -> Triangles:
    first = np.arange(along)[:, None] * (_AROUND + 1) + np.arange(_AROUND)
    a, b, c, d = (np.ravel(first + k) for k in (0, 1, _AROUND + 1, _AROUND + 2))
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).astype(np.uint32)
    mesh = Triangles(
        positions.astype(np.float32), faces, unit(np.array(normals)), uv.astype(np.float32)
    )
    mesh = mesh.reversed_faces() if turned else mesh
    # Poles and centres are one point: half of the triangles there have no area.
    kept = mesh.areas() > 1e-12
    return Triangles(mesh.positions, mesh.faces[kept], mesh.normals, mesh.uv)
