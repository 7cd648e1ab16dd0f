"""Mitsuba scenes in Mitsuba's own parsed form (`mi.parser`): read, instantiated, written."""

from __future__ import annotations

import re
import shutil
import sys
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..backend import mitsuba_folder
from ..errors import UserError
from ..fields.shapes import met_shapes
from .bumps import turn_rectangles, turn_textures
from .files import find
from .images import IMAGES, check_image
from .meshes import FORMATS, check_mesh
from .normals import repair_normals
from .preflight import check_xml
from .textures import require_able
from .transforms import matrix_of, write_nodes

_PLUGIN_NAME = re.compile(r"[A-Za-z0-9_]{1,100}", re.ASCII)
#: Plugins for spectra and polarised light, and spectra that have no RGB.
_SPECTRAL, _WITHOUT_RGB = ("specfilm", "stokes"), ("blackbody", "irregular", "regular")
#: Names of a film's properties begin so: its size, and what of it is rendered.
_FILM = ("width", "height", "crop_")
#: Properties of films of older versions, as these and as Mitsuba's own upgrade spell them.
_OLD_FILM = {
    *("attachLog", "attach_log", "banner", "burn", "componentFormat", "exposure", "fileFormat"),
    *("gamma", "highQualityEdges", "high_quality_edges", "key", "pixelFormat"),
    *("tonemapMethod", "tonemap_method"),
}
_LIBRARY = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
#: Properties without which Mitsuba 3.9 crashes (segmentation fault) where other plugins complain.
_NEEDED = {"bitmap": "filename", "blendbsdf": "weight"}
#: Where copies of files go, by what names them.
_FOLDERS = {
    mi.ObjectType.Shape: "meshes",
    mi.ObjectType.Texture: "textures",
    mi.ObjectType.Emitter: "textures",
}
#: What stands for parts of a scene that nothing uses, by their types.
_UNUSED = {
    mi.ObjectType.Integrator: "path",
    mi.ObjectType.Film: "hdrfilm",
    mi.ObjectType.Sampler: "independent",
}
#: Shapes without a file, and how many axes of each must have one scale.
_ROUND = {"sphere": 3, "cylinder": 2, "disk": 0, "rectangle": 0, "cube": 0}
#: Scales that differ by this part of the larger one are not the same.
_UNEVEN = 1e-3


