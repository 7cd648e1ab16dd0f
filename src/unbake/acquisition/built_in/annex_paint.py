"""Textures of the annex: (base_color (h, w, 3), roughness (h, w)), linear RGB.

The first room is cream, grey and brown. The second has strong colours, which tint all light that
leaves it.
"""

from __future__ import annotations

import numpy as np

from . import demo_paint, patterns
from .demo_paint import Maps
from .patterns import (
    checks,
    diamonds,
    dots,
    grid,
    herringbone,
    mix,
    noise,
    per_cell,
    rectangle,
    step,
    stripes,
    tint,
)

# ------------------------------------------------------------------------------- The first room


def planks(width: float, depth: float) -> Maps:
    """Herringbone planks of pale and dark oak."""
    x, y = grid(width, depth)
    tone, lying = herringbone(x, y, 0.17, ratio=4, seed=21)
    color = tint(tone, (0.46, 0.3, 0.18), (0.8, 0.62, 0.42))
    color = color * mix(noise(x, y, 0.3, 22), 0.85, 1.1)[..., None]
    return color, mix(tone, 0.3, 0.55) + 0.08 * lying


def white(width: float, depth: float) -> Maps:
    """A white ceiling with a grey cast that comes and goes."""
    return demo_paint.ceiling(width, depth, ((0.86, 0.85, 0.82), (0.76, 0.76, 0.74)), seed=36)


def panelling(width: float, height: float) -> Maps:
    """Grey-blue panels below, cream with broad stripes above."""
    x, y = grid(width, height)
    upper = tint(stripes(x, 0.36), (0.84, 0.78, 0.66), (0.72, 0.66, 0.54))
    inner = rectangle(np.mod(x, 0.6) - 0.3, y - 0.5, 0.2, 0.3)
    lower = tint(inner, (0.4, 0.46, 0.5), (0.56, 0.62, 0.64))
    above = step(y - 1.0)
    rough = mix(above, mix(inner, 0.3, 0.45), mix(noise(x, y, 0.5, 23), 0.6, 0.9))
    return tint(above, lower, upper), rough


def plaster(width: float, height: float) -> Maps:
    """Mottled pale plaster above a sage dado with a waved edge."""
    upper, dado = ((0.72, 0.72, 0.7), (0.86, 0.84, 0.78)), ((0.42, 0.54, 0.42), (0.56, 0.66, 0.54))
    return demo_paint.plaster(width, height, upper, dado, seed=33)


def striped(width: float, height: float) -> Maps:
    """Pale blue and white stripes, each with its own gloss."""
    return demo_paint.striped(width, height, ((0.84, 0.82, 0.78), (0.5, 0.6, 0.7)), seed=35)


def spotted(width: float, height: float) -> Maps:
    """Staggered rings on pale sand, shinier than their ground."""
    x, y = grid(width, height)
    ring = dots(x, y, 0.52, 0.18) * (1 - dots(x, y, 0.52, 0.1))
    ground = tint(y / height, (0.7, 0.66, 0.58), (0.86, 0.82, 0.74))
    return tint(ring, ground, (0.34, 0.46, 0.5)), mix(ring, 0.75, 0.35)


def door(width: float, height: float) -> Maps:
    """A painted leaf with two framed fields; UVs in metres, mirrored beyond one metre."""
    x, y = grid(1.0, 1.0)
    fields = rectangle(x - 0.5 * width, y - 0.5, 0.26, 0.34)
    line = fields - rectangle(x - 0.5 * width, y - 0.5, 0.22, 0.3)
    color = tint(fields, (0.8, 0.76, 0.66), (0.72, 0.68, 0.58))
    return tint(line, color, (0.36, 0.44, 0.4)), mix(fields, 0.35, 0.55)


# ------------------------------------------------------------------------------ The second room


def mosaic(width: float, height: float) -> Maps:
    """Large tiles in vermilion, orange and magenta, each with its own gloss."""
    x, y = grid(width, height)
    size = 0.3
    i, j = np.floor(x / size), np.floor(y / size)
    pick = per_cell(i, j, 24)
    color = np.where((pick < 0.4)[..., None], (0.86, 0.26, 0.16), (0.9, 0.58, 0.16))
    color = np.where((pick > 0.78)[..., None], (0.74, 0.22, 0.5), color)
    body = patterns.tiles(x, y, size, 0.014)
    return tint(body, (0.8, 0.7, 0.5), color), mix(body, 0.85, mix(per_cell(i, j, 25), 0.22, 0.6))


def waves(width: float, height: float) -> Maps:
    """Blue waves on aquamarine."""
    x, y = grid(width, height)
    amount = stripes(y + 0.12 * np.sin(2 * np.pi * x / 0.8), 0.5)
    color = tint(amount, (0.5, 0.86, 0.8), (0.14, 0.36, 0.76))
    return color, mix(amount, 0.7, 0.35) + 0.1 * (noise(x, y, 0.5, 26) - 0.5)


def lozenges(width: float, depth: float) -> Maps:
    """A floor of concentric lozenges in yellow and plum, with a border."""
    x, y = grid(width, depth)
    inner = tint(diamonds(x - 1.3, y - 1.5, 0.5), (0.9, 0.78, 0.3), (0.5, 0.2, 0.46))
    border = tint(checks(x, y, 0.2), (0.88, 0.84, 0.74), (0.2, 0.5, 0.4))
    inside = rectangle(x - 1.3, y - 1.5, 0.95, 1.2)
    return tint(inside, border, inner), mix(inside, 0.35, 0.7) + 0.1 * (noise(x, y, 0.4, 27) - 0.5)


def sky(width: float, depth: float) -> Maps:
    """A ceiling between white and sky blue."""
    return demo_paint.ceiling(width, depth, ((0.9, 0.88, 0.84), (0.64, 0.78, 0.9)), 0.7, 28)


def bands(width: float, height: float) -> Maps:
    """Upright bands of teal, violet and lemon."""
    x, y = grid(width, height)
    number = np.floor(x / 0.35)
    pick = np.mod(number, 3)
    color = np.where((pick == 0)[..., None], (0.06, 0.5, 0.46), (0.4, 0.14, 0.56))
    color = np.where((pick == 2)[..., None], (0.88, 0.8, 0.14), color)
    return color, mix(per_cell(number, 0 * number, 30), 0.3, 0.8) + 0.08 * (
        noise(x, y, 0.5, 31) - 0.5
    )


def discs(width: float, height: float) -> Maps:
    """Blue discs on coral."""
    x, y = grid(width, height)
    amount = dots(x, y, 0.5, 0.17)
    color = tint(amount, (0.9, 0.5, 0.4), (0.14, 0.28, 0.66))
    return color, mix(amount, 0.75, 0.35) + 0.1 * (noise(x, y, 0.6, 32) - 0.5)
