"""Options of the command line, made of the fields of settings that have a `Flag`."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, TypeVar

from tyro.conf import FlagCreatePairsOff, arg
from tyro.constructors import PrimitiveConstructorSpec

from .. import config
from ..config import FitConfig, Flag, with_method
from ..errors import UserError, raise_together

Settings = TypeVar("Settings")


@dataclass(frozen=True)
class Option:
    """A field of settings, maybe of a table inside of them, that has an option."""

    path: tuple[str, ...]
    type: Any
    flag: Flag
    default: Any

    @property
    def name(self) -> str:
        """As on the command line, without the two dashes."""
        return (self.flag.name or self.path[-1]).replace("_", "-")


@cache
def options(settings: type) -> tuple[Option, ...]:
    """The options of a settings dataclass, in the order of its fields."""
    return tuple(_options(settings, ()))


def _options(settings: type, path: tuple[str, ...]) -> list[Option]:
    hints = typing.get_type_hints(settings, include_extras=True)
    found = []
    for field in dataclasses.fields(settings):
        hint, here = hints[field.name], (*path, field.name)
        if typing.get_origin(hint) is Annotated:
            kind, *extras = typing.get_args(hint)
            flags = [extra for extra in extras if isinstance(extra, Flag)]
            found += [Option(here, kind, flag, field.default) for flag in flags]
        elif dataclasses.is_dataclass(hint) and isinstance(hint, type):
            found += _options(hint, here)
    return found


def flags(settings: type, *, presets: bool = False, without: Collection[str] = ()) -> type:
    """A dataclass from which the command line makes options.

    Args:
        settings: a dataclass whose fields have flags.
        presets: options that are not given are None and leave the setting as a preset or a file has
            it; the help tells what presets have. Otherwise they have the settings' own defaults.
        without: names of options to leave out.
    """
    fields = []
    for option in options(settings):
        if option.name in without:
            continue
        name = option.name.replace("-", "_")
        told = arg(
            name=option.name,
            help=_help(option, presets),
            metavar=option.flag.metavar or _metavar(option.type),
            help_behavior_hint="",
        )
        if option.type is bool:
            fields.append((name, FlagCreatePairsOff[Annotated[bool, told]], False))
        elif presets and typing.get_origin(option.type) is typing.Literal:
            kind = one_of(*typing.get_args(option.type))
            fields.append((name, Annotated[option.type | None, kind, told], None))
        elif presets:
            fields.append((name, Annotated[option.type | None, told], None))
        else:
            fields.append((name, Annotated[option.type, told], option.default))
    return dataclasses.make_dataclass(settings.__name__ + "Flags", fields, frozen=True)


def one_of(*names: str) -> PrimitiveConstructorSpec[str | None]:
    """The type of an option with these values, or None where it is not given.

    Tyro 1.0 lists the values of optional literals in another order each time, with None as one.
    """
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(names) + "}",
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: value is None or value in names,
        str_from_instance=lambda value: [str(value)],
        choices=names,
    )


def _help(option: Option, presets: bool) -> str:
    text, default = option.flag.help, ""
    if option.flag.choices is not None:
        known = option.flag.choices()
        text += ": " + "; ".join(
            name if name == told else f"{name} ({told})" for name, told in known.items()
        )
    if option.type is bool or not option.flag.tell_default:
        return text + "."
    if presets:
        names: dict[str, list[str]] = {}
        for name in typing.get_args(config.PresetName):
            value = _text(_value(of_preset(name), option.path))
            names.setdefault(value, []).append(name)
        told = [f"{', '.join(who)}: {value}" for value, who in names.items()]
        default = told[0].partition(": ")[2] if len(told) == 1 else "; ".join(told)
        default = f"default: {default}" if len(told) == 1 else default
    else:
        default = f"default: {_text(option.default)}"
    return f"{text} ({default})."


@cache
def of_preset(name: config.PresetName) -> FitConfig:
    """The settings of a preset, to be read alone: their tables of fields could be changed."""
    return config.preset(name)


def _metavar(kind: Any) -> str | None:
    if kind is bool:
        return None
    choices = typing.get_args(kind)
    if choices:
        return "{" + ",".join(map(str, choices)) + "}"
    return "NUMBER" if kind is float else "INT" if kind is int else "TEXT"


def _text(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _value(settings: object, path: tuple[str, ...]) -> object:
    for key in path:
        settings = getattr(settings, key)
    return settings


def given(chosen: Any) -> dict[str, Any]:
    """The values that were given, by option; options that were not are None and left out."""
    named = {f.name.replace("_", "-"): getattr(chosen, f.name) for f in dataclasses.fields(chosen)}
    return {name: value for name, value in named.items() if value is not None}


def with_options(settings: Settings, values: Mapping[str, Any]) -> Settings:
    """Settings with the options that were given.

    Args:
        values: by the options' names.

    Raises:
        UserError: values that the settings refuse, all of them; each names its option.
    """
    known = {option.name: option for option in options(type(settings))}
    problems: list[UserError] = []
    # The method first: whether other options make sense depends on it.
    if "method" in values and isinstance(settings, FitConfig):
        try:
            settings = with_method(settings, values["method"])
        except UserError as error:
            problems.append(UserError(error.what, "--method", error.remedy))
        values = {name: value for name, value in values.items() if name != "method"}
    if not problems:
        with suppress(UserError):  # at once: what one option asks for may need another
            return _replaced(settings, {known[name].path: x for name, x in values.items()})
    for name, value in values.items():
        try:
            settings = _replaced(settings, {known[name].path: value})
        except UserError as error:
            problems.append(UserError(error.what, f"--{name}", error.remedy))
    raise_together(problems, most=None)
    return settings


def _replaced(settings: Any, values: Mapping[tuple[str, ...], object]) -> Any:
    """Settings with other values, by their paths."""
    if not values:
        return settings
    changed: dict[str, Any] = {path[0]: value for path, value in values.items() if len(path) == 1}
    for key in dict.fromkeys(path[0] for path in values if len(path) > 1):
        inner = {p[1:]: x for p, x in values.items() if p[0] == key and len(p) > 1}
        changed[key] = _replaced(getattr(settings, key), inner)
    return dataclasses.replace(settings, **changed)
