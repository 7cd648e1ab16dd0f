"""What glTF files tell before their meshes are read: names, packing, and which way is up."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..acquisition.new_light import axis_of
from ..dataset.camera import Camera, rotation_of, up_of
from ..errors import UserError, named

#: Suffixes of such files.
GLTF = (".glb", ".gltf")
#: The node that `exports/gltf.py` puts around all, to turn it upright; and who writes it.
_UPRIGHT, _WRITER = "upright", "unbake "
#: Extensions of glTF that pack numbers, by what one may know them as.
_PACKED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
    "KHR_mesh_quantization": "quantized",
}


def plain_nodes(file: Path) -> list[str]:
    """The names of a glTF file's nodes.

    Raises:
        UserError: its numbers are packed, of which trimesh 5.2 reads some as zeros.
    """
    try:
        top = _document(file)
        packed = [_PACKED[name] for name in top.get("extensionsRequired", ()) if name in _PACKED]
        names = [str(node.get("name")) for node in top.get("nodes", ())]
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return []  # trimesh tells what is wrong with it
    if packed:
        what = f"the mesh is compressed ({', '.join(packed)})"
        raise UserError(what, file, "Export it without compression")
    return names


def turned_back(file: Path) -> np.ndarray | None:
    """What takes a mesh that `unbake export` turned or scaled to the axes and units of its scene.

    Returns:
        (4, 4); None: the file is of another kind, or nothing was turned or scaled.
    """
    top = _own_document(file)
    return None if top is None else _back(top)


def _back(top: Any) -> np.ndarray | None:
    """The same, of what a file holds."""
    try:
        (root,) = top["scenes"][0]["nodes"]
        node = top["nodes"][root]
        x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
        scale, *_ = (float(value) for value in node.get("scale", (1, 1, 1)))
    except (OSError, ValueError, TypeError, AttributeError, LookupError, RecursionError):
        return None
    length = float(np.linalg.norm((x, y, z, w)))
    sound = np.isfinite(length) and length > 0 and np.isfinite(scale) and scale > 0
    if node.get("name") != _UPRIGHT or not sound:
        return None
    found = np.eye(4)
    found[:3, :3] = rotation_of(np.array((-x, -y, -z, w)) / length) / scale
    return None if np.array_equal(found, np.eye(4)) else found


def told_up(
    files: Sequence[Path], cameras: Sequence[Camera], *, upright: bool, moved: bool
) -> list[str]:
    """What people should know of which way is up in meshes.

    Args:
        files: meshes of all kinds.
        cameras: of the photographs.
        upright: whether the mesh was turned as one with y up.
        moved: whether the user told how it lies in another way.
    """
    if upright:
        return []
    own, others = [], False
    for file in (file for file in files if file.suffix.lower() in GLTF):
        top = _own_document(file)
        others |= top is None
        own += [str(file)] if top is not None and _back(top) is not None else []
    notes = (
        [f"mesh: of an export of unbake, taken back to the axes and units there: {named(own)}"]
        if own
        else []
    )
    if others and not moved and axis_of(up_of(cameras)) == "+z":
        notes.append(
            "GLB files have y up by their specification, and the cameras z: if the mesh lies on "
            "its side, import it with --mesh-y-up"
        )
    return notes


def _own_document(file: Path) -> Any:
    """The JSON of a glTF file that `unbake export` wrote; None of any other file."""
    if file.suffix.lower() not in GLTF:
        return None
    try:
        top = _document(file)
        return top if str(top["asset"]["generator"]).startswith(_WRITER) else None
    except (OSError, ValueError, TypeError, LookupError, RecursionError):
        return None


def _document(file: Path) -> Any:
    """The JSON of a glTF file, which may be anything.

    Raises:
        OSError, ValueError, RecursionError: there is none.
    """
    with file.open("rb") as opened:
        head = opened.read(20)
        if head[:4] == b"glTF" and len(head) == 20:
            return json.loads(opened.read(int.from_bytes(head[12:16], "little")))
        return json.loads(head + opened.read())
