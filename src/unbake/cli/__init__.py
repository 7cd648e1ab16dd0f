"""The command line: one function a command."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console
from rich.text import Text
from tyro.conf import OmitArgPrefixes, Positional, arg

from .. import backend, experiments, exports, signals
from ..acquisition.settings import CaptureSettings, DegradeSettings
from ..config import FitConfig, with_quality
from ..config.light import LightConfig
from ..errors import UserError, collected, of_system, printable, raise_together
from ..evaluation.settings import EvaluationSettings, RenderSettings
from ..importing.faults import ImportFaults
from ..importing.settings import ImportSettings
from ..memory import NO_MEMORY, lacks_memory
from ..solver.settings import SolveSettings
from ..training.run_folder import RunFolder
from ..version import VERSION
from . import bench
from .console import LONGEST, fail, quoted, say
from .flags import flags, given, with_options
from .help import NARROWEST, columns, wrapped_help
from .options import (
    Count,
    Data,
    Experiment,
    File,
    Flag,
    Folder,
    Folders,
    Formats,
    FromRun,
    Meshes,
    Methods,
    OtherData,
    Out,
    OutFile,
    Preset,
    Quality,
    Run,
    RunOrData,
    Runs,
    Scale,
    Scene,
    Scenes,
    Source,
    any_light,
    changed,
    chosen_light,
    chosen_settings,
    exclude,
    exclude_changed,
    require,
    with_length,
)
from .processes import require_one_process, sharing_ranks

#: Between scores of a comparison, unless a file or an option says otherwise.
_SCORE_SECONDS = 5.0

_DESCRIPTION = (
    "Recovers the materials or the lighting of a scene with known geometry from posed "
    "photographs, with the global illumination taken out."
)
_START = (
    "unbake capture demo --out DATA",
    "unbake fit DATA --out RUN",
    "unbake evaluate RUN",
    "unbake report RUN --out report.html",
)
_STATUS = (
    "Exit status: 0; 1 where a part failed or a fit learned nothing; 2 on bad input or a full "
    "disk; ended early: 130 (Ctrl-C), 143 (SIGTERM), 129 (SIGHUP), 141 (closed pipe). Long "
    "commands, such as a fit, save their progress; others leave existing files untouched. A second "
    "Ctrl-C ends at once."
)

if TYPE_CHECKING:
    CaptureFlags = FitFlags = EvaluationFlags = CompareFlags = RenderFlags = LightFlags = Any
    ImportFlags = ImportLightFlags = SolveFlags = DegradeFlags = Any
else:
    CaptureFlags = flags(CaptureSettings)
    DegradeFlags = flags(DegradeSettings)
    ImportFlags = flags(ImportSettings)
    FitFlags = flags(FitConfig, presets=True)
    EvaluationFlags = flags(EvaluationSettings)
    RenderFlags = flags(RenderSettings)
    LightFlags = flags(LightConfig)
    ImportLightFlags = flags(LightConfig, without=("keep-lights",))
    SolveFlags = flags(SolveSettings)
    CompareFlags = flags(FitConfig, presets=True, without=("method",))


def main() -> None:
    """Read the words of the command line and run a command; exits with its status.

    2 on bad input; 130, 143, 129 or 141 if a signal or a closed pipe ended it (`signals.py`).
    """
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)  # Tyro 1.0 wraps texts forever below 10
    words = sys.argv[1:]
    family = words[0] if words and words[0] in FAMILIES else None
    asked = words if family is None else words[1:]
    if asked in ([], ["-h"], ["--help"]):
        told = _overview() if family is None else _overview_of(family)
        print(told, file=sys.stdout if asked else sys.stderr)
        sys.exit(0 if asked else 2)
    if words == ["--version"]:
        say(f"unbake {VERSION}")
        sys.exit(0)
    for command in COMMANDS.values():
        # Tyro 1.0 keeps the line breaks of some arguments' texts.
        command.__doc__ = re.sub(r"\n {8}(?=\S)", " ", inspect.getdoc(command) or "")
    try:
        name = words[0] if family is None else " ".join(words[:2])
        if name in COMMANDS.keys() - SHARED and not {"-h", "--help"} & {*words}:
            require_one_process(name, SHARED)
        with wrapped_help(words):
            status = _run(family, asked)
    except UserError as error:
        fail(str(error))
    except (MemoryError, RuntimeError, ImportError) as error:  # Dr.Jit raises the second
        if not lacks_memory(error):
            raise
        fail(NO_MEMORY)
    except OSError as error:
        # A full disk, a file taken away: nothing that a traceback would explain.
        fail(of_system(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(signals.status())
    sys.exit(status or 0)


def _run(family: str | None, words: list[str]) -> int | None:
    """Run a command; returns its status.

    Args:
        family: its first word, if it has two.
        words: the others.
    """
    if family is not None:
        return tyro.extras.subcommand_cli_from_dict(
            _of_family(family), prog=f"unbake {family}", description=FAMILIES[family], args=words
        )
    # Families are told among the commands where a word is wrong.
    families = {name: partial(_tell_family, name) for name in FAMILIES}
    single = {n: c for n, c in COMMANDS.items() if " " not in n} | families
    return tyro.extras.subcommand_cli_from_dict(
        single, prog="unbake", description=_DESCRIPTION, args=words
    )


def _tell_family(family: str) -> int:
    """Tell the commands whose first word this is."""
    print(_overview_of(family), file=sys.stderr)
    return 2


def capture(
    scene: Positional[Scene],
    /,
    out: Out,
    cameras: File = None,
    envmap: File = None,
    lights: File = None,
    allow_outside: Flag = False,
    *,
    capture: OmitArgPrefixes[CaptureFlags],
    light: OmitArgPrefixes[LightFlags],
) -> None:
    """Render a data set from a Mitsuba scene: photographs, cameras, and the true materials.

    Args:
        scene: A Mitsuba 3 XML file, or a built-in scene: demo, annex (two rooms, and training views
            of one), still, cornell, cube, furnace.
        out: Folder to write; it must not exist.
        cameras: Camera file (or transforms.json) to use instead of --views and --held-out.
        envmap: Environment map (OpenEXR, HDR) to light the scene by, instead of its own light.
        lights: Mitsuba XML file with lights to use instead of the scene's own.
        allow_outside: Read files that the scene names outside of its folder.
        capture: How the data set is rendered.
        light: How the other light is put into the scene.
    """
    settings = with_options(CaptureSettings(), given(capture))
    if cameras is not None:
        exclude_changed("cameras", CaptureSettings, given(capture), "views", "held-out")
    other = any_light(envmap, lights, given(light))
    backend.activate()
    from ..acquisition.capture import capture as run

    start = time.perf_counter()
    options: dict[str, Any] = {"allow_outside": allow_outside, "tell": say}
    run(scene, out, settings, cameras=cameras, light=other, **options)
    took = f"{time.perf_counter() - start:.0f} s"
    say(f"wrote {out} in {took}; next: unbake fit {quoted(out)} --out RUN")


def import_(
    source: Positional[Source],
    /,
    out: Out,
    mesh: Meshes = (),
    images: Folder = None,
    masks: Folder = None,
    exposures: File = None,
    mesh_transform: File = None,
    envmap: File = None,
    lights: File = None,
    allow_outside: Flag = False,
    *,
    settings: OmitArgPrefixes[ImportFlags],
    light: OmitArgPrefixes[ImportLightFlags],
) -> None:
    """Make a data set of photographs, cameras and meshes of other programs.

    Photographs may be PNG, JPEG, TIFF, OpenEXR or camera RAW. The mesh must be in the frame and
    unit of the cameras. Lens distortion is taken out. Exposures come from EXIF. It needs more
    packages: pip install 'unbake[import]', and for camera RAW 'unbake[raw]'

    Without --envmap or --lights the light is unknown, and is fitted with the materials.

    Args:
        source: Folder or transforms.json of nerfstudio, Blender-NeRF or a synthetic NeRF scene, or
            folder of a COLMAP project or model, or of a FIPT room.
        mesh: Mesh (PLY, OBJ, GLB), which only FIPT rooms have themselves; may be given several
            times.
        out: Folder to write to, new or empty.
        images: Folder of the photographs, where it is not the one that the source names; they may
            have been made smaller as a whole.
        masks: Folder of masks, black where a pixel does not count: NAME.jpg.png or NAME.png for
            NAME.jpg. By default the one that the source names.
        exposures: Table (CSV) with the columns name and exposure, instead of EXIF.
        mesh_transform: The dataparser_transforms.json of a nerfstudio run, whose ns-export wrote
            the mesh: takes the mesh back to the frame of COLMAP.
        envmap: Environment map (OpenEXR, HDR) that is the known light.
        lights: Mitsuba XML file with the known lights: emitters, and shapes that emit light.
        allow_outside: Read files that the source and --lights name outside of their folders.
        settings: How the source is read.
        light: How the known light is put into the scene.
    """
    chosen = with_options(ImportSettings(), given(settings))
    known = any_light(envmap, lights, given(light))
    backend.activate()
    from ..importing.import_data import import_data

    start = time.perf_counter()
    files: dict[str, Any] = {
        "images": images,
        "masks": masks,
        "exposures": exposures,
        "mesh_transform": mesh_transform,
        "light": known,
    }
    try:
        import_data(source, out, mesh, chosen, **files, allow_outside=allow_outside, tell=say)
    except ImportFaults as error:
        for fault in error.faults:
            print(f"  {printable(fault, LONGEST)}", file=sys.stderr)
        raise UserError(f"{error.count}, listed above", source, error.remedy) from None
    took = f"{time.perf_counter() - start:.0f} s"
    say(f"wrote {out} in {took}; next: {_fit_of(out, light_known=known is not None)}")


def data(
    what: Positional[Literal["check"]],
    folder: Positional[Data],
    /,
    out: OutFile = None,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
) -> int:
    """Check a data set before a fit: what is wrong with it, where, and what to do about it.

    It tells of files, cameras that see nothing, axes and units of poses that are not those of the
    scene, exposures that differ, light that turns with the cameras, clipped, black and blurred
    photographs, surfaces that no view sees, and duplicates: of all of it at once. The exit status
    is 2 where a fit makes no sense.

    Args:
        what: What to do with it: check.
        folder: Folder of the data set, with its transforms.json.
        out: Page to write, such as check.html, with edges of the geometry on photographs. It needs
            no other file.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or its scene names outside of its folder.
    """
    backend.activate()
    from ..checks.check import check_data
    from ..checks.told import told_rows

    options = {"allow_outside": allow_outside, "clip_negative": clip_negative}
    result = check_data(folder, **options)
    marks = {"ok": "green", "warning": "yellow", "error": "bold red", "hint": "cyan", "—": "dim"}
    console = Console(highlight=False)
    for check, verdict, told in told_rows(result):
        line = Text.assemble(f"{check:11}", (f"{verdict:8}", marks[verdict]), printable(told, 200))
        console.print(line)
    for finding in result.findings:
        say("")
        console.print(Text.assemble((f"{finding.level}: ", marks[finding.level]), str(finding)))
    say("")
    if out is not None:
        from ..report.check_page import write_check

        say(f"wrote {write_check(result, out, clip_negative=clip_negative)}")
    kinds = {kind: result.count(kind) for kind in ("error", "warning", "hint")}
    told = ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in kinds.items() if n)
    known = result.dataset is None or result.dataset.light == "known"
    ready = f"next: {_fit_of(folder, light_known=known)}"
    say(f"{told or 'nothing is wrong'}; {ready if result.usable else 'a fit makes no sense yet'}")
    return 0 if result.usable else 2


def degrade(
    data: Positional[Data],
    /,
    out: Out,
    allow_outside: Flag = False,
    *,
    degrade: OmitArgPrefixes[DegradeFlags],
) -> None:
    """Add the faults of cameras and meshes to a rendered data set, to test how robust a fit is.

    Faults are drawn at random, the same for the same --seed. Their truth is kept in
    OUT/degraded.json: exposures, white balances and poses by view, the response as a table.
    Without an option nothing is changed.

    Args:
        data: Folder of the data set, with its transforms.json.
        out: Folder to write, new or empty.
        allow_outside: Read files that the data set or its scene names outside of its folder.
        degrade: Faults of photographs, poses and meshes.
    """
    settings = with_options(DegradeSettings(), given(degrade))
    if settings.format != "jpeg":
        for name in changed(DegradeSettings, given(degrade), "quality", "chroma"):
            raise UserError("needs --format jpeg", f"--{name}", "Give it, or leave this out")
    backend.activate()
    from ..acquisition.degrade import degrade as run

    run(data, out, settings, allow_outside=allow_outside, tell=say)
    say(f"wrote {out}; next: unbake data check {quoted(out)}")


def fit(
    data: Positional[Data],
    /,
    out: Out,
    preset: Preset = None,
    settings: File = None,
    quality: Quality = None,
    resume: Flag = False,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    allow_doubtful: Flag = False,
    tensorboard: Flag = False,
    radiance_from: Folder = None,
    *,
    fit: OmitArgPrefixes[FitFlags],
) -> int:
    """Recover materials or lighting from the photographs of a data set.

    Ctrl-C, SIGTERM, SIGHUP and a closed pipe stop it after the present step, with a checkpoint from
    which --resume continues. A second Ctrl-C ends it at once.

    Several processes share one fit with mpiexec -n 4 unbake fit DATA --out RUN (docs/machines.md).

    While it runs it tells the terms of its loss, smaller is better. photo: the photographs against
    the pictures of the unknowns; what remains in the end is mostly noise. prior: where L, the
    network that stands for all further light, breaks the rendering equation, at the first point
    that a camera sees; extra: the same one bounce further. These two keep the noise of one sample
    and need not fall. lhs: the photographs against L seen directly. In the end the error on pixels
    that were held aside tells whether a longer fit would be better.

    Args:
        data: Folder of the data set, with its transforms.json.
        out: Folder to write the run to: settings, log, checkpoints, previews.
        preset: Settings to start from: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings, such as the config.toml of a run; instead of --preset.
        quality: How long the fit is: draft, a quarter of the length of the preset or the file;
            normal, the same; high, four times as long. --steps and --seconds take its place.
        resume: Go on with the run in --out; a larger --steps or --seconds makes it longer.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or its scene names outside of its folder.
        allow_doubtful: Begin also where poses seem to have other axes or units than the scene, or
            light seems to turn with the cameras.
        tensorboard: Write losses and scores to OUT/tensorboard, too, for tensorboard --logdir OUT.
        radiance_from: Folder that `unbake solve` wrote for this scene: L starts as it was solved
            there, with any materials, instead of untrained, and has its size.
        fit: Settings that differ from those of the preset or the file.
    """
    changes = given(fit)
    if resume:
        length = {"steps", "seconds"}
        others = {name: value for name, value in changes.items() if name not in length}
        others |= {"preset": preset, "settings": settings, "quality": quality}
        others["radiance-from"] = radiance_from
        exclude("resume", others)
        folder = RunFolder(out)
        folder.require_resumable()
        chosen = folder.settings()
    else:
        chosen = with_quality(chosen_settings(preset, settings), quality or "normal")
    chosen = with_length(chosen, changes)
    backend.activate()
    from ..training.loop import fit as run

    console = Console(highlight=False)
    with sharing_ranks() as ranks:
        progress = run(
            data,
            out,
            chosen,
            resume=resume,
            clip_negative=clip_negative,
            allow_outside=allow_outside,
            allow_doubtful=allow_doubtful,
            tensorboard=tensorboard,
            radiance_from=radiance_from,
            console=console,
            ranks=ranks,
        )
    if not ranks.leads:
        return 0
    if (progress.seconds < chosen.seconds) if chosen.seconds else (progress.step < chosen.steps):
        return signals.status()
    if not progress.step:
        say(f"nothing was learned: the fields are untrained; next: unbake evaluate {quoted(out)}")
        return 0
    skipped = f" ({progress.skipped} skipped)" if progress.skipped else ""
    done = f"{progress.step} steps{skipped}, {progress.samples / 1e6:.1f} M samples in "
    say(f"{done}{progress.seconds:.0f} s; next: unbake evaluate {quoted(out)}")
    return 1 if progress.warning else 0


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
    from ..evaluation.evaluate import evaluate as go
    from ..evaluation.renderings import told_unit
    from ..evaluation.yardsticks import told_yardsticks

    metrics = go(run, settings, allow_outside=allow_outside, tell=say)
    if not metrics["steps"]:
        say("untrained: after 0 steps the fields have their initial values")
    found = metrics.get("yardsticks")
    told = told_yardsticks(metrics["heldout"], found) if found else []
    for split in ("heldout", "train"):
        values = {k: v for k, v in metrics[split].items() if k != "views"}
        if not metrics["quantities"]:  # of known materials there are no scores
            values = {k: v for k, v in values.items() if v is not None}
        shown = _scores(values)
        say(f"{split} ({metrics[split]['views']} views): {shown}")
        if split == "heldout":
            for line in told:
                say(f"  {line}")
    if note := told_unit(metrics["display_exposure"]):
        say(f"note: {note}")
    if told and found and found["ceiling"] is None:
        folder = RunFolder(run)
        data, settings = quoted(folder.data(metrics["data"])), quoted(folder.config_file)
        say(f"for a ceiling: unbake bench ceiling {data} --settings {settings}")
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
    allow_outside: Flag = False,
) -> None:
    """Write what a run recovered for other programs: textures, glTF, OpenUSD, or for Mitsuba.

    The scene keeps its parts and their names. Each material gets textures of albedo, roughness and
    metallic, in the texture coordinates of its parts if these are unique, else unwrapped. What no
    training view saw is filled in from what was seen, and marked in a mask. PATH/export.json has
    all of it.

    Args:
        run: Folder that `unbake fit` wrote.
        out: Folder to write to, new or empty.
        format: One or more of gltf (one file, scene.glb, with parts, textures and lights), textures
            (OpenEXR and PNG), mitsuba (a scene that Mitsuba renders without unbake) and usd
            (OpenUSD; it needs pip install 'unbake[usd]').
        texels: Texels along a scene unit (default: one for each pixel of the training views on the
            surfaces, or more where what was recovered is finer). A texture has from 64 to 8192
            along an edge.
        allow_outside: Read files that the data set or its scene names outside of its folder.
    """
    backend.activate()
    from ..exports.export import export as run_export

    console = Console(highlight=False)
    options: dict[str, Any] = {"allow_outside": allow_outside, "console": console, "tell": say}
    run_export(run, out, format, texels=texels, **options)
    files = {"gltf": "scene.glb", "textures": "textures", "mitsuba": "mitsuba/scene.xml"}
    files |= {"usd": "usd/scene.usdc"}
    say(f"wrote {out}: {', '.join(files[name] for name in files if name in format)}, export.json")


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
    from ..evaluation.rendering import render as go

    places: dict[str, Any] = {"cameras": cameras, "turntable": turntable}
    made = go(run, out, settings, **places, allow_outside=allow_outside, tell=say)
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
        allow_outside: Read files that data sets, scenes and --lights name outside of their folders.
        light: How the light is put into the scene.
        render: How pictures are rendered.
    """
    settings = _render_settings(given(render), width, height)
    _exclude_views(cameras, turntable, given(render))
    chosen = chosen_light(envmap, lights, given(light))
    backend.activate()
    from ..evaluation.rendering import relight as go

    places: dict[str, Any] = {"cameras": cameras, "turntable": turntable, "truth": truth}
    made = go(run, out, chosen, settings, **places, allow_outside=allow_outside, tell=say)
    if made["mean"] is not None:
        scores = {k: v for k, v in made["mean"].items() if k != "views"}
        shown = _scores(scores)
        say(f"mean over {made['mean']['views']} views: {shown}")
    say(f"wrote {out}: {len(made['frames'])} pictures, render.json")


