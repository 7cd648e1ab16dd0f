"""`cornell`: the Cornell box in principled paint, plain colours; open at the front (y = -1)."""

from __future__ import annotations

from pathlib import Path

from .cameras import Camera, camera, scattered
from .meshes import box, merge, quad, rotate_z
from .writer import SceneWriter

WHITE, RED, GREEN = (0.73, 0.71, 0.68), (0.63, 0.065, 0.05), (0.14, 0.45, 0.09)
MAX_DEPTH = 16
SLIT = 1e-3
ABOVE = ((-0.8, -0.9, 0.3), (0.8, 0.7, 0.8))
FRONT = ((-0.8, -0.97, -0.7), (0.8, -0.85, 0.7))


def write(folder: Path) -> Path:
    """Write the box [-1, 1]^3: two blocks under a ceiling light."""
    scene = SceneWriter(folder, camera((0, -3.4, 0), (0, 0, 0), 45.0), max_depth=MAX_DEPTH)
    white = scene.plain("white", WHITE, 0.8)
    floor = quad((-1, -1, -1), (2, 0, 0), (0, 2, 0), overlap=SLIT)
    ceiling = quad((-1, 1, 1), (2, 0, 0), (0, -2, 0), overlap=SLIT)
    back = quad((-1, 1, -1), (2, 0, 0), (0, 0, 2), overlap=SLIT)
    scene.mesh("room", merge(floor, ceiling, back), white)
    left = quad((-1, -1, -1), (0, 2, 0), (0, 0, 2), overlap=SLIT)
    right = quad((1, 1, -1), (0, -2, 0), (0, 0, 2), overlap=SLIT)
    scene.mesh("left", left, scene.plain("red", RED, 0.6))
    scene.mesh("right", right, scene.plain("green", GREEN, 0.6))
    tall = box((-0.63, 0.05, -1), (-0.05, 0.63, 0.2), omit=("-z",))
    short = box((0.05, -0.65, -1), (0.62, -0.08, -0.42), omit=("-z",))
    scene.mesh("tall", rotate_z(tall, 17, (-0.34, 0.34, 0)), scene.plain("tall", WHITE, 0.5))
    scene.mesh("short", rotate_z(short, -17, (0.34, -0.36, 0)), scene.plain("short", WHITE, 0.5))
    light = quad((-0.3, 0.25, 0.995), (0.6, 0, 0), (0, -0.5, 0), unit_uv=True)
    black = scene.diffuse("light_wall", 0.0)
    scene.mesh("light", light, black, emission=(13.0, 10.0, 6.5))
    return scene.save()


def cameras(views: int, held_out: int) -> list[Camera]:
    """Cameras in the free upper half of the box and at its open front, turned to all its sides."""
    train = [_place(2 * i + 1, "train") for i in range(views)]
    return train + [_place(2 * i + 2, "heldout") for i in range(held_out)]


def _place(index: int, split: str) -> Camera:
    # Two places in three lie above the blocks, the third at the opening; the targets keep away
    # from the opening, behind which there is nothing.
    if index % 3:
        origin, target = scattered(index, ABOVE, ((-1, -0.4, -1), (1, 1, 0.6)))
    else:
        origin, target = scattered(index, FRONT, ((-1, 0, -1), (1, 1, 1)))
    return camera(origin, target, 75.0, split)