@dataclass
class ParsedScene:
    """A scene before it is instantiated: nodes that `edit` can change."""

    path: Path
    root: Path  #: folder that holds all its files
    config: mi.parser.ParserConfig
    state: mi.parser.ParserState
    #: Vertex normals that were not numbers, and were replaced when the scene was made.
    repaired_normals: int = 0
    #: Shapes and sensors whose participating media are left out.
    media: int = 0

    def instantiate(self, *, merge: bool = True, bitmaps: bool = True) -> mi.Scene:
        """Make the scene, once: the nodes cannot be used again.

        Args:
            merge: equal materials become one, and meshes that share a material one mesh: tracing a
                step takes longer with every object that a ray can hit. Without it, shapes keep
                their ids.
            bitmaps: without them, those of BSDFs are not loaded but grey, except for opacities.
                Shapes, the kinds of their BSDFs and what rays meet are the same.

        Raises:
            UserError: Mitsuba cannot instantiate the scene.
        """
        try:
            self._forget_queries()
            turn_rectangles(self)
            if merge:
                mi.parser.transform_merge_equivalent(self.config, self.state)
                self._merge_meshes()
            if not bitmaps:  # last, as what differs in its bitmap alone would be merged
                self._leave_out_bitmaps()
            scene = mi.parser.instantiate(self.config, self.state)
        except (RuntimeError, ValueError, MemoryError) as error:
            # Mitsuba 3.9: emitters that were made although their shapes were not crash the process
            # in the next virtual call. They live as long as the nodes, which this error keeps.
            self.state = mi.parser.ParserState()
            raise UserError(f"Mitsuba cannot make this scene: {reason(error)}", self.path) from None
        scene = scene[0] if isinstance(scene, list) else scene
        fault = _fault(scene)
        if fault is not None:
            # Dr.Jit calls all shapes that live, and fails at a mesh without triangles in whatever
            # scene is traced next. The traceback of this error keeps what it can reach.
            del scene
            self.state = mi.parser.ParserState()
            raise UserError(fault[0], self.path, fault[1])
        self.repaired_normals = repair_normals(scene)
        turn_textures(scene)
        return scene

    def _forget_queries(self) -> None:
        """Let Mitsuba find misspelt properties: reading one has marked it as known."""
        for node in self.state.nodes:
            for key in list(node.props):
                node.props.mark_queried(key, False)

    def _leave_out_bitmaps(self) -> None:
        """Make bitmaps grey that only BSDFs other than masks refer to."""
        nodes = self.state.nodes
        kept = {
            inner
            for place, node in enumerate(nodes)
            if node.type != mi.ObjectType.BSDF or node.props.plugin_name() == "mask"
            for inner in self.references(place)
        }
        for place, node in enumerate(nodes):
            if node.props.plugin_name() != "bitmap" or place in kept:
                continue
            for key in list(node.props):
                del node.props[key]
            node.props.set_plugin_name("uniform")
            node.props["value"] = 0.5

    def _merge_meshes(self) -> None:
        """Merge meshes of one material, but no rectangles; flipped normals among themselves.

        Mitsuba 3.9 would merge meshes with flipped normals and others, and fails: "Mesh::merge():
        the two meshes are incompatible". What it merges with a rectangle has a box without the
        rectangle, and so has the scene: light from outside would pass through what is beyond.
        """
        mi.parser.transform_merge_meshes(self.config, self.state)
        nodes, root = self.state.nodes, self.state.root.props
        merged = nodes[len(nodes) - 1].props
        if merged.plugin_name() != "merge":
            return
        for key in list(merged):
            if nodes[merged[key].index()].props.plugin_name() == "rectangle":
                root[f"rectangle {key}"] = merged[key]
                del merged[key]
        every = list(merged)
        if not every:  # a shape of its own would stay, of which no ray knows
            for key in list(root):
                if is_reference(root[key]) and root[key].index() == len(nodes) - 1:
                    del root[key]
            return
        inward = [k for k in every if nodes[merged[k].index()].props.get("flip_normals", False)]
        if not 0 < len(inward) < len(every):
            return
        flipped = mi.parser.SceneNode()
        flipped.type = mi.ObjectType.Shape
        flipped.props.set_plugin_name("merge")
        for key in inward:
            flipped.props[key] = merged[key]
            del merged[key]
        root["flipped meshes"] = mi.Properties.ResolvedReference(len(nodes))
        nodes.append(flipped)

    def principled_nodes(self) -> list:
        """The BSDF nodes whose textures can be replaced."""
        return [self.state.nodes[i] for i in self.principled_indices()]

    def principled_indices(self) -> list[int]:
        """Their places among the nodes; their places in this list are the numbers of materials."""
        nodes = self.state.nodes
        return [i for i, node in enumerate(nodes) if node.props.plugin_name() == "principled"]

    def append(self, node: mi.parser.SceneNode) -> int:
        """Append a node and return its number; all handles of other nodes are void after it."""
        self.state.nodes.append(node)
        return len(self.state.nodes) - 1

    def append_to_root(self, key: str, node: mi.parser.SceneNode) -> None:
        """Append a node, and refer to it from the scene itself by this name."""
        number = self.append(node)
        self.state.root.props[key] = mi.Properties.ResolvedReference(number)

    def references(self, index: int) -> list[int]:
        """The places of the nodes that a node refers to, in the order of its properties."""
        props = self.state.nodes[index].props
        return [props[key].index() for key in list(props) if is_reference(props[key])]

    def reachable(self, index: int) -> list[int]:
        """The places of a node and of all nodes in it, each once, nearer ones first."""
        found = {index: None}
        waiting = deque(found)
        while waiting:
            inner = [i for i in self.references(waiting.popleft()) if i not in found]
            waiting.extend(dict.fromkeys(inner))
            found |= dict.fromkeys(inner)
        return list(found)