def _scores(values: Mapping[str, float | None]) -> str:
    """Scores by their keys in a line; all but SSIM and FLIP are in dB."""
    plain = ("render_ssim", "render_flip")
    told = {k: None if v is None else f"{v:.3f}" if k in plain else f"{v:.2f} dB"
            for k, v in values.items()}  # fmt: skip
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
    from ..viewer.view import view as run

    run(folder, port, allow_outside=allow_outside, tell=say)
    return signals.status()


def solve(
    scene: Positional[Annotated[str | None, arg(metavar="[SCENE]", help_behavior_hint="")]] = None,
    /,
    *,
    out: Out,
    from_: FromRun = None,
    envmap: File = None,
    lights: File = None,
    cameras: File = None,
    allow_outside: Flag = False,
    solve: OmitArgPrefixes[SolveFlags],
    light: OmitArgPrefixes[LightFlags],
) -> int:
    """Learn the radiance of a scene whose materials and lights are known, without tracing paths.

    This is the forward problem, Neural Radiosity: a network L is trained until both sides of the
    rendering equation agree at random points of all surfaces. LHS shows L itself, RHS one bounce
    that ends in L. relMSE is the mean of (a - b)^2 / (b^2 + 0.01) over all pixels and channels of
    the pictures, b being path traced.

    With --from RUN the materials are those that a fit recovered, and L goes on from where the fit
    left it, also under another light: `unbake relight` without paths.

    Writes L (radiance.safetensors), pictures of both sides and of the reference, and relMSE over
    time (solve.json). Ctrl-C ends it early, with what was learned. `unbake fit --radiance-from`
    starts with such an L.

    Args:
        scene: A Mitsuba 3 XML file, or a built-in scene: demo, annex, still, cornell, cube,
            furnace.
        out: Folder to write to, new or empty.
        from_: Folder that `unbake fit` wrote, instead of a scene: pictures are of its held-out
            views.
        envmap: Environment map (OpenEXR, HDR) to light the scene by, instead of its own light.
        lights: Mitsuba XML file with lights to use instead of the scene's own.
        cameras: Camera file (or transforms.json) of the pictures, instead of --views.
        allow_outside: Read files that the scene or --lights names outside of its folder.
        solve: How L is learned and measured.
        light: How the other light is put into the scene.
    """
    settings = with_options(SolveSettings(), given(solve))
    if cameras is not None:
        exclude_changed("cameras", SolveSettings, given(solve), "views")
    other = any_light(envmap, lights, given(light))
    if (scene is None) == (from_ is None):
        raise UserError("give a scene, or a run with --from, and not both", "solve")
    if from_ is not None:
        exclude_changed("from", SolveSettings, given(solve), "views", "resolution")
    backend.activate()
    from ..solver.solve import fine_tune
    from ..solver.solve import solve as run

    console = Console(highlight=False)
    options: dict[str, Any] = {"allow_outside": allow_outside, "console": console, "tell": say}
    options |= {"cameras": cameras, "light": other}
    if from_ is not None:
        made = fine_tune(from_, out, settings, **options)
    else:
        made = run(str(scene), out, settings, **options)
    last = made["measurements"][-1]
    say(f"{last['step']} steps in {last['seconds']:.0f} s; wrote {out}")
    return 0 if made["finished"] else signals.status()


