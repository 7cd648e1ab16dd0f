"""Meshes of other programs, written as a Mitsuba scene of grey parts."""

from __future__ import annotations

import io
import logging
import mmap
import re
import shutil
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from ..errors import UserError, named, printable
from ..io import require_file
from ..scene.meshes import HEADER, check_mesh
from ..scene.normals import repaired
from ..scene.triangles import creased, write_mesh
from .faults import Faults
from .gltf import GLTF, plain_nodes, turned_back
from .polygons import beyond_fans, fan, obj_in_triangles

#: Suffixes of the meshes that are read.
SUFFIXES = (".ply", ".obj", *GLTF)
#: Albedo and roughness of all parts: a fit does not read them.
_ALBEDO, _ROUGHNESS = 0.5, 0.5
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
        step: between positions as they were read, in units of the frame; 0: in double precision.
    """

    name: str
    positions: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None
    uv: np.ndarray | None
    step: float = 0.0

    @property
    def corners(self) -> np.ndarray:
        """The least and the largest coordinates, (2, 3)."""
        return np.stack([self.positions.min(0), self.positions.max(0)])

    def moved(self, matrix: np.ndarray) -> Part:
        """The part after a similarity (4, 4), float64."""
        linear = matrix[:3, :3]
        scale, normals = float(np.cbrt(np.linalg.det(linear))), None
        if self.normals is not None:
            normals = self.normals @ (linear.T / scale)
        positions = self.positions @ linear.T + matrix[:3, 3]
        return replace(self, positions=positions, normals=normals, step=self.step * scale)

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


def read_parts(files: Sequence[Path], faults: Faults, *, upright: bool = False) -> list[Part]:
    """The parts of meshes: objects and groups of an OBJ file, nodes of a glTF file, all of a PLY.

    Positions stay as they are, with the transforms of a glTF file's nodes. One that `unbake export`
    turned upright is turned back. Faces with more than three corners become triangles that fill
    them, also where they are not convex. Materials are not read.

    Args:
        files: PLY, OBJ, GLB or glTF.
        faults: all that is wrong is added to it.
        upright: nothing is turned back.
    """
    parts: list[Part] = []
    names = _Names()
    for file in files:
        with faults.collected(file):
            own = _read_ply(file)
            if own is not None:
                parts.append(replace(own, name=names.unique(file.stem)))
                continue
            back = None if upright else turned_back(file)
            for name, mesh, to_file in _loaded(file):
                part = _part(names.unique(name or file.stem), mesh, to_file, file)
                parts.append(part if back is None else part.moved(back))
    return parts


def check_place(parts: Sequence[Part], faults: Faults) -> None:
    """Find meshes that lose their shape in single precision, as they are far from the origin.

    Mitsuba has positions in single precision, and so have most files, before the mesh is moved.

    Args:
        parts: all of the geometry, in the frame of the cameras.
        faults: to add to.
    """
    if not parts:
        return
    corners = np.stack([part.corners for part in parts])
    extent = float(np.ptp(corners.reshape(-1, 3), axis=0).max())
    farthest = np.abs(corners).max(axis=(1, 2))
    steps = _steps(farthest)
    if not extent:
        faults.add("all vertices of the mesh lie at one point")
        return
    if not np.isfinite(steps).all():
        faults.add("the mesh has positions that are too large for single precision")
        return
    read = max(part.step for part in parts)
    if read > max(_COARSEST * extent, steps.max()):
        what = f"the mesh is {extent:.3g} units wide, and its positions were read in steps of "
        what += f"{read:.2g} units, as they are far from the origin in single precision"
        faults.add(what, remedy="Export it as OBJ, or near the origin")
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


def _steps(farthest: np.ndarray) -> np.ndarray:
    """Steps of single precision at distances from the origin; NaN where it has none so large."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.spacing(np.asarray(farthest, np.float32)).astype(np.float64)


