"""Settings files of earlier formats, read as if they were written today."""

from __future__ import annotations

import dataclasses
from typing import Any

from ..errors import UserError
from ..fields.settings import GridConfig
from ..formats import check_format

#: Version of the settings file. Keys that are absent in earlier ones have the values of `_BEFORE`.
FORMAT = 8

#: Where keys of format 1, which knew albedo and roughness alone, are now.
_MOVED = {
    "learning_rate": "materials.albedo.neural.learning_rate",
    "roughness_learning_rate": "materials.roughness.neural.learning_rate",
    "radiance_learning_rate": "radiance.neural.learning_rate",
    "albedo": "materials.albedo.neural",
    "roughness": "materials.roughness.neural",
    "radiance": "radiance.neural",
    "grid.albedo": "materials.albedo.grid.cells",
    "grid.roughness": "materials.roughness.grid.cells",
    "grid.radiance": "radiance.grid.cells",
    "grid.learning_rate": "materials.albedo.grid.learning_rate",
    "grid.roughness_learning_rate": "materials.roughness.grid.learning_rate",
    "grid.radiance_learning_rate": "radiance.grid.learning_rate",
    "bitmap.albedo": "materials.albedo.bitmap.resolution",
    "bitmap.roughness": "materials.roughness.bitmap.resolution",
    "bitmap.learning_rate": "materials.albedo.bitmap.learning_rate",
    "bitmap.roughness_learning_rate": "materials.roughness.bitmap.learning_rate",
    "regularisation": "regularization",
}
_GROUPS = ("grid", "bitmap")
_NEURAL_ROUGHNESS = "materials.roughness.neural"
_NEURAL_ALBEDO = "materials.albedo.neural"
#: Settings that came with a format, at their value before: a run of an earlier version goes on as
#: it began. By the table that they are in, where there is one.
_BEFORE_8: dict[str, dict[str, Any]] = {
    "": {"lamp_pictures": "ignored"},
    "lighting": {"mean_colour": "grey", "final_anchor": 1.0, "coarse_gain": 1.0},
}
_BEFORE_7: dict[str, dict[str, Any]] = {_NEURAL_ROUGHNESS: {"pieces.places": 0}}
_BEFORE_6: dict[str, dict[str, Any]] = {_NEURAL_ROUGHNESS: {"pieces.own_colours": 0}}
_BEFORE_5: dict[str, dict[str, Any]] = {
    "": {"lamps": "fitted"},
    "lighting": {"scale_told_by": "background"},
}
_BEFORE_4: dict[str, dict[str, Any]] = {
    "path": {"planned_gain": 1.0},
    _NEURAL_ALBEDO: {"pieces.across_slivers": False},
    _NEURAL_ROUGHNESS: {"pieces.across_slivers": False},
}
_BEFORE_3: dict[str, dict[str, Any]] = {
    "": {
        "held_aside": 0.0,
        "beta2": 0.999,
        "least_slope": 0.0,
        "guide.cells": 0,
        "regularization.albedo_smoothness": 0.0,
        "roughness_search.times": 0,
        "roughness_search.pixels_as_one": 0.0,
        "roughness_search.pixels_at_most": 0,
        "roughness_search.rate_before": 1.0,
    },
    "radiance.neural": {"leak": 0.0},
    "radiance.triplane": {"leak": 0.0},
    _NEURAL_ALBEDO: {"pieces.most": 0, "pieces.variation": False},
    _NEURAL_ROUGHNESS: {
        "pieces.most": 0,
        "pieces.colours": 0,
        "pieces.variation": False,
    },
}
#: All of these, by the format that they came with.
_BEFORE = {8: _BEFORE_8, 7: _BEFORE_7, 6: _BEFORE_6, 5: _BEFORE_5, 4: _BEFORE_4, 3: _BEFORE_3}
#: Keys that are no more.
_GONE = (("camera", "smoothness"),)
#: Keys that tell the settings of a run of 0.1, which has no number, from what a user gives.
_OF_RUN = {"preset", "unknown", "method", "seed", "steps", "seconds", "pixels", "spp"}


