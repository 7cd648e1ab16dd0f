"""A mesh with a colour at each vertex as binary glTF, for a page that maps tones."""

from __future__ import annotations

import numpy as np

from ..exports.gltf import Document
from ..imaging.srgb import from_srgb
from .surface import Surface

# Source: the curve of the Academy Color Encoding System as three.js has it, by S. Hill (2016).
_BEFORE = np.array(
    [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
)
_AFTER = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
_EXPOSURE = 1 / 0.6


def glb(surface: Surface, colours: np.ndarray) -> bytes:
    """The surface as it is coloured, without light, as binary glTF.

    Args:
        colours: (n, 3) uint8 sRGB, at vertices, as they are to be seen.
    """
    document = Document()
    unlit = document.use("KHR_materials_unlit")
    material = {"extensions": {unlit: {}}, "pbrMetallicRoughness": {}, "doubleSided": False}
    attributes = {
        "POSITION": document.array(surface.positions, "VEC3", bounds=True),
        "COLOR_0": document.array(before_tone_mapping(colours), "VEC3"),
    }
    primitive = {
        "attributes": attributes,
        "indices": document.array(surface.faces.ravel(), "SCALAR"),
        "material": document.add("materials", material),
    }
    mesh = document.add("meshes", {"primitives": [primitive]})
    document.json["scenes"][0]["nodes"].append(document.add("nodes", {"mesh": mesh}))
    return b"".join(document.content())


def before_tone_mapping(colours: np.ndarray) -> np.ndarray:
    """The numbers that the page's tone mapping turns into these colours.

    The page of viser 1.1 maps tones as films do, which would change what is measured.

    Args:
        colours: (n, 3) uint8 sRGB.

    Returns:
        (n, 3) float32; they may be negative, and over 1.
    """
    y = from_srgb(np.arange(256) / 255)[colours] @ np.linalg.inv(_AFTER).T
    # y = (v (v + 0.0245786) − 0.000090537) / (v (0.983729 v + 0.4329510) + 0.238081)
    a, b = 1 - 0.983729 * y, 0.0245786 - 0.4329510 * y
    c = -0.000090537 - 0.238081 * y
    v = (np.sqrt(np.maximum(b * b - 4 * a * c, 0)) - b) / (2 * a)
    return ((v @ np.linalg.inv(_BEFORE).T) / _EXPOSURE).astype(np.float32)
