"""The true lighting of a rendered data set: its environment and the strengths of its emitters."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..errors import UserError
from ..imaging.pictures import write_exr
from ..io import array, read_json, text, write_json
from ..scene import emitters
from ..scene.parse import parse
from .data_folder import DataFolder
from .image_files import read_image

#: Rows of the image of a true environment.
ROWS = 128
_AGAIN = "Capture the data set again, or remove the file"


def write_true_lighting(scene: Path, data: Path) -> None:
    """Write the true environment map and strengths, each where the scene has such emitters.

    Args:
        scene: the Mitsuba scene that the photographs are rendered from.
        data: the data set's folder.
    """
    folder, parsed = DataFolder(data), parse(scene)
    named = emitters.named_emitters(parsed)
    if named:
        write_json(folder.emission_file, [asdict(emitter) for emitter in named])
    loaded = parsed.instantiate()
    if loaded.environment() is not None:
        picture = emitters.environment_latlong(loaded, ROWS)
        write_exr(folder.environment_file, np.dstack([picture, np.ones(picture.shape[:2])]))


def true_environment(data: Path, *, allow_outside: bool = False) -> np.ndarray | None:
    """The true environment of a data set, in the layout of `latlong`; None without a file.

    Args:
        data: the data set's folder.
        allow_outside: follow a link out of the folder.

    Returns:
        Linear RGB radiance, float32, shape (ROWS, 2 ROWS, 3).

    Raises:
        UserError: the file cannot be read or has another size.
    """
    folder = DataFolder(data, allow_outside)
    file = folder.environment_file
    if not folder.known(file):
        return None
    try:
        # A recovered map is never negative, so neither is the truth that it is compared with.
        picture = read_image(file, 2 * ROWS, ROWS, clip_negative=True)
    except UserError as error:
        raise UserError(error.what, error.where, _AGAIN) from None
    return picture.reshape(ROWS, 2 * ROWS, 4)[..., :3]


def true_emission(data: Path, *, allow_outside: bool = False) -> dict[str, np.ndarray]:
    """True strengths (3,) of a data set's emitters by name, linear RGB; unknown ones left out.

    Args:
        data: the data set's folder.
        allow_outside: follow a link out of the folder.

    Raises:
        UserError: the file is damaged.
    """
    folder = DataFolder(data, allow_outside)
    file = folder.emission_file
    if not folder.known(file):
        return {}
    entries = read_json(file)
    if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
        raise UserError("not a list of lights", file, _AGAIN)
    known: dict[str, np.ndarray] = {}
    for number, emitter in enumerate(entries):
        where = f"{file}, light {number}"
        name = text(emitter, "name", where)
        if emitter.get("strength") is not None:
            known[name] = array(emitter, "strength", (3,), where)
            if not np.isfinite(known[name]).all():
                raise UserError(f"the strength of {name!r} is not finite", file, _AGAIN)
    return known
