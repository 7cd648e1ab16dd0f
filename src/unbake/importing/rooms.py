"""Rooms in the layout of FIPT (Wu et al. 2023), which IRIS (Lin et al. 2025) uses, too.

Rooms that were photographed have their cameras in text files:

    scene.obj               the mesh
    cam.txt                 number of cameras; for each: position, a point it looks at, up
    K_list.txt              the same number; for each: the three rows of its intrinsics
    Image/000_0001.exr      photographs by number, with radiance; or .png with code values
    Image/cam/exposure.npy  of IRIS, beside code values: the exposure of each photograph

Rooms that were rendered have a folder for each split:

    scene.obj
    train/transforms.json   camera_angle_x, and camera to world: x to the left, y up, z forwards
    train/Image/000_0001.exr
    val/...

Sources: the data loaders of github.com/lwwu2/fipt and github.com/facebookresearch/iris.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ..dataset.camera import Camera
from ..dataset.data_folder import TRANSFORMS
from ..errors import UserError
from ..io import array, number, read_object, read_text
from .faults import Faults
from .lens import Lens
from .source import Reading, Shot, Source, find_image, image_header

_MESH, _POSES, _LENSES, _IMAGES = "scene.obj", "cam.txt", "K_list.txt", "Image"
_EXPOSURES, _RESPONSE = Path("cam", "exposure.npy"), Path("cam", "crf.npy")
#: The least exposure.
_LEAST = 1e-9
_UNKNOWN_RESPONSE = f"response: {_RESPONSE} is not used; a fit finds it with --response monotone"
_SPLITS = {"train": "train", "val": "heldout"}
#: The cosine of view direction and up, at most: they are perpendicular but for rounding.
_SKEWED = 0.01
_TO_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])


def is_room(folder: Path) -> bool:
    """Whether a folder has this layout."""
    photographed = (folder / _POSES).is_file() and (folder / _LENSES).is_file()
    return photographed or _has_split(folder / "train")


def read_room(folder: Path, reading: Reading, faults: Faults) -> Source:
    """The photographs of a room, and its mesh.

    Args:
        folder: of the room.
        reading: without a folder of images, those of a room that was photographed are in `Image`.
        faults: all that is wrong is added to it.
    """
    mesh = folder / _MESH if (folder / _MESH).is_file() else None
    shots: list[Shot] = []
    if not _has_split(folder / "train"):
        root = reading.images or folder / _IMAGES
        with faults.collected():
            shots += _photographed(folder, root, reading, faults)
        notes = (_UNKNOWN_RESPONSE,) if (root / _RESPONSE).is_file() else ()
        return Source("FIPT", tuple(shots), notes, mesh)
    if reading.images is not None:
        faults.add("a room with train and val has no other folder of images", reading.images)
    for name, split in _SPLITS.items():
        if _has_split(folder / name):
            with faults.collected(f"{name}/{TRANSFORMS}"):
                shots += _rendered(folder, name, split, reading, faults)
    return Source("FIPT", tuple(shots), mesh=mesh)


def _has_split(folder: Path) -> bool:
    return (folder / TRANSFORMS).is_file() and (folder / _IMAGES).is_dir()


def _photographed(folder: Path, root: Path, reading: Reading, faults: Faults) -> list[Shot]:
    poses, lenses = _rows(folder / _POSES), _rows(folder / _LENSES)
    if len(poses) != len(lenses):
        what = f"{len(poses)} cameras in {_POSES}, {len(lenses)} in {_LENSES}"
        raise UserError(what, folder)
    exposures, shots = _exposures(root, len(poses)), []
    for index, (pose, rows) in enumerate(zip(poses, lenses, strict=True)):
        name = f"{index:03d}_0001"
        with faults.collected(name):
            image = _image(root, name, reading)
            if not reading.has(image, name):
                continue
            header = image_header(image)
            _require_size_of(folder / _IMAGES / f"{name}.exr", image)
            lens = _pinhole(rows, header.width, header.height)
            told = None if exposures is None else exposures[index]
            shots.append(Shot(image.name, None, image, lens, _looking(*pose), exposure=told))
    return shots


def _require_size_of(own: Path, image: Path) -> None:
    """Refuse an image of another size than the room's own, which the lenses of rooms are for."""
    if not own.is_file():
        return
    there, here = (image_header(file) for file in (own, image))
    if (there.width, there.height) != (here.width, here.height):
        what = f"the image has {here.width} x {here.height} pixels, and the cameras are for "
        remedy = "Give images of the size of the room's own"
        raise UserError(f"{what}{there.width} x {there.height}", image, remedy)


