"""The emitters of a scene: their names and strengths, and its environment as an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.envmap import latlong
from .parse import ParsedScene, is_reference, reason, referenced

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


@dataclass(frozen=True)
class NamedEmitter:
    """An emitter whose strength can be optimized."""

    name: str  #: unique: its id, else its shape's id or file name, else its plugin and a number
    strength: tuple[float, float, float] | None  #: linear RGB; None: a bitmap or a spectrum


def named_emitters(scene: ParsedScene) -> list[NamedEmitter]:
    """The emitters of `STRENGTHS` with the strength that the scene gives them."""
    nodes = emitter_nodes(scene)
    pairs = zip(_names(scene, nodes), nodes, strict=True)
    return [NamedEmitter(name, _strength(scene, scene.state.nodes[i].props)) for name, i in pairs]


def emitter_nodes(scene: ParsedScene) -> list[int]:
    """Indices of the nodes that are emitters of `STRENGTHS`, in the order of `named_emitters`."""
    return [i for i, n in enumerate(scene.state.nodes) if n.props.plugin_name() in STRENGTHS]


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

    return latlong(radiance, height, max(1, min(16, 1024 // height)))


def require_emitters(scene: mi.Scene, path: Path) -> None:
    """Raise a `UserError` if nothing in the scene emits light."""
    if not scene.emitters():
        raise UserError("the scene has no light source", path, "Add a light or environment map")


def _names(scene: ParsedScene, emitters: list[int]) -> list[str]:
    """A unique name for each of these nodes."""
    nodes, shapes = scene.state.nodes, {}
    for shape in (n for n in nodes if n.type == mi.ObjectType.Shape):
        for key in list(shape.props):
            if is_reference(shape.props[key]):
                # `mi.parser.write_file` of Mitsuba 3.9 drops ids that nothing refers to.
                file = str(shape.props.get("filename", ""))
                shapes[shape.props[key].index()] = shape.props.id() or Path(file).stem
    names = [
        nodes[i].props.id() or shapes.get(i) or f"{nodes[i].props.plugin_name()} light"
        for i in emitters
    ]
    return [
        name if names.count(name) == 1 else f"{name} {names[: i + 1].count(name)}"
        for i, name in enumerate(names)
    ]


def _strength(scene: ParsedScene, props: mi.Properties) -> tuple[float, float, float] | None:
    """The strength of an emitter, linear RGB; None if it is not one colour."""
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
    if texture.is_spatially_varying():
        return None
    try:
        colour = texture.eval(dr.zeros(mi.SurfaceInteraction3f))
    except RuntimeError:  # a spectrum that Mitsuba does not turn into RGB, such as a black body
        return None
    return tuple(np.ravel(colour).tolist())
