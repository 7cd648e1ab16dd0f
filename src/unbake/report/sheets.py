"""The page's section on textures: sheets of what exports of the runs hold."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unbake.errors import UserError
from unbake.exports import EXPORT_FORMAT
from unbake.formats import check_format
from unbake.imaging import pictures
from unbake.io import read_object
from unbake.quantities import QUANTITIES
from unbake.report.runs import EvaluatedRun, made_of
from unbake.report.wording import made_after

#: Materials of an export that are shown, the largest ones, and pixels along the edge of a sheet.
MOST, EDGE = 12, 256


def texture_sections(folders: Sequence[Path], runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """An entry for each export: its run, and the textures of its largest materials.

    Args:
        folders: of `unbake export`, with textures.
        runs: those of the page.

    Raises:
        UserError: a folder holds no export, no textures, or one of another run.
    """
    return [_section(folder, runs) for folder in folders]


def _section(folder: Path, runs: list[EvaluatedRun]) -> dict[str, Any]:
    file = folder / "export.json"
    remedy = "Make one with `unbake export RUN --out DIR --format textures`"
    manifest = read_object(file, remedy)
    check_format(manifest, EXPORT_FORMAT, file)
    rows = manifest.get("materials")
    if "textures" not in (manifest.get("formats") or ()) or not isinstance(rows, list):
        raise UserError("holds no textures", folder, remedy)
    number = made_of(manifest, file, runs)
    try:
        rows = sorted(rows, key=lambda row: -float(row["area"]))
        materials = [_material(folder / "textures", row) for row in rows[:MOST]]
        return {
            "run": number,
            "materials": materials,
            "more": len(rows) - len(materials),
            "texels": float(manifest.get("texels_per_unit") or 0),
            "unobserved": float(manifest.get("unobserved_share") or 0),
            "made": made_after(manifest, runs[number]),
        }
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
        raise UserError("cannot be read", file, "Export the run again") from None


def _material(folder: Path, row: dict[str, Any]) -> dict[str, Any]:
    """A material's name, numbers and sheets, for the template."""
    sheets = []
    names = [str(name) for name in row["textures"]]
    for quantity, told in QUANTITIES.items():
        name = next((n for n in names if n.endswith(f"_{quantity}.exr")), None)
        if name is not None:
            values = pictures.shrink(pictures.read_exr(folder / Path(name).name), EDGE)
            picture = pictures.shown(values[..., :3], told.display)
            sheets.append({"title": told.title, "picture": pictures.png_data_uri(picture)})
    name = next((n for n in names if n.endswith("_unobserved.png")), None)
    if name is not None:
        mask = pictures.shrink(pictures.read_png(folder / Path(name).name), EDGE)
        picture = np.round(mask).astype(np.uint8)
        sheets.append({"title": "Unobserved", "picture": pictures.png_data_uri(picture)})
    return {
        "name": str(row["name"]),
        "resolution": int(row["resolution"]),
        "unobserved": float(row["unobserved_share"]),
        "sheets": sheets,
    }
