"""The folder of a radiance field that `unbake solve` wrote, which a fit can start with.

    DIR/
      solve.json               settings and domain of L_θ, the scene's geometry, measurements, and
                               after which step θ was written
      radiance.safetensors     θ
      NAME-SIDE.exr, .png      pictures

No other module names these files.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save_file

from ..config.migration import as_before
from ..config.tables import update
from ..errors import UserError
from ..fields.arrays import from_numpy, shaped_like
from ..fields.domain import Domain
from ..fields.radiance import EXTRA, OUTPUTS, RadianceField, make_radiance
from ..fields.registry import representation
from ..fields.settings import FieldSettings, SizedSettings
from ..formats import check_format
from ..io import read_object, require_file, write_atomically, write_json
from ..scene.geometry import RAYS, probe

#: Format of `solve.json`.
FORMAT = 1
#: Numbers by which a small grid may be told to be larger than it is.
_SLACK = 1 << 20
MANIFEST, FIELD = "solve.json", "radiance.safetensors"
#: What reading a damaged manifest raises.
_DAMAGED = (KeyError, IndexError, TypeError, ValueError, OverflowError, UserError)
_AGAIN = "Solve the scene again"


@dataclass(frozen=True)
class Solved:
    """A radiance field read back from its folder."""

    folder: Path
    radiance: RadianceField
    representation: str  #: its name
    settings: FieldSettings  #: of the representation
    geometry: list[float]  #: of the scene; see `scene/geometry.py`
    scene: str  #: what was solved, for people
    steps: int
    sha256: str  #: of the file with θ


def description(
    radiance: RadianceField, form: str, settings: FieldSettings, scene: mi.Scene
) -> dict[str, Any]:
    """What `solve.json` tells of a field, so that it can be made again.

    Args:
        form: name of its representation.
        settings: of that representation.
        scene: that it is the radiance of.
    """
    return {
        "representation": form,
        "settings": asdict(cast(Any, settings)),
        "domain": asdict(radiance.domain),
        "scale": radiance.scale,
        "geometry": probe(scene),
    }


def write_solved(folder: Path, radiance: RadianceField, manifest: Mapping[str, Any]) -> None:
    """Write θ and the manifest, which has the `description` under "radiance" and θ's "step"."""
    arrays = {key: np.array(dr.detach(x)) for key, x in radiance.parameters().items()}
    write_atomically(folder / FIELD, lambda path: save_file(arrays, os.fspath(path)))
    write_json(folder / MANIFEST, manifest, allow_nan=False)


def read_solved(folder: Path | str) -> Solved:
    """A solved field with what is told of it.

    Raises:
        UserError: it cannot be read.
    """
    folder = Path(folder)
    require_solved(folder)
    manifest, file = read_object(folder / MANIFEST), folder / FIELD
    check_format(manifest, FORMAT, folder / MANIFEST)
    require_file(file, "field", _AGAIN)
    content = file.read_bytes()
    try:
        told = manifest["radiance"]
        form = str(told["representation"])
        base = representation(form).radiance
        if base is None:
            raise ValueError(f"{form} cannot represent it")
        settings = update(base, as_before(f"radiance.{form}") | told["settings"])
        geometry = [float(x) for x in told["geometry"]]
        centre = tuple(float(x) for x in told["domain"]["centre"])
        extent, scale = float(told["domain"]["extent"]), float(told["scale"])
        sound = len(centre) == 3 and len(geometry) == RAYS and min(extent, scale) > 0
        if not sound or not all(map(math.isfinite, (*centre, extent, scale, *geometry))):
            raise ValueError("a number is none that it can have")
        found = load(content)
        wanted = settings.numbers(OUTPUTS, EXTRA) if isinstance(settings, SizedSettings) else 0
        if wanted > 2 * sum(x.size for x in found.values()) + _SLACK:
            raise ValueError(f"{FIELD} has fewer numbers than its settings ask for")
        radiance = make_radiance(
            form, settings, Domain(cast(Any, centre), extent), scale=scale, seed=0
        )
        steps = manifest.get("step")
        if steps is None:  # of before: θ was written with each measurement alone
            steps = manifest["measurements"][-1]["step"]
        steps = int(steps)
        fresh = radiance.parameters()
    except (*_DAMAGED, SafetensorError) as error:
        raise UserError(f"is no field that can be read ({error})", folder, _AGAIN) from None
    if {k: v.shape for k, v in found.items()} != {k: tuple(v.shape) for k, v in fresh.items()}:
        raise UserError("does not fit its settings", file, _AGAIN)
    if not all(np.isfinite(value).all() for value in found.values()):
        raise UserError("has a number that is not finite", file, _AGAIN)
    radiance.assign(
        {key: shaped_like(from_numpy(mi.Float, value), fresh[key]) for key, value in found.items()}
    )
    sha256 = hashlib.sha256(content).hexdigest()
    scene = str(manifest.get("scene"))
    return Solved(folder, radiance, form, settings, geometry, scene, steps, sha256)


def require_solved(folder: Path) -> None:
    """Refuse a folder that `unbake solve` did not write.

    Raises:
        UserError: it holds no solved field.
    """
    if not (folder / MANIFEST).is_file():
        remedy = "Give the folder that `unbake solve` wrote"
        raise UserError("no solved radiance field in this folder", folder, remedy)


def load_radiance(folder: Path | str) -> RadianceField:
    """The field L_θ that `solve` or `fine_tune` wrote.

    Raises:
        UserError: it cannot be read.
    """
    return read_solved(folder).radiance