def compare(
    data: Positional[Data],
    /,
    methods: Methods,
    out: Out,
    preset: Preset = None,
    settings: File = None,
    score_seconds: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None,
    evaluate_spp: int = 32,
    evaluate_truth: Flag = False,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    allow_doubtful: Flag = False,
    *,
    compare: OmitArgPrefixes[CompareFlags],
) -> int:
    """Fit several methods to the same photographs, and compare their quality over time.

    Fields, batches, seed and length are the same for all. Learning rates, estimator, warm-up and
    Adam's beta2 are each method's own, unless the settings give them. Methods with a radiance field
    also search for roughness.

    Runs go to OUT/METHOD, tables to OUT/compare.json, a page to OUT/report.html. OUT/untrained has
    the fields before the first step: a method is worth what it adds to these. Where the data set
    has true maps, the same fields are first trained on these: the ceiling of every method. The same
    command again keeps finished runs and goes on with interrupted ones. A method that fails is
    recorded with its error; the exit status is then 1. With mpiexec, processes share the methods.

    Args:
        data: Folder of the data set, with its transforms.json.
        methods: Methods of `unbake fit`, such as: ours prb direct. METHOD:REPRESENTATION, such as
            prb:bitmap, also says how materials are represented (neural, grid, ...).
        out: Folder to write to.
        preset: Settings to start from: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings, such as the config.toml of a run; instead of --preset.
        score_seconds: Training time between scores on all held-out views (default: as the file
            says, else 5; 0: no scores).
        evaluate_spp: Samples per pixel of the final renderings.
        evaluate_truth: Render captured scenes with their true materials too.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or its scene names outside of its folder.
        allow_doubtful: Begin also where poses seem to have other axes or units than the scene, or
            light seems to turn with the cameras.
        compare: Settings of all methods that differ from those of the preset or the file.
    """
    require("evaluate-spp", evaluate_spp, 1)
    chosen = with_length(chosen_settings(preset, settings), given(compare))
    if score_seconds is None:
        score_seconds = chosen.score_seconds or _SCORE_SECONDS
    try:
        chosen = dataclasses.replace(chosen, score_seconds=score_seconds)
    except UserError as error:
        raise UserError(error.what, "--score-seconds") from None
    backend.activate()
    from ..comparison.compare import compare as run
    from ..comparison.method_variant import MethodVariant

    variants = [MethodVariant.of(method) for method in methods]
    evaluation = EvaluationSettings(
        spp=evaluate_spp, clip_negative=clip_negative, truth=evaluate_truth
    )
    with sharing_ranks() as ranks:
        result = run(
            data,
            variants,
            out,
            chosen,
            evaluation=evaluation,
            clip_negative=clip_negative,
            allow_outside=allow_outside,
            allow_doubtful=allow_doubtful,
            ranks=ranks,
        )
    if not ranks.leads:
        return 0
    say(f"wrote {out / 'compare.json'} and {out / 'report.html'}")
    return 1 if any("error" in row for row in result["methods"].values()) else 0


