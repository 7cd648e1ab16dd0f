"""The command line: one function a command."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import shlex
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

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
from ..ranks import Agreed, Ranks, started
from ..solver.settings import SolveSettings
from ..training.run_folder import RunFolder
from ..version import VERSION
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

#: Characters of a line that is printed: more than a path can have.
_LONGEST = 1 << 14
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
    if words in ([], ["-h"], ["--help"]):
        print(_overview(), file=sys.stdout if words else sys.stderr)
        sys.exit(0 if words else 2)
    if words == ["--version"]:
        _say(f"unbake {VERSION}")
        sys.exit(0)
    for command in COMMANDS.values():
        # Tyro 1.0 keeps the line breaks of some arguments' texts.
        command.__doc__ = re.sub(r"\n {8}(?=\S)", " ", inspect.getdoc(command) or "")
    try:
        if words[0] in COMMANDS.keys() - SHARED and not {"-h", "--help"} & {*words}:
            _require_one_process(words[0])
        with wrapped_help(words):
            status = tyro.extras.subcommand_cli_from_dict(
                dict(COMMANDS), prog="unbake", description=_DESCRIPTION
            )
    except UserError as error:
        _fail(str(error))
    except (MemoryError, RuntimeError, ImportError) as error:  # Dr.Jit raises the second
        if not lacks_memory(error):
            raise
        _fail(NO_MEMORY)
    except OSError as error:
        # A full disk, a file taken away: nothing that a traceback would explain.
        _fail(of_system(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(signals.status())
    sys.exit(status or 0)


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
    options: dict[str, Any] = {"allow_outside": allow_outside, "tell": _say}
    run(scene, out, settings, cameras=cameras, light=other, **options)
    took = f"{time.perf_counter() - start:.0f} s"
    _say(f"wrote {out} in {took}; next: unbake fit {_word(out)} --out RUN")


def import_(
    source: Positional[Source],
    /,
    out: Out,
    mesh: Meshes = (),
    images: Folder = None,
    exposures: File = None,
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
        images: Folder of the photographs, where it is not the one that the source names.
        exposures: Table (CSV) with the columns name and exposure, instead of EXIF.
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
    files: dict[str, Any] = {"images": images, "exposures": exposures, "light": known}
    try:
        import_data(source, out, mesh, chosen, **files, allow_outside=allow_outside, tell=_say)
    except ImportFaults as error:
        for fault in error.faults:
            print(f"  {printable(fault, _LONGEST)}", file=sys.stderr)
        raise UserError(f"{error.count}, listed above", source, error.remedy) from None
    took = f"{time.perf_counter() - start:.0f} s"
    _say(f"wrote {out} in {took}; next: {_fit_of(out, light_known=known is not None)}")


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
        _say("")
        console.print(Text.assemble((f"{finding.level}: ", marks[finding.level]), str(finding)))
    _say("")
    if out is not None:
        from ..report.check_page import write_check

        _say(f"wrote {write_check(result, out, clip_negative=clip_negative)}")
    kinds = {kind: result.count(kind) for kind in ("error", "warning", "hint")}
    told = ", ".join(f"{n} {kind}{'s' * (n != 1)}" for kind, n in kinds.items() if n)
    known = result.dataset is None or result.dataset.light == "known"
    ready = f"next: {_fit_of(folder, light_known=known)}"
    _say(f"{told or 'nothing is wrong'}; {ready if result.usable else 'a fit makes no sense yet'}")
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

    run(data, out, settings, allow_outside=allow_outside, tell=_say)
    _say(f"wrote {out}; next: unbake data check {_word(out)}")


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
    with _ranks() as ranks:
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
        _say(f"nothing was learned: the fields are untrained; next: unbake evaluate {_word(out)}")
        return 0
    skipped = f" ({progress.skipped} skipped)" if progress.skipped else ""
    done = f"{progress.step} steps{skipped}, {progress.samples / 1e6:.1f} M samples in "
    _say(f"{done}{progress.seconds:.0f} s; next: unbake evaluate {_word(out)}")
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
    from ..evaluation.yardsticks import told_yardsticks

    metrics = go(run, settings, allow_outside=allow_outside, tell=_say)
    if not metrics["steps"]:
        _say("untrained: after 0 steps the fields have their initial values")
    found = metrics.get("yardsticks")
    told = told_yardsticks(metrics["heldout"], found) if found else []
    for split in ("heldout", "train"):
        values = {k: v for k, v in metrics[split].items() if k != "views"}
        if not metrics["quantities"]:  # of known materials there are no scores
            values = {k: v for k, v in values.items() if v is not None}
        shown = _scores(values)
        _say(f"{split} ({metrics[split]['views']} views): {shown}")
        if split == "heldout":
            for line in told:
                _say(f"  {line}")
    if told and found and found["ceiling"] is None:
        folder = RunFolder(run)
        data, settings = _word(folder.data(metrics["data"])), _word(folder.config_file)
        _say(f"for a ceiling: unbake bench ceiling {data} --settings {settings}")
    wrote = f"wrote {RunFolder(run).evaluation}"
    _say(f"{wrote}; next: unbake report {_word(run)} --out report.html")


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
    _say(f"wrote {write_report(runs, out, **shown, allow_outside=allow_outside)}")


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
    options: dict[str, Any] = {"allow_outside": allow_outside, "console": console, "tell": _say}
    run_export(run, out, format, texels=texels, **options)
    files = {"gltf": "scene.glb", "textures": "textures", "mitsuba": "mitsuba/scene.xml"}
    files |= {"usd": "usd/scene.usdc"}
    _say(f"wrote {out}: {', '.join(files[name] for name in files if name in format)}, export.json")


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
    made = go(run, out, settings, **places, allow_outside=allow_outside, tell=_say)
    _say(f"wrote {out}: {len(made['frames'])} pictures, render.json")


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
    made = go(run, out, chosen, settings, **places, allow_outside=allow_outside, tell=_say)
    if made["mean"] is not None:
        scores = {k: v for k, v in made["mean"].items() if k != "views"}
        shown = _scores(scores)
        _say(f"mean over {made['mean']['views']} views: {shown}")
    _say(f"wrote {out}: {len(made['frames'])} pictures, render.json")


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

    run(folder, port, allow_outside=allow_outside, tell=_say)
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
    options: dict[str, Any] = {"allow_outside": allow_outside, "console": console, "tell": _say}
    options |= {"cameras": cameras, "light": other}
    if from_ is not None:
        made = fine_tune(from_, out, settings, **options)
    else:
        made = run(str(scene), out, settings, **options)
    last = made["measurements"][-1]
    _say(f"{last['step']} steps in {last['seconds']:.0f} s; wrote {out}")
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
    with _ranks() as ranks:
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
    _say(f"wrote {out / 'compare.json'} and {out / 'report.html'}")
    return 1 if any("error" in row for row in result["methods"].values()) else 0


def bench(
    what: Positional[Literal["step", "methods", "rates", "gradients", "ceiling"]] = "step",
    folder: Positional[
        Annotated[Path | None, arg(metavar="[FOLDER]", help_behavior_hint="")]
    ] = None,
    /,
    data: Folders = (),
    scene: Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="")] = None,
    methods: Annotated[tuple[str, ...], arg(metavar="METHODS")] = ("ours",),
    steps: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None,
    seconds: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None,
    seeds: Annotated[tuple[int, ...], arg(metavar="SEEDS", help_behavior_hint="")] = (),
    schedule: Flag = False,
    batches: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None,
    batch: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None,
    spp: Annotated[int | None, arg(metavar="INT", help_behavior_hint="")] = None,
    allow_outside: Flag = False,
    preset: Preset = None,
    settings: File = None,
    out: OutFile = None,
) -> None:
    """Measure the training step, its gradients, learning rates, or the ceiling of the fields.

    step takes one method apart: samples a second, and where the time goes. methods measures several
    side by side, their steps in turn.

    rates searches the learning rates of each method on each data set, and the estimator of those
    that follow paths, by fits that are scored on held-out views. The same command goes on after the
    fits that --out has. Processes that mpiexec starts share the searches.

    gradients takes a run on a data set with true materials. It measures the slope of the loss as a
    quantity goes from the fitted to the true values, and the signal to noise of one batch: of that
    slope, and of the gradients by the fields' parameters.

    ceiling takes a data set with true maps. It trains the fields of the settings on those of the
    training views, without rendering, and scores them on held-out views: no fit with these fields
    can be expected to be better. `unbake evaluate` then shows it beside a result.

    Args:
        what: What to measure.
        folder: For gradients: of a run. For ceiling: of a data set.
        data: Folder of a data set; rates takes several.
        scene: Without --data: a scene to render a small data set of (default: demo).
        methods: METHOD, METHOD:REPRESENTATION or METHOD:REPRESENTATION:ESTIMATOR, such as ours prb
            prb:bitmap prb:bitmap:all-pairs.
        steps: Steps to take the median of, after warm-up (default: 100). For rates, the length of a
            fit (default: as in the settings). For ceiling, steps on the true maps (default: as
            many as they need).
        seconds: For rates, the length of a fit in seconds of training, instead of steps.
        seeds: For rates, seeds of the fits whose scores are averaged, such as 0 1 2 (default: 0).
        schedule: For rates, also search how far all rates fall, and the warm-up of the unknowns.
        batches: For gradients, how many to measure (default: 64).
        batch: For gradients, pixels in a batch (default: as in the run).
        spp: For gradients, samples per pixel (default: as in the run).
        allow_outside: For gradients and ceiling, read files that the data set or its scene names
            outside of its folder.
        preset: Settings to measure: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings; instead of --preset.
        out: JSON file to write the numbers to.
    """
    of_gradients = {"batches": batches, "batch": batch, "spp": spp}
    others = {"data": data, "scene": scene, "methods": methods != ("ours",)}
    others |= {"seconds": seconds, "seeds": seeds, "schedule": schedule}
    if what != "rates":
        _require_one_process(f"bench {what}")
    if what == "gradients":
        others |= {"steps": steps, "preset": preset, "settings": settings}
        _refuse("gradients has no such option", others)
        _bench_gradients(folder, of_gradients, out, allow_outside)
        return
    _refuse("is an option of gradients", of_gradients, "Or: unbake bench gradients RUN")
    if what == "ceiling":
        _refuse("ceiling has no such option", others)
        _bench_ceiling(folder, chosen_settings(preset, settings), steps, out, allow_outside)
        return
    outside = {"allow-outside": allow_outside}
    _refuse("is an option of gradients and ceiling", outside, "Or: unbake bench gradients RUN")
    if folder is not None:
        raise UserError(f"{what} takes no folder", folder, "Or: unbake bench gradients RUN")
    if data:
        exclude("data", {"scene": scene})
    chosen = chosen_settings(preset, settings)
    if what == "rates":
        length = {"steps": steps, "seconds": seconds}
        chosen = with_length(chosen, {k: v for k, v in length.items() if v is not None})
        with _ranks() as ranks:
            _bench_rates(data, methods, chosen, out, seeds or (0,), schedule, ranks)
        return
    only = {"seconds": seconds, "seeds": seeds, "schedule": schedule}
    _refuse("is an option of rates", only, "Or: unbake bench rates")
    if len(data) > 1:
        raise UserError(f"{what} takes one data set", "--data", "Or: unbake bench rates")
    steps = 100 if steps is None else steps
    require("steps", steps, 10)
    backend.activate()
    from ..comparison.bench_methods import bench_methods
    from ..comparison.method_variant import MethodVariant
    from ..profiling.bench_step import bench_step, small_data

    variants = [MethodVariant.of(method) for method in methods]
    if what == "step" and len(variants) != 1:
        raise UserError("step takes one method", "--methods", "Or: unbake bench methods")
    console = Console(highlight=False)
    with small_data(next(iter(data), None), scene or "demo") as small:
        if what == "step":
            bench_step(small, variants[0].settings(chosen), steps, out, console)
        else:
            bench_methods(small, variants, chosen, steps, out, console)


def _refuse(what: str, options: dict[str, Any], remedy: str | None = None) -> None:
    """Raise UserError for the first of these options that was given."""
    for name, value in options.items():
        if value is not None and value is not False and value != ():
            raise UserError(what, f"--{name}", remedy)


def _bench_gradients(
    run: Path | None, options: dict[str, Any], out: Path | None, allow_outside: bool
) -> None:
    if run is None:
        raise UserError("gradients needs a run", remedy="unbake bench gradients RUN")
    batches = 64 if options["batches"] is None else options["batches"]
    folder = RunFolder(run)
    folder.require_fitted()
    changes = {name: options[name] for name in ("batch", "spp") if options[name] is not None}
    config = with_options(folder.settings(), changes)
    backend.activate()
    from ..profiling.bench_gradients import FEWEST, bench_gradients

    require("batches", batches, FEWEST)
    console = Console(highlight=False)
    bench_gradients(run, config, batches, out, console, allow_outside=allow_outside)


def _bench_ceiling(
    data: Path | None, chosen: FitConfig, steps: int | None, out: Path | None, allow_outside: bool
) -> None:
    if data is None:
        raise UserError("ceiling needs a data set", remedy="unbake bench ceiling DATA")
    if steps is not None:
        require("steps", steps, 10)
    backend.activate()
    from ..profiling.bench_ceiling import bench_ceiling

    bench_ceiling(data, chosen, steps, out, Console(highlight=False), allow_outside=allow_outside)


def _bench_rates(
    data: tuple[Path, ...],
    methods: tuple[str, ...],
    chosen: FitConfig,
    out: Path | None,
    seeds: tuple[int, ...],
    schedule: bool,
    ranks: Ranks,
) -> None:
    for option, value in {"data": data, "out": out}.items():
        if not value:
            remedy = "unbake bench rates --data FOLDER [FOLDER ...] --methods prb --out rates.json"
            raise UserError("is needed for rates", f"--{option}", remedy)
    if not chosen.steps and not chosen.seconds:
        raise UserError("must be 1 or more, not 0", "--steps")
    backend.activate()
    from ..comparison.bench_rates import bench_rates
    from ..comparison.method_variant import MethodVariant

    assert out is not None
    for seed in seeds:
        require("seeds", seed, 0)
    variants = [MethodVariant.of(method) for method in methods]
    console = Console(highlight=False)
    bench_rates(data, variants, chosen, out, console, seeds, schedule=schedule, ranks=ranks)
    if ranks.leads:
        _say(f"wrote {out}")


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
    with _ranks() as ranks:
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
        "bench": bench,
        "degrade": degrade,
        "reproduce": reproduce,
    },
    "Check": {
        "doctor": doctor,
    },
}
#: All commands by name.
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


#: Those whose work several processes share. All others are refused to several: each process would
#: do all of the work, and write the same files.
#: Of `bench`, it is `rates` whose work they share.
SHARED = frozenset({"bench", "compare", "fit", "reproduce"})


def _require_one_process(command: str) -> None:
    """Raise a `UserError` where several processes were started for a command that is of one."""
    several = started()
    if several < 2:
        return
    try:
        ranks = Ranks.of_environment()
    except UserError:  # they do not know of each other, and each tells it
        ranks = Ranks()
    with ranks.guarded(_say):
        what = f"{several} processes were started, and unbake {command} takes one"
        names = sorted(SHARED - {"bench"} | {"bench rates"})
        remedy = f"Run it without mpiexec; processes share {', '.join(names)}"
        raise Agreed(what, remedy=remedy)


def _overview() -> str:
    """The help of `unbake` alone: its commands, a line or two each."""
    indent = 4 + max(map(len, COMMANDS))

    def wrapped(text: str, first: str = "", further: str = "") -> list[str]:
        return textwrap.wrap(text, columns(), initial_indent=first, subsequent_indent=further)

    lines = ["usage: unbake COMMAND ...", "", *wrapped(_DESCRIPTION)]
    for title, group in GROUPS.items():
        lines += ["", f"{title}:"]
        for name, command in group.items():
            summary = (inspect.getdoc(command) or "").partition("\n\n")[0]
            text = " ".join(summary.split()).removesuffix(".")
            lines += wrapped(text, f"  {name:{indent - 2}}", " " * indent)
    more = "unbake COMMAND --help tells its options; unbake --version tells the version."
    lines += ["", *wrapped(more)]
    lines += ["", "From nothing to a result:", *(f"  {command}" for command in _START)]
    return "\n".join([*lines, "", *wrapped(_STATUS)])


def _word(path: Path) -> str:
    """A path, quoted for a shell."""
    text = str(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _fit_of(data: Path, *, light_known: bool) -> str:
    """The command that fits a data set."""
    unknown = "" if light_known else " --unknown materials+lighting"
    return f"unbake fit {_word(data)}{unknown} --out RUN"


def _say(line: str) -> None:
    """Print a line; names in it may have control characters, which a terminal would obey."""
    print(printable(line, _LONGEST), flush=True)


@contextmanager
def _ranks() -> Iterator[Ranks]:
    """The ranks that this process is one of; what fails on one of them ends all, in one line."""
    ranks = Ranks.of_environment()
    with ranks.guarded(lambda line: print(printable(line, _LONGEST), file=sys.stderr)):
        yield ranks
        ranks.leave()


def _fail(message: str) -> NoReturn:
    """Tell what is wrong, on one line whatever the width of the terminal, and exit."""
    line = Text.assemble(("error: ", "bold red"), " ".join(message.split()))
    Console(stderr=True).print(line, soft_wrap=True)
    sys.exit(2)
