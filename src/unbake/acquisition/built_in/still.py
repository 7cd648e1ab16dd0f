"""`still`: a few glazed things on a slab under a sky, to recover its light from (Fig. 8)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from . import demo_paint as paint
from .cameras import Camera, camera, halton
from .meshes import ball, box, lathe
from .writer import SceneWriter

FOV = 40.0
DISTANCE = 4.2
CENTRE = (0.0, 0.0, 0.35)
MAX_DEPTH = 16
SKY_ROWS = 64


def write(folder: Path) -> Path:
    """Write the things on [-1, 1]² and the sky above (and below) them."""
    scene = SceneWriter(folder, cameras(1, 0)[0], max_depth=MAX_DEPTH)
    slab = scene.painted("slab", *paint.checked())
    scene.mesh("slab", box((-1, -1, -0.15), (1, 1, 0)), slab)
    outline = [(0.34, 0.0), (0.36, 0.06), (0.2, 0.16), (0.14, 0.5), (0.2, 0.56), (0.1, 0.62)]
    outline += [(0.19, 0.74), (0.2, 0.86), (0.14, 0.98), (0.0, 1.03)]
    pawn = scene.painted("pawn", *paint.glazed((0.75, 0.7, 0.6), (0.5, 0.32, 0.2)))
    scene.mesh("pawn", lathe((-0.35, 0.3, 0), outline), pawn)
    scene.mesh("ball", ball((0.45, 0.35, 0.4), 0.4), scene.plain("ball", (0.7, 0.7, 0.7), 0.25))
    bowl = [(0.14, 0.0), (0.34, 0.12), (0.42, 0.3), (0.42, 0.3), (0.39, 0.3), (0.3, 0.13)]
    bowl += [(0.0, 0.05)]
    clay = scene.painted("clay", *paint.banded((0.7, 0.36, 0.22), (0.82, 0.66, 0.5), 0.4, 0.75))
    scene.mesh("bowl", lathe((0.15, -0.5, 0), bowl), clay)
    scene.environment("sky", _sky(SKY_ROWS))
    return scene.save()


def cameras(views: int, held_out: int) -> list[Camera]:
    """Cameras on a hemisphere, 10° to 70° above the slab, looking at the things."""
    train = [_place(2 * i + 1, "train") for i in range(views)]
    return train + [_place(2 * i + 2, "heldout") for i in range(held_out)]


def _place(index: int, split: str) -> Camera:
    azimuth = 2 * np.pi * halton(index, 2)
    height = np.radians(10 + 60 * halton(index, 3))
    across = np.cos(height) * np.array([np.cos(azimuth), np.sin(azimuth)])
    origin = np.array(CENTRE) + DISTANCE * np.array([*across, np.sin(height)])
    return camera(origin, CENTRE, FOV, split)


def _sky(rows: int) -> np.ndarray:
    """Latitude-longitude radiance, linear RGB: a hazy sun, a blue sky, clouds, brown ground."""
    θ = np.pi * (np.arange(rows) + 0.5) / rows
    φ = 2 * np.pi * (np.arange(2 * rows) + 0.5) / (2 * rows)
    θ, φ = np.meshgrid(θ, φ, indexing="ij")
    up = np.cos(θ)[..., None]
    sky = np.array([0.35, 0.55, 0.95]) * (0.4 + 0.6 * (1 - np.maximum(up, 0)) ** 2)
    ground = np.array([0.22, 0.17, 0.12]) * (0.7 + 0.3 * np.cos(φ)[..., None])
    blend = 1 / (1 + np.exp(-up / 0.05))
    radiance = blend * sky + (1 - blend) * ground
    for (θ0, φ0), width, colour in (
        ((0.9, 1.1), 0.22, (14.0, 11.0, 7.5)),  # the sun behind haze
        ((1.2, 3.9), 0.45, (1.6, 1.7, 1.9)),  # a cloud
        ((0.5, 5.4), 0.35, (0.9, 0.9, 1.1)),  # another one
    ):
        cosine = np.cos(θ) * np.cos(θ0) + np.sin(θ) * np.sin(θ0) * np.cos(φ - φ0)
        radiance += np.exp((cosine - 1) / width**2)[..., None] * np.array(colour)
    return 0.45 * radiance
