"""`unbake render` and `unbake relight`: new pictures of what a run recovered.

DIR/
  render.json      how the pictures were made, their cameras, and their scores where there are any
  NAME.exr, .png   of each camera; numbered from 000 on a turntable
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..acquisition.new_light import change_light, tell_tilt
from ..backend import CUDA_VARIANT
from ..config.light import LightConfig
from ..dataset.camera import Camera
from ..dataset.camera_files import frame_name, frame_of, read_named_cameras
from ..dataset.ground_truth import GroundTruth, counted_pixels
from ..dataset.views import Dataset, View, read_photograph
from ..errors import UserError, collected, printable, raise_together, require_kind
from ..fields.domain import Domain
from ..imaging.pictures import tonemap, write_exr, write_png
from ..io import filled_folder, require_new_folder, write_json
from ..memory import require_memory
from ..scene.geometry import CHANGED, differing, probe
from ..scene.parse import parse
from ..training.recovered import Recovered, load_run, tell_changed_geometry
from ..training.run_folder import RunFolder
from ..training.validation import known_pixels
from ..version import VERSION
from . import renderings
from .evaluate import DEFINITIONS, description
from .forecast import Forecast
from .renderings import (
    METRICS,
    exposure_of,
    finite_pixels,
    mean_scores,
    photographs_of,
    render_camera,
    render_psnr,
    render_scores,
    samples_of,
    scored_views,
    told_not_finite,
    told_unit,
)
from .settings import MOST_PICTURES, RENDER_FORMAT, RenderSettings
from .turntable import turntable as make_turntable
from .yardsticks import seen_materials

#: Memory in bytes that a pixel of a picture takes, its copies included, and where it is scored.
_PIXEL_BYTES, _SCORED_BYTES = 64, 150
#: Of scenes that are not the same: how far bounding boxes differ, as a part of their extent.
_ANOTHER = 0.1
#: The score of pictures whose brightness was aligned, where the fit left that open.
_ALIGNED = "render_psnr_aligned"
_ALIGNED_DEFINITION = (
    "render_psnr after each channel of the pictures was multiplied by one number for all of them, "
    "`render_scale`, which brings them nearest to the truth in the least squares sense, of pixels "
    "that the truth does not show clipped: lighting and materials were both unknown, which may "
    "leave a common factor open"
)


@dataclass(frozen=True)
class _Shot:
    """A picture to make."""

    name: str
    camera: Camera
    split: str | None = None
    truth: View | None = None  #: a view under the same light


@dataclass(frozen=True)
class _Cameras:
    """Which cameras are asked for; None and False: not these."""

    file: Path | None
    turntable: int | None
    truth: Dataset | None = None


def render(
    run: Path | str,
    out: Path | str,
    settings: RenderSettings | None = None,
    *,
    cameras: Path | str | None = None,
    turntable: int | None = None,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Path trace new pictures of a recovered scene, with full global illumination.

    Args:
        run: folder of a fit.
        out: folder to write; it must be new or empty, and is filled only when all is complete.
        settings: how to render; without cameras they say which views of the data set.
        cameras: a camera file or a `transforms.json`.
        turntable: number of cameras on a circle around the scene.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        tell: called with lines of progress.

    Returns:
        The contents of `render.json`.

    Raises:
        UserError: the run, its data set or the cameras cannot be read, the folder is not empty,
            there is no place for a turntable, or the denoiser is not there.

    Paper: Sec. 6.
    """
    settings = _given(settings)
    _require_sound(run, Path(out), settings, cameras, turntable)
    recovered = load_run(Path(run), allow_outside=allow_outside)
    chosen = _Cameras(None if cameras is None else Path(cameras), turntable)
    return _render(recovered, Path(run), Path(out), settings, chosen, None, tell)


