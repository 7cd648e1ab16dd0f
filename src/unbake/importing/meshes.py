"""Meshes of other programs, written as a Mitsuba scene of grey parts."""

from __future__ import annotations

import json
import logging
import mmap
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from ..errors import UserError, named, printable
from ..io import array, number, read_object, require_file
from ..scene.meshes import HEADER, check_mesh
from ..scene.normals import repaired
from ..scene.triangles import creased, write_mesh
from .faults import Faults

#: Suffixes of the meshes that are read.
SUFFIXES = (".ply", ".obj", ".glb", ".gltf")
#: Albedo and roughness of all parts: a fit does not read them.
_ALBEDO, _ROUGHNESS = 0.5, 0.5
#: Extensions of glTF that pack numbers, by what one may know them as.
_PACKED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
    "KHR_mesh_quantization": "quantized",
}
#: From y up to z up.
TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
#: Steps between positions in single precision, as a share of all geometry, that do not show.
_COARSEST = 1e-5
#: The same of the positions of one part, as a share of the largest part; and how many times as wide
#: as that the mesh is where a part is lost, and not one of many small ones.
_OF_PART, _LOST = 1e-4, 1e4
#: Of the constant environment.
_ENVIRONMENT = "environment"
_VERSION = "3.0.0"


@final
@dataclass(frozen=True, eq=False)
class Part:
    """A part of the geometry.

    Args:
        name: unique, of letters, digits, dashes and underscores.
        positions: (n, 3) float64, in the frame of the file.
        faces: (m, 3) indices.
        normals: (n, 3) of unit length as the file has them; None: it has none.
        uv: (n, 2), v upwards, as in OBJ and most PLY files; None where the file has none.
    """

    name: str
    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None

    @property
    def corners(self) -> np.ndarray:
        """The least and the largest coordinates, (2, 3)."""
        return np.stack([self.positions.min(0), self.positions.max(0)])

    def moved(self, matrix: np.ndarray) -> Part:
        """The part after a similarity (4, 4), float64."""
        linear = matrix[:3, :3]
        normals = None
        if self.normals is not None:
            normals = self.normals @ (linear.T / np.cbrt(np.linalg.det(linear)))
        return replace(self, positions=self.positions @ linear.T + matrix[:3, 3], normals=normals)

    def write(self, file: Path) -> None:
        """Write it as binary PLY for Mitsuba, to which v = 0 is the first row of an image.

        Without normals it is smooth, but at creases.
        """
        positions, faces, normals = self.positions, self.faces, self.normals
        uv = None if self.uv is None else self.uv * (1, -1) + (0, 1)
        if normals is None:
            vertices, faces, normals = creased(positions, faces)
            positions, uv = positions[vertices], None if uv is None else uv[vertices]
        write_mesh(file, positions, faces, normals, uv)


def read_parts(files: Sequence[Path], faults: Faults) -> list[Part]:
    """The parts of meshes: objects and groups of an OBJ file, nodes of a glTF file, all of a PLY.

    Positions stay as they are, with the transforms of a glTF file's nodes. Faces with more than
    three corners become triangles. Materials are not read.

    Args:
        files: PLY, OBJ, GLB or glTF.
        faults: all that is wrong is added to it.
    """
    parts: list[Part] = []
    for file in files:
        with faults.collected(file):
            own = _read_ply(file)
            if own is not None:
                parts.append(replace(own, name=_unique(file.stem, parts)))
                continue
            for name, mesh, to_file in _loaded(file):
                parts.append(_part(_unique(name or file.stem, parts), mesh, to_file, file))
    if parts:
        _check_place(parts, faults)
    return parts


def _check_place(parts: Sequence[Part], faults: Faults) -> None:
    """Meshes far from the origin lose their shape, as Mitsuba has them in single precision."""
    corners = np.stack([part.corners for part in parts])
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    farthest = np.abs(corners).max(axis=(1, 2))
    steps = np.spacing(farthest.astype(np.float32)).astype(np.float64)
    if not extent:
        faults.add("all vertices of the mesh lie at one point")
        return
    units, step = f"{farthest.max():.3g} units", f"{steps.max():.2g} units"
    place = f"up to {units} from the origin, where single precision has steps of {step}"
    remedy = "Move mesh and cameras to the origin together"
    if (steps > _COARSEST * extent).any():
        faults.add(f"the mesh is {extent:.3g} units wide and lies {place}", remedy=remedy)
        return
    largest = float(np.ptp(corners, axis=1).max())
    far = [p.name for p, step in zip(parts, steps, strict=True) if step > _OF_PART * largest]
    if far and extent > _LOST * largest:
        what = f"the largest part of the mesh is {largest:.3g} units wide, and some lie {place}"
        faults.add(what, named(far), "Remove these parts, or move them to the others")


