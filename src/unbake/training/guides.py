"""Where roughness has a guide: in rooms, where the settings leave it open."""

from __future__ import annotations

from dataclasses import replace

from ..config import FitConfig
from ..dataset.scene_kind import SceneKind
from ..fields.settings import FieldSettings, NetworkConfig

#: Quantities of which photographs tell little at a point, where the albedo is unknown, too.
GUIDED = ("roughness",)
#: Levels of a guide: cells from the whole room down to its eighth part.
LEVELS = 4


def with_guides(config: FitConfig, kind: SceneKind) -> FitConfig:
    """The settings with a guide, or none, where they leave it open.

    A room has many surfaces of few materials, and light that says little of each. An object alone
    is often of one material and shows its highlights: there a guide was found to add noise.
    Networks of the other presets are the paper's, without guides.
    """
    guided = config.preset == "cpu" and kind == "room" and "albedo" in config.quantities
    materials = {}
    for name, forms in config.materials.items():
        levels = LEVELS if guided and name in GUIDED else 0
        materials[name] = {form: _with_guide(settings, levels) for form, settings in forms.items()}
    radiance = {form: _with_guide(settings, 0) for form, settings in config.radiance.items()}
    return replace(config, materials=materials, radiance=radiance)


def _with_guide(settings: FieldSettings, levels: int) -> FieldSettings:
    if not isinstance(settings, NetworkConfig) or settings.guide.levels is not None:
        return settings
    return replace(settings, guide=replace(settings.guide, levels=levels))
