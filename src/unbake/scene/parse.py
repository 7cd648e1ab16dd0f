"""Load a Mitsuba scene, find its unknown materials and put fields in their place.

Everything works on Mitsuba's own parsed form of a scene (`mi.parser`), never on its text.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.envmap import latlong
from ..fields.texture import painted_meshes_without_uv


@dataclass
class ParsedScene:
    """A scene before it is instantiated: Mitsuba's nodes, free to be changed."""

    path: Path
    config: mi.parser.ParserConfig
    state: mi.parser.ParserState

    def instantiate(self) -> mi.Scene:
        """Make the scene; the nodes are used up.

        Equal materials become one and meshes of one material one mesh: tracing a step costs time
        for each object that a ray may meet.

        Raises:
            UserError: Mitsuba cannot make it.
        """
        try:
            mi.parser.transform_merge_equivalent(self.config, self.state)
            mi.parser.transform_merge_meshes(self.config, self.state)
            scene = mi.parser.instantiate(self.config, self.state)
        except RuntimeError as error:
            # Lights that were made, but whose shapes were not, would end the process in the next
            # virtual call. They live as long as the nodes, which this error keeps alive.
            self.state = mi.parser.ParserState()
            reason = _reason(error)
            if "not been instantiated" in reason:
                # Of errors met in parallel, Mitsuba may tell one that merely follows from another.
                reason = _serial_reason(self.path) or reason
            raise UserError(f"Mitsuba cannot make this scene: {reason}", self.path) from None
        scene = scene[0] if isinstance(scene, list) else scene
        box = np.ravel([scene.bbox().min, scene.bbox().max])
        if not np.isfinite(box).all():
            raise UserError("the scene has no shapes, or one without end", self.path)
        return scene

    def principled_nodes(self) -> list:
        """The nodes whose albedo and roughness are (or stand for) unknowns."""
        return [n for n in self.state.nodes if n.props.plugin_name() == "principled"]


def _serial_reason(path: Path) -> str | None:
    """Why a scene cannot be made, as one thread finds it; None if it can."""
    scene = parse(path)
    scene.config.parallel = False
    try:
        mi.parser.instantiate(scene.config, scene.state)
    except RuntimeError as error:
        scene.state = mi.parser.ParserState()
        return _reason(error)
    return None


def parse(path: Path) -> ParsedScene:
    """Parse a Mitsuba XML scene and resolve its references.

    Raises:
        UserError: the file is missing or is not a Mitsuba scene, or has a number that is not
            finite.
    """
    if not path.is_file():
        raise UserError("no such scene file", where=path)
    config = mi.parser.ParserConfig(mi.variant())
    try:
        state = mi.parser.parse_file(config, str(path))
        mi.parser.transform_upgrade(config, state)
        mi.parser.transform_resolve(config, state)
    except RuntimeError as error:
        raise UserError(f"not a scene that Mitsuba can read: {_reason(error)}", path) from None
    scene = ParsedScene(path, config, state)
    _require_finite(scene)
    _resolve_files(scene)
    return scene


def to_principled(scene: ParsedScene) -> int:
    """Turn every `diffuse` and rough plastic BSDF into `principled`, as the paper did (Sec. 6).

    Diffuse becomes roughness 0.9; rough plastic keeps its colour, with roughness √α, the perceptual
    roughness of the same microfacet width.

    Returns:
        The number of BSDFs changed.
    """
    changed = 0
    for node in scene.state.nodes:
        props = node.props
        match props.plugin_name():
            case "diffuse":
                colour, roughness = _take(props, "reflectance", 0.5), 0.9
            case "roughplastic":
                colour = _take(props, "diffuse_reflectance", 0.5)
                roughness = math.sqrt(_take(props, "alpha", 0.1))
            case _:
                continue
        for key in list(props.keys()):
            del props[key]
        props.set_plugin_name("principled")
        props["base_color"] = colour
        props["roughness"] = roughness
        changed += 1
    return changed


def set_textures(scene: ParsedScene, albedo: object, roughness: object) -> None:
    """Give every `principled` BSDF these textures; all its other parameters stay.

    Raises:
        UserError: there is no such BSDF, so nothing could be fitted.
    """
    set_own_textures(scene, [(albedo, roughness)] * len(material_names(scene)))


