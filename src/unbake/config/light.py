"""Another light than a scene's own. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from ..errors import UserError, require, require_kind, require_ranges
from .flag import Flag

#: World axes, with their signs.
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


def direction(axis: Axis) -> tuple[float, float, float]:
    """The unit vector (3,) of a world axis."""
    sign = -1.0 if axis[0] == "-" else 1.0
    x, y, z = (sign if axis[1] == name else 0.0 for name in "xyz")
    return x, y, z


@dataclass(frozen=True)
class LightConfig:
    """Light that takes the place of all the light of a scene.

    Args:
        envmap: an environment map, OpenEXR, Radiance HDR or PFM, linear RGB, in the layout of
            Mitsuba's `envmap`.
        lights: a Mitsuba XML file with emitters and shapes that emit light.

    Raises:
        UserError: none of the two is given, or both are, or a value has the wrong type or range.
    """

    envmap: Path | str | None = None  #: kept as a `Path`
    lights: Path | str | None = None  #: kept as a `Path`
    envmap_scale: Annotated[float, Flag("Factor on the map's values")] = 1.0
    #: Degrees.
    envmap_rotate: Annotated[
        float,
        Flag("Degrees to turn the environment map about its up axis, counterclockwise from above"),
    ] = 0.0
    envmap_up: Annotated[
        Axis, Flag("World axis that the first row of the environment map lies at")
    ] = "+y"
    #: An environment map takes the place of the scene's own environment in any case.
    keep_lights: Annotated[
        bool, Flag("Keep the scene's own lights beside the new light, instead of turning them off")
    ] = False

    def __post_init__(self) -> None:
        for name in ("envmap", "lights"):
            value = getattr(self, name)
            if value is not None:
                require(isinstance(value, str | os.PathLike), name, "the path of a file", value)
                object.__setattr__(self, name, Path(value))
        if self.envmap is not None and self.lights is not None:
            raise UserError("cannot be given together with --envmap", "--lights", "Give one")
        if self.envmap is None and self.lights is None:
            raise UserError("no light given", None, "Give --envmap FILE or --lights FILE")
        require_ranges(self, {"envmap_scale": (0, 1e9), "envmap_rotate": (-1e6, 1e6)})
        if self.envmap_scale == 0:
            raise UserError("must be more than 0", "envmap_scale")

    @classmethod
    def of(cls, light: LightConfig | Path | str) -> LightConfig:
        """A light as it is, or that of the file of an environment map.

        Raises:
            UserError: it is neither.
        """
        if isinstance(light, str | os.PathLike):
            return cls(envmap=Path(light))
        require_kind(light, cls, "light", 'unbake.LightConfig(envmap="sky.exr")')
        return light

    @property
    def up(self) -> tuple[float, float, float]:
        """The world axis of the map's first row, (3,)."""
        return direction(self.envmap_up)

    @property
    def turn(self) -> float:
        """Radians to turn the map by, about its up axis."""
        return math.radians(self.envmap_rotate)

    def root(self, allow_outside: bool) -> Path | None:
        """The folder that the files which `lights` names must not leave; None: its own."""
        if self.lights is None or not allow_outside:
            return None
        return Path(Path(self.lights).resolve().anchor)

    def told(self) -> dict[str, Any]:
        """All of it as JSON has it, with absolute paths."""
        paths = {"envmap": self.envmap, "lights": self.lights}
        files = {k: None if v is None else os.path.abspath(v) for k, v in paths.items()}
        return asdict(self) | files

    def named(self) -> dict[str, Any]:
        """The same, with the names of files instead of their paths."""
        told = self.told()
        files = {key: told[key] for key in ("envmap", "lights") if told[key] is not None}
        return told | {key: Path(file).name for key, file in files.items()}