def reproduce(
    what: Positional[Experiment],
    /,
    scale: Scale = "cpu",
    out: Out = Path("reproduction"),
    scenes: Path = Path("scenes"),
    only: Scenes = (),
    seeds: Count = None,
    plan: Flag = False,
) -> None:
    """Make a table or a figure of the paper again: data, table and picture.

    Writes OUT/WHAT/data.json, data.csv, table.md and pictures. The same command continues what was
    stopped; data sets and fits are kept in OUT/work, and experiments share them.

    table1: scenes, views, path lengths. table2: path lengths in a cube. fig3: time of a step, by
    scene. fig4: gradients of a roughness. fig5: time and memory against albedo. fig6: materials of
    eight scenes (and fig. 1). fig7, fig8: the ablation, for materials and for lighting.

    Args:
        what: Which one.
        scale: smoke (seconds, to see that it runs), cpu (sized for two cores),
            or paper (for a GPU).
        out: Folder to write to, shared by all experiments.
        scenes: Folder of the published scenes, each in a folder or as .tar.xz.
        only: Folders of scenes, such as kitchen lego, for table1, fig3 and fig6: their results are
            of these alone (by default of all).
        seeds: Number of fits of each kind in fig6, fig7 and fig8 (by default three, two in rooms of
            fig6, and one at paper scale). More seeds later keep what is there.
        plan: Only tell what is left to do, and how long it will take on this machine.
    """
    backend.activate()
    from ..experiments.experiment import ExperimentContext
    from ..experiments.experiment import reproduce as run

    if seeds is not None:
        require("seeds", seeds, 1)
    context = ExperimentContext(scale, out, scenes, seeds=seeds, only=only)
    with sharing_ranks() as ranks:
        run(experiments.load(what), context, plan=plan, ranks=ranks)