def set_own_textures(scene: ParsedScene, textures: list[tuple[object, object]]) -> None:
    """Give each `principled` BSDF an albedo and a roughness texture of its own.

    BSDFs with textures of their own are not merged, nor are their shapes.
    """
    for node, (albedo, roughness) in zip(scene.principled_nodes(), textures, strict=True):
        node.props["base_color"] = albedo
        node.props["roughness"] = roughness


def material_names(scene: ParsedScene) -> list[str]:
    """Names of the `principled` BSDFs, each another one, in the order of the nodes.

    Raises:
        UserError: there is no such BSDF, so nothing could be fitted.
    """
    nodes = scene.principled_nodes()
    if not nodes:
        raise UserError(
            "no material to fit: no shape has a principled, diffuse or roughplastic BSDF",
            where=scene.path,
        )
    names: list[str] = []
    for number, node in enumerate(nodes):
        name = node.props.id() or f"material-{number}"
        names.append(name if name not in names else f"{name}-{number}")
    return names


def show_roughness_as_albedo(scene: ParsedScene) -> None:
    """Put each material's roughness in the place of its base colour (to render what it is)."""
    for node in scene.principled_nodes():
        props = node.props
        props["base_color"] = props["roughness"] if "roughness" in props else 0.5


def write(scene: ParsedScene, folder: Path) -> Path:
    """Write the scene and copies of all its files into a folder, as `scene.xml`.

    Raises:
        UserError: a file that the scene names is missing.
    """
    try:
        mi.parser.transform_relocate(scene.config, scene.state, str(folder))
        mi.parser.write_file(scene.state, str(folder / "scene.xml"))
    except RuntimeError as error:
        raise UserError(f"cannot be copied: {_reason(error)}", scene.path) from None
    return folder / "scene.xml"


def require_emitters(scene: mi.Scene, path: Path) -> None:
    """Raise a `UserError` if nothing in the scene emits light."""
    if not scene.emitters():
        raise UserError("the scene has no light source", path, "Add a light or environment map")


#: Emitters that surround the scene.
ENVIRONMENTS = ("constant", "envmap", "sunsky", "timed_sunsky")
#: Emitters whose strength can be unknown, and the parameter that is their strength.
STRENGTHS = {
    "area": "radiance",
    "directionalarea": "radiance",
    "constant": "radiance",
    "point": "intensity",
    "spot": "intensity",
    "directional": "irradiance",
}


@dataclass(frozen=True)
class Light:
    """A light whose strength is sought."""

    name: str  #: its id in the scene, or that of its shape or its file, or a made up one
    strength: tuple[float, float, float] | None  #: true linear RGB; None: a picture, or not RGB


def set_environment(scene: ParsedScene, emitter: mi.Emitter) -> None:
    """Put this emitter in the place of the scene's environment, whatever that is.

    Raises:
        UserError: the scene has none.
    """
    root = scene.state.root.props
    for key in root.keys():
        node = referenced(scene, root[key])
        if node is not None and node.props.plugin_name() in ENVIRONMENTS:
            # Under a new name: merging meshes reuses those that the parser made up.
            del root[key]
            root["unknown environment"] = emitter
            return
    raise UserError(
        "the scene has no environment map to fit",
        scene.path,
        "Add one, or fit its lights with --unknown emission",
    )


