"""Cameras in JSON: the layouts of nerfstudio, of Blender-NeRF and of the synthetic NeRF scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..dataset.camera import Camera
from ..dataset.camera_files import camera_from_frame, with_top
from ..errors import UserError, named, printable
from ..imaging.headers import CODED_SUFFIXES
from ..io import array, number, read_object, require_file, text
from .faults import Faults
from .lens import Lens, fisheye, opencv
from .nerfstudio import world_of
from .source import Reading, Shot, Source, ends_of, find_image, image_header, suited

#: What the layout with one file is called, for people.
NERFSTUDIO = "nerfstudio"
#: The files of a folder with one file a split, and our names of the splits.
SPLIT_FILES = {
    "transforms_train.json": "train",
    "transforms_test.json": "heldout",
    "transforms_val.json": "heldout",
}
#: Lists of file names at the top of a nerfstudio file, by what they become.
_SPLIT_LISTS = {"train_filenames": "train", "val_filenames": "heldout", "test_filenames": "heldout"}
#: What frames call their split, by what it becomes.
_SPLITS = {
    "train": "train",
    "heldout": "heldout",
    "test": "heldout",
    "val": "heldout",
    "validation": "heldout",
    "eval": "heldout",
}
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE")
_LENSES = ("OPENCV", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = "OPENCV_FISHEYE"
#: The difference of two focal lengths of one camera, relative, that is more than rounding.
_CONTRADICTS = 0.01
#: A pose whose axes are so much longer or shorter than 1 has a scale; shorter ones are no pose.
_ROUNDING, _LEAST_SCALE = 1e-3, 1e-6
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_LENGTHS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
#: The list of held-out frames beside `frames`, as ScanNet++ has it.
_TEST_FRAMES = "test_frames"


def read_one_file(file: Path, reading: Reading, faults: Faults) -> Source:
    """A folder with one `transforms.json`, as nerfstudio, instant-ngp and others write it.

    Args:
        file: the JSON file.
        reading: where images are, and whether `applied_transform` is taken back.
        faults: all that is wrong is added to it.
    """
    top = None
    with faults.collected():
        top = read_object(file)
    if top is None:
        return Source(NERFSTUDIO, ())
    if "scene" in top:
        faults.add(f"the folder is a data set already: {file.name} names a 'scene'")
        return Source("data set", ())
    splits = _listed_splits(top, file, faults)
    shots = _read_frames(file, top, reading, None, faults)
    if top.get(_TEST_FRAMES):
        shots += _read_frames(file, top, reading, "heldout", faults, _TEST_FRAMES)
    poses = {shot.name: shot.to_world for shot in shots}
    world = world_of(top, file, poses, reading.keep_applied_transform, faults)
    placed = [
        Shot(
            shot.name,
            _listed(shot.name, splits) or shot.split,
            shot.image,
            shot.lens,
            world.camera(shot.to_world),
            shot.mask,
        )
        for shot in shots
    ]
    kept, left_out = _of_lists(placed, splits)
    told = (*_unknown_names(top, splits), *left_out)
    return Source(NERFSTUDIO, kept, told, world=world)


def _of_lists(
    shots: Sequence[Shot], splits: Mapping[PurePosixPath, str]
) -> tuple[tuple[Shot, ...], tuple[str, ...]]:
    """The frames that a list of splits names, and a note of the others.

    Where there is a list of those to train on, nerfstudio leaves the others out; all are kept where
    it names no frame.
    """
    if "train" not in splits.values() or all(shot.split is None for shot in shots):
        return tuple(shots), ()
    others = [shot.name for shot in shots if shot.split is None]
    if not others:
        return tuple(shots), ()
    note = f"frames in no list of splits are left out: {named(others)}"
    return tuple(shot for shot in shots if shot.split is not None), (note,)


def _unknown_names(top: dict[str, Any], splits: Mapping[PurePosixPath, str]) -> tuple[str, ...]:
    """A note of the images that lists of splits name, and no frame."""
    frames = top.get("frames")
    frames = frames if isinstance(frames, list) else []
    given = [frame.get("file_path") for frame in frames if isinstance(frame, dict)]
    ends = {PurePosixPath(_slashed(name)).name for name in given if isinstance(name, str)}
    ends |= {PurePosixPath(end).stem for end in ends}
    unknown = [str(name) for name in splits if name.name not in ends and name.stem not in ends]
    if not unknown:
        return ()
    return (f"lists of splits name images that no frame has: {named(unknown)}",)


def read_split_files(folder: Path, reading: Reading, faults: Faults) -> Source:
    """A folder with `transforms_train.json` and its like; arguments as in `read_one_file`.

    The views of `transforms_test.json` are held out; those of `transforms_val.json` where there is
    no other file, and are left out where there is. A file of cameras without pictures, as
    Blender-NeRF writes it for tests, is left out, too. Where one file is left, none says what is
    held out.
    """
    found = {name: folder / name for name in SPLIT_FILES if (folder / name).is_file()}
    notes = []
    for name in [name for name, split in SPLIT_FILES.items() if split == "heldout"]:
        if name in found and _without_pictures(found[name], reading):
            del found[name]
            notes.append(f"{name} is left out: its cameras have no pictures")
    if {"transforms_test.json", "transforms_val.json"} <= found.keys():
        del found["transforms_val.json"]
        notes.append("transforms_val.json is left out: transforms_test.json has held-out views")
    shots, alone = [], len(found) == 1
    for name, file in found.items():
        split = None if alone else SPLIT_FILES[name]
        with faults.collected():
            shots += _read_frames(file, read_object(file), reading, split, faults)
    if "transforms_train.json" not in found:
        faults.add("there is no transforms_train.json")
    return Source("Blender", tuple(shots), tuple(notes))


def _without_pictures(file: Path, reading: Reading) -> bool:
    """Whether a file is one of cameras alone: without frames, or without the image of any frame."""
    frames = None
    with suppress(UserError):
        frames = read_object(file).get("frames")
    if not isinstance(frames, list):
        return False  # which is told when it is read
    given = [frame.get("file_path") for frame in frames if isinstance(frame, dict)]
    names = [name for name in given if isinstance(name, str)]
    if len(names) < len(frames):
        return False

    def has_image(name: str) -> bool:
        try:
            return _image(file.parent, name, reading)[1].is_file()
        except UserError:  # which is told, too
            return True

    return not any(has_image(name) for name in names)


def _slashed(name: str) -> str:
    """The name of a file as it is here, where Windows wrote it."""
    return name.replace("\\", "/")


def _read_frames(
    file: Path,
    top: dict[str, Any],
    reading: Reading,
    split: str | None,
    faults: Faults,
    key: str = "frames",
) -> list[Shot]:
    frames, shots = top.get(key), []
    if not isinstance(frames, list) or not frames:
        faults.add(f"{key!r} is not a list of frames", file.name)
        return []
    for index, frame in enumerate(frames):
        place = f"{file.name}: frame {index}"
        if not isinstance(frame, dict):
            faults.add("the frame is not an object", place)
            continue
        with faults.collected(place):
            shots.append(_shot(file, top, frame, reading, split, faults))
    return [shot for shot in shots if shot is not None]


def _shot(
    file: Path,
    top: dict[str, Any],
    frame: dict[str, Any],
    reading: Reading,
    split: str | None,
    faults: Faults,
) -> Shot | None:
    """A frame; None where its image, pose or lens is faulty, each of which is told, or left out."""
    name = text(frame, "file_path", file.name)
    image = mask = pose = lens = None
    with faults.collected(name):
        name, image = _image(file.parent, name, reading)
        if not reading.has(image, name):
            return None
        header = image_header(image)
        told = _as_numbers(with_top(top, frame))
        lens = _lens(told, header.width, header.height, name)
        if _contradicts(top, frame, lens):
            reading.contradicting.append(name)
        lens = suited(lens, image)
    with faults.collected(f"{file.name}: {name}"):
        pose, scaled = _pose(frame, name)
        if scaled:
            reading.scaled.append(name)
    if "mask_path" in frame:
        with faults.collected(frame["mask_path"]):
            mask = _own_mask(file.parent, frame, name, reading)
    if image is None or lens is None or pose is None:
        return None
    with faults.collected(f"{file.name}: {name}"):
        split = split or _own_split(frame)
    # A suffix that the name lacks; a photograph by another name stands for it, as camera RAW does.
    short = (
        name + image.suffix if image.name == f"{PurePosixPath(name).name}{image.suffix}" else name
    )
    return Shot(short.removeprefix("./"), split, image, lens, pose, mask)


def _own_mask(folder: Path, frame: dict[str, Any], name: str, reading: Reading) -> Path | None:
    """The mask that a frame names; None where it is missing and others may take its place."""
    said = text(frame, "mask_path", name)
    try:
        mask = _named_file(folder, said, reading, exact=True)[1]
        require_file(mask, "mask")
    except UserError:
        if reading.other_masks:
            return None
        raise
    if mask.suffix.lower() not in CODED_SUFFIXES:
        raise UserError("the mask is no PNG, JPEG or TIFF file", mask, "Convert it to PNG")
    image_header(mask)
    return mask


def _own_split(frame: dict[str, Any]) -> str | None:
    """The split that a frame names; None where it names none."""
    said = frame.get("split")
    if said is None:
        return None
    if not isinstance(said, str) or said not in _SPLITS:
        names = ", ".join(_SPLITS)
        raise UserError(f"unknown split {printable(repr(said))}", None, f"There are {names}")
    return _SPLITS[said]


def _named_file(
    folder: Path, name: str, reading: Reading, *, exact: bool = False
) -> tuple[str, Path]:
    """A file that a frame names, and its name as it is here: Windows separates by backslashes."""

    def found(name: str) -> Path:
        outside, only = reading.allow_outside, exact or reading.leave_out_missing
        return find_image(folder, name, "source", allow_outside=outside, exact=only)

    file = found(name)
    if file.is_file() or "\\" not in name:
        return name, file
    name = _slashed(name)
    return name, found(name)


def _image(folder: Path, name: str, reading: Reading) -> tuple[str, Path]:
    """The name and the file of an image.

    Args:
        folder: of the JSON file.
        name: of the image there.
        reading: its folder of images has it instead, by this name, or by the end of it: `0001.png`
            of `images/0001.png`.
    """
    if reading.images is None:
        return _named_file(folder, name, reading)
    name = _slashed(name)
    ends = [str(end) for end in ends_of(name)] or [name]
    outside, only = reading.allow_outside, reading.leave_out_missing
    files = [
        find_image(reading.images, end, "source", allow_outside=outside, exact=only) for end in ends
    ]
    return name, next((file for file in files if file.is_file()), files[0])


def _pose(frame: dict[str, Any], where: str) -> tuple[np.ndarray, bool]:
    """Camera to world, (4, 4), and whether a scale was taken out; some leave out the last row.

    Blender's cameras may have a scale, by which it renders nothing else.
    """
    rows = frame.get("transform_matrix")
    if isinstance(rows, list) and len(rows) == 3:
        frame = {"transform_matrix": [*rows, [0, 0, 0, 1]]}
    pose = np.array(array(frame, "transform_matrix", (4, 4), where), np.float64)
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    scaled = bool(np.isfinite(lengths).all() and lengths.min() > _LEAST_SCALE)
    scaled &= bool(np.abs(lengths - 1).max() > _ROUNDING)
    if scaled:
        pose[:3, :3] /= lengths
    return np.array(Camera(pose, 1, 1, 0, 0, 1, 1).to_world), scaled


def _as_numbers(keys: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a lens; nerfstudio writes as texts what RealityCapture tells."""
    found = dict(keys)
    for key in (*_DISTORTION, *_LENGTHS):
        if isinstance(found.get(key), str):
            with suppress(ValueError):
                found[key] = float(found[key])
    return found


