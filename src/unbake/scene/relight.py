"""Other light in the place of a scene's own: an environment map, or the lights of a file."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..imaging.headers import SUFFIXES, HeaderError, read_header
from ..io import require_file
from .emitters import ENVIRONMENTS, STRENGTHS
from .images import check_image
from .parse import ParsedScene, is_reference, parse, referenced

_FORMATS = "Give an OpenEXR, Radiance HDR or PFM file with linear radiance"
#: Names of what is put into a scene, apart from those that Mitsuba and users make up.
_PREFIX = "new light"


def turn_off(scene: ParsedScene) -> int:
    """Turn off all light of a scene; returns the number of lights.

    Shapes that emitted light stay, black and counted among the emitters: their materials are not
    optimized, as before.

    Raises:
        UserError: a light cannot be turned off.
    """
    count, nodes = _remove(scene, None), scene.state.nodes
    used = {i for number in range(len(nodes)) for i in scene.references(number)}
    for i in sorted(used):
        node = nodes[i]
        if node.type != mi.ObjectType.Emitter:
            continue
        plugin = node.props.plugin_name()
        if plugin not in STRENGTHS:
            where = mi.parser.file_location(scene.state, node)
            raise UserError(f"the light {plugin!r} of a shape cannot be turned off", where)
        node.props[STRENGTHS[plugin]] = mi.ScalarColor3d([0.0, 0.0, 0.0])
        node.props["sampling_weight"] = 0.0  # no sample is spent on it
        count += 1
    return count


def put_environment(
    scene: ParsedScene, file: Path, scale: float, up: tuple[float, float, float], turn: float
) -> None:
    """Put an environment map into the place of a scene's environment, if it has one.

    Args:
        file: OpenEXR, Radiance HDR or PFM, linear RGB, in the layout of Mitsuba's `envmap`.
        scale: what its values are times.
        up: world axis, (3,), that its first row lies at.
        turn: radians to turn it about that axis by, counterclockwise as seen from its tip.

    Raises:
        UserError: the file cannot be read, is black, or has values that are no radiance.
    """
    check_environment(file)
    _remove(scene, ENVIRONMENTS)
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Emitter
    node.props.set_plugin_name("envmap")
    node.props["filename"] = str(file.resolve())
    node.props["scale"] = float(scale)
    node.props["to_world"] = mi.ScalarAffineTransform4d(_rotation(up, turn))
    scene.append_to_root(f"{_PREFIX} environment", node)


def put_lights(scene: ParsedScene, file: Path, root: Path | None = None) -> list[str]:
    """Add the emitters of a Mitsuba XML file and its shapes that emit light.

    Args:
        file: the XML file; what else is in it is left out.
        root: folder that its files must not leave; None: its own.

    Returns:
        What was left out, for people.

    Raises:
        UserError: the file cannot be read, or has no light.
    """
    other = parse(file, root)
    found = [key for key in list(other.state.root.props) if _emits(other, key)]
    if not found:
        remedy = "Add an emitter, or a shape with an area emitter"
        raise UserError("no light in the file", file, remedy)
    new = [_referenced(other, key) for key in found]
    environments = [n for n in new if other.state.nodes[n].props.plugin_name() in ENVIRONMENTS]
    if len(environments) > 1:
        raise UserError(
            "more than one environment in the file", file, "Keep one of them in the file"
        )
    for i in (i for n in environments for i in other.reachable(n)):
        if other.state.nodes[i].props.plugin_name() == "envmap":
            check_environment(Path(other.state.nodes[i].props["filename"]))
    if environments:
        _remove(scene, ENVIRONMENTS)
    moved = _copy(other, new, scene)
    for number, index in enumerate(new):
        root_props = scene.state.root.props
        root_props[f"{_PREFIX} {number}"] = mi.Properties.ResolvedReference(moved[index])
    dark = sum(
        node is not None and node.type == mi.ObjectType.Shape and key not in found
        for key in list(other.state.root.props)
        for node in [referenced(other, other.state.root.props[key])]
    )
    return [f"{file}: left out {dark} shapes that emit no light"] if dark else []


def check_environment(file: Path) -> None:
    """Refuse a file that is no environment map.

    Raises:
        UserError: it cannot be read, is of low dynamic range or black, or has values that are NaN,
            infinite or negative.
    """
    require_file(file, "environment map")
    if file.suffix.lower() not in SUFFIXES:
        raise UserError(f"no environment map can be read from {file.suffix!r}", file, _FORMATS)
    check_image(file)
    try:
        header = read_header(file)
        if min(header.width, header.height) < 3:
            raise HeaderError(f"it has {header.width} x {header.height} pixels")
        bitmap = mi.Bitmap(str(file))
        pixels = np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
    except (HeaderError, RuntimeError, MemoryError, ValueError, OSError) as error:
        told = " ".join(str(error).split())[:160]
        raise UserError(f"the environment map cannot be read ({told})", file, _FORMATS) from None
    bad = int((~np.isfinite(pixels)).any(-1).sum())
    if bad:
        raise UserError(f"{bad} pixels of the environment map are NaN or infinite", file)
    bad = int((pixels < 0).any(-1).sum())
    if bad:
        remedy = "Set them to zero: no radiance is negative"
        raise UserError(f"{bad} pixels of the environment map are negative", file, remedy)
    if not pixels.any():
        raise UserError("the environment map is black", file, "Give one with light in it")


def _rotation(up: tuple[float, float, float], turn: float) -> np.ndarray:
    """The rotation (4, 4) that takes +y to `up`, on the shortest way, after a turn about +y."""
    (sin, cos), (x, y, z) = (np.sin(turn), np.cos(turn)), up
    turned = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    tilted = np.diag([1.0, -1.0, -1.0])
    if y > -1:
        # About y x up = (z, 0, -x), as `up` is a unit vector.
        cross = np.array([[0, x, 0], [-x, 0, -z], [0, z, 0]])
        tilted = np.eye(3) + cross + cross @ cross / (1 + y)
    matrix = np.eye(4)
    matrix[:3, :3] = tilted @ turned
    return matrix


def _remove(scene: ParsedScene, plugins: tuple[str, ...] | None) -> int:
    """Take emitters out of a scene that belong to no shape; returns their number.

    Args:
        plugins: those to take, and learned environments; None: all.
    """
    root, count = scene.state.root.props, 0
    for key in list(root):
        node = referenced(scene, root[key])
        if node is None:
            gone = isinstance(root[key], mi.Emitter)
        else:
            chosen = plugins is None or node.props.plugin_name() in plugins
            gone = chosen and node.type == mi.ObjectType.Emitter
        if gone:
            del root[key]
            count += 1
    return count


def _referenced(scene: ParsedScene, key: str) -> int:
    return scene.state.root.props[key].index()


def _emits(scene: ParsedScene, key: str) -> bool:
    """Whether a property of the root is an emitter, or a shape that has one."""
    node = referenced(scene, scene.state.root.props[key])
    if node is None or node.type not in (mi.ObjectType.Emitter, mi.ObjectType.Shape):
        return False
    inside = scene.reachable(_referenced(scene, key))
    return any(scene.state.nodes[i].type == mi.ObjectType.Emitter for i in inside)


def _copy(source: ParsedScene, indices: list[int], target: ParsedScene) -> dict[int, int]:
    """Copy nodes and all that they refer to; returns their new places by their old ones."""
    chosen = list(dict.fromkeys(i for index in indices for i in source.reachable(index)))
    first = len(target.state.nodes)
    moved = {old: first + number for number, old in enumerate(chosen)}
    taken = {node.props.id() for node in target.state.nodes}
    for old in chosen:
        node = mi.parser.SceneNode()
        node.type = source.state.nodes[old].type
        node.props = mi.Properties(source.state.nodes[old].props)
        for key in list(node.props):
            if is_reference(node.props[key]):
                place = moved[node.props[key].index()]
                node.props[key] = mi.Properties.ResolvedReference(place)
        name = node.props.id()
        if name and name in taken:
            node.props.set_id(f"{_PREFIX} {name} {moved[old]}")
        taken.add(node.props.id())
        target.state.nodes.append(node)
    return moved
