"""Cameras of COLMAP, binary or text, as pycolmap reads them."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..errors import UserError, named
from ..imaging.headers import CODED_SUFFIXES, SUFFIXES
from .faults import Faults
from .lens import Lens
from .source import Reading, Shot, Source, find_image, first_folder, suited

#: Folders of a project that its model may lie in, and those that images lie in beside it.
_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0", "dense/sparse", "model")
_IMAGES = ("images", "input")
_MASKS = "masks"
_ENDINGS = (".bin", ".txt")
_STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE")
_SPHERICAL = ("EQUIRECTANGULAR",)


def find_model(folder: Path) -> Path | None:
    """The folder of a project that has a COLMAP model in it; None where there is none."""
    return next((m for m in (folder / name for name in _MODELS) if is_model(m)), None)


def is_model(folder: Path) -> bool:
    """Whether a folder has a COLMAP model in it."""
    names = ("cameras", "images")
    return any(all((folder / f"{n}{end}").is_file() for n in names) for end in _ENDINGS)


def read_colmap(model: Path, reading: Reading, faults: Faults) -> Source:
    """The photographs of a COLMAP model: rigs, shared cameras, and images in folders included.

    Args:
        model: the folder of `cameras`, `images` and `points3D`, `.bin` or `.txt`.
        reading: without a folder of images, that is the first `images` beside the model or in one
            of the folders above it, up to that of its project. Masks lie in `masks` beside it.
        faults: all that is wrong is added to it.

    Raises:
        UserError: pycolmap is missing, or cannot read the model.
    """
    found = reading.images or _folder_of_images(model)
    if found is None or not found.is_dir():
        faults.add("there is no folder of images (name it with --images)", found)
        found = None
    reconstruction, shots, lenses = None, [], {}
    with faults.collected():
        reconstruction = _reconstruction(model)
    if reconstruction is None:
        return Source("COLMAP", ())
    for image in reconstruction.images.values():
        if not image.has_pose or found is None:
            continue
        with faults.collected(image.name):
            if image.camera_id not in lenses:
                lenses[image.camera_id] = _lens(image.camera)
            file = find_image(
                found,
                image.name,
                "folder of images",
                allow_outside=reading.allow_outside,
                exact=reading.leave_out_missing,
            )
            if reading.has(file, image.name):
                shots.append(_shot(image, lenses[image.camera_id], file))
    if not shots and not reading.missing and not faults:
        faults.add("no image of the model has a pose", model)
    ordered = tuple(sorted(shots, key=lambda shot: shot.name))
    masks = None if found is None else found.parent / _MASKS
    return Source(
        "COLMAP",
        ordered,
        (*_other_models(model), *_without_pose(ordered, found)),
        masks=masks if masks is not None and masks.is_dir() else None,
    )


def _other_models(model: Path) -> list[str]:
    """A note of models beside this one, into which COLMAP divides what it cannot join."""
    if not model.name.isdecimal():
        return []
    beside = [f for f in sorted(model.parent.iterdir()) if f.name.isdecimal() and is_model(f)]
    others = [folder.name for folder in beside if folder.name != model.name]
    return [f"{model.parent} has other models, left out: {named(others)}"] if others else []


def _without_pose(shots: Sequence[Shot], images: Path | None) -> list[str]:
    """A note of photographs in the folder that have no pose."""
    if images is None:
        return []
    known = {PurePosixPath(shot.name).with_suffix("") for shot in shots}
    files = [f for f in images.rglob("*") if f.suffix.lower() in (*CODED_SUFFIXES, *SUFFIXES)]
    every = sorted(PurePosixPath(file.relative_to(images)) for file in files)
    left = [str(name) for name in every if name.with_suffix("") not in known]
    if not left:
        return []
    return [f"{len(left)} of {len(every)} photographs have no pose, left out: {named(left)}"]


def _reconstruction(model: Path) -> Any:
    """The model, as pycolmap reads it."""
    try:
        import pycolmap
    except ImportError:
        remedy = "pip install 'unbake[import]'"
        raise UserError("COLMAP models need pycolmap", model, remedy) from None
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        reconstruction = pycolmap.Reconstruction()
        read = reconstruction.read_binary if _is_binary(model) else reconstruction.read_text
        read(str(model))
    except (ValueError, RuntimeError, OSError, IndexError, MemoryError) as error:
        told = " ".join(str(error).split())[:200]
        remedy = "Write the model again with COLMAP, or copy it again"
        raise UserError(f"pycolmap cannot read the model ({told})", model, remedy) from None
    return reconstruction


def _is_binary(model: Path) -> bool:
    return (model / "cameras.bin").is_file()


def poses_of(model: Path) -> dict[str, np.ndarray]:
    """Camera to world (4, 4), OpenGL axes, by the names of a model's images.

    Raises:
        UserError: pycolmap is missing, or cannot read the model.
    """
    images = _reconstruction(model).images.values()
    return {image.name: _pose(image) for image in images if image.has_pose}


def _shot(image: Any, lens: Lens, file: Path) -> Shot:
    return Shot(image.name, None, file, suited(lens, file), _pose(image))


def _pose(image: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    # COLMAP's cameras look along z with y down.
    return pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def _lens(camera: Any) -> Lens:
    if camera.model_name in _SPHERICAL:
        what = f"a camera of the model {camera.model_name} is no pinhole with a lens"
        raise UserError(what, None, "Turn its images into perspective ones first")
    focal = camera.focal_length_x, camera.focal_length_y
    if not all(math.isfinite(length) and length > 0 for length in focal):
        raise UserError(f"the focal lengths of its camera are {focal[0]:g} and {focal[1]:g}")
    # That of a model is gone with the model.
    own = copy.deepcopy(camera)

    def project(points: np.ndarray) -> np.ndarray:
        return own.img_from_cam(np.c_[points, np.ones(len(points))])

    return Lens(
        camera.width,
        camera.height,
        *focal,
        camera.principal_point_x,
        camera.principal_point_y,
        None if camera.model_name in _STRAIGHT else project,
    )


def _folder_of_images(model: Path) -> Path | None:
    model = model.resolve()
    above = (model, *model.parents[: _depth(model)])
    return first_folder([folder / name for folder in above for name in _IMAGES])


def _depth(model: Path) -> int:
    """How many folders above that of a model its project is; 0 where its place is no usual one."""
    end = PurePosixPath(*model.parts[1:-1], "0" if model.name.isdecimal() else model.name)
    layouts = [PurePosixPath(name).parts for name in _MODELS]
    return max(len(parts) for parts in layouts if end.parts[len(end.parts) - len(parts) :] == parts)
