"""The emitters of a scene: their names and strengths, and its environment as an image."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.envmap import latlong
from . import free_space
from .parse import ParsedScene, is_reference, reason, referenced
from .transforms import matrix_of

#: Plugins that surround the scene.
ENVIRONMENTS = ("constant", "envmap", "sunsky", "timed_sunsky")
#: Plugins whose strength can be optimized, and the parameter that holds it.
STRENGTHS = {
    "area": "radiance",
    "directionalarea": "radiance",
    "constant": "radiance",
    "point": "intensity",
    "spot": "intensity",
    "directional": "irradiance",
}


#: Rows of directions in which an environment is looked at: with a sun, and at most.
_SUN_ROWS, _MOST_ROWS = 4096, 8192
#: Shapes with texture coordinates that are no meshes.
_NO_MESHES = ("rectangle", "disk", "sphere", "cylinder")
#: Rows and columns in which pictures of lamps are looked at that have no texels.
_ROWS = 512
#: In which surfaces are looked for from a point or a spot.
_DIRECTIONS = 256


@dataclass(frozen=True)
class NamedEmitter:
    """An emitter whose strength can be optimized."""

    name: str  #: unique: its id, else its shape's id or file name, else its plugin and a number
    #: Linear RGB, the mean where it is a picture; None where that is not known, as of colours of
    #: vertices.
    strength: tuple[float, float, float] | None
    varies: bool = False  #: whether it differs from place to place


@dataclass(frozen=True, eq=False)
class Picture:
    """The strength of a lamp that differs over its surface.

    Args:
        texture: of linear RGB.
        mean: over texture coordinates from 0 to 1, linear RGB.
        sampled_by_it: whether the lamp is sampled by its texture coordinates. Samples of a mesh
            know them anyway, those of spheres and cylinders do not.
    """

    texture: mi.Texture
    mean: tuple[float, float, float]
    sampled_by_it: bool = True

    def relative(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """What it is at points, over its mean; 1 in channels whose mean is 0."""
        known = mi.Color3f(self.mean) > 0
        found = dr.detach(self.texture.eval(si, active)) * dr.rcp(
            dr.select(known, mi.Color3f(self.mean), 1)
        )
        return dr.select(known, found, 1)

    def sampled(self) -> np.ndarray:
        """The relative picture, float32, shape (rows, columns, 3).

        Of a bitmap they are its own texels, before it is placed by `to_uv`.
        """
        texels = _texels(self.texture)
        if texels is None:
            found = np.array(self.relative(_at_texels(_ROWS, _ROWS), mi.Bool(True)))
            return found.T.reshape(_ROWS, _ROWS, 3).astype(np.float32)
        mean = np.array(self.mean)
        found = np.where(mean > 0, texels / np.where(mean > 0, mean, 1), 1)
        return found.astype(np.float32)


def named_emitters(scene: ParsedScene) -> list[NamedEmitter]:
    """The emitters of `STRENGTHS` with the strength that the scene gives them."""
    nodes, found = emitter_nodes(scene), []
    for name, i in zip(_names(scene, nodes), nodes, strict=True):
        texture = _texture(scene, scene.state.nodes[i].props)
        if texture.is_spatially_varying():
            picture = _picture(texture)
            found.append(NamedEmitter(name, None if picture is None else picture.mean, True))
        else:
            value = texture.eval(dr.zeros(mi.SurfaceInteraction3f))
            found.append(NamedEmitter(name, tuple(np.ravel(value).tolist())))
    return found


def pictures(scene: ParsedScene) -> list[Picture | None]:
    """The pictures of emitters, in the order of `named_emitters`; None: one colour, or unknown."""
    carriers = _carriers(scene)
    found: list[Picture | None] = []
    for i in emitter_nodes(scene):
        texture = _texture(scene, scene.state.nodes[i].props)
        picture = _picture(texture) if texture.is_spatially_varying() else None
        shape = carriers.get(i)
        if picture is not None and (shape is None or shape.plugin_name() not in _NO_MESHES):
            picture = replace(picture, sampled_by_it=False)
        found.append(picture)
    return found


def emitter_nodes(scene: ParsedScene) -> list[int]:
    """Indices of the nodes that are emitters of `STRENGTHS`, in the order of `named_emitters`.

    One that was replaced stays among the nodes, but not in the scene.
    """
    nodes = scene.state.nodes
    there = sorted(scene.reachable(0))
    return [i for i in there if nodes[i].props.plugin_name() in STRENGTHS]


def lights_besides(scene: ParsedScene, plugins: Collection[str]) -> int:
    """The number of emitters that are of none of these plugins, and not black."""
    return len(names_besides(scene, plugins))


def names_besides(scene: ParsedScene, plugins: Collection[str]) -> list[str]:
    """The ids of emitters as of `lights_besides`, or their plugins."""
    pairs = zip(emitter_nodes(scene), named_emitters(scene), strict=True)
    black = {i for i, named in pairs if named.strength == (0.0, 0.0, 0.0)}
    nodes = {i: scene.state.nodes[i] for i in scene.reachable(0) if i not in black}
    found = [n.props for n in nodes.values() if n.type == mi.ObjectType.Emitter]
    return [p.id() or p.plugin_name() for p in found if p.plugin_name() not in plugins]


def placement(props: mi.Properties) -> np.ndarray:
    """Where an emitter stands, and where it looks along +z, (4, 4)."""
    matrix = np.eye(4)
    if "to_world" in props:
        matrix = matrix_of(props["to_world"])
    elif "position" in props:
        matrix[:3, 3] = np.ravel(np.array(props["position"], np.float64))
    elif "direction" in props:
        z = np.ravel(np.array(props["direction"], np.float64))
        z = z / max(float(np.linalg.norm(z)), 1e-30)
        x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
        x /= np.linalg.norm(x)
        matrix[:3, :3] = np.stack([x, np.cross(z, x), z], 1)
    return matrix


def places(scene: ParsedScene) -> list[np.ndarray | None]:
    """Where points and spots stand, (3,), in the order of `named_emitters`; None for others."""
    props = [scene.state.nodes[i].props for i in emitter_nodes(scene)]
    return [
        placement(each)[:3, 3] if STRENGTHS[each.plugin_name()] == "intensity" else None
        for each in props
    ]


def squared_distances(scene: mi.Scene, positions: Sequence[np.ndarray | None]) -> list[float]:
    """The squared distance between emitters and what they light, in m²; 1 without a position.

    An intensity of so many times a radiance causes light of about that radiance: what arrives
    falls with the squared distance.

    Args:
        scene: with surfaces.
        positions: of its emitters, as `places` gives them.

    Returns:
        For each position the squared median distance to what is seen from there, in all directions.
        Where that is nothing, the one to the middle of the scene, at least to its corners.
    """
    low, high, diagonal = free_space.bounds(scene)
    directions = free_space.sphere_directions(_DIRECTIONS)
    found = []
    for place in positions:
        if place is None or not np.isfinite(diagonal):
            found.append(1.0)
            continue
        origins = np.broadcast_to(place, directions.shape)
        away = free_space.trace(scene, origins, directions).distance
        away = away[np.isfinite(away) & (away > 0)]
        far = max(float(np.linalg.norm(place - (low + high) / 2)), diagonal / 2)
        found.append(float(np.median(away) if len(away) else far) ** 2 or 1.0)
    return found


def environment_latlong(scene: mi.Scene, height: int) -> np.ndarray:
    """The radiance of a scene's own environment, averaged over the pixels of an image.

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

    return latlong(radiance, height, _samples_along(environment, height))


