"""Files of cameras: our own, with places and targets, and the frames of a `transforms.json`."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from ..errors import UserError, collected, raise_together
from ..io import array, integer, number, read_json, text, write_text
from .camera import Camera, LookAt
from .data_folder import TRANSFORMS

SPLITS = ("train", "heldout")
Placed = TypeVar("Placed")

_PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_NO_CAMERA_FILE = f"A camera file holds a list 'cameras', or the 'frames' of a {TRANSFORMS}"


def frame_name(split: str, index: int) -> str:
    """The name of a view: its split and its number in that split, as in `train_000`."""
    return f"{split}_{index:03d}"


def named_by_split(posed: Iterable[tuple[str, Placed]]) -> list[tuple[str, str, Placed]]:
    """Cameras or placements with their splits, and the names that views of these have.

    Returns:
        Name, split and camera, in the order given.
    """
    counts: dict[str, int] = {}
    found = []
    for split, camera in posed:
        counts[split] = counts.get(split, -1) + 1
        found.append((frame_name(split, counts[split]), split, camera))
    return found


def write_camera_file(path: Path, cameras: Sequence[tuple[str, LookAt]]) -> None:
    """Write (split, placement) pairs as a camera file: JSON, one camera a line, world units."""
    lines = []
    for name, split, placed in named_by_split(cameras):
        entry = {
            "name": name,
            "split": split,
            "origin": _rounded(placed.origin),
            "target": _rounded(placed.target),
            "up": _rounded(placed.up),
            "fov": placed.fov,
        }
        lines.append("  " + json.dumps(entry))
    write_text(path, '{"cameras": [\n' + ",\n".join(lines) + "\n]}\n")


def read_cameras(
    path: Path, width: int, height: int, *, keep_size: bool = False
) -> list[tuple[str, Camera]]:
    """Read (split, camera) pairs from a camera file or a nerfstudio `transforms.json`.

    A camera file is `{"cameras": [{"name", "split", "origin", "target", "up", "fov"}]}` or the
    list alone; `split` is "train" where it is missing, and `name` may be missing, too (see
    `read_named_cameras`). Horizontal fields of view stay as in the file (see `Camera.rescaled`).

    Args:
        path: the file.
        width, height: image size in pixels of the cameras returned.
        keep_size: leave cameras the size that the file gives them, if it does.

    Raises:
        UserError: the file is missing or not JSON, or entries lack a key or are no valid cameras:
            it tells of several.
    """
    found = _read_entries(path, width, height, keep_size)
    return [(split, camera) for _, split, camera in found]


def read_named_cameras(
    path: Path, width: int, height: int, *, keep_size: bool = False
) -> list[tuple[str, str, Camera]]:
    """Read cameras with the names that their pictures get; arguments as of `read_cameras`.

    That is the `name` of an entry; else the name of its file (`file_path`) without the suffix,
    unless files in several folders have the same; else its split and number, as of
    `named_by_split`.

    Returns:
        Name, split and camera, in the order of the file.

    Raises:
        UserError: as of `read_cameras`; or names cannot be those of files, or are not unique: it
            tells all of them.
    """
    found = _read_entries(path, width, height, keep_size)
    numbered = named_by_split((split, camera) for _, split, camera in found)
    told: list[str | None] = []
    stems: list[str] = []
    faults: list[UserError] = []
    for index, (entry, _, _) in enumerate(found):
        with collected(faults):
            told.append(_told(entry, "name", f"{path}: camera {index}"))
            # As written on any system.
            file = _told(entry, "file_path", f"{path}: camera {index}") or ""
            stems.append(PurePosixPath(file.replace("\\", "/")).stem)
    raise_together(faults)
    if max(Counter(filter(None, stems)).values(), default=0) > 1:
        stems = [""] * len(stems)
    names = [
        name or stem or number
        for name, stem, (number, _, _) in zip(told, stems, numbered, strict=True)
    ]
    _require_names_of_files(names, path)
    return [(name, split, camera) for name, (_, split, camera) in zip(names, found, strict=True)]


def _told(entry: dict[str, Any], key: str, where: str) -> str | None:
    """A text of an entry of a camera file; None if it is not there."""
    return None if entry.get(key) is None else text(entry, key, where)


def _require_names_of_files(names: Sequence[str], path: Path) -> None:
    """Refuse names of cameras that pictures cannot have, and those that several have."""
    faults = []
    wrong = [name for name in names if not name.isprintable() or "/" in name or "\\" in name]
    if wrong:
        what = f"names of cameras that pictures cannot have: {', '.join(map(repr, wrong))}"
        faults.append(UserError(what, path, "Leave out slashes and control characters"))
    doubled = [name for name, count in Counter(names).items() if count > 1]
    if doubled:
        what = f"several cameras have the same name: {', '.join(map(repr, doubled))}"
        faults.append(UserError(what, path, "Give each camera a 'name' of its own"))
    raise_together(faults, most=None)


def _read_entries(
    path: Path, width: int, height: int, keep_size: bool
) -> list[tuple[dict[str, Any], str, Camera]]:
    """The entries of a camera file with their splits and cameras; see `read_cameras`."""
    content = read_json(path)
    if isinstance(content, dict) and "frames" in content:
        entries = content["frames"]
    else:
        entries = content.get("cameras") if isinstance(content, dict) else content
    if not isinstance(entries, list) or not entries:
        raise UserError("no cameras in the file", path, _NO_CAMERA_FILE)
    top = content if isinstance(content, dict) else {}
    _require_own_frame(top, path)
    cameras, faults = [], []
    for index, entry in enumerate(entries):
        where = f"{path}: camera {index}"
        with collected(faults):
            if not isinstance(entry, dict):
                raise UserError("the entry is not an object", where, _NO_CAMERA_FILE)
            split = read_split(entry, where)
            if "transform_matrix" in entry:
                camera = camera_from_frame(entry, top, where, (width, height))
            else:
                camera = _camera_from_entry(entry, where, width, height)
            camera = camera if keep_size else camera.rescaled(width, height)
            cameras.append((entry, split, camera))
    raise_together(faults)
    return cameras


def _require_own_frame(top: Mapping[str, Any], path: Path) -> None:
    """Refuse poses that another program has turned, moved or scaled: `import` takes that back."""
    same = top.get("applied_scale", 1) == 1
    if "applied_transform" in top:
        try:
            rows = np.array(top["applied_transform"], np.float64)
        except (TypeError, ValueError):
            rows = np.empty(0)
        same &= rows.shape in ((3, 4), (4, 4)) and np.allclose(rows[:3], np.eye(4)[:3])
    if not same:
        what = "its poses are in the frame after 'applied_transform' and 'applied_scale'"
        remedy = f"Give the {TRANSFORMS} that `unbake import` wrote; or remove these keys, if "
        raise UserError(what, path, f"{remedy}the scene is in that frame, too")


def camera_from_frame(
    frame: dict[str, Any], top: dict[str, Any], where: str, size: tuple[int, int] | None = None
) -> Camera:
    """The camera of one frame of a `transforms.json`.

    Args:
        frame: the frame; what it lacks is taken from `top`.
        top: the file's top level: `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, or `camera_angle_x`.
        where: file and frame, for error messages.
        size: (width, height) in pixels where neither has `w` and `h`.

    Raises:
        UserError: a key is missing or of the wrong type, the lens is distorted, or the values are
            no valid camera.
    """
    both = with_top(top, frame)
    _check_lens(both, where)
    if size is None or ("w" in both and "h" in both):
        size = (integer(both, "w", where), integer(both, "h", where))
    width, height = size
    matrix = array(frame, "transform_matrix", (4, 4), where)
    fl_x = _focal(both, "fl_x", "camera_angle_x", width, where)
    if fl_x is None:
        raise UserError(
            "the key 'fl_x' is missing", where, "Give 'fl_x' in pixels, or 'camera_angle_x'"
        )
    fl_y = _focal(both, "fl_y", "camera_angle_y", height, where)
    if fl_y is None:
        fl_y = fl_x
    cx = number(both, "cx", where) if "cx" in both else width / 2
    cy = number(both, "cy", where) if "cy" in both else height / 2
    try:
        return Camera(matrix, fl_x, fl_y, cx, cy, width, height)
    except UserError as error:
        raise UserError(error.what, where, error.remedy) from None


def with_top(top: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a frame, with those at the top of the file where it has none of its own.

    An angle of the frame takes the place of focal lengths at the top.
    """
    angle = "camera_angle_x" in frame and "fl_x" not in frame
    replaced = {"fl_x", "fl_y", "camera_angle_y"} if angle else set()
    if "camera_angle_y" in frame and "fl_y" not in frame:
        replaced.add("fl_y")
    return {key: value for key, value in top.items() if key not in replaced} | dict(frame)