def parse(path: Path, root: Path | None = None) -> ParsedScene:
    """Parse a Mitsuba XML scene and resolve its references.

    No file that the scene names is loaded yet, and of plugins integrators and samplers alone.

    Args:
        path: the scene.
        root: folder that the scene's files must not leave, links resolved; None: the scene's own.

    Raises:
        UserError: the file is missing or is not a Mitsuba scene, has a number that is not finite,
            or names a plugin that is not Mitsuba's or a file that is missing, damaged or outside.
    """
    if not path.is_file():
        raise UserError("no such scene file", where=path)
    root = (path.parent if root is None else root).resolve()
    folders = check_xml(path, root)
    config = mi.parser.ParserConfig(mi.variant())
    # Mitsuba 3.9 ends the process if a node fails on another thread, such as a bitmap that is cut
    # off ("terminate called"), or tells an error that another one caused. It is no faster there.
    config.parallel = False
    try:
        state = mi.parser.parse_file(config, str(path))
        mi.parser.transform_upgrade(config, state)
        mi.parser.transform_resolve(config, state)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"not a scene that Mitsuba can read: {reason(error)}", path) from None
    scene = ParsedScene(path, root, config, state)
    _require_own_plugins(scene)
    _replace_unused(scene)
    _require_finite(scene)
    _require_round(scene)
    _require_needed(scene)
    _resolve_files(scene, folders)
    scene.media = _leave_out_media(scene)
    require_able(scene)
    _require_rgb(scene)
    return scene


def write(scene: ParsedScene, folder: Path) -> Path:
    """Write the scene and copies of all its files into a folder, as `scene.xml`.

    Shapes, materials and lights keep ids that somebody chose. Files that lie in the folder already
    are left where they are.

    Raises:
        UserError: a file cannot be copied.
    """
    copies: dict[str, str] = {}
    try:
        for node in scene.state.nodes:
            if "filename" in node.props:
                source = node.props["filename"]
                if source not in copies:
                    copies[source] = _copy(Path(source), folder, _FOLDERS.get(node.type, "assets"))
                node.props["filename"] = copies[source]
        write_nodes(scene, folder / "scene.xml")
    except (RuntimeError, ValueError) as error:
        raise UserError(f"cannot be copied: {reason(error)}", scene.path) from None
    return folder / "scene.xml"


def _leave_out_media(scene: ParsedScene) -> int:
    """Take participating media from shapes and sensors, and count these: nothing here has them."""
    nodes, count = scene.state.nodes, 0
    for node in nodes:
        media = [
            key
            for key in list(node.props)
            if is_reference(node.props[key])
            and nodes[node.props[key].index()].type == mi.ObjectType.Medium
        ]
        for key in media:
            del node.props[key]
        count += bool(media)
    if count:
        _leave_out_shells(scene)
    return count


def _leave_out_shells(scene: ParsedScene) -> None:
    """Take out shapes that only held a medium: without it they are nothing."""
    nodes = scene.state.nodes

    def is_shell(place: int) -> bool:
        kinds = [nodes[i] for i in scene.references(place)]
        dark = all(node.type != mi.ObjectType.Emitter for node in kinds)
        return dark and any(node.props.plugin_name() == "null" for node in kinds)

    shells = {
        place
        for place, node in enumerate(nodes)
        if node.type == mi.ObjectType.Shape and is_shell(place)
    }
    for node in nodes:
        for key in list(node.props):
            if is_reference(node.props[key]) and node.props[key].index() in shells:
                del node.props[key]