def environment_latlong(scene: mi.Scene, height: int) -> np.ndarray:
    """The radiance of a scene's own environment, averaged over the pixels of a picture.

    Returns:
        Linear RGB, float32, shape (height, 2 height, 3), in the layout of `latlong`.

    Raises:
        UserError: the scene has no environment.
    """
    environment = scene.environment()
    if environment is None:
        raise UserError("the scene has no environment map")

    def radiance(d: mi.Vector3f) -> mi.Color3f:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
        si.wi = -d
        return environment.eval(si)

    return latlong(radiance, height, max(1, min(16, 1024 // height)))


def lights_of(scene: ParsedScene) -> list[Light]:
    """The lights whose strength could be sought, as the scene describes them."""
    nodes = _light_nodes(scene)
    pairs = zip(_light_names(scene, nodes), nodes, strict=True)
    return [Light(name, _colour(scene, scene.state.nodes[i].props)) for name, i in pairs]


def set_emission(scene: ParsedScene, make: Callable[[int], Sequence[mi.Texture]]) -> list[Light]:
    """Give every light a texture as its strength; a light with a picture loses that.

    Args:
        make: from the number of lights to as many textures, each of one colour.

    Returns:
        The lights as they were, in the order of their textures.

    Raises:
        UserError: the scene has no light whose strength could be fitted.
    """
    lights = lights_of(scene)
    if not lights:
        raise UserError(
            "the scene has no light to fit: no area, point, spot or directional one",
            scene.path,
            "Add one, or fit its environment map with --unknown lighting",
        )
    for i, texture in zip(_light_nodes(scene), make(len(lights)), strict=True):
        props = scene.state.nodes[i].props
        props[STRENGTHS[props.plugin_name()]] = texture
    return lights


def _light_nodes(scene: ParsedScene) -> list[int]:
    """Numbers of the nodes that are lights."""
    return [i for i, n in enumerate(scene.state.nodes) if n.props.plugin_name() in STRENGTHS]


def _light_names(scene: ParsedScene, lights: list[int]) -> list[str]:
    """A name for each of these nodes, no two the same."""
    nodes, shapes = scene.state.nodes, {}
    for shape in (n for n in nodes if n.type == mi.ObjectType.Shape):
        for key in shape.props.keys():
            if _is_reference(shape.props[key]):
                # Copied scenes have lost ids that nothing refers to.
                file = str(_take(shape.props, "filename", ""))
                shapes[shape.props[key].index()] = shape.props.id() or Path(file).stem
    names = [
        nodes[i].props.id() or shapes.get(i) or f"{nodes[i].props.plugin_name()} light"
        for i in lights
    ]
    return [
        name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    ]


def _colour(scene: ParsedScene, props: mi.Properties) -> tuple[float, float, float] | None:
    """The strength that a light was given, linear RGB; None if that is not one colour."""
    key = STRENGTHS[props.plugin_name()]
    node = referenced(scene, props[key]) if key in props else None
    if node is not None:
        texture = mi.PluginManager.instance().create_object(node.props)
        texture = (texture.expand() or [texture])[0]
    else:
        texture = props.get_emissive_texture(key, 1.0)
    if texture.is_spatially_varying():
        return None
    try:
        colour = texture.eval(dr.zeros(mi.SurfaceInteraction3f))
    except RuntimeError:  # a spectrum that Mitsuba does not turn into RGB, such as a black body
        return None
    return tuple(np.ravel(colour).tolist())


def _is_reference(value: object) -> bool:
    return isinstance(value, mi.Properties.ResolvedReference)


def referenced(scene: ParsedScene, value: object) -> object | None:
    """The node that a property refers to, if it does."""
    return scene.state.nodes[value.index()] if _is_reference(value) else None


def require_unwrapped(scene: mi.Scene, path: Path) -> None:
    """Raise a `UserError` if a mesh with unknown materials has no texture coordinates."""
    names = painted_meshes_without_uv(scene)
    if names:
        shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
        raise UserError(
            f"meshes without texture coordinates cannot have bitmaps: {shown}",
            path,
            "Use --representation neural or grid, or unwrap the mesh",
        )


def _resolve_files(scene: ParsedScene) -> None:
    """Make the names of files absolute: Mitsuba would look for them in the working directory."""
    folder = scene.path.parent.resolve()
    for node in scene.state.nodes:
        for key in node.props.keys():
            value = node.props[key]
            if not isinstance(value, str):
                continue
            file = folder / value
            if value and file.is_file():
                node.props[key] = str(file)
            elif key == "filename":
                where = mi.parser.file_location(scene.state, node)
                raise UserError(f"the file {value!r} does not exist", where=where)


def _take(props: mi.Properties, key: str, default: float) -> object:
    return props[key] if key in props else default


def _require_finite(scene: ParsedScene) -> None:
    for node in scene.state.nodes:
        for key in node.props.keys():
            if not _is_finite(node.props[key]):
                raise UserError(
                    f"{node.props.plugin_name()}.{key} has a number that is not finite",
                    mi.parser.file_location(scene.state, node),
                    "Correct it",
                )


def _is_finite(value: object) -> bool:
    if hasattr(value, "wavelengths"):  # a spectrum: its class has no name of its own
        value = value.values
    elif dr.is_array_v(value):
        value = np.array(value)
    elif isinstance(value, mi.ScalarAffineTransform4d):
        value = np.array(value.matrix)
    elif not isinstance(value, float):
        return True
    return bool(np.isfinite(value).all())


def _reason(error: Exception) -> str:
    """What Mitsuba says, on one line, without the places in its own source."""
    text = " ".join(re.sub(r"\[\w+\.(cpp|h):\d+\]", "", str(error)).split())
    return text[:300] or type(error).__name__