def as_before(outer: str) -> dict[str, Any]:
    """Settings of a table that came later, at their value before.

    Args:
        outer: the dotted key of the table.
    """
    return {
        key: value for tables in _BEFORE.values() for key, value in tables.get(outer, {}).items()
    }


def migrated(table: dict[str, Any]) -> dict[str, Any]:
    """A table of settings in today's format, without its number.

    A file that does not tell its format may have keys of both.

    Raises:
        UserError: the format is newer, or a key of an old table is not known.
    """
    table = dict(table)
    version = table.get("format")
    if version is not None:
        check_format(table, FORMAT, "format")
        del table["format"]
    # Where unbake wrote the file, all settings are in it but those of later versions.
    written = version in range(1, FORMAT) or (version is None and _OF_RUN <= table.keys())
    found = _moved(table, version) if version in (None, 1) else table
    every = [
        item
        for came_with, tables in _BEFORE.items()
        if version is None or version < came_with
        for item in tables.items()
    ]
    if written and not _has(found, "lighting.final_anchor") and _has(found, "lighting.anchor"):
        # The weight was the same throughout.
        _put(found, "lighting.final_anchor", found["lighting"]["anchor"], "lighting.final_anchor")
    for outer, settings in every if written else ():
        if outer and not _has(found, outer):
            continue
        for inner, value in settings.items():
            key = f"{outer}.{inner}".lstrip(".")
            if not _has(found, key):
                _put(found, key, value, key)
    for outer, key in _GONE if written else ():
        if _has(found, f"{outer}.{key}"):
            found[outer] = {k: v for k, v in found[outer].items() if k != key}
    return found


def _has(table: Any, dotted: str) -> bool:
    """Whether there is anything at a dotted key."""
    first, _, rest = dotted.partition(".")
    if not isinstance(table, dict) or first not in table:
        return False
    return not rest or _has(table[first], rest)


def _moved(table: dict[str, Any], version: int | None) -> dict[str, Any]:
    """A table of format 1, or of a file that does not tell it, with keys where they are now."""
    found: dict[str, Any] = {}
    for key, value in table.items():
        if key in _GROUPS and isinstance(value, dict):
            for inner, setting in value.items():
                dotted = f"{key}.{inner}"
                if dotted not in _MOVED:
                    known = [k.partition(".")[2] for k in _MOVED if k.startswith(f"{key}.")]
                    raise UserError("unknown key", dotted, f"Known keys: {', '.join(known)}")
                _put(found, _MOVED[dotted], setting, dotted)
        elif key == "radiance" and version is None and not _is_network(value):
            _put(found, key, value, key)
        else:
            _put(found, _MOVED.get(key, key), value, key)
    return found


def _is_network(radiance: object) -> bool:
    """Whether the table [radiance] is that of a network, as in format 1.

    In format 2 it holds tables of representations. One of these is named `grid`, as the network's
    hash grid was.
    """
    if not isinstance(radiance, dict):
        return False
    if "width" in radiance or "hidden" in radiance:
        return True
    grid = radiance.get("grid")
    hashed = {field.name for field in dataclasses.fields(GridConfig)}
    return isinstance(grid, dict) and bool(hashed & grid.keys())


def _put(table: dict[str, Any], dotted: str, value: Any, key: str) -> None:
    """Put a value at a dotted key, and keep the values that are there already."""
    *outer, last = dotted.split(".")
    for name in outer:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise UserError("must be a table", key)
    if isinstance(value, dict):
        inner = table.setdefault(last, {})
        if not isinstance(inner, dict):
            raise UserError("must be a table", key)
        for name, item in value.items():
            _put(inner, name, item, f"{key}.{name}")
    else:
        table[last] = value
