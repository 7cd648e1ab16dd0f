"""Other light in a scene, for captures and for what a run recovered."""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..config.light import Axis, LightConfig
from ..dataset.camera import Camera, up_of
from ..scene import relight
from ..scene.parse import ParsedScene

#: Cosine below which an environment map that stands beside the cameras' upward direction is told.
_UPRIGHT = 0.7


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


def tell_tilt(
    light: LightConfig | None, cameras: Sequence[Camera], tell: Callable[[str], None]
) -> None:
    """Tell of an environment map whose sky is not where cameras, one at least, have up."""
    if light is None or light.envmap is None:
        return
    up = up_of(cameras)
    wanted = axis_of(up)
    if up @ np.array(light.up) >= _UPRIGHT or wanted == light.envmap_up:
        return
    tell(
        f"the map's first row lies at {light.envmap_up}, while the cameras' up is {wanted}: "
        f"--envmap-up {wanted} turns it"
    )


def axis_of(up: np.ndarray) -> Axis:
    """The world axis that is nearest to a direction (3,), with its sign."""
    axis = int(np.argmax(np.abs(up)))
    return typing.get_args(Axis)[2 * axis + int(up[axis] < 0)]