def _fault(scene: mi.Scene) -> tuple[str, str | None] | None:
    """What makes a scene that Mitsuba made useless, and the remedy."""
    box = np.ravel([scene.bbox().min, scene.bbox().max])
    if not np.isfinite(box).all():
        return "the scene has no shapes, or one without end", None
    if np.ptp(box.reshape(2, 3), axis=0).max() == 0:
        return "all shapes of the scene lie in one point", "Correct their transforms"
    for shape in met_shapes(scene):
        # Dr.Jit 1.5 cannot look up the corners of what was hit where a mesh has none at all.
        if isinstance(shape, mi.Mesh) and not shape.face_count():
            return f"the mesh {shape.id()!r} has no triangles", "Remove it"
    return None


def _copy(source: Path, folder: Path, kind: str) -> str:
    """Copy a file into a folder's folder; its path in there, with a number where it is taken."""
    if source.is_relative_to(folder):
        return source.relative_to(folder).as_posix()
    (folder / kind).mkdir(exist_ok=True)
    target, number = folder / kind / source.name, 0
    while target.exists():
        number += 1
        target = target.with_name(f"{source.stem} ({number}){source.suffix}")
    shutil.copyfile(source, target)
    return target.relative_to(folder).as_posix()


def referenced(scene: ParsedScene, value: Any) -> Any | None:
    """The node that a property refers to; None if it is no reference."""
    return scene.state.nodes[value.index()] if is_reference(value) else None


def is_reference(value: object) -> bool:
    """Whether the value of a property is a reference to another node."""
    return isinstance(value, mi.Properties.ResolvedReference)


def _require_own_plugins(scene: ParsedScene) -> None:
    """Raise a `UserError` where Mitsuba would run code that is not its own."""
    own = mitsuba_folder() / "plugins"
    for name in sorted({node.props.plugin_name() for node in scene.state.nodes}):
        named = _PLUGIN_NAME.fullmatch(name) is not None
        if named:
            # Where Mitsuba has no plugin of that name, it takes one of the working folder.
            library = Path(str(mi.file_resolver().resolve(f"plugins/{name}{_LIBRARY}")))
            named = not library.exists() or library.resolve().parent == own
        if not named:
            node = next(n for n in scene.state.nodes if n.props.plugin_name() == name)
            where = mi.parser.file_location(scene.state, node)
            raise UserError(
                f"the type {name[:80]!r} is no plugin of Mitsuba", where, "Correct its name"
            )


def _replace_unused(scene: ParsedScene) -> None:
    """Put usual plugins in place of those that Mitsuba cannot make here, and that nothing uses.

    Integrators and samplers of a scene are not used, nor is more of a film than its size. They may
    be of older versions of Mitsuba, have properties of these, or be for spectra and polarisation.
    """
    own = mitsuba_folder() / "plugins"
    for node in scene.state.nodes:
        usual, name = _UNUSED.get(node.type), node.props.plugin_name()
        if usual is None:
            continue
        known = name not in _SPECTRAL and (own / f"{name}{_LIBRARY}").exists()
        if known and node.type == mi.ObjectType.Film:  # its size is used
            for key in list(node.props):
                if key in _OLD_FILM:
                    del node.props[key]
            continue
        if known and _can_be_made(node):
            continue
        node.props.set_plugin_name(usual)
        for key in list(node.props):
            if node.type != mi.ObjectType.Film or not key.startswith(_FILM):
                del node.props[key]


def _can_be_made(node: mi.parser.SceneNode) -> bool:
    """Whether a plugin knows all the properties of an integrator or a sampler.

    Integrators in others are not tried, nor are those around them, nor plugins of another kind than
    the node, of which scenes are refused later.
    """
    name = node.props.plugin_name()
    if mi.PluginManager.instance().plugin_type(name) != node.type:
        return True
    values = {key: node.props[key] for key in list(node.props)}
    plain = {key: value for key, value in values.items() if not is_reference(value)}
    if len(plain) < len(values) and node.type == mi.ObjectType.Integrator:
        return True
    try:
        mi.load_dict({"type": name} | plain, parallel=False)
    except (RuntimeError, ValueError, TypeError):
        return False
    return True


