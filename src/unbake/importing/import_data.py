"""Make a data set of the photographs, cameras and meshes of other programs."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path, PurePosixPath
from typing import Any

import mitsuba as mi
import numpy as np

from ..acquisition.new_light import put_light, tell_tilt
from ..config.light import LightConfig
from ..dataset.camera import Camera
from ..dataset.data_folder import TRANSFORMS, DataFolder
from ..dataset.mistakes import UNITS
from ..dataset.photographs import MOST_PIXELS
from ..dataset.spread import evenly
from ..dataset.views import LONGEST_NAME, Dataset
from ..errors import UserError, named, printable
from ..imaging.headers import CODED_SUFFIXES
from ..io import filled_folder, require_new_folder, require_utf8
from ..scene import free_space, relight
from ..scene.parse import parse, write
from .colmap import find_model, read_colmap
from .exposures import exposures_of, read_table
from .faults import Faults
from .frames import SPLIT_FILES, read_one_file, read_split_files
from .gltf import told_up
from .lamps import Lamp, find_lamps, with_lamps
from .lens import WIDEST
from .meshes import TO_Z_UP, Part, check_place, read_parts, write_scene
from .photographs import Pictures, check_cameras, check_pictures
from .progress import each_photograph
from .raw import for_sensor, is_raw, raw_balances
from .rooms import is_room, read_room
from .seen import on_mesh, on_mesh_if_stray, shares_seen
from .settings import ImportSettings
from .source import Reading, Shot, Source, masks_in, orientation
from .views import block_for, complete_masks, require_disk, write_view
from .world import World, read_matrix

#: Poses are the same but for this in their axes, and this part of the largest coordinate.
_SAME = 1e-6
#: A mesh that is this many times as wide as the space of the cameras may be in another unit.
_LARGER = 20
#: Photographs with which other units of the mesh are tried, and options that are told, at most.
_TRIED, _TOLD = 32, 3
#: Pixels along an edge that suit most photographs.
_SMALL = 2048
#: Pixels to train on from which on it is told that they are many: 4 GB when decoded.
_MANY = 170_000_000
#: Parts of a mesh from which on it is told that they are many.
_MANY_PARTS = 200
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
    mesh_matrix: str | Path | Sequence[float | str] | None = None,
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
        mesh_matrix: 16 numbers, row by row, or a file of them, that take the mesh to the frame of
            the cameras, after all else that moves it.
        light: the known light; None: the light is unknown, and a constant environment stands for
            it.
        allow_outside: read files that lie outside of the source.
        tell: called with what was found.

    Raises:
        UserError: the input has faults, no photograph sees the mesh, or the disk has no room. All
            faults of cameras, files and meshes are told at once, and all of pixels.
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
        masks is not None,
    )
    found = _found(source, reading, None if masks is None else Path(masks), faults)
    given = [Path(mesh) for mesh in meshes] or ([] if found.mesh is None else [found.mesh])
    if not given:
        faults.add("no mesh was given (--mesh FILE)")
    found = _balanced(found)
    parts = read_parts(given, faults, upright=settings.mesh_y_up)
    parts = _placed(parts, found.world, settings, mesh_transform, mesh_matrix, faults)
    check_place(parts, faults)
    known, told = _exposures(found.shots, exposures, faults)
    _check_light(light, allow_outside, faults)
    if light is not None and settings.lamps == "found":
        faults.add("lamps are found where the light is unknown: leave out --lamps, or the light")
    names = _names(found.shots, faults)
    check_cameras(found.shots, faults)
    splits = _splits(found.shots, settings.holdout)
    if splits and "train" not in splits.values() and not faults:
        faults.add("no photograph is left to train on: the source holds all of them out")
    _check_sizes(_pixels(found.shots, splits, settings.longest), settings.longest, faults)
    if faults:  # what is wrong with photographs is told with the rest
        check_pictures(found.shots, faults, tell)
        faults.require_none(source)
    with filled_folder(out) as folder:
        data = DataFolder(folder)
        file, scene = _write_scene(data, parts, found.shots, light, allow_outside, tell)
        # Before photographs are decoded, which may take long
        seen = _shares_seen(scene, found, parts, settings, turnable=mesh_matrix is None)
        enclosed = light is None and _enclosed(scene, found.shots)
        require_disk(folder.parent, found.shots, settings.longest)
        pictures = check_pictures(found.shots, faults, tell)
        faults.require_none(source)
        frames, blank, stray = _write_views(
            data, scene, found.shots, pictures, settings, names, splits, known, tell
        )
        background = pictures.background(settings.background, names)
        _require_counted(blank, splits)
        complete_masks(data, frames)
        data.write_transforms(
            {"scene": data.relative(file), "background": background}
            | ({"light": "unknown"} if light is None else {})
            | {"frames": frames}
        )
        lamps = _put_lamps(data, parts, settings, enclosed, tell) if light is None else []
    sizes = _sizes(found.shots, splits, settings.longest)
    moved = mesh_matrix is not None or mesh_transform is not None
    ways = told_up(given, _cameras(found.shots), upright=settings.mesh_y_up, moved=moved)
    changes = (*ways, *_straightening(found.shots), *pictures.told(), *sizes)
    found = replace(found, notes=(*found.notes, *changes))
    told_of = [told, *_background(background, pictures, names, stray)]
    for line in (
        *_summary(found, splits, seen, parts, told_of),
        *pictures.warnings(names, background, blank),
        *_told_lamps(lamps, settings.lamps),
        *([_dark(parts, found.shots)] if enclosed and not lamps else []),
    ):
        tell(line)
    return DataFolder(out)


# ------------------------------------------------------------------------------------------ reading


def _found(source: Path, reading: Reading, masks: Path | None, faults: Faults) -> Source:
    """What the source holds, with masks."""
    found = _read_source(source, reading, faults)
    reading.tell_missing(faults)
    found = masks_in(found, masks, reading, faults)
    told = [
        note for of in (_scaled, _turned, _raw_beside, _reformatted) for note in of(found.shots)
    ]
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
    parts: list[Part],
    world: World,
    settings: ImportSettings,
    transform: str | Path | None,
    matrix: str | Path | Sequence[float | str] | None,
    faults: Faults,
) -> list[Part]:
    """The parts in the frame of the cameras."""
    moves = []
    if transform is not None:
        with faults.collected(transform):
            moves.append(world.exported(Path(transform)))
    if settings.mesh_y_up:
        moves.append(TO_Z_UP)
    if settings.mesh_scale != 1:
        moves.append(np.diag([settings.mesh_scale] * 3 + [1.0]))
    if matrix is not None:
        with faults.collected():
            moves.append(read_matrix(matrix))
    for move in moves:
        parts = [part.moved(move) for part in parts]
    return parts


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


def _exposures(
    shots: Sequence[Shot], table: str | Path | None, faults: Faults
) -> tuple[dict[str, float], str]:
    """Exposures by name, of a table or as EXIF tells, and what is told of them."""
    if table is not None:
        with faults.collected():
            return read_table(Path(table), shots, faults)
    return exposures_of(shots)


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
    if len(names) == 1:
        told = "one photograph asks to turn it; it is taken as stored"
    else:
        told = f"{len(names)} photographs asks to turn them; they are taken as stored"
    return [f"the EXIF of {told}: {named(names)}"]


def _raw_beside(shots: Sequence[Shot]) -> list[str]:
    """A note of photographs whose camera RAW lies beside them, and so is not read."""
    folders = {shot.image.parent for shot in shots if not shot.raw}
    files = (file for folder in folders if folder.is_dir() for file in folder.iterdir())
    raw = {file.with_suffix("") for file in files if is_raw(file)}
    names = [shot.name for shot in shots if not shot.raw and shot.image.with_suffix("") in raw]
    if not names:
        return []
    what = f"camera RAW beside its photograph is not read ({len(names)}): {named(names)}"
    return [f"{what}; move it to a folder of its own, and name that with --images"]


def _reformatted(shots: Sequence[Shot]) -> list[str]:
    """A note of photographs that others take the place of, which differ in their suffix."""
    suffixes = {shot.name: PurePosixPath(shot.name).suffix.lower() for shot in shots}
    names = [
        shot.name
        for shot in shots
        if suffixes[shot.name] in CODED_SUFFIXES
        and suffixes[shot.name] != shot.image.suffix.lower()
        and not shot.raw
    ]
    if not names:
        return []
    return [f"photographs of another format are taken, as these do not exist: {named(names)}"]


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
        tell_tilt(light, _cameras(shots), tell)
        file = write(parsed, data.scene.resolve())
    return file, parse(file).instantiate()


def _put_lamps(
    data: DataFolder,
    parts: Sequence[Part],
    settings: ImportSettings,
    enclosed: bool,
    tell: Callable[[str], None],
) -> list[Lamp]:
    """Find lamps in a data set that is written, and let them shine in its scene.

    Args:
        data: whose scene is written again if there are any.
        parts: of its mesh.
        settings: whether they are looked for.
        enclosed: whether the mesh keeps an environment out.
        tell: called now and then.
    """
    if settings.lamps == "none" or (settings.lamps == "auto" and not enclosed):
        return []
    lamps = find_lamps(parts, Dataset.load(data.path).train, tell)
    if lamps:
        rest, shining = with_lamps(parts, lamps)
        strengths = {part.name: lamp.radiance for part, lamp in zip(shining, lamps, strict=True)}
        write_scene([*rest, *shining], data.scene, environment=not enclosed, lamps=strengths)
    return lamps


def _write_views(
    data: DataFolder,
    scene: mi.Scene,
    shots: Sequence[Shot],
    pictures: Pictures,
    settings: ImportSettings,
    names: Mapping[str, str],
    splits: Mapping[str, str],
    exposures: Mapping[str, float],
    tell: Callable[[str], None],
) -> tuple[list[dict[str, Any]], list[str], list[str]]:
    """Write photographs and masks.

    Returns:
        Their frames, names of those of which masks leave no pixel, and names of those of which
        alpha leaves in much that is no mesh.
    """
    hidden = pictures.background(settings.background, names) == "hidden"
    stray: list[str] = []

    def arguments() -> Iterator[tuple[Shot, np.ndarray | None]]:
        for shot in shots:  # what is traced is traced in this thread
            block, seen = block_for(shot, settings.longest), None
            if hidden and shot.name not in pictures.transparent:
                seen = on_mesh(scene, shot, block)
            elif settings.background == "hidden":
                seen = on_mesh_if_stray(scene, shot, block)
                stray.extend([] if seen is None else [shot.name])
            yield shot, seen

    def written(shot: Shot, seen: np.ndarray | None) -> tuple[dict[str, Any], bool]:
        name, split = names[shot.name], splits[shot.name]
        changed = shot.name in pictures.negative | pictures.profiles.keys()
        block = block_for(shot, settings.longest)
        return write_view(data, shot, name, split, exposures, seen, block, changed=changed)

    made = list(each_photograph(written, arguments(), shots, "wrote", tell))
    blank = [
        shot.name
        for shot, (_, counts) in zip(shots, made, strict=True)
        if not counts and shot.mask is not None
    ]
    return [frame for frame, _ in made], blank, stray


def _shares_seen(
    scene: mi.Scene,
    source: Source,
    parts: Sequence[Part],
    settings: ImportSettings,
    *,
    turnable: bool,
) -> np.ndarray:
    """The share of each photograph's pixels that see the mesh.

    Args:
        scene: with the mesh.
        source: of the photographs.
        parts: of the mesh.
        settings: whether it was turned.
        turnable: nothing has moved it after that, but for its scale.

    Raises:
        UserError: none does; it tells what is known of the frame of cameras, and what may help.
    """
    cameras = _cameras(source.shots)
    seen = shares_seen(scene, cameras)
    if seen.any():
        return seen
    mesh, stand = _box(_corners(parts)), _box(_origins(source.shots))
    remedy = (
        "Mesh and cameras must be in one frame and unit (--mesh-scale, --mesh-matrix move the mesh)"
    )
    if source.world.put_back:
        remedy += (
            "; --keep-applied-transform leaves nerfstudio's cameras in the frame of their file"
        )
    if turnable:
        for options, count in _seen_after(scene, cameras, parts, source.shots, settings):
            remedy += f"; {options}, {count} of {len(cameras)} photographs would see it"
    notes = "".join(f". {note}" for note in source.world.notes)
    what = f"no photograph sees the mesh, which is {mesh}; the cameras stand {stand}"
    raise UserError(what, None, remedy + notes)


def _seen_after(
    scene: mi.Scene,
    cameras: Sequence[Camera],
    parts: Sequence[Part],
    shots: Sequence[Shot],
    settings: ImportSettings,
) -> list[tuple[str, int]]:
    """Options after which photographs see the mesh, and how many: a turn, another unit, or both.

    Args:
        scene: with the mesh.
        cameras: of all photographs.
        parts: of the mesh.
        shots: the photographs.
        settings: how the mesh was moved.

    Returns:
        The likeliest first: most photographs see the mesh, and it is as large as the space of the
        cameras. Other units only where most photographs see it.
    """
    mesh, stand = (np.ptp(points, axis=0).max() for points in (_corners(parts), _origins(shots)))
    few = evenly(cameras, _TRIED)
    back = TO_Z_UP if settings.mesh_y_up else TO_Z_UP.T
    found = []
    for turn, scale in product((np.eye(4), back), (1.0, *UNITS)):
        turned = turn is back
        larger = abs(np.log10(scale * mesh / stand)) if min(mesh, stand) > 0 else 0.0
        if (scale == 1 and not turned) or (scale != 1 and larger > 1):
            continue
        count = int((shares_seen(scene, _moved(few, turn, scale)) > 0).sum())
        if count > (0 if scale == 1 else len(few) / 2):
            found.append((-count, float(larger), turn, scale))
    found.sort(key=lambda each: each[:2])
    told = []
    for _, _, turn, scale in found[:_TOLD]:
        scaled = "" if scale == 1 else f"with --mesh-scale {settings.mesh_scale * scale:g}"
        if settings.mesh_y_up != (turn is back):
            options = f"{scaled or 'with'} --mesh-y-up"
        else:
            options = " ".join(filter(None, (scaled, "without --mesh-y-up" * (turn is back))))
        count = int((shares_seen(scene, _moved(cameras, turn, scale)) > 0).sum())
        told.append((options, count))
    return told


def _moved(cameras: Sequence[Camera], turn: np.ndarray, scale: float) -> list[Camera]:
    """Cameras that see the mesh as it would be seen if it were scaled, and turned back.

    Args:
        turn: of the cameras, (4, 4).
        scale: of the mesh.
    """
    moved = []
    for camera in cameras:
        pose = turn @ camera.to_world
        pose[:3, 3] /= scale
        moved.append(replace(camera, to_world=pose))
    return moved


def _corners(parts: Sequence[Part]) -> np.ndarray:
    """The least and the largest coordinates of each part, (2 n, 3)."""
    return np.concatenate([part.corners for part in parts])


def _cameras(shots: Sequence[Shot]) -> list[Camera]:
    """As they are where lenses are straight."""
    return [shot.lens.camera(shot.to_world) for shot in shots]


def _origins(shots: Sequence[Shot]) -> np.ndarray:
    """Where cameras stand, (n, 3)."""
    return np.array([shot.to_world[:3, 3] for shot in shots])


def _box(points: np.ndarray) -> str:
    """The size and place of points (n, 3), for people."""
    low, high = points.min(0), points.max(0)
    middle = ", ".join(f"{value:.3g}" for value in 0.5 * (low + high))
    return f"{(high - low).max():.3g} units wide around ({middle})"


def _told_lamps(lamps: Sequence[Lamp], asked: str) -> list[str]:
    """What was found of lamps, for people."""
    if not lamps:
        none = "lamps: none found, no surface is surely too bright to reflect"
        return [none] if asked == "found" else []
    triangles = sum(len(lamp.faces) for lamp in lamps)
    count = "one found" if len(lamps) == 1 else f"{len(lamps)} found"
    told = f"lamps: {count}, {triangles:,} triangles that are too bright to reflect"
    clipped = sum(lamp.clipped for lamp in lamps)
    if clipped:
        told += f"; {clipped} clipped in the photographs, so that their strength is a guess"
    return [told]


def _dark(parts: Sequence[Part], shots: Sequence[Shot]) -> str:
    """A warning of cameras that all stand inside of the mesh."""
    warning = (
        "warning: all cameras stand inside the mesh, which keeps an environment out, and no "
        "surface is surely a lamp. Give the lights of the room with --lights FILE"
    )
    mesh, stand = (np.ptp(points, axis=0).max() for points in (_corners(parts), _origins(shots)))
    if not 0 < _LARGER * stand <= mesh:
        return warning
    times = f"{mesh / stand:.0f} times as wide as the space of the cameras"
    return f"{warning}. The mesh is {times}: check that both are in one unit"


def _enclosed(scene: mi.Scene, shots: Sequence[Shot]) -> bool:
    """Whether all cameras stand where the mesh is in nearly all directions."""
    return bool((free_space.enclosure(scene, _origins(shots)) >= _ENCLOSED).all())


def _check_sizes(count: int, longest: int, faults: Faults) -> None:
    """Refuse more pixels to train on than a fit can have.

    Args:
        count: of them.
        longest: as the settings have it.
        faults: to add to.
    """
    if count > MOST_PIXELS:
        what = f"the photographs to train on have {count:,} pixels, more than {MOST_PIXELS:,}"
        faults.add(what, remedy=f"Make them smaller with --longest {_shorter(longest)}")


def _shorter(longest: int) -> int:
    """What to make photographs smaller by, where so many pixels along an edge are too many."""
    return _SMALL if not longest or longest > _SMALL else max(1, longest // 2)


def _require_counted(blank: Sequence[str], splits: Mapping[str, str]) -> None:
    """Refuse photographs of which no pixel is left to train on.

    Raises:
        UserError: it tells what to correct.
    """
    if all(name in blank for name, split in splits.items() if split == "train"):
        what = "masks leave no pixel of any photograph to train on"
        raise UserError(what, None, "Masks are black where pixels do not count: correct them")


def _pixels(shots: Sequence[Shot], splits: Mapping[str, str], longest: int) -> int:
    """How many pixels a fit would decode."""
    return sum(
        shot.lens.width * shot.lens.height // block_for(shot, longest) ** 2
        for shot in shots
        if splits[shot.name] == "train"
    )


def _sizes(shots: Sequence[Shot], splits: Mapping[str, str], longest: int) -> list[str]:
    """What was made of the sizes of photographs, or could be, for people."""
    blocks = Counter(block_for(shot, longest) for shot in shots)
    told = [
        f"sizes: {block} x {block} pixels become one: {count} of {len(shots)} photographs"
        for block, count in sorted(blocks.items())
        if block > 1
    ]
    count = _pixels(shots, splits, longest)
    if count <= _MANY or 0 < longest <= _SMALL:
        return told
    return [
        *told,
        f"the photographs to train on have {count / 1e6:,.0f} million pixels, of which a fit draws "
        f"few. With --longest {_SMALL} they load faster, and take less room",
    ]


# ------------------------------------------------------------------------------------------ telling


def _summary(
    source: Source,
    splits: Mapping[str, str],
    seen: np.ndarray,
    parts: Sequence[Part],
    more_told: Sequence[str],
) -> list[str]:
    """What was found, in a few lines; `more_told` of exposures and the background."""
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
    lines = [f"{source.kind}: {', '.join([views, *more])}", *source.world.notes, *source.notes]
    lines += more_told
    lines += [f"mesh: {count}, {triangles:,} triangles; {share}"]
    if len(parts) >= _MANY_PARTS:
        lines += [
            f"each of the {len(parts)} parts has a BSDF of its own, which makes loading and steps "
            "slower: join those that are no materials of their own"
        ]
    blind = [shot.name for shot, value in zip(shots, seen, strict=True) if value == 0]
    if blind:
        count = "one photograph does" if len(blind) == 1 else f"{len(blind)} photographs do"
        lines += [f"{count} not see the mesh: {named(blind)}"]
    return lines


def _background(
    background: str, pictures: Pictures, names: Collection[str], stray: Sequence[str]
) -> list[str]:
    """What becomes of pixels beside the mesh, for people.

    Args:
        background: of the data set.
        pictures: what photographs hold.
        names: of all photographs.
        stray: photographs of which alpha leaves much in that is no mesh.
    """
    if background == "visible":
        return ["background: visible, pixels beside the mesh show the environment"]
    clear = len(pictures.transparent)
    ways = [f"by the alpha of photographs ({clear} with transparent pixels)"] if clear else []
    if clear < len(names):
        ways.append(f"where the mesh is not seen ({len(names) - clear} photographs)")
    told = [f"background: hidden, {' and '.join(ways)}"]
    if stray:
        what = "alpha leaves in much that is no mesh, which is masked as well"
        told.append(f"background: {what}: {named(stray)}")
    return told
