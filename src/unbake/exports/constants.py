"""What a material has beside its textures, as it is written to glTF and OpenUSD.

Source: Mitsuba 3.9, `principled`; Khronos, KHR_materials_ior and KHR_materials_clearcoat; Pixar,
UsdPreviewSurface 2.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeGuard

from ..scene.parse import ParsedScene

#: Parameters of `principled` that are not written where they are not 0.
_UNKNOWN = ("anisotropic", "flatness", "sheen", "spec_tint", "spec_trans")
#: Quantities that are written to glTF and OpenUSD.
TEXTURED = ("albedo", "roughness", "metallic")
#: Opacities between these are fractions, neither a hole nor solid.
FRACTIONS = 0.05, 0.95
#: The opacity from which a cut-out is solid.
CUTOFF = 0.5
#: From 12.5 on, no index of refraction belongs to `specular`.
_MOST_SPECULAR = 12.0


@dataclass(frozen=True)
class Constants:
    """Of one `principled` BSDF."""

    ior: float  #: index of refraction
    clearcoat: float  #: strength of a layer above it whose index is 1.5, [0, 1]
    clearcoat_roughness: float  #: perceptual
    left_out: tuple[str, ...]  #: parameters of the BSDF that are not written


def material_constants(scene: ParsedScene, materials: Sequence[int]) -> Constants:
    """The constants of a material; of several BSDFs in one they are those of the first.

    Args:
        scene: with `principled` BSDFs.
        materials: numbers of these, as in `edit.material_names`.
    """
    props = scene.state.nodes[scene.principled_indices()[materials[0]]].props
    left_out = [name for name in _UNKNOWN if props.get(name, 0.0) != 0.0]
    coat = props.get("clearcoat", 0.0)
    if not is_number(coat):
        left_out.append("clearcoat")
        coat = 0.0
    gloss = props.get("clearcoat_gloss", 0.0)
    gloss = min(max(gloss, 0.0), 1.0) if is_number(gloss) else 0.0
    alpha = 0.1 + (0.001 - 0.1) * gloss
    # Mitsuba's coat reflects a quarter of what a smooth layer would.
    coat = min(max(0.25 * coat, 0.0), 1.0)
    return Constants(_index(props), coat, math.sqrt(alpha), tuple(left_out))


def constant_opacity(scene: ParsedScene, masks: Sequence[int]) -> float | None:
    """What masks leave of a surface, in [0, 1]; None where one has a texture.

    Args:
        scene: the scene.
        masks: their nodes.
    """
    found = 1.0
    for mask in masks:
        opacity = scene.state.nodes[mask].props.get("opacity", 0.5)
        if not is_number(opacity):
            return None
        found *= min(max(float(opacity), 0.0), 1.0)
    return found


def is_number(value: object) -> TypeGuard[float]:
    """Whether it is a number: Mitsuba takes whole ones for others."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _index(props: Any) -> float:
    """The index of refraction, of which `specular` is another form; 1 at least."""
    eta, specular = props.get("eta", None), props.get("specular", 0.5)
    if not is_number(eta):
        specular = specular if is_number(specular) else 0.5
        specular = min(max(specular, 0.0), _MOST_SPECULAR)
        eta = 2 / (1 - math.sqrt(0.08 * specular)) - 1
    return max(float(eta), 1.0)
