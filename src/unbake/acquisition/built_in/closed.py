"""`cube` (paper Sec. 6.2, Table 2) and `furnace`: closed cubes [-1, 1]^3 with Lambertian walls."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np

from .cameras import Camera, camera
from .meshes import Mesh, merge, quad
from .writer import SceneWriter

FOV = 75.0
INSET = 0.9
# Table 2: the longest path at albedo 0.97 has 140 vertices.
MAX_DEPTH = 140


def write_cube(folder: Path, albedo: float) -> Path:
    """A closed cube lit by an area light on the ceiling. Paper: Sec. 6.2."""
    scene = SceneWriter(folder, cameras(1, 0)[0], max_depth=MAX_DEPTH)
    scene.mesh("walls", _inside(), scene.diffuse("wall", albedo))
    # The light reflects like the walls, so the mean path length is 1 / (1 - albedo).
    light = quad((-0.4, 0.4, 0.999), (0.8, 0, 0), (0, -0.8, 0), unit_uv=True)
    scene.mesh("light", light, scene.diffuse("light_wall", albedo), emission=(3.0, 3.0, 3.0))
    return scene.save()


def write_furnace(folder: Path, albedo: float) -> Path:
    """A closed cube whose walls emit E = 1 and reflect: the radiance is 1 / (1 - albedo)."""
    scene = SceneWriter(folder, cameras(1, 0)[0], max_depth=MAX_DEPTH)
    scene.mesh("walls", _inside(), scene.diffuse("wall", albedo), emission=(1.0, 1.0, 1.0))
    return scene.save()


def cameras(views: int, held_out: int) -> list[Camera]:
    """Training cameras at the eight corners, held-out ones near the edges, looking at the centre.

    More than eight (twelve) repeat the ring closer to the centre.
    """
    corners = [np.array(c) for c in product((-1, 1), repeat=3)]
    edges = [np.array(e) for e in product((-1, 0, 1), repeat=3) if sum(map(abs, e)) == 2]
    placed = [_ring(corners, i, "train") for i in range(views)]
    return placed + [_ring(edges, i, "heldout") for i in range(held_out)]


def _ring(directions: list[np.ndarray], index: int, split: str) -> Camera:
    lap, slot = divmod(index, len(directions))
    # A stride of 5 spreads few cameras over the whole ring (5 is coprime to 8 and 12).
    direction = directions[5 * slot % len(directions)]
    return camera(direction * INSET * 0.8**lap, (0, 0, 0), FOV, split)


def _inside() -> Mesh:
    # Overlapping walls leave no slit; the winding of a box is turned to face inwards.
    e = 1e-3
    outside = [
        quad((-1, -1, -1), (2, 0, 0), (0, 2, 0), overlap=e),
        quad((-1, 1, 1), (2, 0, 0), (0, -2, 0), overlap=e),
        quad((-1, -1, -1), (0, 0, 2), (2, 0, 0), overlap=e),
        quad((1, 1, -1), (0, 0, 2), (-2, 0, 0), overlap=e),
        quad((-1, 1, -1), (0, 0, 2), (0, -2, 0), overlap=e),
        quad((1, -1, -1), (0, 0, 2), (0, 2, 0), overlap=e),
    ]
    return merge(*outside)