def _exposures(root: Path, count: int) -> list[float] | None:
    """The exposures of so many photographs; None where they are not told."""
    file = root / _EXPOSURES
    if not file.is_file():
        return None
    try:
        told = np.load(file, mmap_mode="r", allow_pickle=False)
        if told.shape == (count,) and (_LEAST <= told).all() and (told <= 1 / _LEAST).all():
            return [float(value) for value in told]
    except (OSError, ValueError, TypeError, EOFError):
        pass
    raise UserError(f"the file is not {count} positive numbers, one for each camera", file)


def _rendered(folder: Path, name: str, split: str, reading: Reading, faults: Faults) -> list[Shot]:
    top = read_object(folder / name / TRANSFORMS)
    angle, frames, shots = number(top, "camera_angle_x", name), top.get("frames"), []
    if not 0 < angle < math.pi:
        raise UserError("'camera_angle_x' is not between 0 and π")
    if not isinstance(frames, list) or not frames:
        raise UserError("'frames' is not a list of frames")
    for index, frame in enumerate(frames):
        with faults.collected(f"{name}: frame {index}"):
            if not isinstance(frame, dict):
                raise UserError("the frame is not an object")
            image = _image(folder / name / _IMAGES, f"{index:03d}_0001", reading)
            if not reading.has(image, f"{name}/{index:03d}_0001"):
                continue
            header = image_header(image)
            focal = 0.5 * header.width / math.tan(0.5 * angle)
            middle = 0.5 * header.width, 0.5 * header.height
            lens = Lens(header.width, header.height, focal, focal, *middle)
            pose = array(frame, "transform_matrix", (4, 4), name) @ _TO_OPENGL
            shots.append(Shot(f"{name}/{image.name}", split, image, lens, _checked(pose)))
    return shots


def _image(folder: Path, name: str, reading: Reading) -> Path:
    return find_image(folder, name, "source", allow_outside=reading.allow_outside)


def _rows(file: Path) -> np.ndarray:
    """Three rows of three numbers for each camera, (n, 3, 3)."""
    lines = [line.split() for line in read_text(file).splitlines() if line.strip()]
    try:
        found = np.array(lines[1:], np.float64).reshape(-1, 3, 3)
        if len(found) == int(lines[0][0]) and np.isfinite(found).all():
            return found
    except (ValueError, IndexError):
        pass
    raise UserError("the file is not a number of cameras and three rows of three for each", file)


def _pinhole(rows: np.ndarray, width: int, height: int) -> Lens:
    (fl_x, skew, cx), (_, fl_y, cy), _ = rows
    if skew or fl_x <= 0 or fl_y <= 0:
        raise UserError(f"the intrinsics in {_LENSES} are no pinhole without skew")
    return Lens(width, height, fl_x, fl_y, cx, cy)


def _looking(origin: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Camera to world of a camera by its position, a point that it looks at, and up."""
    with np.errstate(all="ignore"):
        forwards = (target - origin) / np.linalg.norm(target - origin)
        up = up / np.linalg.norm(up)
        right = np.cross(forwards, up)
    if not abs(forwards @ up) < _SKEWED:
        raise UserError(f"the axes of the camera in {_POSES} are not perpendicular")
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(right, forwards), -forwards, origin], 1)
    return _checked(pose)


def _checked(pose: np.ndarray) -> np.ndarray:
    return np.array(Camera(pose, 1, 1, 0, 0, 1, 1).to_world)
