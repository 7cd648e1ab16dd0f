"""The built-in scenes: two rooms, a still life, the Cornell box, the paper's cube, a furnace."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ...errors import UserError
from . import annex, closed, cornell, demo, still
from .cameras import Camera

__all__ = ["SCENES", "Camera", "default_cameras", "write_scene"]


@dataclass(frozen=True)
class _BuiltIn:
    """A built-in scene.

    Args:
        write: writes it into a folder, with walls of an albedo if it has any, and returns its XML.
        cameras: its cameras, of numbers of training and held-out views.
    """

    write: Callable[[Path, float], Path]
    cameras: Callable[[int, int], list[Camera]]


_SCENES = {
    "demo": _BuiltIn(lambda folder, albedo: demo.write(folder), demo.cameras),
    "annex": _BuiltIn(lambda folder, albedo: annex.write(folder), annex.cameras),
    "still": _BuiltIn(lambda folder, albedo: still.write(folder), still.cameras),
    "cornell": _BuiltIn(lambda folder, albedo: cornell.write(folder), cornell.cameras),
    "cube": _BuiltIn(closed.write_cube, closed.cameras),
    "furnace": _BuiltIn(closed.write_furnace, closed.cameras),
}
#: Names of the built-in scenes.
SCENES = tuple(_SCENES)


def write_scene(name: str, folder: Path, *, albedo: float = 0.5) -> Path:
    """Write a built-in scene as a self-contained Mitsuba 3 scene and return the path of its XML.

    `folder` gets `scene.xml`, `meshes/*.ply` and `textures/*.exr` (linear, raw); lengths are
    metres in `demo` and `annex`, half widths of the box or slab elsewhere; z is up. `albedo` in
    [0, 1) is that of the walls of `cube` and `furnace`, the other scenes ignore it. Needs a Mitsuba
    variant.

    Raises:
        UserError: there is no such scene, or the albedo is out of range.
    """
    _check(name)
    if not 0.0 <= albedo < 1.0:
        raise UserError(f"albedo {albedo:g} is out of range", name, "Choose 0 <= albedo < 1")
    return _SCENES[name].write(Path(folder), albedo)


def default_cameras(name: str, views: int, held_out: int) -> list[Camera]:
    """Cameras made for a built-in scene: `views` for training, then `held_out` others.

    World units, z up, horizontal field of view in degrees (square images). Fewer views are a
    prefix of more. No camera stands inside an object, and no two of them are alike.

    Raises:
        UserError: there is no such scene, or a number is negative.
    """
    _check(name)
    if views < 0 or held_out < 0:
        raise UserError("the number of views is negative", name, "Ask for at least one view")
    return _SCENES[name].cameras(views, held_out)


def _check(name: str) -> None:
    if name not in SCENES:
        raise UserError(f"there is no built-in scene {name!r}", None, f"Choose {', '.join(SCENES)}")
