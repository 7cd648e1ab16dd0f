"""What Mitsuba 3.9 or a fit cannot use: textures in some places, BSDFs in some others."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from ..errors import UserError
from .meshes import ply_fields

if TYPE_CHECKING:
    from .parse import ParsedScene

#: BSDFs that bend normals, and the textures whose slopes or vectors they can read.
_BENDING = ("bumpmap", "normalmap")
_AREA = ("area", "directionalarea")
_PATTERNS = ("checkerboard", "mesh_attribute")
#: The properties of a PLY file that are colours, in any way; the last one is that of `write_ply`.
_COLOURS = ({"red", "green", "blue"}, {"r", "g", "b"}, {"color_0", "color_1", "color_2"})
_AS_COLOURS = "Write it as PLY with red, green and blue as float, linear from 0 to 1, without alpha"
#: BSDFs that let light pass as it is.
_OPEN = ("mask", "null", "thindielectric")
#: Those that are fitted: `principled`, and what `edit.to_principled` turns into it.
_FITTED = ("diffuse", "principled", "roughplastic")


def require_able(scene: ParsedScene) -> None:
    """Refuse textures and nestings of BSDFs that Mitsuba or a fit has no right method for.

    Raises:
        UserError: names the line.
    """
    nodes = scene.state.nodes
    for place in scene.reachable(0):
        node = nodes[place]
        plugin, inner = node.props.plugin_name(), [nodes[i] for i in scene.references(place)]
        names = [each.props.plugin_name() for each in inner]
        fault = remedy = None
        if plugin in _BENDING and (pattern := _first(names, _PATTERNS)):
            fault, remedy = f"a {plugin} cannot read a {pattern}", "Give a bitmap"
        elif plugin in _BENDING and "mask" in names:
            # Its holes let no light pass: Mitsuba asks the outer BSDF, which does not know of them.
            fault, remedy = f"a {plugin} around a mask", f"Put the {plugin} into the mask"
        elif plugin in _AREA and (pattern := _first(names, _PATTERNS)):
            fault, remedy = f"the radiance of a lamp cannot be a {pattern}", "Give a bitmap"
        elif node.type == mi.ObjectType.Shape and (missing := _missing_colours(scene, place)):
            fault, remedy = missing, _AS_COLOURS
        elif plugin == "shapegroup" and _has_vertex_colours(scene, place):
            fault = "instances of meshes whose vertices have colours have other colours"
            remedy = "Place the meshes themselves, or give a bitmap"
        elif plugin == "twosided" and _has_unlike_sides(scene, place) and _is_worn(scene, place):
            # Fields know places, and not sides.
            fault = "the two sides have different BSDFs, and a fit gives both one material"
            remedy = "Give each side a shape of its own, a little apart"
        elif plugin == "blendbsdf" and _lets_pass(scene, place) and _is_worn(scene, place):
            # Bounces choose random numbers by which a mask stops a ray. A blend may let it pass.
            fault = "a blend with a BSDF that lets light pass"
            remedy = "Use a mask, whose opacity is the other one's share"
        if fault is not None:
            raise UserError(fault, mi.parser.file_location(scene.state, node), remedy)


def _first(names: list[str], wanted: tuple[str, ...]) -> str | None:
    return next((name for name in names if name in wanted), None)


def _has_unlike_sides(scene: ParsedScene, place: int) -> bool:
    """Whether a `twosided` has two different BSDFs, at least one of which is to be fitted."""
    nodes = scene.state.nodes
    sides = {i for i in scene.references(place) if nodes[i].type == mi.ObjectType.BSDF}
    if len(sides) < 2:
        return False
    found = {nodes[i].props.plugin_name() for side in sides for i in scene.reachable(side)}
    return not found.isdisjoint(_FITTED)


def _lets_pass(scene: ParsedScene, place: int) -> bool:
    """Whether a BSDF, or one in it, lets light pass as it is."""
    nodes = scene.state.nodes
    return any(nodes[i].props.plugin_name() in _OPEN for i in scene.reachable(place))


def _is_worn(scene: ParsedScene, place: int) -> bool:
    """Whether a shape has this BSDF, or one around it."""
    nodes = scene.state.nodes
    shapes = [i for i in scene.reachable(0) if nodes[i].type == mi.ObjectType.Shape]
    return any(place in scene.reachable(shape) for shape in shapes)


def _missing_colours(scene: ParsedScene, place: int) -> str | None:
    """What is wrong with the colours that a shape's texture takes of its mesh, which are black."""
    shape, wanted = scene.state.nodes[place].props, _attributes(scene, place)
    for element in [kind for kind in ("vertex", "face") if f"{kind}_color" in wanted]:
        if shape.plugin_name() == "obj":
            return "the colours of an OBJ file are not read"
        if shape.plugin_name() == "ply":
            fields = ply_fields(Path(shape["filename"])).get(element, {})
            types = {name.lower(): kind for name, kind in fields.items()}
            colours = next((each for each in _COLOURS if each <= types.keys()), None)
            if colours is None:
                return f"the mesh has no {element}_color"
            if any(np.dtype(types[name]).kind != "f" for name in colours):
                return f"{element}_color has integers, of which Mitsuba makes albedo up to 255"
            if types.keys() & {"alpha", "a"}:
                return f"{element}_color has an alpha, and is not read"
    return None


def _attributes(scene: ParsedScene, place: int) -> set[str]:
    """The names of mesh attributes that textures of a node read."""
    found = [scene.state.nodes[i].props for i in scene.reachable(place)]
    return {str(p.get("name", "")) for p in found if p.plugin_name() == "mesh_attribute"}


def _has_vertex_colours(scene: ParsedScene, place: int) -> bool:
    return any(name.startswith("vertex_") for name in _attributes(scene, place))