def write_scene(parts: Sequence[Part], folder: Path, *, environment: bool) -> Path:
    """Write `scene.xml` and a PLY file for each part; returns its path.

    Every part has a material of its own, grey on both sides.

    Args:
        folder: made here.
        environment: add a constant one, of radiance 1.
    """
    (folder / "meshes").mkdir(parents=True)
    root = ElementTree.Element("scene", version=_VERSION)
    if environment:
        emitter = _add(root, "emitter", type="constant", id=_ENVIRONMENT)
        _add(emitter, "rgb", name="radiance", value="1")
    for part in parts:
        material, sides_of_it, shape_of_it = _ids(part.name)
        sides = _add(root, "bsdf", type="twosided", id=sides_of_it)
        bsdf = _add(sides, "bsdf", type="principled", id=material)
        _add(bsdf, "rgb", name="base_color", value=f"{_ALBEDO:g}")
        _add(bsdf, "float", name="roughness", value=f"{_ROUGHNESS:g}")
        part.write(folder / "meshes" / f"{part.name}.ply")
        shape = _add(root, "shape", type="ply", id=shape_of_it)
        _add(shape, "string", name="filename", value=f"meshes/{part.name}.ply")
        _add(shape, "ref", name="bsdf", id=sides_of_it)
    ElementTree.indent(root, space="    ")
    file = folder / "scene.xml"
    ElementTree.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)
    return file