def _whole(plain: Mapping[str, Any], width: int, height: int) -> dict[str, int]:
    """The size of an image where its camera tells it with a fraction, which Blender leaves off."""
    w, h = plain.get("w"), plain.get("h")
    if not (isinstance(w, int | float) and isinstance(h, int | float)):
        return {}
    fits = 0 <= w - width < 1 and 0 <= h - height < 1
    return {"w": width, "h": height} if fits else {}


def _lens(keys: Mapping[str, Any], width: int, height: int, where: str) -> Lens:
    """The lens of a frame; `width` and `height` are those of its image, where it tells none."""
    # instant-ngp has no model, but a flag.
    model = _FISHEYE if keys.get("is_fisheye") is True else keys.get("camera_model", "OPENCV")
    if model not in (*_PINHOLES, *_LENSES, _FISHEYE):
        raise UserError(f"unknown camera_model {model!r}", where)
    plain = {k: v for k, v in keys.items() if k not in (*_DISTORTION, "camera_model", "is_fisheye")}
    plain["transform_matrix"] = np.eye(4).tolist()
    if "w" not in plain or "h" not in plain:
        plain |= {"w": width, "h": height}
        middle = number(dict(keys), "cx", where) if "cx" in keys else width / 2
        if not 1 / 3 < middle / width < 2 / 3:
            what = f"'cx' is {middle:g}, and the image has {width} pixels across"
            raise UserError(what, where, "Give 'w' and 'h', the size that the camera is for")
    plain |= _whole(plain, width, height)
    camera = camera_from_frame(plain, {}, where)
    values = {k: number(dict(keys), k, where) for k in _DISTORTION if k in keys}
    k1, k2, k3, k4, k5, k6, p1, p2 = (values.get(k, 0.0) for k in _DISTORTION)
    focal, centre = (camera.fl_x, camera.fl_y), (camera.cx, camera.cy)
    project = None
    if model == _FISHEYE:
        project = fisheye(focal, centre, np.array([k1, k2, k3, k4]))
    elif any(values.values()):  # whatever the model is called, as nerfstudio does
        if k4 or k5 or k6:
            raise UserError("the lens has k4, k5 or k6, which programs use differently", where)
        project = opencv(focal, centre, np.array([k1, k2, k3]), p1, p2)
    return Lens(camera.width, camera.height, *focal, *centre, project)


