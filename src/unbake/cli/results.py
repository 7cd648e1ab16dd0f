"""Commands of finished runs: `evaluate`, `report`, `export`, `render`, `relight` and `view`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from tyro.conf import OmitArgPrefixes, Positional, arg

from .. import backend, exports, signals
from ..errors import UserError, collected, quoted, raise_together
from ..evaluation.settings import EvaluationSettings, RenderSettings
from ..io import require_writable_file
from ..training.run_folder import RunFolder
from .console import say
from .flags import flags, given, with_options
from .options import (
    Count,
    File,
    Flag,
    Folders,
    Formats,
    LightFlags,
    OtherData,
    Out,
    Run,
    RunOrData,
    Runs,
    chosen_light,
    exclude_changed,
)

if TYPE_CHECKING:
    EvaluationFlags = RenderFlags = Any
else:
    EvaluationFlags = flags(EvaluationSettings)
    RenderFlags = flags(RenderSettings)


def evaluate(
    run: Positional[Run],
    /,
    allow_outside: Flag = False,
    *,
    evaluate: OmitArgPrefixes[EvaluationFlags],
) -> None:
    """Render the recovered scene and measure it against photographs and truth.

    Writes pictures and metrics.json to RUN/evaluation.

    Args:
        run: Folder that `unbake fit` wrote.
        allow_outside: Read files that the data set or its scene names outside of its folder.
        evaluate: How views are rendered.
    """
    settings = with_options(EvaluationSettings(), given(evaluate))
    backend.activate()
    from ..evaluation.evaluate import evaluate as run_evaluate
    from ..evaluation.renderings import told_noise, told_unit
    from ..evaluation.yardsticks import told_yardsticks

    metrics = run_evaluate(run, settings, allow_outside=allow_outside, tell=say)
    if not metrics["steps"]:
        say("untrained: after 0 steps the fields have their initial values")
    found = metrics.get("yardsticks")
    told = told_yardsticks(metrics["heldout"], found) if found else []
    if scale := metrics.get("albedo_scale"):
        factors = " ".join(f"{factor:.2f}" for factor in scale)
        told.insert(0, f"albedo is aligned by the factors {factors} (red, green, blue)")
    for split in ("heldout", "train"):
        values = {k: v for k, v in metrics[split].items() if k != "views"}
        if not metrics["quantities"]:  # of known materials there are no scores
            values = {k: v for k, v in values.items() if v is not None}
        views, scored = metrics[split]["views"], metrics.get("scored", {}).get(split, {})
        if not views:
            continue
        say(f"{split} ({views} views): {_scores(values, views, scored)}")
        if split == "heldout":
            for line in told:
                say(f"  {line}")
    for note in (told_unit(metrics["display_exposure"]), told_noise(settings.spp)):
        if note:
            say(f"note: {note}")
    if told and found and found["ceiling"] is None:
        folder = RunFolder(run)
        data, config_file = quoted(folder.data(metrics["data"])), quoted(folder.config_file)
        say(f"for a ceiling: unbake bench ceiling {data} --settings {config_file}")
    wrote = f"wrote {RunFolder(run).evaluation}"
    say(f"{wrote}; next: unbake report {quoted(run)} --out report.html")


def report(
    runs: Positional[Runs],
    /,
    out: Out,
    exported: Folders = (),
    relit: Folders = (),
    allow_outside: Flag = False,
) -> None:
    """Write one HTML page that shows evaluated runs of a data set side by side.

    Args:
        runs: Folders of runs, each after `unbake evaluate`.
        out: The page to write, such as report.html. It needs no other file.
        exported: Folders of `unbake export`, with textures: the page shows their sheets.
        relit: Folders of `unbake relight` or `unbake render`: the page shows their pictures.
        allow_outside: Read files that the data set names outside of its folder.
    """
    if not runs:
        raise UserError("no run given", remedy="unbake report RUN [RUN ...] --out report.html")
    require_writable_file(out, "page")
    backend.activate()
    from ..report.page import write_report

    shown: dict[str, Any] = {"exported": exported, "relit": relit}
    say(f"wrote {write_report(runs, out, **shown, allow_outside=allow_outside)}")


def export(
    run: Positional[Run],
    /,
    out: Out,
    format: Formats = exports.DEFAULT_FORMATS,
    texels: Annotated[float | None, arg(metavar="TEXELS", help_behavior_hint="")] = None,
    max_texture: Annotated[int, arg(metavar="TEXELS")] = exports.LARGEST_TEXTURE,
    metres_per_unit: Annotated[float, arg(metavar="METRES")] = 1.0,
    cameras: Flag = True,
    allow_outside: Flag = False,
) -> None:
    """Write what a run recovered for other programs: textures, glTF, OpenUSD, or for Mitsuba.

    The scene keeps its parts and their names. Each material gets textures of albedo, roughness and
    metallic, and of opacity where it is cut out, in the texture coordinates of its parts if these
    are unique, else unwrapped. What no training view saw is filled in from what was seen, and
    marked in a mask. PATH/export.json has all of it.

    Args:
        run: Folder that `unbake fit` wrote.
        out: Folder to write to, new or empty.
        format: One or more of gltf (one file, scene.glb, with parts, textures and lights), textures
            (OpenEXR and PNG), mitsuba (a scene that Mitsuba renders without unbake) and usd
            (OpenUSD; it needs pip install 'unbake[usd]').
        texels: Texels along a scene unit (default: one for each pixel of the training views on the
            surfaces, or more where what was recovered, or a known texture, is finer). A texture has
            from 64 to --max-texture along an edge.
        max_texture: Texels along an edge of a texture, at most: 64, 128, … or 8192.
        metres_per_unit: How long a unit of the scene is, in glTF and OpenUSD: 0.001 where it is a
            millimetre.
        cameras: Leave out the views of the data set, which are cameras in glTF and OpenUSD.
        allow_outside: Read files that the data set or its scene names outside of its folder.
    """
    backend.activate()
    from ..exports.export import export as run_export

    console = Console(highlight=False)
    options: dict[str, Any] = {"allow_outside": allow_outside, "console": console, "tell": say}
    options |= {"texels": texels, "max_texture": max_texture}
    options |= {"metres_per_unit": metres_per_unit, "cameras": cameras}
    written = run_export(run, out, format, **options)["formats"]
    files = {"gltf": "scene.glb", "textures": "textures", "mitsuba": "mitsuba/scene.xml"}
    files |= {"usd": "usd/scene.usdc"}
    say(f"wrote {out}: {', '.join(files[name] for name in files if name in written)}, export.json")


def render(
    run: Positional[Run],
    /,
    out: Out,
    cameras: File = None,
    turntable: Count = None,
    width: Count = None,
    height: Count = None,
    allow_outside: Flag = False,
    *,
    render: OmitArgPrefixes[RenderFlags],
) -> None:
    """Render new pictures of the recovered scene, with all its light.

    Writes NAME.exr (linear radiance) and NAME.png of each camera, and render.json.

    Args:
        run: Folder that `unbake fit` wrote.
        out: Folder to write to, new or empty.
        cameras: Camera file (or transforms.json) to render instead of views of the data set.
        turntable: Render so many pictures on a circle around the scene. In rooms without a free
            circle the camera turns on the spot.
        width: Width of the pictures in pixels (default: as the photographs, or as --height).
        height: Height of the pictures in pixels (default: as the photographs, or as --width).
        allow_outside: Read files that the data set or its scene names outside of its folder.
        render: How pictures are rendered.
    """
    settings = _render_settings(given(render), width, height)
    _exclude_views(cameras, turntable, given(render))
    backend.activate()
    from ..evaluation.rendering import render as run_render

    places: dict[str, Any] = {"cameras": cameras, "turntable": turntable}
    made = run_render(run, out, settings, **places, allow_outside=allow_outside, tell=say)
    say(f"wrote {out}: {len(made['frames'])} pictures, render.json")


def relight(
    run: Positional[Run],
    /,
    out: Out,
    envmap: File = None,
    lights: File = None,
    cameras: File = None,
    turntable: Count = None,
    truth: OtherData = None,
    width: Count = None,
    height: Count = None,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    *,
    light: OmitArgPrefixes[LightFlags],
    render: OmitArgPrefixes[RenderFlags],
) -> None:
    """Render the recovered scene under another light, which takes the place of its own.

    Give --envmap or --lights. --cameras, --turntable and --truth exclude each other.

    Writes NAME.exr (linear radiance) and NAME.png of each camera, and render.json.

    Args:
        run: Folder that `unbake fit` wrote.
        out: Folder to write to, new or empty.
        envmap: Environment map (OpenEXR, HDR) to light the scene by.
        lights: Mitsuba XML file with lights: emitters, and shapes that emit light.
        cameras: Camera file (or transforms.json) to render instead of views of the data set.
        turntable: Render so many pictures on a circle around the scene. In rooms without a free
            circle the camera turns on the spot.
        truth: Data set of the same scene under that light, from `unbake capture` with the same
            --envmap or --lights: its views are rendered and compared.
        width: Width of the pictures in pixels (default: as the photographs, or as --height).
        height: Height of the pictures in pixels (default: as the photographs, or as --width).
        clip_negative: Take negative pixels of --truth as zero instead of refusing them.
        allow_outside: Read files that data sets, scenes and --lights name outside of their folders.
        light: How the light is put into the scene.
        render: How pictures are rendered.
    """
    settings = _render_settings(given(render), width, height)
    _exclude_views(cameras, turntable, given(render))
    chosen = chosen_light(envmap, lights, given(light))
    backend.activate()
    from ..evaluation.rendering import relight as run_relight

    places: dict[str, Any] = {"cameras": cameras, "turntable": turntable, "truth": truth}
    reading: Any = {"clip_negative": clip_negative, "allow_outside": allow_outside}
    made = run_relight(run, out, chosen, settings, **places, **reading, tell=say)
    if made["mean"] is not None:
        scores = {k: v for k, v in made["mean"].items() if k != "views"}
        views, scored = made["mean"]["views"], made.get("scored", {})
        say(f"mean over {views} views: {_scores(scores, views, scored)}")
    say(f"wrote {out}: {len(made['frames'])} pictures, render.json")


def view(
    folder: Positional[RunOrData],
    /,
    port: Annotated[int, arg(metavar="PORT")] = 8080,
    allow_outside: Flag = False,
) -> int:
    """Show a run or a data set in the browser: surfaces, cameras, pictures, the log.

    It prints the address of a page on this machine, which no other machine can open, and goes on
    until Ctrl-C. Of a fit that still runs, new checkpoints are shown as they come; nothing is
    written to its folder. It needs viser: pip install 'unbake[view]'

    Args:
        folder: Folder that `unbake fit` wrote, or of a data set.
        port: Port of 127.0.0.1; 0 takes any that is free.
        allow_outside: Read files that the data set or its scene names outside of its folder.
    """
    from ..viewer.dependencies import require_viser

    require_viser()
    backend.activate()
    from ..viewer.view import view as run_view

    run_view(folder, port, allow_outside=allow_outside, tell=say)
    return signals.status()


def _scores(values: Mapping[str, float | None], views: int, scored: Mapping[str, int]) -> str:
    """Means over views by their keys in a line; all but SSIM and FLIP are in dB.

    Args:
        scored: how many views have a score, where not all have it.
    """
    plain = ("render_ssim", "render_flip")
    told = {k: None if v is None else f"{v:.3f}" if k in plain else f"{v:.2f} dB"
            for k, v in values.items()}  # fmt: skip
    told |= {k: f"{told[k]} ({n} of {views} views)" for k, n in scored.items() if k in told}
    return ", ".join(f"{key} {value or '—'}" for key, value in told.items())


def _render_settings(
    values: dict[str, Any], width: int | None, height: int | None
) -> RenderSettings:
    """The settings of pictures with the options that were given; all wrong ones are told."""
    settings, faults = RenderSettings(), []
    with collected(faults):
        settings = with_options(settings, values)
    for name, value in {"width": width, "height": height}.items():
        try:
            settings = dataclasses.replace(settings, **{name: value})
        except UserError as error:
            faults.append(UserError(error.what, f"--{name}"))
    raise_together(faults, most=None)
    return settings


def _exclude_views(cameras: Path | None, turntable: int | None, values: dict[str, Any]) -> None:
    """Refuse --views where pictures are of other cameras."""
    for option, value in {"cameras": cameras, "turntable": turntable}.items():
        if value is not None:
            exclude_changed(option, RenderSettings, values, "views")