def doctor() -> int:
    """Check that unbake runs on this machine, and say what to install if it does not."""
    from .. import doctor as module

    return module.main()


#: The commands by what they are for, in the order of the help.
GROUPS: Mapping[str, Mapping[str, Callable[..., int | None]]] = {
    "Start": {
        "capture": capture,
        "import": import_,
        "data": data,
        "fit": fit,
    },
    "Results": {
        "evaluate": evaluate,
        "report": report,
        "export": export,
        "render": render,
        "relight": relight,
        "view": view,
    },
    "The forward problem": {
        "solve": solve,
    },
    "Compare and measure": {
        "compare": compare,
        **{f"bench {name}": measure for name, measure in bench.MEASUREMENTS.items()},
        "degrade": degrade,
        "reproduce": reproduce,
    },
    "Check": {
        "doctor": doctor,
    },
}
#: All commands by name, of which some have two words.
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
#: What commands that share their first word have in common.
FAMILIES: Mapping[str, str] = {"bench": bench.SUMMARY}
#: Those whose work several processes share. All others are refused to several: each process would
#: do all of the work, and write the same files.
SHARED = frozenset({"bench rates", "compare", "fit", "reproduce"})


def _of_family(family: str) -> dict[str, Callable[..., int | None]]:
    """The commands whose first word this is, by their second one."""
    start = f"{family} "
    return {n.removeprefix(start): c for n, c in COMMANDS.items() if n.startswith(start)}


