"""Make a data set of the photographs, cameras and meshes of other programs."""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

from ..acquisition.new_light import put_light, tell_tilt
from ..config.light import LightConfig
from ..dataset.camera import LONGEST_SIDE, Camera, frame_of, spread_rays
from ..dataset.data_folder import TRANSFORMS, DataFolder
from ..dataset.views import LONGEST_NAME, PIXEL_BYTES, counted_by, read_radiance
from ..errors import UserError, named, printable
from ..imaging.coded import decode, encode, read_codes
from ..imaging.pictures import write_exr
from ..imaging.profiles import linear_srgb, profile_name, read_profile
from ..io import filled_folder, require_new_folder, require_utf8, write_atomically
from ..memory import require_memory
from ..scene import free_space, relight
from ..scene.parse import parse, write
from .colmap import find_model, read_colmap
from .exposures import exposures_of, read_table
from .faults import Faults
from .frames import NERFSTUDIO, SPLIT_FILES, read_one_file, read_split_files
from .lens import WIDEST, Lens
from .meshes import TO_Z_UP, Part, read_parts, read_transform, write_scene
from .raw import CLIPPED as CLIPPED_RAW
from .raw import for_sensor, raw_balances, raw_told, read_raw
from .rooms import is_room, read_room
from .settings import ImportSettings
from .source import Reading, Shot, Source, image_header, masks_in, orientation, same_shape

#: Codes at and above this share of the largest one are taken for clipped: 250 of 255.
CLIPPED_CODE = 250 / 255
#: A linear value below zero by more than this is a colour that sRGB lacks, and the share of pixels
#: with one from which on it is told.
_BEYOND, _OFTEN = 0.01, 0.01
#: Rays a view, along each edge, that tell how much of a photograph sees the mesh.
_RAYS = 64
#: Poses are the same but for this in their axes, and this part of the largest coordinate.
_SAME = 1e-6
#: A mesh that is this many times as wide as the space of the cameras may be in another unit.
_LARGER = 20
#: A camera from which this share of all directions hits the mesh stands in a room.
_ENCLOSED = 0.95
_KNOWN = (
    f"It has a {TRANSFORMS} (nerfstudio), transforms_train.json (Blender), cam.txt and K_list.txt "
    "(FIPT), or cameras.bin or cameras.txt (COLMAP), maybe in sparse/0"
)


