"""Baked textures as files: OpenEXR with linear values, and PNG for programs that take 8 bits."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..imaging.pictures import shown, to_bytes, write_exr, write_png
from ..quantities import QUANTITIES
from .bake import Baked

#: What PNG files hold, by quantity.
COLOUR_SPACES = {
    name: {"exr": "linear", "png": "sRGB" if q.display == "colour" else "linear"}
    for name, q in QUANTITIES.items()
} | {"opacity": {"exr": "linear", "png": "linear"}}


def file_names(names: Sequence[str]) -> list[str]:
    """Names of files for these names: safe anywhere, and different also where case is ignored."""
    taken: set[str] = set()
    found = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._-")[:60] or "material"
        number, chosen = 1, plain
        while chosen.lower() in taken:
            number += 1
            chosen = f"{plain}-{number}"
        taken.add(chosen.lower())
        found.append(chosen)
    return found


def write_textures(folder: Path, stem: str, baked: Baked) -> list[str]:
    """Write the textures of a material; returns the names of the files."""
    names = []
    for name, values in baked.values.items():
        write_exr(folder / f"{stem}_{name}.exr", as_image(values))
        write_png(folder / f"{stem}_{name}.png", picture(name, values))
        names += [f"{stem}_{name}.exr", f"{stem}_{name}.png"]
    if baked.opacity is not None:
        write_exr(folder / f"{stem}_opacity.exr", baked.opacity)
        write_png(folder / f"{stem}_opacity.png", to_bytes(baked.opacity))
        names += [f"{stem}_opacity.exr", f"{stem}_opacity.png"]
    return [*names, write_mask(folder, stem, baked)]


def write_mask(folder: Path, stem: str, baked: Baked) -> str:
    """Write what no training view saw of a material, in white; returns the name of the file."""
    mask = np.where(baked.covered & ~baked.observed, 255, 0).astype(np.uint8)
    write_png(folder / f"{stem}_unobserved.png", mask)
    return f"{stem}_unobserved.png"


def as_image(values: np.ndarray) -> np.ndarray:
    """The same without the axis of channels where there is one channel."""
    return values[..., 0] if values.shape[-1] == 1 else values


def base_colour(baked: Baked) -> np.ndarray:
    """The albedo in 8 bits, (n, n, 3), or (n, n, 4) with an opacity that varies as its alpha.

    Colours are not multiplied by it.
    """
    colour = picture("albedo", baked.values["albedo"])
    if baked.opacity is None or baked.constant_opacity is not None:
        return colour
    return np.concatenate([colour, to_bytes(baked.opacity)[..., None]], -1)


def picture(name: str, values: np.ndarray) -> np.ndarray:
    """A texture in 8 bits: colours through the sRGB curve, other quantities as they are."""
    found = shown(values, QUANTITIES[name].display)
    return found if values.shape[-1] == 3 else found[..., 0]
