"""Settings as TOML text, in which every setting stands."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..fields.registry import representations
from ..io import DEEPEST, nesting, read_text, why_unreadable
from ..transport.methods import METHODS
from .fit import FitConfig, PresetName
from .migration import FORMAT, migrated
from .presets import preset
from .tables import typed, update

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: Characters of settings; those that unbake writes have some 1,300. The time that tomllib takes for
#: a dotted key grows by the square of its length: 2 s here, minutes for 100,000.
LONGEST = 1 << 14


def to_toml(config: FitConfig) -> str:
    """The settings as TOML text; `from_toml` gives the same settings back.

    Fields that the fit does not have are left out where they are as in the preset: a file does not
    name representations that are registered by chance.
    """
    table = dataclasses.asdict(config)
    base = preset(config.preset)
    for name, forms in config.materials.items():
        used = config.representation if name in config.quantities else None
        kept = _kept(forms, base.materials[name], used)
        table["materials"][name] = {form: table["materials"][name][form] for form in kept}
    kept = _kept(config.radiance, base.radiance, config.radiance_representation)
    table["radiance"] = {form: table["radiance"][form] for form in kept}
    lines: list[str] = []
    _write_table({"format": FORMAT} | table, (), lines)
    return "\n".join(lines).strip() + "\n"


def _kept(forms: Mapping[str, Any], base: Mapping[str, Any], used: str | None) -> list[str]:
    return [form for form, value in forms.items() if form == used or value != base[form]]


def _write_table(table: dict, path: tuple[str, ...], lines: list[str]) -> None:
    # What is None is left out: TOML has no word for it.
    scalars = {k: v for k, v in table.items() if not isinstance(v, dict)}
    values = {key: value for key, value in scalars.items() if value is not None}
    if path and scalars:
        lines += ["", f"[{'.'.join(path)}]"]
    lines += [f"{key} = {json.dumps(value)}" for key, value in values.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            _write_table(value, (*path, key), lines)


def from_toml(text: str, where: str = "settings") -> FitConfig:
    """Settings from TOML text; keys that are absent keep the value of the named preset.

    Settings of earlier formats are understood.

    Raises:
        UserError: the text is not TOML, a key is unknown, or a value has the wrong type or range.
    """
    table = to_tables(text, where)
    try:
        _require_registered(table)
        name = typed(table.get("preset", "cpu"), PresetName, "preset")
        return update(preset(name), table)
    except UserError as error:
        raise UserError(
            error.what,
            where=f"{where}: {error.where}" if error.where else where,
            remedy=error.remedy,
        ) from None


def to_tables(text: str, where: str = "settings") -> dict[str, Any]:
    """TOML text as tables, with today's names, also where a value is none of today's.

    Raises:
        UserError: the text is not TOML, longer than settings are, or of a newer version.
    """
    text = text.removeprefix("\ufeff")  # as programs of Windows may begin a file
    if len(text) > LONGEST:
        raise UserError(f"has {len(text)} characters, settings at most {LONGEST}", where)
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of numbers with thousands of digits
        raise UserError(f"not valid TOML ({why_unreadable(error)})", where) from None
    if nesting(table) > DEEPEST:
        raise UserError(f"not valid TOML (nested deeper than {DEEPEST} levels)", where)
    try:
        return migrated(table)
    except UserError as error:
        raise UserError(
            error.what, f"{where}: {error.where}" if error.where else where, error.remedy
        ) from None


def _require_registered(table: Mapping[str, Any]) -> None:
    """Refuse unknown methods and representations, before their own tables are unknown keys."""
    for key, names in (
        ("method", tuple(METHODS)),
        ("representation", representations()),
        ("radiance_representation", representations(radiance=True)),
    ):
        value = table.get(key)
        if isinstance(value, str) and value not in names:
            what = f"must be one of {', '.join(names)}, not {value!r}"
            raise UserError(what, key, "A name of your own must be registered first")


def read_toml(path: str | Path) -> FitConfig:
    """Settings from a TOML file; see `from_toml`."""
    return from_toml(read_text(Path(path)), str(path))