def import_data(
    source: str | Path,
    out: str | Path,
    meshes: Sequence[str | Path] = (),
    settings: ImportSettings | None = None,
    *,
    images: str | Path | None = None,
    masks: str | Path | None = None,
    exposures: str | Path | None = None,
    mesh_transform: str | Path | None = None,
    light: LightConfig | None = None,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> DataFolder:
    """Make a data set of photographs and cameras of another program and of meshes in their frame.

    World units and axes stay those of the source. Photographs stay as they are where their lens is
    a pinhole with square pixels; others are resampled to one.

    Args:
        source: a folder or file of nerfstudio, Blender-NeRF, a synthetic NeRF scene, COLMAP or
            FIPT.
        out: folder to write, new or empty; it appears only when it is complete.
        meshes: PLY, OBJ or GLB files; none are needed where the source has its own (FIPT).
        settings: None: the defaults.
        images: folder of the images, where it is not the source's own.
        masks: folder of masks, where it is not the source's own: zero where pixels do not count.
        exposures: table of `name,exposure`; None: EXIF tells.
        mesh_transform: nerfstudio's `dataparser_transforms.json`, which is taken back of the mesh.
        light: the known light; None: the light is unknown, and a constant environment stands for
            it.
        allow_outside: read files that lie outside of the source.
        tell: called with what was found.

    Raises:
        UserError: the input has faults, all of which are told, or no photograph sees the mesh.
    """
    source, out, settings = Path(source), Path(out), settings or ImportSettings()
    require_new_folder(out)
    require_utf8(source, "source")
    faults = Faults()
    reading = Reading(
        None if images is None else Path(images),
        allow_outside,
        settings.keep_applied_transform,
        settings.leave_out_missing,
    )
    found = _found(source, reading, None if masks is None else Path(masks), faults)
    given = [Path(mesh) for mesh in meshes] or ([] if found.mesh is None else [found.mesh])
    if not given:
        faults.add("no mesh was given (--mesh FILE)")
    found = _balanced(found)
    parts = _placed(read_parts(given, faults), settings, mesh_transform, faults)
    known, told = exposures_of(found.shots)
    if exposures is not None:
        with faults.collected():
            known, told = read_table(Path(exposures), found.shots, faults)
    _check_light(light, allow_outside, faults)
    names = _names(found.shots, faults)
    pictures = _check_pictures(found.shots, faults)
    splits = _splits(found.shots, settings.holdout)
    if splits and "train" not in splits.values() and not faults:
        faults.add("no photograph is left to train on: the source holds all of them out")
    faults.require_none(source)
    with filled_folder(out) as folder:
        data = DataFolder(folder)
        file, scene = _write_scene(data, parts, found.shots, light, allow_outside, tell)
        seen = _shares_seen(scene, found, parts)
        dark = light is None and _enclosed(scene, found.shots)
        background = pictures.background(settings.background, names)
        frames, blank = [], []
        for shot in found.shots:
            cut = background == "hidden" and shot.name not in pictures.transparent
            on_mesh = _on_mesh(scene, shot.lens.camera(shot.to_world)) if cut else None
            changed = pictures.negative | pictures.profiles.keys()
            same = shot.lens.straight and not shot.raw and shot.name not in changed
            name, split = names[shot.name], splits[shot.name]
            frame, counts = _write_view(data, shot, name, split, known, on_mesh, same=same)
            frames.append(frame)
            blank += [] if counts or shot.mask is None else [shot.name]
        if all(shot.name in blank for shot in found.shots if splits[shot.name] == "train"):
            what = "masks leave no pixel of any photograph to train on"
            raise UserError(what, None, "Masks are black where pixels do not count: correct them")
        _complete_masks(data, frames)
        data.write_transforms(
            {"scene": data.relative(file), "background": background}
            | ({"light": "unknown"} if light is None else {})
            | {"frames": frames}
        )
    found = replace(found, notes=(*found.notes, *_straightening(found.shots), *pictures.told()))
    for line in _summary(found, splits, seen, parts, told):
        tell(line)
    for line in pictures.warnings(names, background, blank):
        tell(line)
    if dark:
        tell(_dark(parts, found.shots))
    return DataFolder(out)


# ------------------------------------------------------------------------------------------ reading


def _found(source: Path, reading: Reading, masks: Path | None, faults: Faults) -> Source:
    """What the source holds, with masks."""
    found = _read_source(source, reading, faults)
    if reading.missing and not found.shots and not faults:
        faults.add("no photograph of the source exists", found.kind, "--images names their folder")
    found = masks_in(found, masks, reading, faults)
    told = (*_scaled(found.shots), *_turned(found.shots))
    return replace(found, notes=(*found.notes, *reading.notes(), *told))


def _read_source(source: Path, reading: Reading, faults: Faults) -> Source:
    folder = source if source.is_dir() else source.parent
    if not source.exists():
        raise UserError("the source does not exist", source, "Check the path")
    if source.suffix == ".json" and source.name not in SPLIT_FILES:
        return read_one_file(source, reading, faults)
    if any((folder / name).is_file() for name in SPLIT_FILES):
        return read_split_files(folder, reading, faults)
    if (folder / TRANSFORMS).is_file():
        return read_one_file(folder / TRANSFORMS, reading, faults)
    if is_room(folder):
        return read_room(folder, reading, faults)
    model = find_model(folder)
    if model is not None:
        return read_colmap(model, reading, faults)
    raise UserError("no cameras were found in the source", source, _KNOWN)


def _placed(
    parts: list[Part], settings: ImportSettings, transform: str | Path | None, faults: Faults
) -> list[Part]:
    """The parts in the frame of the cameras."""
    if transform is not None:
        if settings.keep_applied_transform:
            what = (
                "a mesh is taken back to the frame of COLMAP, and --keep-applied-transform leaves "
            )
            faults.add(f"{what}cameras in another", remedy="Leave one of them out")
        with faults.collected(transform):
            back = read_transform(Path(transform))
            parts = [part.moved(back) for part in parts]
    return [part.moved(TO_Z_UP) for part in parts] if settings.mesh_y_up else parts


def _balanced(source: Source) -> Source:
    """All camera RAW in the white balance of the first one: cameras choose one for each.

    Its factors are of the sensor. Those of another one are as much larger as they are for daylight.
    """
    balances, daylight = {}, {}
    for shot in source.shots:
        if shot.raw:
            with contextlib.suppress(UserError):  # that it cannot be read is told elsewhere
                balances[shot.name], daylight[shot.name] = raw_balances(shot.image)
    if not balances:
        return source
    name, first = next(iter(balances.items()))
    shots = list(source.shots)
    for number, shot in enumerate(shots):
        if shot.raw and first is not None:
            own = for_sensor(first, daylight[name], daylight.get(shot.name))
            shots[number] = replace(shot, balance=own)
    note = "white balance: cameras chose several, all photographs have that of the first"
    if first is None:
        note = "white balance: the first photograph tells none, all have that of daylight"
    notes = [note] if len(set(balances.values())) > 1 else []
    if None not in (first, daylight[name]) and len(set(daylight.values()) - {None}) > 1:
        notes.append("white balance: sensors differ, each has it in factors of its own")
    return replace(source, shots=tuple(shots), notes=(*source.notes, *notes))


def _check_light(light: LightConfig | None, allow_outside: bool, faults: Faults) -> None:
    """Read the files of a light, and add what is wrong with them to the faults."""
    if light is None:
        return
    if light.envmap is not None:
        with faults.collected():
            relight.check_environment(Path(light.envmap))
    if light.lights is not None:
        with faults.collected():
            parse(Path(light.lights), light.root(allow_outside))


def _names(shots: Sequence[Shot], faults: Faults) -> dict[str, str]:
    """Names of views by those of photographs: stems, and folders where stems are not unique."""
    stems = [PurePosixPath(shot.name).stem for shot in shots]
    names = dict(zip((shot.name for shot in shots), stems, strict=True))
    if len(set(stems)) < len(stems):
        names = {name: "_".join(_plain(PurePosixPath(name).with_suffix(""))) for name in names}
    # Results are named after views
    names = {key: _printable(name) for key, name in names.items()}
    taken: dict[str, str] = {}
    for shot in shots:
        other = taken.setdefault(names[shot.name], shot.name)
        if other != shot.name:
            faults.add(_clash(other, shot.name), shot.name, "Rename one of them")
        if len(names[shot.name].encode()) > LONGEST_NAME:
            faults.add(f"the name of the photograph has over {LONGEST_NAME} bytes", shot.name)
    files: dict[Path, str] = {}
    for shot in shots:
        other = files.setdefault(shot.image.resolve(), shot.name)
        if other != shot.name:
            faults.add(f"the photograph is the file of {other}, too", shot.name)
    for name, count in Counter(shot.name for shot in shots).items():
        if count > 1:
            faults.add("a photograph has two poses", name)
    return names


def _clash(name: str, other: str) -> str:
    """Why the views of two photographs would have one name."""
    both = [PurePosixPath(path).with_suffix("") for path in (name, other)]
    how = "but for its suffix" if both[0] == both[1] else "once folders are joined by _"
    return f"the photograph has the name of {printable(name)} {how}"


def _printable(name: str) -> str:
    return "".join(letter if letter.isprintable() else "_" for letter in name)


def _plain(path: PurePosixPath) -> list[str]:
    return [part for part in path.parts if part not in ("/", ".", "..")]


@dataclass(frozen=True)
class _Pictures:
    """What the pixels of photographs say: names of those with an alpha channel, and so on.

    Args:
        with_alpha: have an alpha channel.
        transparent: have pixels whose alpha is less than 1.
        empty: have pixels whose alpha is 0, and no mask.
        grey: have one channel of colour.
        negative: have negative radiance.
        profiles: the names of colour profiles that are not those of sRGB.
        beyond: have such a profile, and colours that sRGB lacks.
    """

    with_alpha: set[str] = field(default_factory=set)
    transparent: set[str] = field(default_factory=set)
    empty: set[str] = field(default_factory=set)
    grey: set[str] = field(default_factory=set)
    negative: set[str] = field(default_factory=set)
    profiles: dict[str, str] = field(default_factory=dict)
    beyond: set[str] = field(default_factory=set)

    def told(self) -> list[str]:
        """What was changed of the colours, for people."""
        count = Counter(self.profiles.values())
        told = [
            f"colours: photographs with the profile {name}, converted to sRGB: {n}"
            for name, n in sorted(count.items())
        ]
        if self.beyond:
            told.append(f"colours that sRGB lacks are cut off in {named(sorted(self.beyond))}")
        return told

    def add(self, shot: Shot, pixels: np.ndarray) -> None:
        """Take a photograph into account: (H, W, 4)."""
        if (pixels[..., 3] < 1).any():
            self.transparent.add(shot.name)
        if shot.mask is None and (pixels[..., 3] <= 0).any():
            self.empty.add(shot.name)
        profile = _profile(shot)
        if profile is not None:
            self.profiles[shot.name] = profile_name(profile)
            if (pixels[..., :3] < -_BEYOND).any(axis=2).mean() > _OFTEN:
                self.beyond.add(shot.name)
        elif (pixels < 0).any():
            self.negative.add(shot.name)
        channels = image_header(shot.image).channels
        if shot.name in self.transparent or channels in (2, 4):
            self.with_alpha.add(shot.name)
        if channels <= 2:
            self.grey.add(shot.name)

    def background(self, wanted: str, names: Collection[str]) -> str:
        """The background of the data set, "visible" or "hidden".

        Args:
            wanted: the same, or "auto".
            names: of all photographs.
        """
        if wanted != "auto":
            return wanted
        # Screenshots and pictures of some converters have an alpha of 1 everywhere.
        return "hidden" if self.transparent and self.with_alpha == set(names) else "visible"

    def warnings(
        self, names: Collection[str], background: str, blank: Sequence[str]
    ) -> Iterator[str]:
        """What may be fitted for something else than it is, or not at all, for people.

        Args:
            names: of all photographs.
            background: of the data set, "visible" or "hidden".
            blank: photographs of which no pixel counts.
        """
        if self.grey and len(self.grey) < len(names):
            yield (
                "warning: photographs without colours are among others, and a fit takes their grey "
                f"for the colour: {named(sorted(self.grey))}. Remove them"
            )
        if self.empty and background == "visible":
            opaque = sorted(set(names) - self.transparent)
            others = f", beside opaque ones ({named(opaque)})" if opaque else ""
            which = "the opaque ones" if opaque else "their alpha"
            yield (
                "warning: photographs have pixels of alpha 0, fitted as a black background: "
                f"{named(sorted(self.empty))}{others}. Give --background hidden or --masks FOLDER, "
                f"or remove {which}"
            )
        if blank:
            yield (
                f"warning: masks leave no pixel of {len(blank)} photographs: {named(blank)}. They "
                "are black where pixels do not count"
            )
        if self.negative:
            few = ", ".join(sorted(self.negative)[:3])
            yield f"{len(self.negative)} photographs have negative pixels, taken as zero: {few}"


def _check_pictures(shots: Sequence[Shot], faults: Faults) -> _Pictures:
    """Decode all photographs and masks once, and add those that cannot be read to the faults."""
    found = _Pictures()
    for shot in shots:
        size = shot.lens.width, shot.lens.height
        if max(size) > LONGEST_SIDE:
            faults.add(f"the image has over {LONGEST_SIDE} pixels along an edge", shot.name)
            continue
        with faults.collected(shot.name):
            found.add(shot, _pixels(shot))
        with faults.collected(shot.name):
            shot.lens.camera(shot.to_world)
        if shot.mask is None:
            continue
        with faults.collected(shot.mask):
            header = image_header(shot.mask)
            if not same_shape((header.width, header.height), size):
                raise UserError("the mask has another size than its image")
            _mask(shot)
    return found


def _pixels(shot: Shot) -> np.ndarray:
    """The photograph, (H, W, 4) float32: linear, alpha premultiplied; maybe negative."""
    need = PIXEL_BYTES * shot.lens.width * shot.lens.height
    require_memory(need, "the image needs", "Use a smaller image", shot.name)
    if shot.coded:
        codes, profile = read_codes(shot.image), _profile(shot)
        pixels = decode(codes)
        if profile is not None and codes.shape[2] >= 3:
            pixels[..., :3] = linear_srgb(codes[..., :3], profile) * pixels[..., 3:]
        return pixels
    if shot.raw:
        linear = read_raw(shot.image, shot.balance, shot.size)
        return np.concatenate([linear, np.ones_like(linear[..., :1])], 2)
    pixels = read_radiance(shot.image, shot.lens.width, shot.lens.height)
    return pixels.reshape(shot.lens.height, shot.lens.width, 4)


def _mask(shot: Shot) -> np.ndarray | None:
    """Which pixels count, (H, W) bool; None: all do."""
    mask = None if shot.mask is None else _of_size(counted_by(read_codes(shot.mask)), shot.size)
    told = raw_told(shot.image, shot.balance, shot.size) if shot.raw else _told(shot)
    if told is None or told.all():
        return mask
    return told if mask is None else mask & told


def _of_size(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask for an image that was made smaller or larger: a pixel counts if all of it does."""
    if mask.shape == size[::-1]:
        return mask
    share = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).resize(
        size, Image.Resampling.BOX
    )
    return np.equal(np.asarray(share), 255)


def _told(shot: Shot) -> np.ndarray | None:
    """As `raw_told`, of a photograph whose colours are mixed to those of sRGB; None: all pixels."""
    if _profile(shot) is None:
        return None
    codes = read_codes(shot.image)[..., :3]
    clipped = codes >= CLIPPED_CODE * np.iinfo(codes.dtype).max
    return np.logical_or(clipped.all(2), ~clipped.any(2))


def _profile(shot: Shot) -> bytes | None:
    """The colour profile of a photograph, unless it is that of sRGB."""
    return read_profile(shot.image) if shot.coded else None


def _scaled(shots: Sequence[Shot]) -> list[str]:
    """A note of cameras that were made for images of another size."""
    changed = [shot for shot in shots if shot.lens.scale != 1]
    if not changed:
        return []
    sizes = sorted(f"{shot.lens.scale:.3g}" for shot in changed)
    by = " to ".join(dict.fromkeys((sizes[0], sizes[-1])))
    count = f"{len(changed)} of {len(shots)}"
    return [f"cameras are scaled by {by}, to the size of their photographs: {count}"]


def _turned(shots: Sequence[Shot]) -> list[str]:
    """A note of photographs that programs would show turned or mirrored."""
    names = [shot.name for shot in shots if orientation(shot.image) != 1]
    if not names:
        return []
    told = "asks to turn them; they are taken as stored"
    return [f"the EXIF of {len(names)} photographs {told}: {named(names)}"]


def _straightening(shots: Sequence[Shot]) -> list[str]:
    """Notes of photographs whose lens is not taken out as a whole."""
    narrowed = [shot.name for shot in shots if shot.lens.narrowed]
    beyond = [shot.name for shot in shots if shot.lens.beyond]
    notes = []
    if narrowed:
        what = f"lenses that see more than {WIDEST} degrees: what lies beyond is cut off"
        notes.append(f"{what} ({named(narrowed)})")
    if beyond:
        where = "principal points outside of the photograph or near its edge"
        what = f"{where}: what lies beyond it is masked"
        notes.append(f"{what} ({named(beyond)})")
    return notes


def _splits(shots: Sequence[Shot], holdout: int) -> dict[str, str]:
    """Splits by name: the source's own, else every n-th photograph by name is held out.

    Those of one pose, as of a bracket, count as one.
    """
    own = {shot.name: shot.split for shot in shots if shot.split is not None}
    if own:
        return {shot.name: own.get(shot.name, "train") for shot in shots}
    posed = _of_one_pose(shots)
    held = posed[::holdout] if holdout and len(posed) > 1 else []
    if len(held) == len(posed):
        held = posed[:1]
    aside = {name for names in held for name in names}
    return {shot.name: "heldout" if shot.name in aside else "train" for shot in shots}


def _of_one_pose(shots: Sequence[Shot]) -> list[list[str]]:
    """The names of photographs that have the same pose, in the order of the first of each."""
    farthest = max((float(np.abs(shot.to_world[:3, 3]).max()) for shot in shots), default=0.0)
    tolerance = _SAME * np.array([1, 1, 1, farthest])
    poses = np.empty((len(shots), 3, 4))
    groups: list[list[str]] = []
    for shot in sorted(shots, key=lambda shot: shot.name):
        apart = np.abs(poses[: len(groups)] - shot.to_world[:3])
        same = np.flatnonzero((apart <= tolerance).all(axis=(1, 2)))
        if len(same):
            groups[same[0]].append(shot.name)
        else:
            poses[len(groups)] = shot.to_world[:3]
            groups.append([shot.name])
    return groups


# ------------------------------------------------------------------------------------------ writing


def _write_scene(
    data: DataFolder,
    parts: Sequence[Part],
    shots: Sequence[Shot],
    light: LightConfig | None,
    allow_outside: bool,
    tell: Callable[[str], None],
) -> tuple[Path, mi.Scene]:
    """Write the scene; returns its file, and what Mitsuba makes of it."""
    file = write_scene(parts, data.scene, environment=light is None)
    if light is not None:
        parsed = parse(file)
        put_light(parsed, light, allow_outside, tell)
        tell_tilt(light, [shot.lens.camera(shot.to_world) for shot in shots], tell)
        file = write(parsed, data.scene.resolve())
    return file, parse(file).instantiate()


def _shares_seen(scene: mi.Scene, source: Source, parts: Sequence[Part]) -> np.ndarray:
    """The share of each photograph's pixels that see the mesh."""
    cameras = [shot.lens.camera(shot.to_world) for shot in source.shots]
    seen = np.array([_hits(scene, *spread_rays([c], _RAYS)).mean() for c in cameras])
    if not seen.any():
        mesh, stand = _box(_corners(parts)), _box(_origins(source.shots))
        remedy = "Mesh and cameras must be in one frame and unit"
        if source.kind == NERFSTUDIO:
            remedy += (
                "; --keep-applied-transform leaves nerfstudio's cameras in the frame of their file"
            )
        what = f"no photograph sees the mesh, which is {mesh}; the cameras stand {stand}"
        raise UserError(what, None, remedy)
    return seen


def _corners(parts: Sequence[Part]) -> np.ndarray:
    """The least and the largest coordinates of each part, (2 n, 3)."""
    return np.concatenate([part.corners for part in parts])


def _origins(shots: Sequence[Shot]) -> np.ndarray:
    """Where cameras stand, (n, 3)."""
    return np.array([shot.to_world[:3, 3] for shot in shots])


def _box(points: np.ndarray) -> str:
    """The size and place of points (n, 3), for people."""
    low, high = points.min(0), points.max(0)
    middle = ", ".join(f"{value:.3g}" for value in 0.5 * (low + high))
    return f"{(high - low).max():.3g} units wide around ({middle})"


def _dark(parts: Sequence[Part], shots: Sequence[Shot]) -> str:
    """A warning of cameras that all stand inside of the mesh."""
    warning = (
        "warning: all cameras stand inside the mesh, which keeps an environment out, and lamps "
        "are not found by a fit. Give the lights of the room with --lights FILE"
    )
    mesh, stand = (np.ptp(points, axis=0).max() for points in (_corners(parts), _origins(shots)))
    if not 0 < _LARGER * stand <= mesh:
        return warning
    times = f"{mesh / stand:.0f} times as wide as the space of the cameras"
    return f"{warning}. The mesh is {times}: check that both are in one unit"


def _enclosed(scene: mi.Scene, shots: Sequence[Shot]) -> bool:
    """Whether all cameras stand where the mesh is in nearly all directions."""
    return bool((free_space.enclosure(scene, _origins(shots)) >= _ENCLOSED).all())


def _on_mesh(scene: mi.Scene, camera: Camera) -> np.ndarray:
    """Which pixels see nothing but the mesh, by their four corners: (H, W) bool."""
    x, y = np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0))
    hit = _hits(scene, *camera.rays(x.ravel(), y.ravel())).reshape(x.shape)
    return hit[:-1, :-1] & hit[:-1, 1:] & hit[1:, :-1] & hit[1:, 1:]


