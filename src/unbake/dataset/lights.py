"""What the lights of a data set truly are, where it was rendered: files beside its other truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..imaging.pictures import write_exr
from ..io import array, read_json, text, write_json
from ..scene import parse as scenes
from .views import read_image

#: Rows of the picture of a true environment.
ROWS = 128
_AGAIN = "Capture the data set again, or remove the file"


def write_lights(scene: Path, folder: Path) -> None:
    """Write the true lighting of a scene: `environment.exr`, `emission.json`, or what there is.

    Args:
        scene: the Mitsuba scene that photographs were rendered from.
        folder: `truth` of the data set.
    """
    parsed = scenes.parse(scene)
    lights = scenes.lights_of(parsed)
    if lights:
        write_json(folder / "emission.json", [asdict(light) for light in lights])
    loaded = parsed.instantiate()
    if loaded.environment() is not None:
        picture = scenes.environment_latlong(loaded, ROWS)
        write_exr(folder / "environment.exr", np.dstack([picture, np.ones(picture.shape[:2])]))


def true_environment(data: Path) -> np.ndarray | None:
    """The true environment of a data set, in the layout of `latlong`; None where it is not known.

    Returns:
        Linear RGB radiance, float32, shape (ROWS, 2 ROWS, 3).

    Raises:
        UserError: the file cannot be read, or has another size.
    """
    file = data / "truth" / "environment.exr"
    if not file.is_file():
        return None
    try:
        # A map is positive: of pixels below zero, it can only miss what is below.
        picture = read_image(file, 2 * ROWS, ROWS, clip_negative=True)
    except UserError as error:
        raise UserError(error.what, error.where, _AGAIN) from None
    return picture.reshape(ROWS, 2 * ROWS, 4)[..., :3]


def true_emission(data: Path) -> dict[str, np.ndarray]:
    """The true strength of the lights of a data set by name, linear RGB, where it is known.

    Raises:
        UserError: the file is damaged.
    """
    file = data / "truth" / "emission.json"
    if not file.is_file():
        return {}
    entries = read_json(file)
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise UserError("not a list of lights", file, _AGAIN)
    known: dict[str, np.ndarray] = {}
    for number, light in enumerate(entries):
        where = f"{file}, light {number}"
        name = text(light, "name", where)
        if light.get("strength") is not None:
            known[name] = array(light, "strength", (3,), where)
            if not np.isfinite(known[name]).all():
                raise UserError(f"the strength of {name!r} is not finite", file, _AGAIN)
    return known
