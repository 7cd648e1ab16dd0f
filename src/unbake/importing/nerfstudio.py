"""What nerfstudio does to the world of cameras before it writes them, and how it is taken back."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ..dataset.data_folder import TRANSFORMS
from ..errors import UserError
from ..io import array, number
from .colmap import is_model, poses_of
from .faults import Faults
from .world import World, is_rotation

#: What nerfstudio did to the world of COLMAP before it wrote that as `applied_transform`. Its
#: reader takes it for done where there is `_INSERTED` beside a file without that key.
TURNED_ONCE = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
_INSERTED = "colmap/sparse/0"
#: Where models lie that cameras were made of: ScanNet++ has the folder beside that of the file.
_MODELS = (_INSERTED, "sparse/0", "../colmap", "../colmap/sparse/0")
#: What it does to the worlds of Metashape, and of no other program.
_METASHAPE = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0]])
#: Poses agree if their axes do to so much, and positions to so much of the largest coordinate.
_AGREE = 1e-3

_KEY = '"applied_transform": [[0,1,0,0],[1,0,0,0],[0,0,-1,0]]'
_UNTOLD = (
    f"{TRANSFORMS} has no 'applied_transform': older nerfstudio turned the cameras of COLMAP and "
    "did not say so, and a newer one leaves it out where it has not turned them. Where a mesh of "
    f"COLMAP does not fit, add to the file: {_KEY}"
)
_SCANNET = (
    "test_frames: the file may be of ScanNet++, whose cameras are turned without a word: for its "
    f"mesh, add to the file: {_KEY}"
)
_INSTANT_NGP = (
    f"{TRANSFORMS} may be of instant-ngp, whose colmap2nerf.py turns and scales cameras unless it "
    "is run with --keep_colmap_coords: a mesh of COLMAP does not fit then"
)
_POLYCAM = (
    "orientation_override: the file may be of Polycam (or RealityCapture); the mesh of Polycam "
    "(GLB) has other axes: for that, give --mesh-matrix 0 0 1 0 1 0 0 0 0 1 0 0 0 0 0 1"
)
_METASHAPE_SCALE = (
    "applied_transform: the file is of Metashape, whose cameras nerfstudio divides by a scale: "
    "where the XML of cameras has <scale> S, give --mesh-scale with the number 1 / S"
)


def world_of(
    top: dict[str, Any], file: Path, poses: Mapping[str, np.ndarray], keep: bool, faults: Faults
) -> World:
    """The frame that the cameras of a file are in.

    They are taken back to that before `applied_transform`; where the file lacks it and a model of
    COLMAP lies beside it, to that of the model.

    Args:
        top: what the file holds.
        file: the file.
        poses: camera to world (4, 4) as the file has it, by names of photographs.
        keep: leave cameras where they are.
        faults: what is wrong with the keys is added to it.
    """
    if "applied_transform" in top or "applied_scale" in top:
        return _applied(top, file, keep, faults)
    inserted = TURNED_ONCE if (file.parent / _INSERTED).exists() else np.eye(4)
    if keep:
        return World(applied=inserted)
    turn = _measured(file.parent, poses)
    if turn is None:
        return World(applied=inserted, notes=_untold(top, file))
    if np.array_equal(turn, np.eye(4)):
        return World(applied=inserted)
    note = f"cameras are in the frame of COLMAP's model beside {TRANSFORMS}, which has them turned"
    return World(inserted, 1.0, np.linalg.inv(turn), True, (note,))


def _applied(top: dict[str, Any], file: Path, keep: bool, faults: Faults) -> World:
    """The frame of cameras of a file that says what was done to the world."""
    applied, scale = np.eye(4), 1.0
    with faults.collected(file.name):
        if "applied_transform" in top:
            rows = top["applied_transform"]
            shape = (4, 4) if isinstance(rows, list) and len(rows) == 4 else (3, 4)
            applied[:3] = array(top, "applied_transform", shape, str(file))[:3]
        if not is_rotation(applied[:3, :3]):
            raise UserError("'applied_transform' is no rotation with a translation")
    with faults.collected(file.name):
        scale = number(top, "applied_scale", file.name) if "applied_scale" in top else 1.0
        if scale <= 0:
            raise UserError("'applied_scale' is not positive")
    if faults or keep:
        return World(applied, scale) if not faults else World()
    notes = (_METASHAPE_SCALE,) if np.allclose(applied[:3], _METASHAPE) else ()
    if np.allclose(applied, np.eye(4)) and scale == 1:
        return World(applied, scale)
    done = applied.copy()
    done[:3] *= scale
    told = f"cameras are in the frame before 'applied_transform' of {TRANSFORMS}"
    return World(applied, scale, np.linalg.inv(done), True, (told, *notes))


def _untold(top: dict[str, Any], file: Path) -> tuple[str, ...]:
    """Notes of what may have been done to cameras of a file that does not say so."""
    # instant-ngp writes the key; its script turns and scales what COLMAP found by default.
    if "aabb_scale" in top:
        return (_INSTANT_NGP,)
    if top.get("orientation_override") == "none":
        return (_POLYCAM,)
    if top.get("test_frames"):
        return (_SCANNET,)
    return (_UNTOLD,) if (file.parent / "colmap").is_dir() else ()


def _measured(folder: Path, poses: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """What takes the poses of a COLMAP model near a folder to those of its file, (4, 4).

    None: there is no model with photographs of these names, or no turn of axes to axes does it.
    """
    model = next((m for m in (folder / name for name in _MODELS) if is_model(m)), None)
    if model is None or not poses:
        return None
    try:
        known = {PurePosixPath(name).stem: pose for name, pose in poses_of(model).items()}
    except UserError:
        return None
    given = {PurePosixPath(name).stem: pose for name, pose in poses.items()}
    both = sorted(given.keys() & known.keys())
    if not both:
        return None
    return _turn(np.stack([given[s] for s in both]), np.stack([known[s] for s in both]))


def _turn(poses: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """What takes all of these poses (n, 4, 4) to those: axes to axes; None: that does not."""
    turn = np.eye(4)
    turn[:3, :3] = np.round(poses[0, :3, :3] @ known[0, :3, :3].T)
    farthest = max(float(np.abs(poses[:, :3, 3]).max()), 1e-12)
    apart = np.abs(turn @ known - poses)[:, :3]
    agree = (apart <= _AGREE * np.array([1, 1, 1, farthest])).all()
    return turn if agree else None
