"""The parts of a scene as its author gave them: shapes with names, triangles and materials."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.pieces import Pieces
from ..fields.shapes import PlacedShape, placed_shapes
from ..scene import edit
from ..scene.parse import ParsedScene, parse
from ..scene.transforms import chosen_id
from ..scene.triangles import doubled_normals, unit
from .tessellate import TESSELLATED, Triangles, tessellated

#: What meshes have besides the values stored in them.
_BUFFERS = ("vertex_positions", "vertex_normals", "vertex_texcoords")
#: By which a shape that was made is found among the nodes.
_ID = "shape node {}"


@dataclass(frozen=True, eq=False)
class Part:
    """A shape of the scene, once for each place that it stands at."""

    #: Unique: its id, else the name of its file, else its plugin and a number; of what an instance
    #: places, the instance's id where it has one, with that behind it in a group of several shapes.
    name: str
    node: int  #: among the nodes of the parsed scene
    bsdf: int | None  #: the node of its outermost BSDF
    emitter: int | None  #: the node of its emitter
    materials: tuple[int, ...]  #: numbers of its `principled` BSDFs, as in `edit.material_names`
    triangles: Triangles  #: in world space
    two_sided: bool  #: both sides reflect
    exact: bool  #: False: the shape was round, and became triangles
    instanced: bool  #: it stands in a group, which instances place
    dropped: int  #: triangles without an area, which were left out
    pieces: np.ndarray | None = None  #: (m, 3) of each triangle, as `Pieces.of` tells them
    is_pane: bool = False  #: thin glass, which both sides show
    is_shown: bool = True  #: it is no mere boundary, which pictures do not show
    masks: tuple[int, ...] = ()  #: the nodes of the masks around its BSDF, the outermost first
    is_bumped: bool = False  #: it has a bump map

    @property
    def is_optimized(self) -> bool:
        """Whether a fit optimizes its material; see `transport/optimized.py`."""
        return bool(self.materials) and self.emitter is None


@dataclass(frozen=True)
class Parts:
    """All parts of a scene, and shapes that cannot become triangles."""

    scene: ParsedScene  #: whose nodes the numbers of the parts are of
    parts: list[Part]
    left_out: list[str]  #: names of shapes that are no surfaces of triangles

    def without(self, known: Collection[int]) -> Parts:
        """The same, but for materials of these numbers, which no fit changes: no part has them."""
        parts = [
            replace(part, materials=tuple(n for n in part.materials if n not in known))
            for part in self.parts
        ]
        return replace(self, parts=parts)


def parsed_principled(path: Path, root: Path) -> ParsedScene:
    """The scene of a data set with the BSDFs that a fit sees."""
    scene = parse(path, root)
    edit.to_principled(scene)
    return scene


def read_parts(path: Path, root: Path, pieces: Pieces | None = None) -> Parts:
    """Load the scene of a data set, unmerged.

    Args:
        path: the scene.
        root: folder that its files must not leave.
        pieces: of surface that fields tell apart.

    Raises:
        UserError: the scene cannot be loaded, or holds nothing that can be exported.
    """
    scene = parsed_principled(path, root)
    nodes = scene.state.nodes
    names = _names(scene)
    materials = {node: number for number, node in enumerate(scene.principled_indices())}
    described = {i: _described(scene, i, materials) for i in names}
    made = _instantiated(path, root, list(names))
    numbers = {_ID.format(i): i for i in names}
    parts, left_out = [], []
    taken: set[str] = set()
    everything = placed_shapes(made)
    together = Counter(each.instance.id() for each in everything if each.instance is not None)
    for placed in everything:
        i = numbers[placed.shape.id()]
        name = names[i]
        if placed.instance is not None:
            by = placed.instance.id()
            if chosen := chosen_id(nodes[numbers[by]]):
                name = chosen if together[by] == 1 else f"{chosen}/{name}"
        triangles = _triangles(placed, nodes[i].props)
        if triangles is None:
            left_out.append(names[i])
            continue
        sound, kept = _sound(triangles)
        if not len(sound.faces):
            left_out.append(names[i])
            continue
        part = replace(
            described[i],
            name=_unique(name, taken),
            triangles=sound,
            exact=placed.shape.is_mesh(),
            instanced=placed.to_world is not None,
            dropped=int((~kept).sum()),
        )
        if pieces is not None:
            known = pieces.of(placed.shape)
            every = np.broadcast_to(known, (len(kept), 3)) if len(known) == 1 else known
            part = replace(part, pieces=every[kept])
        parts.append(part)
    if not parts:
        raise UserError("the scene has no shape that can be exported", path)
    return Parts(scene, parts, left_out)


def _instantiated(path: Path, root: Path, shapes: list[int]) -> mi.Scene:
    """The scene, whose shapes have ids by the numbers of their nodes."""
    scene = parsed_principled(path, root)
    for i in shapes:
        scene.state.nodes[i].props.set_id(_ID.format(i))
    return scene.instantiate(merge=False)


def _described(scene: ParsedScene, node: int, materials: Mapping[int, int]) -> Part:
    """What the nodes say of a shape.

    Args:
        materials: numbers of the `principled` BSDFs, by their nodes.
    """
    nodes = scene.state.nodes
    inside = scene.references(node)
    bsdf = next((i for i in inside if nodes[i].type == mi.ObjectType.BSDF), None)
    emitter = next((i for i in inside if nodes[i].type == mi.ObjectType.Emitter), None)
    found = [] if bsdf is None else scene.reachable(bsdf)
    plugins = {nodes[i].props.plugin_name() for i in found}
    return Part(
        name="",
        node=node,
        bsdf=bsdf,
        emitter=emitter,
        materials=tuple(materials[i] for i in found if i in materials),
        triangles=_NOTHING,
        two_sided="twosided" in plugins,
        exact=True,
        instanced=False,
        dropped=0,
        is_pane="thindielectric" in plugins,
        masks=_masks(scene, bsdf),
        is_bumped="bumpmap" in plugins,
        is_shown=emitter is not None or bsdf is None or nodes[bsdf].props.plugin_name() != "null",
    )


def _masks(scene: ParsedScene, bsdf: int | None) -> tuple[int, ...]:
    """The nodes of the masks around a BSDF, the outermost first: no other BSDF may hold one."""
    nodes, found = scene.state.nodes, []
    while bsdf is not None and nodes[bsdf].props.plugin_name() == "mask":
        found.append(bsdf)
        inside = scene.references(bsdf)
        bsdf = next((i for i in inside if nodes[i].type == mi.ObjectType.BSDF), None)
    return tuple(found)


_NOTHING = Triangles(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32), None, None)


def _names(scene: ParsedScene) -> dict[int, str]:
    """The names of all shapes, by the numbers of their nodes."""
    names = {}
    for i, node in enumerate(scene.state.nodes):
        if node.type == mi.ObjectType.Shape:
            # Shapes need no id, and data sets of earlier versions have lost theirs.
            stem = Path(str(node.props.get("filename", ""))).stem
            names[i] = chosen_id(node) or stem or f"{node.props.plugin_name()}-{len(names)}"
    return names


def _unique(name: str, taken: set[str]) -> str:
    number, chosen = 1, name
    while chosen in taken:
        number += 1
        chosen = f"{name}-{number}"
    taken.add(chosen)
    return chosen


def unique_names(names: list[str], clean: Callable[[str], str] = str) -> list[str]:
    """These names, with a number behind those that are taken."""
    taken: set[str] = set()
    return [_unique(clean(name), taken) for name in names]


def _triangles(placed: PlacedShape, props: mi.Properties) -> Triangles | None:
    """A shape in world space; None if it is no surface that becomes triangles."""
    shape = placed.shape
    if shape.is_mesh():
        mesh = _of_mesh(shape)
    elif props.plugin_name() in TESSELLATED:
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, np.float64).reshape(4, 4)
        mesh = tessellated(props.plugin_name()).moved(matrix)
        mesh = mesh.turned() if _is_turned(shape, props) else mesh
    else:
        return None
    return mesh if placed.to_world is None else mesh.moved(placed.to_world)


def _is_turned(shape: mi.Shape, props: mi.Properties) -> bool:
    """Whether Mitsuba's normals are opposite to those of the shape's transform.

    Of disks the transform itself is turned. Spheres that are mirrored are turned once more.
    """
    plugin = props.plugin_name()
    if plugin == "disk":
        return False
    return shape.has_flipped_normals() if plugin == "sphere" else props.get("flip_normals", False)


def _of_mesh(mesh: mi.Mesh) -> Triangles:
    positions = np.array(mesh.vertex_positions_buffer(), np.float32).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer(), np.uint32).reshape(-1, 3)
    normals = uv = None
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        normals = unit(np.array(mesh.vertex_normals_buffer(), np.float32).reshape(-1, 3))
    if mesh.has_vertex_texcoords():
        uv = np.array(mesh.vertex_texcoords_buffer(), np.float32).reshape(-1, 2)
    made = Triangles(positions, faces, normals, uv, _stored(mesh))
    return _as_shaded(_as_seen(mesh, made))


def _stored(mesh: mi.Mesh) -> dict[str, np.ndarray]:
    """The values stored in a mesh."""
    if not mesh.has_mesh_attributes():
        return {}
    rows = {"vertex": mesh.vertex_count(), "face": mesh.face_count()}
    params = mi.traverse(mesh)
    return {
        name: np.array(params[name], np.float32).reshape(rows[name.split("_")[0]], -1)
        for name in params.keys()  # noqa: SIM118 - it is no dictionary
        if name.startswith(("vertex_", "face_"))
        and mesh.has_attribute(name)
        and name not in _BUFFERS
    }


def _as_shaded(triangles: Triangles) -> Triangles:
    """The triangles wound to the side of their normals, which Mitsuba shades by.

    Files may have them the other way around, and a scale below zero turns them.
    """
    if triangles.normals is None:
        return triangles
    shading = triangles.normals[triangles.faces].sum(1)
    against = (doubled_normals(triangles.positions, triangles.faces) * shading).sum(1) < 0
    faces = np.where(against[:, None], triangles.faces[:, ::-1], triangles.faces)
    return replace(triangles, faces=np.ascontiguousarray(faces))


def _as_seen(mesh: mi.Mesh, triangles: Triangles) -> Triangles:
    """The triangles with normals on the side where Mitsuba has them, which may flip them."""
    if not mesh.has_flipped_normals():
        return triangles
    largest = int(np.argmax(triangles.areas()))
    corners = triangles.faces[largest]
    a, b, c = triangles.positions[corners].astype(np.float64)
    hit = dr.zeros(mi.PreliminaryIntersection3f)
    hit.t, hit.shape = mi.Float(1), mi.ShapePtr(mesh)
    hit.prim_index, hit.prim_uv = mi.UInt32(largest), mi.Point2f(1 / 3)
    si = mesh.compute_surface_interaction(dr.zeros(mi.Ray3f), hit)
    n, shading = np.ravel(np.array(si.n)), np.ravel(np.array(si.sh_frame.n))
    if n @ np.cross(b - a, c - a) < 0:
        triangles = triangles.reversed_faces()
    if triangles.normals is not None and shading @ triangles.normals[corners].sum(0) < 0:
        triangles = replace(triangles, normals=-triangles.normals)
    return triangles


def _sound(triangles: Triangles) -> tuple[Triangles, np.ndarray]:
    """The triangles without those of no area, with the vertices that they use; which are kept."""
    kept = triangles.areas() > 0
    used, faces = np.unique(triangles.faces[kept], return_inverse=True)
    return triangles.of_vertices(used, faces.reshape(-1, 3).astype(np.uint32), kept), kept