def _add(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def _read_ply(file: Path) -> Part | None:
    """A PLY file of triangles as Mitsuba reads it; None where it cannot.

    trimesh 5.2 joins vertices of such files that have the same texture coordinates, and forgets
    normals then.
    """
    if file.suffix.lower() != ".ply" or not file.is_file():
        return None
    told = mi.log_level()
    try:
        check_mesh("ply", file)
        mi.set_log_level(mi.LogLevel.Error)  # it would warn that files of text are slow
        mesh: Any = mi.load_dict({"type": "ply", "filename": str(file)})
    except (UserError, RuntimeError):
        return None
    finally:
        mi.set_log_level(told)
    params = mi.traverse(mesh)

    def table(name: str, columns: int) -> np.ndarray:
        return np.array(params[name], np.float64).reshape(-1, columns)

    return Part(
        file.stem,
        table("vertex_positions", 3),
        np.array(params["faces"], np.int64).reshape(-1, 3),
        table("vertex_normals", 3) if _has_normals(file) else None,
        table("vertex_texcoords", 2) if mesh.has_vertex_texcoords() else None,
    )


def _has_normals(file: Path) -> bool:
    """Whether a PLY file has normals."""
    with file.open("rb") as opened:
        return re.search(rb"\n\s*property \w+ nx\s", opened.read(HEADER)) is not None


def _require_absolute(file: Path) -> None:
    """Refuse an OBJ file whose faces count corners backwards from where they stand.

    trimesh 5.2 counts from the end of the file, which is the same where all corners come first.
    """
    if not file.stat().st_size:
        return
    with file.open("rb") as opened, mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as all_:
        first = re.search(rb"(?m)^[ \t]*f[ \t][^\r\n#]*?[ \t/]-[0-9]", all_)
        if first and re.compile(rb"(?m)^[ \t]*v[tn]?[ \t]").search(all_, first.end()):
            what = "faces count vertices backwards (negative numbers), in parts of the file"
            remedy = "Export it with numbers from the start of the file, or as GLB or PLY"
            raise UserError(what, file, remedy)


def _loaded(file: Path) -> list[tuple[str, Any, np.ndarray]]:
    """The triangle meshes of a file: names, meshes, and what takes these to its frame, (4, 4)."""
    try:
        import trimesh
    except ImportError:
        remedy = "pip install 'unbake[import]'"
        raise UserError("meshes need trimesh", file, remedy) from None
    require_file(file, "mesh")
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError("the mesh is of a format that is not read (PLY, OBJ, GLB)", file)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    of_nodes = suffix in (".glb", ".gltf")
    if of_nodes:
        _require_plain(file)
    options: dict[str, Any] = {"process": False}
    if suffix == ".obj":
        # Not maintain_order: with it, trimesh 5.2 gives vertices the normals and texture
        # coordinates of others.
        options |= {"split_objects": True, "split_groups": True}
        _require_absolute(file)
    if suffix == ".ply" and _has_normals(file):
        options["fix_texture"] = False  # it would forget normals
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of textures that are not there
            scene = trimesh.load_scene(file, **options)
        found = []
        for node in sorted(scene.graph.nodes_geometry):
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                found.append((str(node if of_nodes else name), mesh, np.array(transform)))
    except Exception as error:  # readers of damaged files raise whatever they meet
        told = " ".join(str(error).split())[:160] or type(error).__name__
        raise UserError(f"the mesh cannot be read ({told})", file) from None
    if not found:
        raise UserError("the mesh has no triangles", file)
    if len(found) == 1 and not of_nodes:
        return [("", *found[0][1:])]
    return found


def _require_plain(file: Path) -> None:
    """Refuse a glTF file whose numbers are packed: trimesh 5.2 reads some as zeros."""
    try:
        with file.open("rb") as opened:
            head = opened.read(20)
            if head[:4] == b"glTF" and len(head) == 20:
                told = opened.read(int.from_bytes(head[12:16], "little"))
            else:
                told = head + opened.read()
        top = json.loads(told)
        packed = [_PACKED[name] for name in top.get("extensionsRequired", ()) if name in _PACKED]
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return  # trimesh tells what is wrong with it
    if packed:
        what = f"the mesh is compressed ({', '.join(packed)})"
        raise UserError(what, file, "Export it without compression")


def read_transform(file: Path) -> np.ndarray:
    """What takes a mesh of `ns-export` back to the frame of COLMAP, (4, 4) float64.

    Args:
        file: the `dataparser_transforms.json` of the run: `transform` (3, 4) and `scale`, which
            have taken the cameras to the frame that it trained in.

    Raises:
        UserError: the file is of another kind.
    """
    top = read_object(file)
    forwards = np.eye(4)
    forwards[:3] = array(top, "transform", (3, 4), str(file))
    scale = number(top, "scale", str(file))
    rotation = forwards[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-4 or np.linalg.det(rotation) < 0:
        raise UserError("'transform' is no rotation with a translation", file)
    if not scale > 0:
        raise UserError("'scale' is not positive", file)
    forwards[:3] *= scale
    return np.linalg.inv(forwards)


def _part(name: str, mesh: Any, to_file: np.ndarray, file: Path) -> Part:
    linear = to_file[:3, :3]
    if not np.isfinite(to_file).all() or np.linalg.cond(linear) > 1e12:
        raise UserError(f"the transform of {printable(name)!r} flattens it", file)
    positions = np.array(mesh.vertices, np.float64) @ linear.T + to_file[:3, 3]
    faces = np.array(mesh.faces, np.int64)
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    if not np.isfinite(positions).all():
        raise UserError("the mesh has vertices that are not finite", file)
    if faces.min() < 0 or faces.max() >= len(positions):
        raise UserError("the mesh has triangles of vertices that it does not have", file)
    # Parts of an OBJ file share its vertices
    used, places = np.unique(faces, return_inverse=True)
    faces, normals = places.reshape(faces.shape), None
    # Where the file has none, trimesh 5.2 makes them up at this very access, and keeps them there.
    if "vertex_normals" in mesh._cache and np.shape(mesh.vertex_normals) == positions.shape:
        found = np.array(mesh.vertex_normals, np.float64)[used] @ np.linalg.inv(linear)
        normals = _of_length_one(found, positions[used], faces)
    uv = getattr(mesh.visual, "uv", None)
    known = uv is not None and np.shape(uv) == (len(positions), 2) and np.isfinite(uv).all()
    # Corners of a PLY file's triangles may differ in their texture, but not in their normals.
    known = known and (normals is None or file.suffix.lower() != ".ply")
    return Part(
        name, positions[used], faces, normals, np.array(uv, np.float64)[used] if known else None
    )


def _of_length_one(
    normals: np.ndarray, positions: np.ndarray, faces: np.ndarray
) -> np.ndarray | None:
    """Normals of length 1, (n, 3), what is none repaired; None where no vertex has one."""
    length = np.linalg.norm(normals, axis=1)
    broken = ~(np.isfinite(length) & (length > 0))
    if broken.all():
        return None
    found = normals / np.where(broken, 1, length)[:, None]
    return repaired(found, broken, positions, faces) if broken.any() else found


def _ids(name: str) -> tuple[str, str, str]:
    """What a part is called in the scene: its material, both sides of that, and its shape."""
    return name, f"{name}_sides", f"{name}_shape"


def _unique(name: str, parts: Sequence[Part]) -> str:
    """A name for files and for Mitsuba that no part has, also where case is not told apart."""
    taken = {_ENVIRONMENT, *(key.lower() for part in parts for key in _ids(part.name))}
    plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:60] or "part"
    found, number = plain, 1
    while not taken.isdisjoint(key.lower() for key in _ids(found)):
        number += 1
        found = f"{plain}_{number}"
    return found