def frame_of(camera: Camera) -> dict[str, Any]:
    """What `camera_from_frame` reads of a frame; numbers are not rounded."""
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fl_x,
        "fl_y": camera.fl_y,
        "cx": camera.cx,
        "cy": camera.cy,
        "transform_matrix": camera.to_world.tolist(),
    }


def read_split(entry: dict[str, Any], where: str) -> str:
    """The split of a frame, "train" where it names none."""
    split = entry.get("split", "train")
    if split not in SPLITS:
        raise UserError(f"unknown split {split!r}", where, "The splits are 'train' and 'heldout'")
    return split


def _camera_from_entry(entry: dict[str, Any], where: str, width: int, height: int) -> Camera:
    origin, target, up = (array(entry, key, (3,), where) for key in ("origin", "target", "up"))
    fov = number(entry, "fov", where)
    try:
        return Camera.look_at(origin, target, up, fov, width, height)
    except UserError as error:
        raise UserError(error.what, where, error.remedy) from None


def _check_lens(keys: dict[str, Any], where: str) -> None:
    remedy = "Undistort the images first; only pinhole cameras are supported"
    model = keys.get("camera_model", "PINHOLE")
    if model not in _PINHOLE_MODELS:
        raise UserError(f"unknown camera_model {model!r}", where, remedy)
    if keys.get("is_fisheye") is True:
        raise UserError("the lens is a fisheye ('is_fisheye')", where, remedy)
    distorted = [key for key in _DISTORTION if key in keys and number(keys, key, where) != 0]
    if distorted:
        raise UserError(f"lens distortion in {', '.join(distorted)}", where, remedy)


def _focal(keys: dict[str, Any], focal: str, angle: str, pixels: int, where: str) -> float | None:
    if focal in keys:
        return number(keys, focal, where)
    if angle not in keys:
        return None
    radians = number(keys, angle, where)
    if not 0 < radians < math.pi:
        raise UserError(
            f"{angle!r} is {radians:g}", where, "It is a field of view in radians, between 0 and π"
        )
    return 0.5 * pixels / math.tan(radians / 2)


def _rounded(vector: Sequence[float]) -> list[float]:
    return [round(float(v), 5) for v in vector]
