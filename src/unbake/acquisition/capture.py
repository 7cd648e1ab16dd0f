"""Render a multi-view data set, with its ground truth, from any Mitsuba scene (Sec. 6)."""

from __future__ import annotations

import math
import os
import re
import secrets
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config.light import LightConfig, direction
from ..dataset.camera import Camera
from ..dataset.camera_files import named_by_split, read_cameras
from ..dataset.data_folder import DataFolder
from ..dataset.lighting import write_true_lighting
from ..dataset.pixels import CameraRays
from ..dataset.views import Dataset, View
from ..errors import UserError, printable, raise_together, require_kind
from ..fields.arrays import from_numpy
from ..imaging.pictures import write_exr
from ..io import is_locked, locked, removed_with_parents, require_file, require_utf8
from ..quantities import QUANTITIES
from ..scene import edit, free_space
from ..scene.checked import checked_scene
from ..scene.parse import ParsedScene, parse, write
from ..signals import cleaned_up
from ..transport.light_by_depth import light_by_depth
from ..transport.render import parts_of, path_integrator, render_materials
from ..transport.vertex import SceneView, has_area_emitters, rays_behind_area_emitters
from .built_in import SCENES, default_cameras, write_scene
from .coverage import BLACK, BLACK_BACKS, TURN_THEM, black_share, coverage, is_room
from .new_light import change_light, tell_tilt
from .placement import place
from .settings import LIGHT_PIXELS, LIGHT_SAMPLES, CaptureSettings

#: Samples a pixel of the truth images, which are noisy at edges only.
TRUTH_SAMPLES = 16
#: From so much noise on, in parts of a pixel's light, more samples are recommended.
_NOISY = 0.5

_KIND = "data folder"
#: How the names of unfinished captures end.
_PARTIAL = ".partial"