def relight(
    run: Path | str,
    out: Path | str,
    light: LightConfig | Path | str,
    settings: RenderSettings | None = None,
    *,
    cameras: Path | str | None = None,
    turntable: int | None = None,
    truth: Path | str | None = None,
    clip_negative: bool = False,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Path trace pictures of a recovered scene under another light.

    Args:
        run: folder of a fit.
        out: folder to write; it must be new or empty, and is filled only when all is complete.
        light: takes the place of all light of the scene, unless it says otherwise; or the file of
            an environment map that does.
        settings: how to render; without cameras they say which views of the data set.
        cameras: a camera file or a `transforms.json`.
        turntable: number of cameras on a circle around the scene.
        truth: a data set of the same scene under that light, as `capture` makes it with the same
            `light`. Its views are rendered and compared, as in an evaluation.
        clip_negative: take negative pixels of the truth as zero, also where the fit did not.
        allow_outside: read files of data sets, scenes and the light that lie outside of their
            folders.
        tell: called with lines of progress.

    Returns:
        The contents of `render.json`.

    Raises:
        UserError: as of `render`; the light cannot be used, or the truth cannot be read.

    Paper: Sec. 6.
    """
    settings, light = _given(settings), LightConfig.of(light)
    _require_sound(run, Path(out), settings, cameras, turntable, truth, light)
    true = None if truth is None else Dataset.load(Path(truth), allow_outside=allow_outside)
    change = partial(change_light, light=light, allow_outside=allow_outside, tell=tell)
    recovered = load_run(Path(run), allow_outside=allow_outside, change=change)
    recovered.clip_negative = recovered.clip_negative or clip_negative
    if true is not None:
        _require_truth_of(recovered.problem.scene_view.scene, true, light, tell)
    chosen = _Cameras(None if cameras is None else Path(cameras), turntable, true)
    return _render(recovered, Path(run), Path(out), settings, chosen, light, tell)


def _given(settings: RenderSettings | None) -> RenderSettings:
    """The settings, or the usual ones; a `UserError` where they are of another kind."""
    settings = settings or RenderSettings()
    require_kind(settings, RenderSettings, "settings", "unbake.RenderSettings(spp=256)")
    return settings


def _require_sound(
    run: Path | str,
    out: Path,
    settings: RenderSettings,
    cameras: Path | str | None,
    turntable: int | None,
    truth: Path | str | None = None,
    light: LightConfig | None = None,
) -> None:
    """Check what can be checked before anything is read; all that is wrong is told at once."""
    faults: list[UserError] = []
    with collected(faults):
        RunFolder(Path(run)).require_fitted()
    with collected(faults):
        require_new_folder(out)
    given = {"--cameras": cameras, "--turntable": turntable, "--truth": truth}
    named = [name for name, value in given.items() if value is not None]
    if len(named) > 1:
        what = f"cannot be given together with {named[1]}"
        faults.append(UserError(what, named[0], "Give one of them"))
    if turntable is not None and not 1 <= turntable <= MOST_PICTURES:
        what = f"must be from 1 to {MOST_PICTURES}, not {turntable}"
        faults.append(UserError(what, "--turntable"))
    if truth is not None and not (settings.width is None and settings.height is None):
        what = "pictures have the size of the truth"
        faults.append(UserError(what, "--truth", "Leave out their size"))
    if settings.denoise and mi.variant() != CUDA_VARIANT:
        what = f"Mitsuba's denoiser needs an NVIDIA GPU, and {mi.variant()} runs on the CPU"
        faults.append(UserError(what, "--denoise", "Leave it out, and take a larger --spp"))
    named_files = {"--cameras": cameras}
    if light is not None:
        named_files |= {"--envmap": light.envmap, "--lights": light.lights}
    for name, file in named_files.items():
        if file is not None and not Path(file).is_file():
            what = f"there is no file {printable(file)}"
            faults.append(UserError(what, name, "Check the path"))
    if truth is not None and not Path(truth).is_dir():
        what = f"there is no folder {printable(truth)}"
        faults.append(UserError(what, "--truth", "Check the path"))
    raise_together(faults, most=None)


def _require_truth_of(
    scene: mi.Scene, truth: Dataset, light: LightConfig, tell: Callable[[str], None]
) -> None:
    """Refuse a truth of another scene, and tell of one that may be of another light.

    Args:
        scene: under the light.
    """
    true = parse(truth.scene, truth.root).instantiate()
    own, other = Domain.of(scene.bbox()), Domain.of(true.bbox())
    apart = np.linalg.norm(np.subtract(own.centre, other.centre)) + abs(own.extent - other.extent)
    if apart > _ANOTHER * own.extent:
        what = f"is of another scene than the run: they span {other.told()} and {own.told()}"
        raise UserError(what, truth.folder, "Give a capture of the same scene under that light")
    elsewhere = differing(probe(scene), probe(true))
    if elsewhere > CHANGED:
        tell(
            f"warning: {100 * elsewhere:.0f} % of the rays through the scene end elsewhere than in "
            f"that of {printable(truth.folder)}: is it the same, under the same light?"
        )
    if "light" not in truth.render:  # as of version 0.1, or of photographs
        return
    named, wanted = truth.render["light"], light.named()
    if named is None:
        tell(f"warning: {printable(truth.folder)} was captured under the scene's own light")
    elif isinstance(named, dict) and named != wanted:
        others = ", ".join(f"{k} {named.get(k)}" for k in wanted if named.get(k) != wanted[k])
        tell(f"warning: {printable(truth.folder)} was captured under another light: {others}")


def _render(
    recovered: Recovered,
    run: Path,
    out: Path,
    settings: RenderSettings,
    cameras: _Cameras,
    light: LightConfig | None,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    tell_changed_geometry(RunFolder(run), recovered.dataset, tell)
    tell_tilt(light, [view.camera for view in recovered.dataset.train], tell)
    shots, placed = _shots(recovered, settings, cameras, tell)
    largest = max(shot.camera.width * shot.camera.height for shot in shots)
    if cameras.truth is None:
        require_memory(_PIXEL_BYTES * largest, "a picture needs", "Lower --width and --height")
    else:
        remedy = "Capture a smaller truth, or leave it out"
        require_memory(_SCORED_BYTES * largest, "a picture and its scores need", remedy)
    hide = recovered.problem.hide_emitters
    if cameras.truth is not None:
        hide = cameras.truth.background == "hidden"
    compared = [shot.truth for shot in shots if shot.truth is not None]
    exposure = 0.0
    if compared:
        exposure = exposure_of(photographs_of(compared, recovered.clip_negative, tell))
    shared = bool(compared) and recovered.config.shares_scale
    forecast = Forecast(sum(samples_of(shot.camera, settings) for shot in shots), tell)
    frames, masks, brightest = [], [], 0.0
    with filled_folder(out) as folder:
        for number, shot in enumerate(shots):
            done = forecast.begin(shot.name, samples_of(shot.camera, settings))
            words = (settings, hide, settings.seed + number)
            radiance = _picture(recovered, shot.camera, *words, done)
            brightest = max(brightest, float(radiance.max(initial=0, where=np.isfinite(radiance))))
            write_exr(folder / f"{shot.name}.exr", radiance)
            write_png(folder / f"{shot.name}.png", tonemap(radiance, settings.exposure))
            mask = _counted(recovered, shot, settings)
            masks.append(np.packbits(mask) if shared and mask is not None else None)
            frames.append(_frame(shot) | _scores(recovered, shot, radiance, mask, exposure))
            _tell_progress(number, len(shots), frames[-1], tell)
        keys, aligned = METRICS, {}
        if shared:
            keys, aligned = (*METRICS, _ALIGNED), _aligned(recovered, folder, shots, masks, frames)
        notes = []
        if compared and (note := told_unit(exposure)):
            notes.append(note)
        if brightest == 0:
            notes.append("all pictures are black: no light reaches what they show; a closed room "
                         "is lit by lights inside of it, as --lights puts them there")  # fmt: skip
        manifest = {
            "format": RENDER_FORMAT,
            "unbake": VERSION,
            "run": {
                "folder": os.fspath(run.resolve()),
                "data": RunFolder(run).origin().data,
                "steps": recovered.progress.step,
            }
            | description(recovered.config),
            "light": None if light is None else light.told(),
            "cameras": placed,
            "settings": asdict(settings),
            "variant": mi.variant(),
            "truth": None if cameras.truth is None else os.path.abspath(cameras.truth.folder),
            "mean": mean_scores(frames, keys) if compared else None,
            **_scored(frames if compared else (), keys),
            **aligned,
            "display_exposure": exposure if compared else None,
            "frames": frames,
            "definitions": {
                key: DEFINITIONS[key] for key in ("psnr", "colour_space", "mask")
            }
            | renderings.DEFINITIONS
            | ({_ALIGNED: _ALIGNED_DEFINITION} if aligned else {})
            | {"files": "OpenEXR: linear RGB radiance; PNG: the same times 2^exposure as sRGB"},
            "notes": notes,
        }  # fmt: skip
        write_json(folder / "render.json", manifest, allow_nan=False)
    for note in notes:
        tell(f"note: {note}")
    return manifest


def _shots(
    recovered: Recovered,
    settings: RenderSettings,
    cameras: _Cameras,
    tell: Callable[[str], None],
) -> tuple[list[_Shot], dict[str, Any]]:
    """The pictures to make, and how their cameras were chosen."""
    dataset = recovered.dataset
    first = dataset.train[0].camera
    width, height = picture_size(first, settings)
    if cameras.file is not None:
        found = read_named_cameras(cameras.file, first.width, first.height, keep_size=True)
        shots = [
            _Shot(name, camera.rescaled(*picture_size(camera, settings)), split)
            for name, split, camera in found
        ]
        return shots, {"kind": "file", "file": os.fspath(cameras.file)}
    if cameras.turntable is not None:
        scene, count = recovered.problem.scene_view.scene, cameras.turntable
        poses = recovered.cameras
        room = dataset.kind == "room"
        table = make_turntable(scene, poses, count, width, height, room)
        tell(table.told())
        shots = [_Shot(frame_name("turntable", i), c) for i, c in enumerate(table.cameras)]
        told = {"centre": table.centre.tolist(), "radius": table.radius, "up": table.up.tolist()}
        return shots, {"kind": f"turntable, {table.kind}"} | told
    source = cameras.truth or dataset
    chosen = [v for v in source.views if settings.views in ("all", v.split)]
    if not chosen:
        tell(f"no view has the split {settings.views!r}: all views are rendered")
        chosen = list(source.views)
    shots = []
    for view in chosen:
        # Those of the truth are as it tells them.
        camera = recovered.camera(view) if cameras.truth is None else view.camera
        scaled = camera.rescaled(*picture_size(camera, settings))
        truth = None if cameras.truth is None else view
        shots.append(_Shot(view.name, scaled, view.split, truth))
    return shots, {"kind": "views", "of": "truth" if cameras.truth else "data"}


def picture_size(camera: Camera, settings: RenderSettings) -> tuple[int, int]:
    """Width and height in pixels: the camera's own, or as the settings say."""
    width, height = settings.width, settings.height
    if width is None and height is None:
        return camera.width, camera.height
    if width is None:
        width = max(1, round(camera.width * (height or 1) / camera.height))
    if height is None:
        height = max(1, round(camera.height * width / camera.width))
    return width, height


def _picture(
    recovered: Recovered,
    camera: Camera,
    settings: RenderSettings,
    hide: bool,
    seed: int,
    done: Callable[[float], object],
) -> np.ndarray:
    seen = render_camera(recovered.problem.scene_view, camera, settings, hide, seed, done)
    if not settings.denoise:
        return seen
    denoiser = mi.OptixDenoiser(mi.ScalarVector2u(camera.width, camera.height))
    return np.array(denoiser(mi.TensorXf(seen)))


def _counted(recovered: Recovered, shot: _Shot, settings: RenderSettings) -> np.ndarray | None:
    """The pixels of a picture that count, (H, W) bool, as in an evaluation; None without truth."""
    if shot.truth is None:
        return None
    photograph = read_photograph(shot.truth, recovered.clip_negative)
    truth = GroundTruth.of(shot.truth, recovered.config.quantities)
    seen = None
    if recovered.config.learns_materials:
        seen = seen_materials(recovered.problem, shot.truth, settings.material_spp)
    return counted_pixels(photograph, known_pixels(seen, truth))


def _scores(
    recovered: Recovered,
    shot: _Shot,
    radiance: np.ndarray,
    mask: np.ndarray | None,
    exposure: float,
) -> dict[str, float | None]:
    """Scores of a picture against the truth; empty without truth.

    Args:
        mask: the pixels that count; None without truth.
        exposure: stops, of SSIM and FLIP.
    """
    if shot.truth is None or mask is None:
        return {}
    photograph = read_photograph(shot.truth, recovered.clip_negative)
    shown, compared = shot.truth.photographed(radiance), shot.truth.readable(photograph[..., :3])
    return render_scores(shown, compared, mask, exposure)


def _aligned(
    recovered: Recovered,
    folder: Path,
    shots: Sequence[_Shot],
    masks: Sequence[np.ndarray | None],
    frames: Sequence[dict[str, Any]],
) -> dict[str, Any]:
    """Add the score of aligned pictures to frames; returns the factor of each channel.

    The pictures are read again, so that not all of them have to be held at once.

    Args:
        folder: with the pictures.
        masks: the pixels of each that count, as bits.
    """

    def pictures(shot: _Shot, view: View) -> tuple[np.ndarray, np.ndarray]:
        bitmap = mi.Bitmap(str(folder / f"{shot.name}.exr"))
        radiance = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
        photograph = read_photograph(view, recovered.clip_negative)[..., :3]
        return np.array(radiance), view.readable(photograph)

    every = list(zip(shots, masks, frames, strict=True))
    above, below = np.zeros(3), np.zeros(3)
    for shot, bits, frame in every:
        frame[_ALIGNED] = None
        if shot.truth is not None and bits is not None:
            radiance, true = pictures(shot, shot.truth)
            shown, mask = radiance * np.float32(shot.truth.exposure), _unpacked(bits, radiance)
            mask &= finite_pixels(radiance)
            told = mask[..., None] & (true < min(1.0, shot.truth.clipped or 1.0))
            above += np.where(told, shown * true, 0).sum((0, 1), dtype=np.float64)
            below += np.where(told, shown * shown, 0).sum((0, 1), dtype=np.float64)
    scale = np.where((above > 0) & (below > 0), above / np.where(below > 0, below, 1), 1)
    for shot, bits, frame in every:
        if shot.truth is not None and bits is not None and bits.any():
            radiance, true = pictures(shot, shot.truth)
            shown = shot.truth.photographed(radiance * scale.astype(radiance.dtype))
            frame[_ALIGNED] = render_psnr(shown, true, _unpacked(bits, radiance))
    return {"render_scale": scale.tolist()}


def _unpacked(bits: np.ndarray, picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return np.unpackbits(bits, count=height * width).astype(bool).reshape(height, width)


def _frame(shot: _Shot) -> dict[str, Any]:
    """A picture in `render.json`, which is read as a camera file, too."""
    split = {} if shot.split is None else {"split": shot.split}
    return {"name": shot.name, "file_path": f"{shot.name}.exr", **frame_of(shot.camera), **split}


def _scored(frames: Sequence[dict[str, Any]], keys: Sequence[str]) -> dict[str, Any]:
    """Of how many pictures means are; empty where they are of all."""
    found = scored_views(frames, keys)
    return {"scored": found} if found else {}


def _tell_progress(
    number: int, count: int, frame: dict[str, Any], tell: Callable[[str], None]
) -> None:
    """Tell scores of each picture, else progress at every quarter."""
    if METRICS[0] in frame:
        value = frame[METRICS[0]]
        told = "—" if value is None else f"render {value:.1f} dB"
        tell(f"{frame['name']}: {', '.join(filter(None, [told, told_not_finite(frame)]))}")
    elif (number + 1) * 4 // count > number * 4 // count:
        tell(f"rendered {number + 1} of {count} pictures")