def _summary(command: Callable[..., int | None]) -> str:
    """The first paragraph of the help of a command, without its full stop."""
    return " ".join((inspect.getdoc(command) or "").partition("\n\n")[0].split()).removesuffix(".")


def _listed(summaries: Mapping[str, str], width: int) -> list[str]:
    """Names with what they stand for, as wrapped lines.

    Args:
        width: of the longest name.
    """
    lines = []
    for name, text in summaries.items():
        first, further = f"  {name:{width}}  ", " " * (width + 4)
        lines += textwrap.wrap(text, columns(), initial_indent=first, subsequent_indent=further)
    return lines


def _overview() -> str:
    """The help of `unbake` alone: its commands, a line or two each."""
    width = max(len(name.split()[0]) for name in COMMANDS)
    lines = ["usage: unbake COMMAND ...", "", *textwrap.wrap(_DESCRIPTION, columns())]
    for title, group in GROUPS.items():
        summaries = {}
        for name, command in group.items():
            family = name.split()[0]
            summaries[family] = FAMILIES.get(family) or _summary(command)
        lines += ["", f"{title}:", *_listed(summaries, width)]
    more = "unbake COMMAND --help tells its options; unbake --version tells the version."
    lines += ["", *textwrap.wrap(more, columns())]
    lines += ["", "From nothing to a result:", *(f"  {command}" for command in _START)]
    return "\n".join([*lines, "", *textwrap.wrap(_STATUS, columns())])


def _overview_of(family: str) -> str:
    """The help of commands that share their first word."""
    summaries = {name: _summary(command) for name, command in _of_family(family).items()}
    lines = [f"usage: unbake {family} COMMAND ...", ""]
    lines += textwrap.wrap(f"{FAMILIES[family]}.", columns())
    lines += ["", *_listed(summaries, max(map(len, summaries))), ""]
    lines += textwrap.wrap(f"unbake {family} COMMAND --help tells its options.", columns())
    return "\n".join(lines)


def _fit_of(data: Path, *, light_known: bool) -> str:
    """The command that fits a data set."""
    unknown = "" if light_known else " --unknown materials+lighting"
    return f"unbake fit {quoted(data)}{unknown} --out RUN"