def capture(
    scene: str | Path,
    out: Path | str,
    settings: CaptureSettings,
    *,
    cameras: Path | str | None = None,
    light: LightConfig | Path | str | None = None,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> Dataset:
    """Render a scene from many cameras, with its true materials and lighting.

    Args:
        scene: a Mitsuba XML file, or the name of a built-in scene.
        out: folder to write; it must not exist yet, and appears only when it is complete.
        cameras: a camera file; None: the built-in scene's own cameras, or automatic placement.
        light: takes the place of the scene's own light; or the file of an environment map that
            does.
        allow_outside: read files that the scene names and that lie outside of its folder.
        tell: called with lines of progress.

    Raises:
        UserError: scene or cameras cannot be used, values of the scene make no sense, all
            photographs are black, or `out` exists.

    Paper: Sec. 6.
    """
    require_kind(settings, CaptureSettings, "settings", "unbake.CaptureSettings()")
    light = None if light is None else LightConfig.of(light)
    out, cameras = Path(out), None if cameras is None else Path(cameras)
    require_scene(str(scene))
    require_utf8(out, _KIND)
    if os.path.lexists(out):
        raise UserError("exists already", where=out, remedy="Give another --out, or remove it")
    # Nobody else has a folder of this name: what is removed in the end is our own.
    partial = out.with_name(f"{_partial_name(out)}{secrets.token_hex(8)}{_PARTIAL}")
    with cleaned_up(removed_with_parents(partial)):
        try:
            _tell_unfinished(out, tell)
            partial.mkdir(parents=True)
            with locked(partial):
                dataset = _capture(
                    str(scene), DataFolder(partial), settings, cameras, light, allow_outside, tell
                )
                dataset.save(partial)
                partial.rename(out)
        except OSError as error:
            raise UserError(f"cannot be written ({error.strerror})", where=out) from None
    return Dataset.load(out)


def require_scene(name: str) -> None:
    """Refuse a misspelt scene before anything is written.

    Raises:
        UserError: it is neither a file nor a built-in scene.
    """
    if name in SCENES:
        return
    path = Path(name)
    require_utf8(path, "scene")
    if path.suffix != ".xml" and not path.exists():
        known = ", ".join(SCENES)
        raise UserError(f"no such scene: {name!r}", None, f"Give an XML file or one of {known}")
    if not path.exists():
        raise UserError("no such scene file", where=path)
    require_file(path, "scene file")


def _partial_name(out: Path) -> str:
    """How the names of unfinished captures to a folder begin."""
    return f".{out.name[:100]}."


def _tell_unfinished(out: Path, tell: Callable[[str], None]) -> None:
    """Tell of captures to this folder that were killed; they are left for the user to remove.

    Raises:
        UserError: one is at work: all that the second one of the two renders would be lost.
    """
    pattern = re.compile(re.escape(_partial_name(out)) + r"[0-9a-f]{16}" + re.escape(_PARTIAL))
    for folder in out.parent.iterdir() if out.parent.is_dir() else ():
        if not pattern.fullmatch(folder.name):
            continue
        if is_locked(folder):
            remedy = f"Wait for its end, give another --out, or remove {folder} if none is"
            raise UserError("another capture to this folder is at work", out, remedy)
        tell(f"an earlier capture did not finish and has left {printable(folder, 1000)}")


def _capture(
    name: str,
    data: DataFolder,
    settings: CaptureSettings,
    camera_file: Path | None,
    light: LightConfig | None,
    allow_outside: bool,
    tell: Callable[[str], None],
) -> Dataset:
    written = data.scene.with_name("made")
    file = write_scene(name, written) if name in SCENES else Path(name)
    source = _Source(file, light, allow_outside)
    path, apart = _copy_scene(source, data.scene, tell)
    posed, seen, visible = _choose_views(name, apart, settings, camera_file, tell)
    tell_tilt(light, [c for split, c in posed if split == "train"], tell)
    del apart  # while two scenes live, kernels have the shapes of both
    scene = source.instance()
    shutil.rmtree(written, ignore_errors=True)
    rays = CameraRays.of([c for _, c in posed])
    # Stratified samples have a third less variance than independent ones at the same cost.
    spp = samples_of_grid(settings.spp)
    if spp != settings.spp:
        tell(f"{spp} samples per pixel instead of {settings.spp}: they fill a grid")
    sampler = mi.load_dict({"type": "multijitter", "sample_count": spp})
    rgb, alpha, noise = photographs(scene, rays, settings, sampler, visible, tell)
    if not rgb.any():
        what = "all photographs are black: no light reaches what the cameras see"
        remedy = "Check where its lights are, and where they shine"
        if not visible:
            remedy += "; photographs with a hidden background do not show lamps themselves"
        raise UserError(what, source.file, remedy)
    _tell_noise(noise, spp, tell)
    truth, mask = _truth(path, scene, rays)
    write_true_lighting(path, data.path)
    shares = light_of_views(scene, [c for split, c in posed if split == "train"], settings, visible)
    views, first = [], 0
    for view_name, split, camera in named_by_split(posed):
        shape = (camera.height, camera.width)
        part = slice(first, first + camera.width * camera.height)
        first = part.stop
        view = View(
            name=view_name,
            split=split,
            camera=camera,
            image=data.image(view_name),
            truth={name: data.truth(name, view_name) for name in truth},
        )
        write_exr(view.image, _rgba(rgb[part], alpha[part], shape))
        for name, file in view.truth.items():
            write_exr(file, _rgba(truth[name][part], mask[part], shape))
        views.append(view)
    return Dataset(
        folder=data.path,
        scene=path,
        background="visible" if visible else "hidden",
        views=tuple(views),
        render={
            "integrator": path_integrator(scene),
            "max_depth": settings.max_depth,
            "rr_depth": settings.rr_depth,
            "spp": spp,
            "seed": settings.seed,
            "variant": mi.variant(),
            "mitsuba": mi.__version__,
            "light": None if light is None else light.named(),
        },
        coverage=round(float(seen), 4),
        light_by_depth=shares,
    )


def _choose_views(
    name: str,
    scene: mi.Scene,
    settings: CaptureSettings,
    camera_file: Path | None,
    tell: Callable[[str], None],
) -> tuple[list[tuple[str, Camera]], float, bool]:
    """The cameras and their splits, and what is told of them.

    Returns:
        Cameras; the share of the surface that training views see; whether they show emitters.
    """
    if camera_file is None:
        posed = posed_cameras(name, scene, settings)
        asked = settings.up == "auto" and name not in SCENES
        if asked and (axis := free_space.up_of_ground(scene)):
            tell(
                "cameras are placed with +y up, as no sensor of the scene tells: all stands on a "
                f"ground with {axis} up, which --up {axis} sets"
            )
    elif settings.up != "auto":
        raise UserError("cannot be given with a camera file", "up", "Leave one of both out")
    else:
        posed = _read_square(camera_file, settings.resolution, tell)
    if not any(split == "train" for split, _ in posed):
        remedy = "Ask for at least one with --views"
        raise UserError("no training view", where=camera_file, remedy=remedy)
    counts = {split: sum(s == split for s, _ in posed) for split in ("train", "heldout")}
    trained = [c for split, c in posed if split == "train"]
    seen = coverage(scene, trained, own=camera_file is None)
    tell(
        f"{counts['train']} training and {counts['heldout']} held-out views; the training views "
        f"see {100 * seen:.0f} % of the surface"
    )
    black = black_share(scene, [camera for _, camera in posed])
    if black > BLACK:
        tell(f"warning: {100 * black:.0f} % {BLACK_BACKS}. {TURN_THEM}")
    # Cameras of a file may stand elsewhere than the scene's own sensors.
    if settings.background == "auto":
        visible = is_room(scene, () if camera_file is None else [c for _, c in posed])
    else:
        visible = settings.background == "visible"
    return posed, seen, visible


def samples_of_grid(count: int) -> int:
    """The samples of the grid, nearly a square, that has so many or a few more.

    Mitsuba's stratified sampler rounds to it with a warning of its own.
    """
    rows = math.isqrt(count)
    return rows * -(-count // rows)


@dataclass(frozen=True)
class _Source:
    """The scene to be captured, read anew for each use; errors name the user's file."""

    file: Path
    light: LightConfig | None
    allow_outside: bool

    def parsed(self, tell: Callable[[str], None]) -> ParsedScene:
        """The scene under the light of the photographs."""
        root = Path(self.file.resolve().anchor) if self.allow_outside else None
        parsed = parse(self.file, root)
        if self.light is not None:
            change_light(parsed, self.light, self.allow_outside, tell)
        return parsed

    def instance(self) -> mi.Scene:
        """The same with opaque BSDFs turned into `principled`."""
        parsed = self.parsed(lambda line: None)
        edit.to_principled(parsed)
        return parsed.instantiate()


def _copy_scene(
    source: _Source, folder: Path, tell: Callable[[str], None]
) -> tuple[Path, mi.Scene]:
    """Write the scene and its files into the folder, opaque BSDFs turned into `principled`.

    Returns:
        The file that was written, and the scene with its meshes apart.
    """
    folder.mkdir(parents=True)
    parsed = source.parsed(tell)
    if parsed.media:
        tell(f"participating media are left out: {parsed.media}")
    scene, faults = checked_scene(source.parsed(lambda line: None), lit=True)
    raise_together(faults)
    assert scene is not None
    lost = edit.lost_properties(parsed)
    changed = edit.to_principled(parsed)
    if changed:
        tell(f"{changed} BSDF{'s' * (changed != 1)} made principled")
    if lost is not None:
        tell(f"left out, as principled has no such property: {lost}")
    return write(parsed, folder), scene


def _read_square(file: Path, size: int, tell: Callable[[str], None]) -> list[tuple[str, Camera]]:
    """The cameras of a camera file and their splits, with pictures of `size` x `size` pixels."""
    own = read_cameras(file, size, size, keep_size=True)
    if oblong := sum(camera.width != camera.height for _, camera in own):
        tell(
            f"photographs are square, and {oblong} cameras of {printable(file)} are not: their "
            "horizontal fields of view stay"
        )
    return [(split, camera.rescaled(size, size)) for split, camera in own]


def posed_cameras(
    name: str, scene: mi.Scene, settings: CaptureSettings
) -> list[tuple[str, Camera]]:
    """A built-in scene's own cameras, or such as are placed automatically, and their splits.

    Args:
        name: of the scene, a file or a built-in one.
        scene: the same. Shapes tell its ground from what stands on it: merged meshes may hide it.
        settings: how many, and the size of their images.

    Raises:
        UserError: there is no place for cameras, or the scene's own need no axis that is up.
    """
    size = settings.resolution
    if name in SCENES:
        if settings.up != "auto":
            what = "cannot be given with a built-in scene, which has cameras of its own"
            raise UserError(what, "--up", "Leave it out")
        return [
            (c["split"], Camera.look_at(c["origin"], c["target"], c["up"], c["fov"], size, size))
            for c in default_cameras(name, settings.views, settings.held_out)
        ]
    up = None if settings.up == "auto" else np.array(direction(settings.up))
    placed = place(scene, settings.views, settings.held_out, seed=settings.seed, up=up)
    return [(split, look.camera(size, size)) for split, look in placed]


def photographs(
    scene: mi.Scene,
    rays: CameraRays,
    settings: CaptureSettings,
    sampler: mi.Sampler,
    visible: bool,
    tell: Callable[[str], None],
) -> tuple[np.ndarray, np.ndarray, float]:
    """Path trace all pixels of all views with Mitsuba.

    Args:
        scene: the scene.
        rays: of the views.
        settings: lengths of paths, and the seed.
        sampler: with the number of samples a pixel.
        visible: whether emitters are seen.
        tell: called with lines of progress.

    Returns:
        Linear RGB (pixels, 3) and alpha (pixels,), float32; and the noise of a pixel: the standard
        error of its luminance in parts of that, median of the pixels with light. It is NaN where
        there is none, and where a pixel has one sample. Stratified samples have somewhat less.

    Raises:
        UserError: pixels are not finite.
    """
    integrator = mi.load_dict(
        {
            "type": path_integrator(scene),
            "max_depth": settings.max_depth,
            "rr_depth": settings.rr_depth,
            "hide_emitters": not visible,
        }
    )
    hidden_lamps = not visible and has_area_emitters(scene)
    spp = sampler.sample_count()
    sampler.set_samples_per_wavefront(spp)
    rgb = np.zeros((rays.pixels, 3), np.float32)
    alpha = np.zeros(rays.pixels, np.float32)
    noise = np.full(rays.pixels, np.nan, np.float32)
    told = 0.0
    for part, ray, seed in parts_of(rays.through, rays.pixels, spp, settings.seed):
        sampler.seed(dr.opaque(mi.UInt32, seed), dr.width(ray))
        if hidden_lamps:
            ray = rays_behind_area_emitters(scene, ray)
        radiance, valid, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
        light = mi.luminance(radiance)
        channels = [*radiance, dr.select(valid, mi.Float(1), 0), light, light**2]
        dr.eval(channels)
        means = [np.array(dr.block_sum(c, spp)) / spp for c in channels]
        rgb[part], alpha[part] = np.stack(means[:3], -1), means[3]
        noise[part] = _relative_error(means[4], means[5], spp)
        if part.stop / rays.pixels - told >= 0.25 or part.stop == rays.pixels:
            told = part.stop / rays.pixels
            tell(f"rendered {100 * told:.0f} % of the pixels")
    if not np.isfinite(rgb).all():
        count = int((~np.isfinite(rgb).all(1)).sum())
        raise UserError(f"{count} rendered pixels are not finite", None, "Check the scene's values")
    lit = noise[np.isfinite(noise)]
    return rgb, np.minimum(alpha, 1), float(np.median(lit)) if lit.size else math.nan


def _relative_error(light: np.ndarray, squares: np.ndarray, spp: int) -> np.ndarray:
    """The standard error of means of `spp` values, in parts of the mean; NaN where that is 0."""
    if spp == 1:
        return np.full_like(light, np.nan)
    variance = np.maximum(squares - light**2, 0) / (spp - 1)
    return np.divide(np.sqrt(variance), light, out=np.full_like(light, np.nan), where=light > 0)


def _tell_noise(noise: float, spp: int, tell: Callable[[str], None]) -> None:
    """Say how noisy photographs are, and warn if no fit can see roughness in them."""
    if math.isnan(noise):
        return
    what = f"the noise of a pixel is {100 * noise:.0f} % of its light (median)"
    if noise > _NOISY:
        more = spp * (noise / _NOISY) ** 2
        digits = 10 ** max(math.floor(math.log10(more)) - 1, 0)
        samples = math.ceil(more / digits) * digits
        what = f"warning: {what}. --spp {samples} would bring it to {100 * _NOISY:.0f} %"
    tell(what)


def light_of_views(
    scene: mi.Scene, cameras: list[Camera], settings: CaptureSettings, visible: bool
) -> tuple[float, ...]:
    """The shares of the light that paths of depth 1, 2, … carry to views; see `light_by_depth`.

    Args:
        scene: with its true materials.
        cameras: of the views.
        settings: of the paths that carry all light.
        visible: whether emitters are seen.

    Returns:
        Shares to four digits, up to the depth that carries all; none where there is no light.
    """
    rays = CameraRays.of(cameras)
    count = min(rays.pixels, LIGHT_PIXELS)
    chosen = np.random.default_rng(settings.seed).integers(rays.pixels, size=count)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(settings.seed, count * LIGHT_SAMPLES)
    pixel = from_numpy(mi.UInt32, np.repeat(chosen, LIGHT_SAMPLES))
    ray = rays.through(pixel, sampler.next_2d())
    shares = light_by_depth(
        scene,
        ray,
        settings.seed + 1,
        max_depth=settings.max_depth,
        rr_depth=settings.rr_depth,
        hide_emitters=not visible,
        groups=LIGHT_SAMPLES,
    ).round(4)
    return tuple(shares[: np.searchsorted(shares, 1.0) + 1].tolist()) if shares[-1] > 0 else ()


def _truth(
    path: Path, scene: mi.Scene, rays: CameraRays
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Pictures of all quantities, each (pixels, 3), and the mask of all pixels."""
    specular = 32  # for cut-outs (null interactions): pixels behind mirrors are masked out
    pictures, mask = {}, np.zeros(0)
    for name, quantity in QUANTITIES.items():
        parsed, shown = parse(path), scene
        blended = edit.fill_blends(parsed)
        if name != "albedo":
            edit.show_as_albedo(parsed, quantity.slot, quantity.default)
        if blended or name != "albedo":
            shown = parsed.instantiate()
        values, mask = render_materials(
            SceneView.of(shown, None, specular), rays.through, rays.pixels, TRUTH_SAMPLES, seed=1
        )
        pictures[name] = values["albedo"]
    return pictures, mask


def _rgba(rgb: np.ndarray, alpha: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return np.concatenate([rgb, alpha[:, None]], 1).reshape(*shape, 4)
