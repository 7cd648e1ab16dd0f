"""Commands of data sets: `capture`, `import`, `data` and `degrade`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.text import Text
from tyro.conf import OmitArgPrefixes, Positional

from .. import backend
from ..acquisition.settings import CaptureSettings, DegradeSettings
from ..config.light import LightConfig
from ..errors import UserError, printable, quoted
from ..importing.faults import ImportFaults
from ..importing.settings import ImportSettings
from ..io import require_writable_file
from .console import LONGEST, say
from .flags import flags, given, with_options
from .options import (
    Data,
    File,
    Flag,
    Folder,
    LightFlags,
    Matrix,
    Meshes,
    Out,
    OutFile,
    Scene,
    Source,
    any_light,
    changed,
    exclude_changed,
)

if TYPE_CHECKING:
    CaptureFlags = DegradeFlags = ImportFlags = ImportLightFlags = Any
else:
    CaptureFlags = flags(CaptureSettings)
    DegradeFlags = flags(DegradeSettings)
    ImportFlags = flags(ImportSettings)
    ImportLightFlags = flags(LightConfig, without=("keep-lights",))


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
        cameras: Camera file (or transforms.json) to use instead of --views, --held-out and
            --up.
        envmap: Environment map (OpenEXR, HDR) to light the scene by, instead of its own light.
        lights: Mitsuba XML file with lights to use instead of the scene's own.
        allow_outside: Read files that the scene names outside of its folder.
        capture: How the data set is rendered.
        light: How the other light is put into the scene.
    """
    settings = with_options(CaptureSettings(), given(capture))
    if cameras is not None:
        exclude_changed("cameras", CaptureSettings, given(capture), "views", "held-out", "up")
    other = any_light(envmap, lights, given(light))
    backend.activate()
    from ..acquisition.capture import capture as run_capture

    start = time.perf_counter()
    options: dict[str, Any] = {"allow_outside": allow_outside, "tell": say}
    run_capture(scene, out, settings, cameras=cameras, light=other, **options)
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
    mesh_matrix: Matrix = (),
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
            the mesh: takes the mesh back to the frame of the cameras.
        mesh_matrix: What takes the mesh to the frame of the cameras, row by row: a file (text or
            JSON) or 16 numbers; a rotation with a scale and a translation. It comes after the other
            options that move the mesh.
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
        "mesh_matrix": mesh_matrix or None,
        "light": known,
    }
    try:
        import_data(source, out, mesh, chosen, **files, allow_outside=allow_outside, tell=say)
    except ImportFaults as error:
        for fault in error.faults:
            print(f"  {printable(fault, LONGEST)}", file=sys.stderr)
        raise UserError(f"{error.count}, listed above", source, error.remedy) from None
    took = f"{time.perf_counter() - start:.0f} s"
    say(f"wrote {out} in {took}; next: unbake data check {quoted(out)}")


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
    require_writable_file(out, "page")
    backend.activate()
    from ..checks.check import check_data
    from ..checks.told import told_rows

    options = {"allow_outside": allow_outside, "clip_negative": clip_negative}
    result = check_data(folder, **options, tell=say)
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
    ready = f"next: {_fit_of(folder)}"
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
    from ..acquisition.degrade import degrade as run_degrade

    try:
        run_degrade(data, out, settings, allow_outside=allow_outside, tell=say)
    except UserError as error:
        if "--clip-negative" not in (error.remedy or ""):
            raise
        # No camera has such pixels, and a fit of the copy would not learn of the choice.
        remedy = "Write the image again without them: a camera has none"
        raise UserError(error.what, error.where, remedy) from None
    say(f"wrote {out}; next: unbake data check {quoted(out)}")


def _fit_of(data: Path) -> str:
    """The command that fits a data set, which says itself whether its light is unknown."""
    return f"unbake fit {quoted(data)} --out RUN"