def _require_rgb(scene: ParsedScene) -> None:
    """Refuse spectra that Mitsuba does not turn into RGB: it fails when light is computed."""
    for node in (scene.state.nodes[i] for i in scene.reachable(0)):
        name = node.props.plugin_name()
        if name in _WITHOUT_RGB:
            where = mi.parser.file_location(scene.state, node)
            remedy = "Give <rgb>, or <spectrum> with a list of wavelengths and values"
            raise UserError(f"a spectrum of the type {name!r} has no RGB", where, remedy)


def _resolve_files(scene: ParsedScene, folders: list[Path]) -> None:
    """Make file names absolute: Mitsuba would look for them in the working directory.

    Args:
        folders: to search, after that of the file that has the name, and the scene's.
    """
    own = scene.path.parent.resolve()
    beside = [Path(str(file)).parent.resolve() for file in scene.state.files]
    for node in scene.state.nodes:
        value = node.props.get("filename", None)
        if not isinstance(value, str):
            continue
        try:
            file = find(value, [beside[node.file_index], own, *folders], scene.root, None)
        except UserError as error:
            where = mi.parser.file_location(scene.state, node)
            raise UserError(error.what, where, error.remedy) from None
        node.props["filename"] = str(file)
        plugin = node.props.plugin_name()
        if plugin in FORMATS:
            check_mesh(plugin, file, node.props.get("shape_index", 0))
        elif plugin in IMAGES:
            check_image(file)


def _require_finite(scene: ParsedScene) -> None:
    for node in scene.state.nodes:
        for key in list(node.props):
            if not _is_finite(node.props[key]):
                raise UserError(
                    f"{node.props.plugin_name()}.{key} has a number that is not finite",
                    mi.parser.file_location(scene.state, node),
                    "Write a finite number",
                )


def _require_round(scene: ParsedScene) -> None:
    """Refuse placements of shapes without a file that Mitsuba 3.9 does not make as they say.

    Spheres and cylinders stay round whatever their scale. Flat ones that are flattened once more
    have normals that are no numbers.
    """
    for node in scene.state.nodes:
        axes = _ROUND.get(node.props.plugin_name())
        if axes is None or "to_world" not in node.props:
            continue
        matrix = matrix_of(node.props["to_world"])[:3, :3]
        largest, _, least = np.linalg.svd(matrix, compute_uv=False)
        fault = remedy = None
        if least <= 1e-9 * largest:
            fault, remedy = "has no extent along an axis", "Scale it by more than 0"
        elif axes and np.ptp(np.linalg.svd(matrix[:, :axes], compute_uv=False)) > _UNEVEN * largest:
            fault = "is scaled more along one axis than another, and Mitsuba keeps it round"
            remedy = "Use a mesh instead"
        if fault is not None:
            where = mi.parser.file_location(scene.state, node)
            raise UserError(f"the {node.props.plugin_name()} {fault}", where, remedy)


def _require_needed(scene: ParsedScene) -> None:
    for node in scene.state.nodes:
        plugin = node.props.plugin_name()
        needed = _NEEDED.get(plugin)
        if needed is not None and needed not in node.props:
            where = mi.parser.file_location(scene.state, node)
            raise UserError(f"the {plugin} has no {needed!r}", where, "Add it")


def is_spectrum(value: object) -> bool:
    """Whether the value of a property is a spectrum, whose class has no name of its own."""
    return hasattr(value, "wavelengths")


def _is_finite(value: Any) -> bool:
    if is_spectrum(value):
        value = value.values
    elif dr.is_array_v(value):
        value = np.array(value)
    elif isinstance(value, mi.ScalarAffineTransform4d):
        value = np.array(value.matrix)
    elif not isinstance(value, float):
        return True
    return bool(np.isfinite(value).all())


def reason(error: Exception) -> str:
    """Mitsuba's message on one line, without positions in its C++ source."""
    text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\]", "", str(error)).split())
    return text[:300] or type(error).__name__