def _hits(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether rays (n, 3) hit something, (n,) bool."""
    return np.isfinite(free_space.trace(scene, origins, directions).distance)


def _write_view(
    data: DataFolder,
    shot: Shot,
    name: str,
    split: str,
    exposures: Mapping[str, float],
    on_mesh: np.ndarray | None,
    *,
    same: bool,
) -> tuple[dict[str, Any], bool]:
    """Write the photograph and the mask of a view; returns its frame, and whether any pixel counts.

    Args:
        data: to write to.
        shot: the view.
        name: its name in the data set.
        split: its split.
        exposures: by names of photographs.
        on_mesh: pixels that alone count, (H, W) bool, also where the source has no mask.
        same: copy the file as it is.
    """
    camera, limit, exact = shot.lens.camera(shot.to_world), _clipped(shot), None
    if same:
        image = data.image(name, shot.image.suffix.lower())
        image.parent.mkdir(exist_ok=True)
        shutil.copyfile(shot.image, image)
    else:
        image = data.image(name, ".png" if shot.coded else ".exr")
        pixels = np.maximum(_pixels(shot), 0)
        if not shot.lens.straight:
            pixels, exact = _straightened(shot.lens, pixels, camera.fl_x, limit)
        _write_picture(image, pixels)
    frame: dict[str, Any] = {
        "file_path": data.relative(image),
        "split": split,
        **frame_of(camera),
    }
    if shot.coded:
        frame["encoding"] = "srgb"
    if limit is not None:
        frame["clipped"] = limit
    if shot.name in exposures:
        frame["exposure"] = exposures[shot.name]
    mask = _mask(shot)
    if mask is not None and not shot.lens.straight:
        straight = shot.lens.straightened(mask[..., None].astype(np.float32), camera.fl_x)
        mask = straight[..., 0] >= 1
    masks = [one for one in (on_mesh, mask, exact) if one is not None]
    counted = np.all(masks, 0)
    if masks:
        file = data.mask(name)
        _write_codes(file, np.where(counted, 255, 0).astype(np.uint8)[..., None])
        frame["mask_path"] = data.relative(file)
    if on_mesh is not None:
        frame["mask_from"] = "mesh"
    return frame, bool(counted.any())


def _complete_masks(data: DataFolder, frames: Sequence[dict[str, Any]]) -> None:
    """Give all views a mask where any has one, so that none seems to be missing."""
    bare = [frame for frame in frames if "mask_path" not in frame]
    for frame in bare if len(bare) < len(frames) else ():
        file = data.mask(PurePosixPath(frame["file_path"]).stem)
        _write_codes(file, np.full((frame["h"], frame["w"], 1), 255, np.uint8))
        frame["mask_path"] = data.relative(file)


def _straightened(
    lens: Lens, pixels: np.ndarray, focal: float, limit: float | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """The photograph of the pinhole camera, and which of its pixels say what they say.

    A pixel between a clipped one and another is darker than the limit, and nobody knows how bright
    it should be: neither its value nor that it is clipped would be true. A pixel that
    looks beyond the photograph's edge says nothing.

    Args:
        limit: from which on channels are clipped; None: they never are.
    """
    straight, shown = lens.straightened(pixels, focal), lens.shown(focal)
    if limit is None:
        return straight, shown
    clipped = (pixels[..., :3] >= np.float32(limit)).astype(np.float32)
    between = (lens.straightened(clipped, focal) > 0) & (straight[..., :3] < np.float32(limit))
    exact = np.logical_not(np.any(between, axis=2))
    return straight, exact if shown is None else exact & shown


def _write_picture(file: Path, pixels: np.ndarray) -> None:
    """Write linear RGBA, premultiplied, as 16-bit codes or OpenEXR by the suffix of the file."""
    opaque = bool((pixels[..., 3] >= 1).all())
    if file.suffix == ".exr":
        write_exr(file, pixels[..., :3] if opaque else pixels)
        return
    alpha = pixels[..., 3:]
    codes = encode(pixels[..., :3] / np.where(alpha > 0, alpha, 1))
    if not opaque:
        codes = np.concatenate([codes, np.round(65535 * alpha).astype(np.uint16)], 2)
    _write_codes(file, codes)


def _write_codes(file: Path, codes: np.ndarray) -> None:
    bitmap = mi.Bitmap(np.ascontiguousarray(codes))
    write_atomically(file, lambda p: bitmap.write(str(p), mi.Bitmap.FileFormat.PNG))


def _clipped(shot: Shot) -> float | None:
    """The decoded value from which on a photograph is taken for clipped; None of radiance."""
    if shot.raw:
        return CLIPPED_RAW
    if not shot.coded:
        return None
    profile = _profile(shot)
    if profile is None:
        code = np.full((1, 1, 1), round(CLIPPED_CODE * 255), np.uint8)
        return round(float(decode(code)[0, 0, 0]), 6)
    # The least that any mixture of clipped colours can be.
    codes = np.array([round(CLIPPED_CODE * 255), 255], np.uint8)
    mixtures = np.stack(np.meshgrid(codes, codes, codes), -1).reshape(1, -1, 3)
    return round(float(linear_srgb(mixtures, profile).min()), 6)


# ------------------------------------------------------------------------------------------ telling


def _summary(
    source: Source,
    splits: Mapping[str, str],
    seen: np.ndarray,
    parts: Sequence[Part],
    exposures: str,
) -> list[str]:
    """What was found, in a few lines."""
    shots = source.shots
    sizes = sorted({(shot.lens.width, shot.lens.height) for shot in shots})
    size = " to ".join(f"{w} x {h}" for w, h in dict.fromkeys((sizes[0], sizes[-1])))
    held = sum(split == "heldout" for split in splits.values())
    bent = sum(not shot.lens.straight for shot in shots)
    masked = sum(shot.mask is not None for shot in shots)
    more = [f"{bent} undistorted"] if bent else []
    more += [f"{masked} with masks"] if masked else []
    views = f"{len(shots) - held} training and {held} held-out views of {size} pixels"
    triangles = sum(len(part.faces) for part in parts)
    count = "one part" if len(parts) == 1 else f"{len(parts)} parts"
    low, high = (f"{100 * value:.0f}" for value in (seen.min(), seen.max()))
    share = f"{100 * seen.mean():.0f} % of the pixels see it"
    share += "" if low == high else f" ({low} to {high} % by view)"
    lines = [f"{source.kind}: {', '.join([views, *more])}", *source.notes, exposures]
    lines += [f"mesh: {count}, {triangles:,} triangles; {share}"]
    blind = [shot.name for shot, value in zip(shots, seen, strict=True) if value == 0]
    if blind:
        lines += [f"{len(blind)} photographs do not see the mesh: {', '.join(blind[:3])}"]
    return lines
