"""Textures of the surfaces of the demo room: (base_color (h, w, 3), roughness (h, w)).

Linear RGB; nothing is finer than about 10 cm, so that photographs of 128 pixels resolve it.
"""

from __future__ import annotations

import numpy as np

from . import patterns
from .patterns import (
    checks,
    diamonds,
    dots,
    grid,
    herringbone,
    mix,
    motif,
    noise,
    per_cell,
    rectangle,
    step,
    stripes,
    tint,
)

Maps = tuple[np.ndarray, np.ndarray]
Colour = tuple[float, float, float]


def floor(width: float, depth: float) -> Maps:
    """Herringbone planks, and a rug with a rosette on them."""
    x, y = grid(width, depth)
    tone, lying = herringbone(x, y, 0.17, ratio=4, seed=3)
    color = tint(tone, (0.42, 0.22, 0.1), (0.78, 0.52, 0.28))
    color = color * mix(noise(x, y, 0.3, 4), 0.85, 1.1)[..., None]
    roughness = mix(tone, 0.28, 0.55) + 0.08 * lying
    return _rug(x - 2.1, y - 1.45, color, roughness)


def _rug(x: np.ndarray, y: np.ndarray, color: np.ndarray, roughness: np.ndarray) -> Maps:
    cream, red, teal = (0.85, 0.76, 0.58), (0.6, 0.13, 0.08), (0.1, 0.36, 0.36)
    field = tint(diamonds(x, y, 0.42), red, (0.78, 0.4, 0.18))
    field = tint(motif(x, y, 0.5), field, cream)
    field = tint(motif(x, y, 0.26, petals=4), field, teal)
    border = tint(checks(x, y, 0.15), teal, cream)
    rug = tint(rectangle(x, y, 1.1, 0.75), border, field)
    inside = rectangle(x, y, 1.25, 0.9)
    return tint(inside, color, rug), mix(inside, roughness, mix(noise(x, y, 0.4, 5), 0.75, 0.9))


def ceiling(
    width: float,
    depth: float,
    colours: tuple[Colour, Colour] = ((0.84, 0.8, 0.72), (0.82, 0.74, 0.6)),
    cell: float = 0.9,
    seed: int = 6,
) -> Maps:
    """White with a cast, a warm one by default, that comes and goes in clouds of `cell` metres."""
    x, y = grid(width, depth, 48)
    return tint(noise(x, y, cell, seed), *colours), mix(noise(x, y, 0.7, seed + 1), 0.5, 0.9)


def plaster(
    width: float,
    height: float,
    plaster: tuple[Colour, Colour] = ((0.84, 0.58, 0.24), (0.86, 0.7, 0.42)),
    dado: tuple[Colour, Colour] = ((0.3, 0.46, 0.28), (0.4, 0.56, 0.34)),
    seed: int = 8,
) -> Maps:
    """Mottled plaster, ochre by default, above a striped dado with a waved edge."""
    x, y = grid(width, height)
    upper, lower = tint(noise(x, y, 0.45, seed), *plaster), tint(stripes(x, 0.4), *dado)
    above = step(y - 0.8 - 0.05 * np.sin(2 * np.pi * x / 0.8))
    return tint(above, lower, upper), mix(above, 0.35, mix(noise(x, y, 0.5, seed + 1), 0.5, 0.9))


def striped(
    width: float,
    height: float,
    colours: tuple[Colour, Colour] = ((0.84, 0.74, 0.58), (0.76, 0.36, 0.22)),
    seed: int = 10,
) -> Maps:
    """Stripes, terracotta and cream by default, every colour with its own gloss."""
    x, y = grid(width, height)
    amount = stripes(x, 0.5)
    gloss = mix(amount, 0.8, 0.35) + 0.12 * (noise(x, y, 0.5, seed) - 0.5)
    return tint(amount, *colours), gloss


def tiles(width: float, height: float) -> Maps:
    """Glazed tiles in four colours, and a gloss for every tile."""
    x, y = grid(width, height)
    size = 0.325
    i, j = np.floor(x / size), np.floor(y / size)
    color = tint(checks(x, y, size), (0.82, 0.74, 0.6), (0.24, 0.52, 0.54))
    accent = per_cell(i, j, 11) > 0.78
    color = np.where(accent[..., None], np.array((0.84, 0.56, 0.16)), color)
    body = patterns.tiles(x, y, size, 0.012)
    gloss = mix(per_cell(i, j, 12), 0.22, 0.6)
    return tint(body, (0.7, 0.62, 0.5), color), mix(body, 0.85, gloss)


