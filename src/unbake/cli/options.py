"""What the commands share: their options, and how what was given is checked."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from .. import config, experiments
from ..errors import UserError

Scene = Annotated[str, arg(metavar="SCENE")]
Data = Annotated[Path, arg(metavar="DATA")]
Run = Annotated[Path, arg(metavar="RUN")]
Runs = Annotated[tuple[Path, ...], arg(metavar="RUN [RUN ...]", help_behavior_hint="(required)")]
Experiment = Annotated[experiments.Name, arg(metavar="WHAT", help_behavior_hint="(required)")]
Scale = Annotated[experiments.Scale, arg(metavar="SCALE")]
Methods = Annotated[tuple[str, ...], arg(metavar="METHODS", help_behavior_hint="(required)")]
#: Where None stands for what preset or settings file say, "default: None" would tell nothing.
Count = Annotated[int | None, arg(metavar="INT", help_behavior_hint="")]
Seconds = Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")]
Preset = Annotated[
    config.PresetName | None, arg(metavar="{cpu,paper,release}", help_behavior_hint="")
]
Method = Annotated[str | None, arg(metavar="METHOD", help_behavior_hint="")]
Unknown = Annotated[config.Unknown | None, arg(metavar="WHAT", help_behavior_hint="")]
Prior = Annotated[
    config.PriorName | None, arg(metavar="{one-bounce,extra-bounce}", help_behavior_hint="")
]
Quantities = Annotated[tuple[str, ...] | None, arg(metavar="NAMES", help_behavior_hint="")]
Representation = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Flag = FlagCreatePairsOff[Annotated[bool, arg(help_behavior_hint="")]]


def chosen_settings(preset: config.PresetName | None, settings: Path | None) -> config.FitConfig:
    """The settings that --preset or --settings name, if either was given."""
    if settings is None:
        return config.preset(preset or "cpu")
    exclude("settings", {"preset": preset})
    return config.read_toml(settings)


def overridden(settings: config.FitConfig, given: dict[str, object]) -> config.FitConfig:
    """Settings with the options that were given; errors name the option."""
    keys = {"batch": "pixels", "radiance": "radiance_representation"}
    if given["steps"] is not None and given["seconds"] is not None:
        exclude("seconds", {"steps": given["steps"]})
    if given["steps"] is not None:
        settings = dataclasses.replace(settings, seconds=0.0)
    # The method first: whether other options make sense depends on it.
    for option, value in sorted(given.items(), key=lambda item: item[0] != "method"):
        if value is None:
            continue
        try:
            if option == "max-depth":
                path = dataclasses.replace(settings.path, max_depth=value)
                settings = dataclasses.replace(settings, path=path)
            else:
                settings = dataclasses.replace(settings, **{keys.get(option, option): value})
        except UserError as error:
            raise UserError(error.what, f"--{option}", error.remedy) from None
    return settings


def exclude(option: str, others: dict[str, object]) -> None:
    """Refuse options that make no sense beside another one."""
    for name, value in others.items():
        if value is not None:
            raise UserError(f"cannot be given together with --{option}", where=f"--{name}")


def require(name: str, value: int, least: int) -> None:
    """Raise UserError where an option is smaller than `least`."""
    if value < least:
        raise UserError(f"must be {least} or more, not {value}", where=f"--{name}")
