"""Albedo and roughness patterns of the built-in scenes, as functions of metric coordinates.

Every function takes `x`, `y`: arrays (h, w) of metres, and returns an array (h, w) in [0, 1], so
that `tint` can turn it into a colour and `mix` into a roughness. Edges are softened over 2 cm.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

EDGE = 0.012
Colour = np.ndarray | Sequence[float]


def grid(
    width: float, height: float, per_metre: int = 96, origin: tuple[float, float] = (0.0, 0.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Metric coordinates (h, w) of the texel centres; row 0 lies at v = 0, as Mitsuba reads it."""
    columns, rows = max(8, round(width * per_metre)), max(8, round(height * per_metre))
    x = (np.arange(columns) + 0.5) / columns * width + origin[0]
    y = (np.arange(rows) + 0.5) / rows * height + origin[1]
    x, y = np.broadcast_arrays(x[None, :], y[:, None])
    return x, y


def mix(amount: np.ndarray, first: np.ndarray | float, second: np.ndarray | float) -> np.ndarray:
    """Numbers (h, w): `first` where `amount` is 0, `second` where it is 1."""
    return first + amount * (np.asarray(second) - first)


def tint(amount: np.ndarray, first: Colour, second: Colour) -> np.ndarray:
    """Colours (h, w, 3): `first` where `amount` is 0, `second` where it is 1; maps or triples."""
    first, second = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    return first + amount[..., None] * (second - first)


def step(distance: np.ndarray, edge: float = EDGE) -> np.ndarray:
    """A smooth step from 0 to 1 as the signed `distance` in metres passes 0."""
    t = np.clip(distance / (2 * edge) + 0.5, 0.0, 1.0)
    return t * t * (3 - 2 * t)


def noise(x: np.ndarray, y: np.ndarray, cell: float, seed: int) -> np.ndarray:
    """Smooth value noise with features of about `cell` metres."""
    table = np.random.default_rng(seed).random((64, 64))
    gx, gy = x / cell, y / cell
    ix, iy = np.floor(gx).astype(int), np.floor(gy).astype(int)
    fx, fy = gx - ix, gy - iy
    fx, fy = fx * fx * (3 - 2 * fx), fy * fy * (3 - 2 * fy)
    corner = [[table[(iy + j) % 64, (ix + i) % 64] for i in (0, 1)] for j in (0, 1)]
    low = corner[0][0] * (1 - fx) + corner[0][1] * fx
    high = corner[1][0] * (1 - fx) + corner[1][1] * fx
    return low * (1 - fy) + high * fy


def per_cell(i: np.ndarray, j: np.ndarray, seed: int) -> np.ndarray:
    """One random number for each pair of integers."""
    table = np.random.default_rng(seed).random((64, 64))
    return table[j.astype(int) % 64, i.astype(int) % 64]


def stripes(x: np.ndarray, period: float, duty: float = 0.5) -> np.ndarray:
    """1 on the first `duty` of every period along x."""
    phase = np.mod(x, period)
    return step(phase) * step(duty * period - phase) + step(phase - period)


def checks(x: np.ndarray, y: np.ndarray, size: float) -> np.ndarray:
    """A chequerboard of squares of `size` metres."""
    a = 2 * stripes(x, 2 * size) - 1
    b = 2 * stripes(y, 2 * size) - 1
    return 0.5 * (1 + a * b)


def tiles(x: np.ndarray, y: np.ndarray, size: float, joint: float) -> np.ndarray:
    """1 on square tiles of `size` metres, 0 in the joints of half-width `joint` between them."""
    near = np.minimum(np.mod(x, size), np.mod(y, size))
    near = np.minimum(near, np.minimum(size - np.mod(x, size), size - np.mod(y, size)))
    return step(near - joint)


def dots(x: np.ndarray, y: np.ndarray, spacing: float, radius: float) -> np.ndarray:
    """Discs in staggered rows."""
    row = np.floor(y / spacing)
    shifted = x + 0.5 * spacing * np.mod(row, 2)
    dx = np.mod(shifted, spacing) - 0.5 * spacing
    dy = y - (row + 0.5) * spacing
    return step(radius - np.hypot(dx, dy))


def diamonds(x: np.ndarray, y: np.ndarray, period: float) -> np.ndarray:
    """Concentric diamonds about the origin, `period` metres apart along the axes."""
    return stripes(np.abs(x) + np.abs(y), period)


def herringbone(
    x: np.ndarray, y: np.ndarray, width: float, ratio: int = 4, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Herringbone planks of `width` by `ratio * width`: (the tone of each plank, its long axis)."""
    c = np.sqrt(0.5)
    i = np.floor((x * c + y * c) / width).astype(int)
    j = np.floor((y * c - x * c) / width).astype(int)
    # Along each row of cells, `ratio` cells of a lying plank alternate with `ratio` ends of
    # standing planks, and each row is shifted by one cell: the usual staircase of the pattern.
    phase = np.mod(i - j, 2 * ratio)
    lying = phase < ratio
    plank_i = np.where(lying, i - phase, i)
    plank_j = np.where(lying, j, j - (2 * ratio - 1 - phase))
    tone = per_cell(plank_i + 7 * lying, plank_j + 13 * lying, seed)
    return tone, lying.astype(np.float64)


def motif(x: np.ndarray, y: np.ndarray, radius: float, petals: int = 8) -> np.ndarray:
    """A rosette about the origin."""
    angle, r = np.arctan2(y, x), np.hypot(x, y)
    return step(radius * (0.72 + 0.28 * np.cos(petals * angle)) - r)


def rectangle(x: np.ndarray, y: np.ndarray, half_width: float, half_height: float) -> np.ndarray:
    """1 inside a rectangle about the origin."""
    return step(half_width - np.abs(x)) * step(half_height - np.abs(y))
