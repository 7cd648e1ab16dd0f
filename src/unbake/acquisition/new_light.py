"""Other light in a scene, for captures and for what a run recovered."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..config.light import LightConfig
from ..scene import relight
from ..scene.parse import ParsedScene


def change_light(
    scene: ParsedScene, light: LightConfig, allow_outside: bool, tell: Callable[[str], None]
) -> None:
    """Give a scene another light.

    Args:
        scene: it is changed.
        light: the new one.
        allow_outside: read files that `light` names and that lie outside of its folder.
        tell: called with what happened to the scene's own light.

    Raises:
        UserError: the light cannot be used.
    """
    if not light.keep_lights:
        count = relight.turn_off(scene)
        tell(f"turned off {count} light{'' if count == 1 else 's'} of the scene")
    put_light(scene, light, allow_outside, tell)


def put_light(
    scene: ParsedScene, light: LightConfig, allow_outside: bool, tell: Callable[[str], None]
) -> None:
    """Add a light to those that a scene has; arguments and errors as of `change_light`."""
    if light.envmap is not None:
        map_ = Path(light.envmap)
        relight.put_environment(scene, map_, light.envmap_scale, light.up, light.turn)
    if light.lights is not None:
        for line in relight.put_lights(scene, Path(light.lights), light.root(allow_outside)):
            tell(line)
