"""What a material has beside its textures, as glTF and OpenUSD know it.

Source: Mitsuba 3.9, `principled`; Khronos, KHR_materials_ior and KHR_materials_clearcoat; Pixar,
UsdPreviewSurface 2.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..scene.parse import ParsedScene

#: Parameters of `principled` that are lost where they are not 0: glTF and OpenUSD have none such.
_UNKNOWN = ("anisotropic", "flatness", "sheen", "spec_tint", "spec_trans")
#: Quantities that glTF and OpenUSD have textures of.
TEXTURED = ("albedo", "roughness", "metallic")
#: From 12.5 on, no index of refraction belongs to `specular`.
_MOST_SPECULAR = 12.0


@dataclass(frozen=True)
class Constants:
    """Of one `principled` BSDF."""

    ior: float  #: index of refraction
    clearcoat: float  #: strength of a layer above it whose index is 1.5, [0, 1]
    clearcoat_roughness: float  #: perceptual
    left_out: tuple[str, ...]  #: parameters of the BSDF that have no place


def material_constants(scene: ParsedScene, materials: Sequence[int]) -> Constants:
    """The constants of a material; of several BSDFs in one they are those of the first.

    Args:
        scene: with `principled` BSDFs.
        materials: numbers of these, as in `edit.material_names`.
    """
    props = scene.state.nodes[scene.principled_indices()[materials[0]]].props
    left_out = [name for name in _UNKNOWN if props.get(name, 0.0) != 0.0]
    coat = props.get("clearcoat", 0.0)
    if not isinstance(coat, float):
        left_out.append("clearcoat")
        coat = 0.0
    gloss = props.get("clearcoat_gloss", 0.0)
    gloss = min(max(gloss, 0.0), 1.0) if isinstance(gloss, float) else 0.0
    alpha = 0.1 + (0.001 - 0.1) * gloss
    # Mitsuba's coat reflects a quarter of what a smooth layer would.
    coat = min(max(0.25 * coat, 0.0), 1.0)
    return Constants(_index(props), coat, math.sqrt(alpha), tuple(left_out))


def _index(props: Any) -> float:
    """The index of refraction, of which `specular` is another form; 1 at least."""
    eta, specular = props.get("eta", None), props.get("specular", 0.5)
    if not isinstance(eta, float):
        specular = specular if isinstance(specular, float) else 0.5
        specular = min(max(specular, 0.0), _MOST_SPECULAR)
        eta = 2 / (1 - math.sqrt(0.08 * specular)) - 1
    return max(eta, 1.0)