def _samples_along(environment: mi.Emitter, height: int) -> int:
    """Directions along an edge of a pixel of an image that miss no pixel of the environment.

    The sun is half a degree wide, and carries most of the light of its sky.
    """
    params = mi.traverse(environment)
    usual = max(1, min(16, 1024 // height))
    if any(key.endswith("sun_scale") for key in params.keys()):  # noqa: SIM118
        return max(usual, math.ceil(_SUN_ROWS / height))
    rows = environment_rows(environment)
    return max(usual, min(math.ceil(rows / height), math.ceil(_MOST_ROWS / height)))


def environment_rows(environment: mi.Emitter) -> int:
    """Rows of an environment's picture, 0 of one that has none."""
    params = mi.traverse(environment)
    return params["data"].shape[0] if "data" in params else 0


def require_emitters(scene: mi.Scene, path: Path) -> None:
    """Raise a `UserError` if nothing in the scene emits light."""
    if not scene.emitters():
        raise UserError("the scene has no light source", path, "Add a light or environment map")


def _names(scene: ParsedScene, emitters: list[int]) -> list[str]:
    """A unique name for each of these nodes."""
    nodes = scene.state.nodes
    # Shapes need no id, and data sets of earlier versions have lost theirs.
    shapes = {
        i: props.id() or Path(str(props.get("filename", ""))).stem
        for i, props in _carriers(scene).items()
    }
    names = [
        nodes[i].props.id() or shapes.get(i) or f"{nodes[i].props.plugin_name()} light"
        for i in emitters
    ]
    return [
        name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    ]


def _carriers(scene: ParsedScene) -> dict[int, mi.Properties]:
    """The shapes that refer to nodes, such as to emitters, by the indices of these."""
    return {
        shape.props[key].index(): shape.props
        for shape in scene.state.nodes
        if shape.type == mi.ObjectType.Shape
        for key in list(shape.props)
        if is_reference(shape.props[key])
    }


def _picture(texture: mi.Texture) -> Picture | None:
    """A texture with its mean; None where that is black."""
    texels, params = _texels(texture), mi.traverse(texture)
    placed = "to_uv" in params and not np.allclose(np.array(params["to_uv"].matrix), np.eye(3))
    if texels is None or placed:
        side = _ROWS if texels is None else min(max(_ROWS, *texels.shape[:2]), _MOST_ROWS)
        values = np.array(texture.eval(_at_texels(side, side))).reshape(-1, side**2).T
    else:
        values = texels.reshape(-1, 3)
    red, green, blue = np.broadcast_to(values.mean(0, dtype=np.float64), 3).tolist()
    mean = (red, green, blue)
    return Picture(texture, mean) if max(mean) > 0 and np.isfinite(mean).all() else None


def _texels(texture: mi.Texture) -> np.ndarray | None:
    """The texels of a bitmap, linear RGB, shape (rows, columns, 3); None of other textures."""
    params = mi.traverse(texture)
    if "data" not in params:
        return None
    data = np.array(params["data"])
    return np.broadcast_to(data[..., :3], (*data.shape[:2], 3))


def _at_texels(rows: int, columns: int) -> mi.SurfaceInteraction3f:
    """The middles of the texels of an image, row by row."""
    si = dr.zeros(mi.SurfaceInteraction3f, rows * columns)
    number = dr.arange(mi.UInt32, rows * columns)
    x, y = mi.Float(number % columns) + 0.5, mi.Float(number // columns) + 0.5
    si.uv = mi.Point2f(x / columns, y / rows)
    return si


def _texture(scene: ParsedScene, props: mi.Properties) -> mi.Texture:
    """The strength of an emitter."""
    key = STRENGTHS[props.plugin_name()]
    node = referenced(scene, props[key]) if key in props else None
    try:
        if node is not None:
            texture = mi.PluginManager.instance().create_object(node.props)
            texture = (texture.expand() or [texture])[0]
        else:
            texture = props.get_emissive_texture(key, 1.0)
    except (RuntimeError, ValueError) as error:
        raise UserError(
            f"{key!r} of {props.plugin_name()} is no strength: {reason(error)}", scene.path
        ) from None
    return texture