def write_scene(
    parts: Sequence[Part],
    folder: Path,
    *,
    environment: bool,
    lamps: Mapping[str, Sequence[float]] | None = None,
) -> Path:
    """Write `scene.xml` and a PLY file for each part; returns its path.

    Every part has a material of its own, grey on both sides; that of lamps is black.

    Args:
        folder: its `meshes` are made here, and take the place of earlier ones.
        environment: add a constant one, of radiance 1.
        lamps: radiance of the parts that shine, linear RGB, by name.
    """
    lamps = lamps or {}
    shutil.rmtree(folder / "meshes", ignore_errors=True)
    (folder / "meshes").mkdir(parents=True)
    root = ElementTree.Element("scene", version=_VERSION)
    if environment:
        emitter = _add(root, "emitter", type="constant", id=_ENVIRONMENT)
        _add(emitter, "rgb", name="radiance", value="1")
    for part in parts:
        material, sides_of_it, shape_of_it = _ids(part.name)
        sides = _add(root, "bsdf", type="twosided", id=sides_of_it)
        bsdf = _add(sides, "bsdf", type="principled", id=material)
        albedo = 0.0 if part.name in lamps else _ALBEDO
        _add(bsdf, "rgb", name="base_color", value=f"{albedo:g}")
        _add(bsdf, "float", name="roughness", value=f"{_ROUGHNESS:g}")
        if part.name in lamps:
            _add(bsdf, "float", name="specular", value="0")
        part.write(folder / "meshes" / f"{part.name}.ply")
        shape = _add(root, "shape", type="ply", id=shape_of_it)
        _add(shape, "string", name="filename", value=f"meshes/{part.name}.ply")
        _add(shape, "ref", name="bsdf", id=sides_of_it)
        if part.name in lamps:
            emitter = _add(shape, "emitter", type="area")
            value = " ".join(f"{x:.6g}" for x in lamps[part.name])
            _add(emitter, "rgb", name="radiance", value=value)
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

    positions = table("vertex_positions", 3)
    return Part(
        file.stem,
        positions,
        np.array(params["faces"], np.int64).reshape(-1, 3),
        table("vertex_normals", 3) if _has_normals(file) else None,
        table("vertex_texcoords", 2) if mesh.has_vertex_texcoords() else None,
        float(_steps(np.abs(positions).max())),
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
        from trimesh.resolvers import FilePathResolver
    except ImportError:
        remedy = "pip install 'unbake[import]'"
        raise UserError("meshes need trimesh", file, remedy) from None
    require_file(file, "mesh")
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise UserError("the mesh is of a format that is not read (PLY, OBJ, GLB)", file)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    of_nodes = suffix in GLTF
    own = plain_nodes(file) if of_nodes else []
    options: dict[str, Any] = {"process": False}
    opened: Any = file
    if suffix == ".obj":
        # Not maintain_order: with it, trimesh 5.2 gives vertices the normals and texture
        # coordinates of others.
        options |= {"split_objects": True, "split_groups": True}
        _require_absolute(file)
        in_triangles = obj_in_triangles(file)
        if in_triangles is not None:
            opened = io.BytesIO(in_triangles)
            options |= {"file_type": "obj", "resolver": FilePathResolver(str(file))}
    if suffix == ".ply" and _has_normals(file):
        options["fix_texture"] = False  # it would forget normals
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # of textures that are not there
            scene = trimesh.load_scene(opened, **options)
        found = []
        for node in scene.graph.nodes_geometry:
            transform, name = scene.graph[node]
            mesh = scene.geometry[name]
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                mesh = _refilled(mesh, file, options) if suffix == ".ply" else mesh
                called = _called(scene, node, mesh, own) if of_nodes else str(name)
                found.append((called, mesh, np.array(transform)))
        found.sort(key=lambda row: (row[0], len(row[1].faces), *row[1].bounds.ravel()))
    except UserError:
        raise
    except Exception as error:  # readers of damaged files raise whatever they meet
        told = " ".join(str(error).split())[:160] or type(error).__name__
        remedy = "It may be incomplete: export it again, with triangulated faces, or as GLB"
        remedy = remedy if suffix == ".ply" else "It may be incomplete: export it again"
        raise UserError(f"the mesh cannot be read ({told})", file, remedy) from None
    if not found:
        raise UserError("the mesh has no triangles", file)
    if len(found) == 1 and not of_nodes:
        return [("", *found[0][1:])]
    return found


def _called(scene: Any, node: Any, mesh: Any, own: Collection[str]) -> str:
    """The name of a node of a glTF file; of one with several materials, with that of the part.

    trimesh 5.2 gives each material of a node a node of its own, with a random name.

    Args:
        scene: of trimesh.
        node: its name there.
        mesh: of that node.
        own: names of nodes in the file.
    """
    if str(node) in own:
        return str(node)
    parent = scene.graph.transforms.parents.get(node)
    if parent is None or not re.fullmatch(rf"{re.escape(str(parent))}_[0-9a-f]{{6}}", str(node)):
        return str(node)
    material = getattr(getattr(mesh.visual, "material", None), "name", None)
    return f"{parent}_{material}" if material else str(parent)


def _refilled(mesh: Any, file: Path, options: dict[str, Any]) -> Any:
    """The mesh of a PLY file, with triangles that fill its faces where fans do not.

    Args:
        mesh: as trimesh reads it, which keeps what the file holds.
        file: for the error message.
        options: that it was read with.
    """
    import trimesh
    from trimesh.exchange.ply import _elements_to_kwargs

    raw = mesh.metadata.get("_ply_raw", {})
    faces = _lists(raw, ("vertex_index", "vertex_indices"))
    if faces is None:
        return mesh
    vertices = np.column_stack([raw["vertex"]["data"][axis] for axis in "xyz"]).astype(np.float64)
    lengths, vertices_of = np.array([len(face) for face in faces]), np.concatenate(faces)
    own = beyond_fans(vertices, vertices_of, lengths, file)
    if not own:
        return mesh
    triangles = [own.get(number, fan(length)) for number, length in enumerate(lengths)]
    firsts = np.repeat(np.cumsum(lengths) - lengths, [len(each) for each in triangles])
    corners = np.concatenate(triangles) + firsts[:, None]
    data = {"vertex_indices": vertices_of[corners]}
    textures = _lists(raw, ("texcoord",))
    if textures is not None:
        uv = np.concatenate(textures).reshape(-1, 2)
        data["texcoord"] = uv[corners].reshape(-1, 6)
    raw["face"] |= {"data": data, "properties": {}}  # colours of faces are not read
    fix_texture = options.get("fix_texture", True)
    kwargs = _elements_to_kwargs(raw, fix_texture, None)
    return trimesh.Trimesh(**kwargs, process=False)


def _lists(raw: dict[str, Any], names: Sequence[str]) -> list[np.ndarray] | None:
    """A list of each face of a PLY file by the first of these names; None: it has none."""
    data = raw.get("face", {}).get("data")
    known = data.keys() if isinstance(data, dict) else getattr(data, "dtype", data).names or ()
    for name in names:
        if name in known:
            rows = data[name] if isinstance(data, dict) else data[name]["f1"]
            return [np.asarray(row) for row in rows]
    return None


def _part(name: str, mesh: Any, to_file: np.ndarray, file: Path) -> Part:
    linear = to_file[:3, :3]
    if not np.isfinite(to_file).all() or np.linalg.cond(linear) > 1e12:
        raise UserError(f"the transform of {printable(name)!r} flattens it", file)
    if np.ndim(mesh.vertices) != 2 or np.shape(mesh.vertices)[1] != 3:
        raise UserError("the mesh has vertices without three coordinates", file)
    with np.errstate(all="ignore"):  # that they are finite is looked at next
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
        with np.errstate(all="ignore"):  # those that are none are repaired
            found = np.array(mesh.vertex_normals, np.float64)[used] @ np.linalg.inv(linear)
        normals = _of_length_one(found, positions[used], faces)
    uv = getattr(mesh.visual, "uv", None)
    known = uv is not None and np.shape(uv) == (len(positions), 2) and np.isfinite(uv).all()
    # Corners of a PLY file's triangles may differ in their texture, but not in their normals.
    known = known and (normals is None or file.suffix.lower() != ".ply")
    own = np.array(uv, np.float64)[used] if known else None
    step = 0.0  # of OBJ, whose numbers are text
    if file.suffix.lower() != ".obj":
        step = float(_steps(np.abs(mesh.vertices[used]).max()) * np.linalg.norm(linear, 2))
    return Part(name, positions[used], faces, normals, own, step)


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


class _Names:
    """Names for files and for Mitsuba, unique also where case is not told apart."""

    def __init__(self) -> None:
        self._taken = {_ENVIRONMENT}
        self._next: dict[str, int] = {}

    def unique(self, name: str) -> str:
        """A name that no part has, nor any of its `_ids`, by a number if need be."""
        plain = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:60] or "part"
        count = self._next.get(plain.lower(), 1)
        found = plain if count == 1 else f"{plain}_{count}"
        while not self._taken.isdisjoint(key.lower() for key in _ids(found)):
            count += 1
            found = f"{plain}_{count}"
        self._next[plain.lower()] = count + 1
        self._taken.update(key.lower() for key in _ids(found))
        return found
