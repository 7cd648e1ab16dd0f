"""Options that several commands share, and checks of their values."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, UseAppendAction, arg

from .. import config, experiments, exports
from ..config.light import LightConfig
from ..errors import UserError, raise_together
from .flags import flags, one_of, with_options

Scene = Annotated[str, arg(metavar="SCENE")]
Data = Annotated[Path, arg(metavar="DATA")]
Run = Annotated[Path, arg(metavar="RUN")]
RunOrData = Annotated[Path, arg(metavar="RUN|DATA")]
Runs = Annotated[tuple[Path, ...], arg(metavar="RUN [RUN ...]", help_behavior_hint="(required)")]
Experiment = Annotated[experiments.Name, arg(metavar="WHAT", help_behavior_hint="(required)")]
Scale = Annotated[experiments.Scale, arg(metavar="SCALE")]
Methods = Annotated[tuple[str, ...], arg(metavar="METHODS", help_behavior_hint="(required)")]
Formats = Annotated[
    tuple[str, ...],  # which `export` checks, as it takes commas
    arg(metavar="FORMATS", help_behavior_hint=f"(default: {' '.join(exports.DEFAULT_FORMATS)})"),
]
#: Where a command writes to.
Out = Annotated[Path, arg(aliases=("-o",))]
#: None stands for the value of the preset or the file: the help says no "default: None".
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
OtherData = Annotated[Path | None, arg(metavar="DATA", help_behavior_hint="")]
OutFile = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="", aliases=("-o",))]
RequiredFile = Annotated[Path, arg(metavar="FILE", aliases=("-o",))]
Folder = Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="")]
FromRun = Annotated[Path | None, arg(name="from", metavar="RUN", help_behavior_hint="")]
Source = Annotated[Path, arg(metavar="SOURCE")]
Meshes = UseAppendAction[Annotated[tuple[Path, ...], arg(metavar="MESH", help_behavior_hint="")]]
Matrix = Annotated[tuple[str, ...], arg(metavar="FILE|16 NUMBERS", help_behavior_hint="")]
Scenes = Annotated[tuple[str, ...], arg(metavar="SCENES", help_behavior_hint="")]
Folders = Annotated[tuple[Path, ...], arg(metavar="FOLDERS", help_behavior_hint="")]
Seconds = Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")]
Count = Annotated[int | None, arg(metavar="INT", help_behavior_hint="")]
Preset = Annotated[
    config.PresetName | None,
    one_of(*typing.get_args(config.PresetName)),
    arg(metavar="{cpu,paper,release,release-lighting}", help_behavior_hint=""),
]
Quality = Annotated[
    Literal["draft", "normal", "high"] | None,
    one_of("draft", "normal", "high"),
    arg(metavar="{draft,normal,high}", help_behavior_hint=""),
]
Flag = FlagCreatePairsOff[Annotated[bool, arg(help_behavior_hint="")]]

if TYPE_CHECKING:
    LightFlags = Any
else:
    LightFlags = flags(LightConfig)


def chosen_settings(preset: config.PresetName | None, settings: Path | None) -> config.FitConfig:
    """The settings that --preset or --settings name, if either was given."""
    if settings is None:
        return config.preset(preset or "cpu")
    exclude("settings", {"preset": preset})
    return config.read_toml(settings)


def chosen_light(envmap: Path | None, lights: Path | None, values: dict[str, Any]) -> LightConfig:
    """The light that --envmap or --lights and the options beside them name."""
    _require_envmap(envmap, values)
    return with_options(LightConfig(envmap=envmap, lights=lights), values)


def any_light(
    envmap: Path | None, lights: Path | None, values: dict[str, Any]
) -> LightConfig | None:
    """The same; None where neither option was given."""
    if envmap is None and lights is None:
        _require_envmap(envmap, values)
        if values.get("keep-lights"):
            remedy = "Give one, or leave this out"
            raise UserError("needs --envmap or --lights", "--keep-lights", remedy)
        return None
    return chosen_light(envmap, lights, values)


def _require_envmap(envmap: Path | None, values: dict[str, Any]) -> None:
    """Refuse options that say something about a map that there is not."""
    for name, value in values.items():
        unchanged = value == getattr(LightConfig, name.replace("-", "_"))
        if name.startswith("envmap-") and envmap is None and not unchanged:
            raise UserError("needs --envmap", f"--{name}", "Give it, or leave this out")


def with_length(settings: config.FitConfig, values: dict[str, Any]) -> config.FitConfig:
    """Settings with the options that were given; steps or seconds take the place of each other.

    Raises:
        UserError: options do not fit together, or say something about what is not unknown, or the
            settings refuse them.
    """
    if "steps" in values:
        exclude("seconds", {"steps": values["steps"]} if "seconds" in values else {})
        settings = dataclasses.replace(settings, seconds=0.0)
    if values.get("seconds") == 0:
        raise UserError("must be more than 0", "--seconds", "--steps 0 trains nothing")
    chosen = with_options(settings, values)
    if "pose-sigma" in values and not chosen.camera.of_places:
        what = "no pose or lens is refined that could be uncertain"
        remedy = "Give --poses refined or --intrinsics refined, too"
        raise UserError(what, "--pose-sigma", remedy)
    of_materials = [name for name in ("quantities", "representation") if name in values]
    if of_materials and not chosen.learns_materials:
        what = f"no material is unknown with --unknown {chosen.unknown}"
        remedy = "Leave it out, or give --unknown materials"
        raise_together([UserError(what, f"--{name}", remedy) for name in of_materials], most=None)
    return chosen


def require_of_method(settings: config.FitConfig, values: dict[str, Any]) -> None:
    """Refuse options that say something about what the method of a fit does not have.

    Args:
        values: of the options that were given. Files may name what only other methods have.

    Raises:
        UserError: it tells all such options.
    """
    from ..transport.objective import has_radiance

    faults = []
    if "radiance" in values and not has_radiance(settings.chosen_method):
        what = f"the method {settings.method} has no radiance field"
        faults.append(UserError(what, "--radiance", "Leave it out, or give --method ours"))
    if "max-depth" in values and not settings.follows_paths:
        what = f"the method {settings.method} does not follow paths to their end"
        faults.append(UserError(what, "--max-depth", "Leave it out, or give --method prb"))
    raise_together(faults, most=None)


def exclude(option: str, others: dict[str, object]) -> None:
    """Refuse options that make no sense beside another one."""
    for name, value in others.items():
        if value is not None:
            raise UserError(f"cannot be given together with --{option}", where=f"--{name}")


def exclude_changed(option: str, settings: type, values: Mapping[str, object], *names: str) -> None:
    """Refuse options that are not as usual, beside another one that makes them senseless.

    Args:
        settings: whose options they are.
        values: of the options.
        names: of those that are refused.
    """
    exclude(option, changed(settings, values, *names))


def changed(settings: type, values: Mapping[str, object], *names: str) -> dict[str, object]:
    """Those of some options that are not as usual; arguments as of `exclude_changed`."""
    usual = {name: getattr(settings, name.replace("-", "_")) for name in names}
    return {name: values[name] for name in names if values.get(name, usual[name]) != usual[name]}


def require(name: str, value: int, least: int) -> None:
    """Raise UserError where an option is smaller than `least`."""
    if value < least:
        raise UserError(f"must be {least} or more, not {value}", where=f"--{name}")
