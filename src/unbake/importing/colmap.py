"""Cameras of COLMAP, binary or text, as pycolmap reads them."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..io import inside
from .faults import Faults
from .lens import Lens
from .source import Shot, Source, first_folder, image_header, with_suffix

#: Folders of a project that its model may lie in, and those that images lie in beside it.
_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0", "dense/sparse", "model")
_IMAGES = ("images", "input")
_ENDINGS = (".bin", ".txt")
_STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE")


def find_model(folder: Path) -> Path | None:
    """The folder of a project that has a COLMAP model in it; None where there is none."""
    return next((m for m in (folder / name for name in _MODELS) if _is_model(m)), None)


def _is_model(folder: Path) -> bool:
    names = ("cameras", "images")
    return any(all((folder / f"{n}{end}").is_file() for n in names) for end in _ENDINGS)


def read_colmap(model: Path, images: Path | None, allow_outside: bool, faults: Faults) -> Source:
    """The photographs of a COLMAP model: rigs, shared cameras, and images in folders included.

    Args:
        model: the folder of `cameras`, `images` and `points3D`, `.bin` or `.txt`.
        images: the folder of the images; None: the first of `images` beside the model or in one of
            the two folders above it.
        allow_outside: read images that lie outside of their folder.
        faults: all that is wrong is added to it.

    Raises:
        UserError: pycolmap is missing, or cannot read the model.
    """
    found = images or _folder_of_images(model)
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
        if image.camera_id not in lenses:
            lenses[image.camera_id] = _lens(image.camera)
        with faults.collected(image.name):
            shots.append(_shot(image, lenses[image.camera_id], found, allow_outside))
    if not shots and not faults:
        faults.add("no image of the model has a pose", model)
    return Source("COLMAP", tuple(sorted(shots, key=lambda shot: shot.name)))


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
        raise UserError(f"pycolmap cannot read the model ({told})", model) from None
    return reconstruction


def _is_binary(model: Path) -> bool:
    return (model / "cameras.bin").is_file()


def _shot(image: Any, lens: Lens, folder: Path, allow_outside: bool) -> Shot:
    name = image.name
    said = inside(folder, name, name, "folder of images", allow_outside=allow_outside)
    file = with_suffix(said)
    header = image_header(file)
    if (header.width, header.height) != (lens.width, lens.height):
        size = f"{header.width} x {header.height}"
        told = f"its camera is for {lens.width} x {lens.height} pixels, it has {size}"
        raise UserError(told, name)
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    # COLMAP's cameras look along z with y down.
    return Shot(name, None, file, lens, pose @ np.diag([1.0, -1.0, -1.0, 1.0]))


def _lens(camera: Any) -> Lens:
    # That of a model is gone with the model.
    own = copy.deepcopy(camera)

    def project(points: np.ndarray) -> np.ndarray:
        return own.img_from_cam(np.c_[points, np.ones(len(points))])

    return Lens(
        camera.width,
        camera.height,
        camera.focal_length_x,
        camera.focal_length_y,
        camera.principal_point_x,
        camera.principal_point_y,
        None if camera.model_name in _STRAIGHT else project,
    )


def _folder_of_images(model: Path) -> Path | None:
    model = model.resolve()
    above = (model, *model.parents[:3])
    return first_folder([folder / name for folder in above for name in _IMAGES])