def dotted(width: float, height: float) -> Maps:
    """Staggered discs on sand, shinier than their ground."""
    x, y = grid(width, height)
    amount = dots(x, y, 0.52, 0.17)
    ground = tint(y / height, (0.72, 0.6, 0.36), (0.84, 0.72, 0.5))
    core = dots(x, y, 0.52, 0.08)
    color = tint(core, tint(amount, ground, (0.5, 0.62, 0.56)), (0.14, 0.34, 0.4))
    return color, mix(amount, 0.75, 0.35) + 0.1 * (noise(x, y, 0.6, 13) - 0.5)


def wood() -> Maps:
    """Varnished wood, streaked; one metre square."""
    x, y = grid(1.0, 1.0)
    streak = noise(0.25 * x, y, 0.09, 14)
    color = tint(streak, (0.4, 0.18, 0.08), (0.68, 0.38, 0.18))
    return color, mix(noise(x, y, 0.2, 15), 0.25, 0.5)


def pale_wood() -> Maps:
    """Oiled pale wood; one metre square."""
    x, y = grid(1.0, 1.0)
    streak = noise(0.3 * x, y, 0.1, 16)
    return tint(streak, (0.66, 0.48, 0.28), (0.82, 0.66, 0.44)), mix(noise(x, y, 0.3, 17), 0.4, 0.7)


def cabinet() -> Maps:
    """Painted doors with a lozenge each; UVs in metres."""
    x, y = grid(1.3, 1.3)
    lozenge = step(0.2 - np.abs(np.mod(x, 0.65) - 0.325) - np.abs(y - 0.35))
    color = tint(lozenge, (0.22, 0.4, 0.34), (0.84, 0.68, 0.36))
    color = tint(step(y - 0.72), color, (0.7, 0.46, 0.26))
    return color, mix(lozenge, 0.6, 0.3) + 0.15 * (noise(x, y, 0.3, 18) - 0.5)


def checked() -> Maps:
    """Checks of 12 cm; one metre square."""
    x, y = grid(1.0, 1.0)
    amount = checks(x, y, 0.12)
    return tint(amount, (0.84, 0.72, 0.5), (0.5, 0.16, 0.12)), mix(amount, 0.4, 0.8)


def spines(colour: Colour, roughness: float) -> Maps:
    """Book spines of 8 cm in shades of one colour; one metre square."""
    x, y = grid(1.0, 1.0)
    shade = per_cell(np.floor(x / 0.08), np.floor(y / 0.5), 19)
    color = np.asarray(colour) * mix(shade, 0.7, 1.15)[..., None]
    return color, mix(shade, roughness - 0.1, roughness + 0.1)


def banded(first: Colour, second: Colour, smooth: float, rough: float) -> Maps:
    """Level bands on a turned object; (u, v) in [0, 1]."""
    _, y = grid(1.0, 1.0, 64)
    amount = stripes(y, 0.4)
    return tint(amount, first, second), mix(amount, smooth, rough)


def glazed(first: Colour, second: Colour) -> Maps:
    """A glossy glaze (roughness 0.15 to 0.3) with a belt of discs; (u, v) in [0, 1]."""
    x, y = grid(1.0, 1.0, 128)
    belt = step(0.12 - np.abs(y - 0.45)) * (1 - dots(2 * x, 2 * (y - 0.325), 0.5, 0.14))
    return tint(belt, first, second), mix(belt, 0.15, 0.3)


def wedges(first: Colour, second: Colour) -> Maps:
    """Eight wedges round a turned object; (u, v) in [0, 1]."""
    x, _ = grid(1.0, 1.0, 128)
    amount = stripes(x, 0.25)
    return tint(amount, first, second), mix(amount, 0.55, 0.85)


def picture(width: float, height: float) -> Maps:
    """A sun over hills."""
    x, y = grid(width, height, 160)
    sky = tint(y / height, (0.86, 0.6, 0.3), (0.3, 0.5, 0.66))
    sky = tint(step(0.12 - np.hypot(x - 0.56, y - 0.4)), sky, (0.88, 0.34, 0.12))
    far = step(0.3 + 0.06 * np.sin(9 * x) - y)
    near = step(0.16 + 0.05 * np.sin(7 * x + 2) - y)
    color = tint(near, tint(far, sky, (0.3, 0.4, 0.5)), (0.16, 0.34, 0.2))
    return color, mix(far, 0.7, 0.4)