def _contradicts(top: Mapping[str, Any], frame: Mapping[str, Any], lens: Lens) -> bool:
    """Whether the keys of a frame, or those at the top without it, tell two focal lengths.

    Where one is of the frame and the other at the top, that of the frame alone counts.
    """
    for length, angle, size in (
        ("fl_x", "camera_angle_x", lens.width),
        ("fl_y", "camera_angle_y", lens.height),
    ):
        own = frame if length in frame or angle in frame else top
        if own is top and ("fl_x" in frame or "camera_angle_x" in frame):
            continue
        given, told = own.get(length), own.get(angle)
        if not (isinstance(given, int | float) and isinstance(told, int | float)):
            continue
        if given > 0 and 0 < told < math.pi:
            focal = 0.5 * size / math.tan(0.5 * told)
            if abs(focal / given - 1) > _CONTRADICTS:
                return True
    return False


def _listed_splits(top: dict[str, Any], file: Path, faults: Faults) -> dict[PurePosixPath, str]:
    """Splits by the paths of images, where the file has lists of them."""
    splits = {}
    for key, split in _SPLIT_LISTS.items():
        names = top.get(key)
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(n, str) and n for n in names):
            faults.add(f"{key!r} is not a list of names", file.name)
            continue
        splits |= {PurePosixPath(_slashed(name)): split for name in names}
    return splits


def _listed(name: str, splits: Mapping[PurePosixPath, str]) -> str | None:
    """The split of an image in such lists; None where they have none, or more than one.

    Lists name images as frames do, or from another folder: one path is then the end of the other.
    """
    path = PurePosixPath(name)
    if path in splits:
        return splits[path]

    def same(listed: PurePosixPath, path: PurePosixPath) -> bool:
        count = min(len(listed.parts), len(path.parts))
        return count > 0 and listed.parts[-count:] == path.parts[-count:]

    found = {split for listed, split in splits.items() if same(listed, path)}
    if not found:  # images may be of another format by now
        short = path.with_suffix("")
        found = {x for listed, x in splits.items() if same(listed.with_suffix(""), short)}
    return found.pop() if len(found) == 1 else None
