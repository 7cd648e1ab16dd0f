"""Edits of a parsed scene: textures and emitters of our own replace those that it has."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import UserError, collected, named, raise_together
from ..fields.shapes import bsdf_classes, met_shapes
from ..fields.texture import painted_meshes_without_uv
from ..quantities import QUANTITIES
from .emitters import ENVIRONMENTS, STRENGTHS, NamedEmitter, emitter_nodes, named_emitters
from .one_number import one_number
from .parse import ParsedScene, is_reference, is_spectrum, referenced

_NO_MATERIAL = "no material to fit: no surface has a principled, diffuse or roughplastic BSDF"
_GIVE_ONE = "Give one a principled BSDF: all others are known"

#: Properties of the BSDFs that become `principled`.
_PROPERTIES = {
    "diffuse": {"reflectance"},
    "roughplastic": {
        "alpha",
        "diffuse_reflectance",
        "distribution",
        "ext_ior",
        "int_ior",
        "nonlinear",
        "sample_visible",
        "specular_reflectance",
    },
}
#: Index of refraction of a `principled` that does not say; those so near to it are the same, such
#: as 1.5 in Mitsuba's air.
_ETA, _NEAR = 1.5, 1e-3


#: Shapes that stand for others.
_NO_SURFACES = ("instance", "merge", "shapegroup")


def to_principled(scene: ParsedScene) -> int:
    """Turn every `diffuse` and rough plastic BSDF into `principled`, as the paper did (Sec. 6).

    Diffuse becomes roughness 0.9; rough plastic keeps its colour and its index of refraction, with
    roughness √α, the perceptual roughness of the same microfacet width. Shapes without a BSDF are
    diffuse to Mitsuba, and share a new one.

    Returns:
        The number of BSDFs changed.

    Raises:
        UserError: some have a property that their plugin does not know, no width that is a number,
            no index of refraction from 1, or a number out of range; it tells all of them.
    """
    nodes = [n for n in scene.state.nodes if n.props.plugin_name() == "principled"]
    wrong = [fault for node in nodes for fault in _range_faults(scene, node)]
    changed, faults = turned_principled(scene)
    raise_together([*wrong, *faults])
    return changed


def turned_principled(scene: ParsedScene) -> tuple[int, list[UserError]]:
    """As `to_principled`: the number of BSDFs changed, and what is wrong with those to be changed.

    Numbers of those that are `principled` already are not looked at; see `values.value_faults`.
    """
    faults: list[UserError] = []
    changed = 0
    for node in scene.state.nodes:
        with collected(faults):
            changed += _made_principled(scene, node)
    return changed + _give_bare_shapes_a_bsdf(scene), faults


def lost_properties(scene: ParsedScene) -> str | None:
    """What `to_principled` will not keep of rough plastic, and of how many; None: it keeps all."""
    lost: Counter[str] = Counter()
    for node in scene.state.nodes:
        props = node.props
        if props.plugin_name() != "roughplastic":
            continue
        lost["'specular_reflectance'"] += not _is_one(props.get("specular_reflectance", 1.0))
        lost["'nonlinear'"] += props.get("nonlinear", False) is True
        lost["'distribution' beckmann"] += props.get("distribution", None) == "beckmann"
    told = [f"{name} of {n} BSDF{'s' * (n != 1)}" for name, n in lost.items() if n]
    return ", ".join(told) or None


def _is_one(value: Any) -> bool:
    """Whether a number, a colour or a spectrum is 1; textures are not."""
    values = value.values if is_spectrum(value) else value
    return not is_reference(value) and bool(np.all(np.array(values) == 1))


def _made_principled(scene: ParsedScene, node: mi.parser.SceneNode) -> bool:
    """Turn a BSDF into `principled` if it is one of those; returns whether it was."""
    props = node.props
    unknown = sorted(set(props) - _PROPERTIES.get(props.plugin_name(), set(props)))
    if unknown:
        raise UserError(
            f"{props.plugin_name()} has no property {' or '.join(map(repr, unknown))}",
            mi.parser.file_location(scene.state, node),
            f"It has {', '.join(sorted(_PROPERTIES[props.plugin_name()]))}",
        )
    eta = _ETA
    match props.plugin_name():
        case "diffuse":
            colour, roughness = props.get("reflectance", 0.5), 0.9
        case "roughplastic":
            colour = props.get("diffuse_reflectance", 0.5)
            roughness = math.sqrt(_alpha(scene, node))
            eta = _eta(scene, node)
        case _:
            return False
    for key in list(props.keys()):
        del props[key]
    props.set_plugin_name("principled")
    props["base_color"] = colour
    props["roughness"] = roughness
    if abs(eta - _ETA) > _NEAR:
        props["eta"] = eta
    return True


def _give_bare_shapes_a_bsdf(scene: ParsedScene) -> int:
    """Give shapes without BSDF and emitter one that is grey, as Mitsuba does.

    Returns:
        The number of BSDFs that are new.
    """
    nodes = scene.state.nodes
    bare = []
    for i, node in enumerate(nodes):
        if node.type != mi.ObjectType.Shape or node.props.plugin_name() in _NO_SURFACES:
            continue
        kinds = {nodes[number].type for number in scene.references(i)}
        if not kinds & {mi.ObjectType.BSDF, mi.ObjectType.Emitter}:
            bare.append(i)
    if not bare:
        return 0
    grey = mi.parser.SceneNode()
    grey.type = mi.ObjectType.BSDF
    grey.props.set_plugin_name("principled")
    grey.props.set_id("without-bsdf")
    grey.props["base_color"], grey.props["roughness"] = 0.5, 0.9
    number = scene.append(grey)
    for i in bare:
        scene.state.nodes[i].props["bsdf"] = mi.Properties.ResolvedReference(number)
    return 1


def _range_faults(scene: ParsedScene, node: mi.parser.SceneNode) -> list[UserError]:
    """Numbers of a `principled` that no surface has; Mitsuba 3.9 checks colours alone."""
    values = [(quantity, node.props.get(quantity.slot)) for quantity in QUANTITIES.values()]
    return [
        UserError(
            f"{quantity.slot!r} of principled is {value:g}, not from 0 to {quantity.upper:g}",
            mi.parser.file_location(scene.state, node),
            "Correct it",
        )
        for quantity, value in values
        if isinstance(value, int | float) and not 0 <= value <= quantity.upper
    ]


def _alpha(scene: ParsedScene, node: mi.parser.SceneNode) -> float:
    """The width of the microfacets of rough plastic."""
    alpha = node.props.get("alpha", 0.1)
    if isinstance(alpha, int | float) and alpha >= 0:
        return alpha
    given = "a texture" if is_reference(alpha) else repr(alpha)[:80]
    raise UserError(
        f"'alpha' of roughplastic is {given}, not a number from 0",
        mi.parser.file_location(scene.state, node),
        "Use a principled BSDF, whose roughness is the square root of alpha",
    )


def _eta(scene: ParsedScene, node: mi.parser.SceneNode) -> float:
    """The index of refraction of rough plastic, relative to what is around it; 1 at least."""
    # The defaults of `roughplastic`; other BSDFs have others.
    given = {"int_ior": "polypropylene", "ext_ior": "air"}
    given |= {key: node.props[key] for key in given if key in node.props}
    # Mitsuba takes whole numbers for other ones in files, but not here.
    exact = {k: float(v) if type(v) is int else v for k, v in given.items()}
    try:
        # It knows the names of `roughplastic`, and computes nothing beside the index.
        dielectric = mi.traverse(mi.load_dict({"type": "dielectric", **exact}))
        eta = float(np.ravel(np.array(dielectric["eta"]))[0])
    except (RuntimeError, TypeError):
        eta = math.nan
    if 1 - _NEAR <= eta < math.inf:
        return max(eta, 1.0)
    told = " and ".join(f"{key!r} {value!r}"[:80] for key, value in given.items())
    raise UserError(
        f"roughplastic has no index of refraction from 1 by {told}",
        mi.parser.file_location(scene.state, node),
        "Give numbers above 0 or names that Mitsuba knows, the larger one as 'int_ior'",
    )


def require_optimized(scene: mi.Scene, path: Path) -> None:
    """Raise a `UserError` if no shape of a scene has a material that could be fitted.

    Those of lamps count where there are no others, as of a furnace.

    Args:
        scene: after `to_principled`.
        path: its file.
    """
    if not any("Principled" in bsdf_classes(shape) for shape in met_shapes(scene)):
        raise UserError(_NO_MATERIAL, path, _GIVE_ONE)


def material_names(scene: ParsedScene) -> list[str]:
    """Unique names of the `principled` BSDFs, in the order of the nodes.

    Raises:
        UserError: there is no such BSDF, so nothing could be fitted.
    """
    nodes = scene.principled_nodes()
    if not nodes:
        raise UserError(_NO_MATERIAL, scene.path, _GIVE_ONE)
    names: list[str] = []
    for number, node in enumerate(nodes):
        name = node.props.id() or f"material-{number}"
        names.append(name if name not in names else f"{name}-{number}")
    return names


def lamp_materials(scene: ParsedScene) -> frozenset[int]:
    """The numbers of materials that lamps alone have, as in `material_names`.

    Photographs show the light of a lamp, and next to nothing of what it reflects. Where no other
    shape has a material, as in a furnace, there are none.

    Args:
        scene: after `to_principled`.
    """
    nodes = scene.state.nodes
    of_lamps: set[int] = set()
    of_others: set[int] = set()
    for place in scene.reachable(0):
        if nodes[place].type != mi.ObjectType.Shape:
            continue
        inner = scene.references(place)
        lamp = any(nodes[i].type == mi.ObjectType.Emitter for i in inner)
        bsdfs = [i for i in inner if nodes[i].type == mi.ObjectType.BSDF]
        (of_lamps if lamp else of_others).update(*map(scene.reachable, bsdfs))
    places = scene.principled_indices()
    if of_others.isdisjoint(places):
        return frozenset()
    return frozenset(n for n, i in enumerate(places) if i in of_lamps - of_others)


def set_textures(scene: ParsedScene, textures: Mapping[str, object]) -> None:
    """Give every `principled` BSDF these textures, by parameter; all its other parameters stay.

    Raises:
        UserError: there is no such BSDF, so nothing could be fitted.
    """
    set_own_textures(scene, [textures] * len(material_names(scene)))


def set_own_textures(scene: ParsedScene, textures: Sequence[Mapping[str, object]]) -> None:
    """Give each `principled` BSDF textures of its own, by parameter; none: it stays as it is.

    BSDFs with textures of their own are not merged, nor are their shapes.
    """
    for node, own in zip(scene.principled_nodes(), textures, strict=True):
        for slot, texture in own.items():
            node.props[slot] = texture


def wrap_textures(
    scene: ParsedScene, plugin: str, textures: Sequence[Mapping[str, mi.Texture]]
) -> None:
    """Put a texture around parameters of each `principled` BSDF: its own and another one.

    Args:
        plugin: name of the texture; it finds the BSDF's own as `own`, the other as `fitted`.
        textures: the other ones, by parameter, for each BSDF.
    """
    defaults = {quantity.slot: quantity.default for quantity in QUANTITIES.values()}
    nodes = scene.state.nodes
    # By number: a node that is appended moves all others.
    for number, others in zip(scene.principled_indices(), textures, strict=True):
        for slot, other in others.items():
            own = nodes[number].props.get(slot, defaults[slot])
            nodes[number].props[slot] = _texture(scene, plugin, own=own, fitted=other)


def _texture(scene: ParsedScene, plugin: str, **props: Any) -> mi.Properties.ResolvedReference:
    """Append a texture with these properties; a reference to it."""
    node = mi.parser.SceneNode()
    node.type = mi.ObjectType.Texture
    node.props.set_plugin_name(plugin)
    for key, value in props.items():
        node.props[key] = value
    return mi.Properties.ResolvedReference(scene.append(node))


def show_as_albedo(scene: ParsedScene, slot: str, default: float) -> None:
    """Replace each base colour by another parameter, so that an albedo integrator renders it.

    Args:
        scene: changed in place.
        slot: the parameter of `principled`, one number.
        default: what stands for it where the scene does not say.
    """
    nodes, plugin = scene.state.nodes, one_number()
    # By number: a node that is appended moves all others.
    for number in scene.principled_indices():
        value = nodes[number].props.get(slot, default)
        if not isinstance(value, float | int):
            value = _texture(scene, plugin, own=value)
        nodes[number].props["base_color"] = value


def fill_blends(scene: ParsedScene) -> int:
    """Let the BSDF to fit stand on both sides of blends with one that is known.

    For pictures of true materials: Mitsuba gives a blend the mean of what it takes for the albedo
    of the two, which is the peak of the lobe of metals and 0 of glass.

    Args:
        scene: after `to_principled`; changed in place.

    Returns:
        The number of blends changed.
    """
    nodes, fitted, changed = scene.state.nodes, set(scene.principled_indices()), 0
    for node in nodes:
        props = node.props
        if props.plugin_name() != "blendbsdf":
            continue
        inner = {key: props[key].index() for key in list(props) if is_reference(props[key])}
        sides = [key for key, i in inner.items() if nodes[i].type == mi.ObjectType.BSDF]
        known = [key for key in sides if fitted.isdisjoint(scene.reachable(inner[key]))]
        if len(sides) == 2 and len(known) == 1:
            (unknown,) = set(sides) - set(known)
            props[known[0]] = props[unknown]
            changed += 1
    return changed


def set_environment(scene: ParsedScene, emitter: mi.Emitter) -> None:
    """Replace the scene's environment, whatever plugin it is.

    Raises:
        UserError: the scene has no environment.
    """
    root = scene.state.root.props
    for key in list(root):
        node = referenced(scene, root[key])
        if node is not None and node.props.plugin_name() in ENVIRONMENTS:
            # Under a new name: `transform_merge_meshes` of Mitsuba 3.9 makes up names again that
            # the parser has used.
            del root[key]
            root["unknown environment"] = emitter
            return
    raise UserError(
        "the scene has no environment map to fit",
        scene.path,
        "Add one, or fit its lights with --unknown emission",
    )


def set_emission(
    scene: ParsedScene, make: Callable[[int], Sequence[mi.Texture]]
) -> list[NamedEmitter]:
    """Give every emitter of `STRENGTHS` a texture as its strength, also where it had a picture.

    Args:
        make: returns as many textures as it is asked for.

    Returns:
        The emitters before the edit, in the order of their textures.

    Raises:
        UserError: the scene has no such emitter.
    """
    emitters = named_emitters(scene)
    if not emitters:
        raise UserError(
            "the scene has no light to fit: no area, point, spot or directional one",
            scene.path,
            "Add one, or fit its environment map with --unknown lighting",
        )
    for i, texture in zip(emitter_nodes(scene), make(len(emitters)), strict=True):
        props = scene.state.nodes[i].props
        props[STRENGTHS[props.plugin_name()]] = texture
    return emitters


def require_unwrapped(scene: mi.Scene, path: Path) -> None:
    """Raise a `UserError` if a mesh with unknown materials has no texture coordinates."""
    names = painted_meshes_without_uv(scene)
    if names:
        raise UserError(
            f"meshes without texture coordinates cannot have bitmaps: {named(names)}",
            path,
            "Use --representation neural or grid, or unwrap the mesh",
        )
