"""Settings changed by nested tables, as a TOML file holds them.

Unknown keys and wrong types are errors, so that a misspelt setting is never silently ignored.
"""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator, Mapping
from difflib import get_close_matches
from itertools import chain
from textwrap import shorten
from typing import Any, TypeVar, cast

from ..errors import UserError, collected, mistyped, raise_together

Settings = TypeVar("Settings")

#: Characters of known keys in a message.
_SHOWN = 120


def update(
    settings: Settings, table: Mapping[str, Any], path: tuple[str, ...] = (), values: Any = None
) -> Settings:
    """Settings with the values of a table.

    Args:
        settings: a dataclass, or dataclasses or values by name.
        table: nested as the settings are; what is absent stays.
        path: keys that lead to the table, for errors.
        values: type of the values by name.

    Raises:
        UserError: keys are unknown, or values have the wrong type or range.
    """
    if isinstance(settings, Mapping):
        current = dict(settings)
        hints = dict.fromkeys(current, values)
    else:
        hints = typing.get_type_hints(type(settings))
        current = {key: getattr(settings, key) for key in hints}
    changes, faults = {}, []
    if unknown := [key for key in table if key not in current]:
        faults.append(_unknown(unknown, list(current), path))
    for key in (key for key in table if key in current):
        with collected(faults):
            changes[key] = _changed(current[key], table[key], hints[key], (*path, key))
    raise_together(faults)
    if isinstance(settings, Mapping):
        return cast(Settings, {**current, **changes})
    try:
        return dataclasses.replace(cast(Any, settings), **changes)
    except UserError as error:
        where = ".".join((*path, *([error.where] if error.where else [])))
        raise UserError(error.what, where, error.remedy) from None


def _changed(current: Any, value: object, hint: Any, path: tuple[str, ...]) -> Any:
    """One value, or one table, in the place of the current one."""
    if not dataclasses.is_dataclass(current) and not isinstance(current, Mapping):
        return typed(value, hint, ".".join(path))
    if not isinstance(value, Mapping):
        raise UserError("must be a table", where=".".join(path))
    _, inner = typing.get_args(hint) or (None, None)
    return update(current, value, path, inner)


def flattened(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested tables by their dotted keys."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _unknown(keys: list[str], names: list[str], path: tuple[str, ...]) -> UserError:
    """That a table has keys that there are not, and which there are.

    Where they are many, those that resemble the unknown ones most.
    """
    known = ", ".join(names)
    if len(known) > _SHOWN:
        ranked = [get_close_matches(key[:_SHOWN], names, len(names), cutoff=0) for key in keys]
        nearest = dict.fromkeys(chain.from_iterable(zip(*ranked, strict=True)))
        known = shorten(", ".join(nearest), _SHOWN, placeholder=" …")
    remedy = f"Known keys: {known}"
    if len(keys) == 1:
        return UserError("unknown key", ".".join((*path, *keys)), remedy)
    told = shorten(", ".join(keys), _SHOWN, placeholder=" …")
    return UserError(f"unknown keys {told}", ".".join(path) or None, remedy)


def typed(value: object, hint: Any, where: str) -> Any:
    """The value as the type that an annotation asks for; raises a `UserError` otherwise."""
    if typing.get_origin(hint) is tuple:
        item = typing.get_args(hint)[0]
        if not isinstance(value, list | tuple):
            raise UserError(f"must be a list, not {type(value).__name__}", where=where)
        return tuple(typed(x, item, where) for x in value)
    if (wrong := mistyped(value, hint)) is not None:
        raise UserError(wrong, where)
    if type(value) is int and float in (hint, *typing.get_args(hint)):
        if abs(value) >= 1 << 53:  # where floats leave out integers
            raise UserError("must be float, not int", where)
        return float(value)
    return value
