"""Numbers and pictures of a scene that no surface and no light has."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.shapes import met_shapes
from ..quantities import QUANTITIES, Quantity
from .emitters import ENVIRONMENTS, STRENGTHS
from .parse import ParsedScene, is_reference, is_spectrum

#: Files that can hold any number; those of codes hold 0 to 1.
_FLOATS = (".exr", ".hdr", ".rgbe", ".pfm")
#: What rounding and resampling may add, as a part of the largest value.
_SLACK = 1e-3
_ATTRIBUTE = re.compile(r'MeshAttribute\[\s*name = "(.*)"')
_COLOURS = ("color0", "color1")


def value_faults(scene: ParsedScene) -> list[UserError]:
    """What is wrong with what surfaces reflect and lights give, each with its file or line.

    Photographs of such a scene cannot be explained, and its true materials are not those that its
    photographs show.

    Args:
        scene: after `to_principled`.
    """
    faults: list[UserError] = []
    nodes, looked = scene.state.nodes, set()
    for place in scene.reachable(0):
        plugin, props = nodes[place].props.plugin_name(), nodes[place].props
        if plugin == "principled":
            for quantity in QUANTITIES.values():
                faults += _of_slot(scene, place, quantity, looked)
        if plugin in STRENGTHS and (key := STRENGTHS[plugin]) in props:
            value = props[key]
            inner = value.index() if is_reference(value) else None
            picture = None if inner is None else nodes[inner].props.get("filename", None)
            if isinstance(picture, str):
                faults += _of_picture(Path(picture), None, "radiance", looked)
            elif (range_ := _range(value)) is not None and range_[0] < 0:
                faults.append(_negative(scene, place, key, range_[0]))
        scale = props.get("scale", None)
        if nodes[place].type == mi.ObjectType.Emitter and isinstance(scale, int | float):
            faults += [_negative(scene, place, "scale", scale)] if scale < 0 else []
        picture = props.get("filename", None)
        if plugin in ENVIRONMENTS and isinstance(picture, str):
            faults += _of_picture(Path(picture), None, "the environment map", looked)
    return faults


def attribute_faults(scene: mi.Scene, path: Path) -> list[UserError]:
    """Textures that read values which their meshes do not have: they would be black.

    Args:
        scene: whose shapes are apart.
        path: its file.

    Returns:
        An error for each, with the shape and the values; each is told once.
    """
    found = {}
    for shape in met_shapes(scene):
        bsdf = shape.bsdf()
        for node in () if bsdf is None else mi.traverse(bsdf).hierarchy:
            if not node.class_name().startswith("MeshAttribute"):
                continue
            name = _ATTRIBUTE.search(str(node))
            if name is not None and not np.all(shape.has_attribute(name[1])):
                which = f"the shape {shape.id()!r}" if shape.id() else "a shape without an id"
                what = f"{which} has no {name[1]!r}, which its material reads"
                remedy = "Correct the name, or give a bitmap"
                if name[1].startswith("vertex_"):  # other numbers of PLY files are not read
                    one = name[1].removeprefix("vertex_")
                    remedy += f". Of a PLY file it is what is called {one}_x, or {one}_r, _g and _b"
                found[what] = UserError(what, path, remedy)
    return [*found.values()]


def _negative(scene: ParsedScene, place: int, key: str, value: float) -> UserError:
    where = mi.parser.file_location(scene.state, scene.state.nodes[place])
    remedy = "No light is negative: correct it"
    return UserError(f"{key!r} of the light is {value:g}", where, remedy)


def _of_slot(
    scene: ParsedScene, place: int, quantity: Quantity, looked: set[tuple[Path, str]]
) -> list[UserError]:
    """What is wrong with a parameter of a material."""
    nodes = scene.state.nodes
    value = nodes[place].props.get(quantity.slot, None)
    holder, values = nodes[place], {quantity.slot: value}
    if is_reference(value):
        holder = nodes[value.index()]
        plugin, picture = holder.props.plugin_name(), holder.props.get("filename", None)
        if plugin == "bitmap" and isinstance(picture, str):
            return _of_picture(Path(picture), quantity.upper, quantity.slot, looked)
        if plugin != "checkerboard":
            return []
        values = {key: holder.props.get(key, None) for key in _COLOURS}
    faults = []
    for key, given in values.items():
        found = _range(given)
        least, most = -_SLACK * quantity.upper, (1 + _SLACK) * quantity.upper
        if found is None or (found[0] >= least and found[1] <= most):
            continue
        what = f"{key!r} is {_shown(found)}, not from 0 to {quantity.upper:g}"
        where = mi.parser.file_location(scene.state, holder)
        faults.append(UserError(what, where, "No surface has that: correct it"))
    return faults


def _of_picture(
    file: Path, upper: float | None, name: str, looked: set[tuple[Path, str]]
) -> list[UserError]:
    """What is wrong with the pixels of a picture; each is looked at once.

    Args:
        upper: the largest value that makes sense; None: any does.
        name: of what it holds.
        looked: files that were, and as what.
    """
    if file.suffix.lower() not in _FLOATS or (file, name) in looked:
        return []
    looked.add((file, name))
    try:
        pixels = np.array(mi.Bitmap(str(file)), np.float32)
    except (RuntimeError, MemoryError, ValueError):
        return []  # Mitsuba tells what is wrong when the scene is made
    pixels = np.atleast_3d(pixels)
    colours = pixels[..., : 3 if pixels.shape[2] > 2 else 1]
    bad = int((~np.isfinite(colours)).any(-1).sum())
    if bad:
        return [UserError(f"{bad} pixels of {name} are NaN or infinite", file, "Correct them")]
    least, most = (0, np.inf) if upper is None else (-_SLACK * upper, (1 + _SLACK) * upper)
    bad = int(((colours < least) | (colours > most)).any(-1).sum())
    if not bad:
        return []
    found = float(colours.min()), float(colours.max())
    if upper is None:
        return [UserError(f"{bad} pixels of {name} are negative", file, "Set them to zero")]
    what = f"{bad} pixels of {name!r} are not from 0 to {upper:g}, but {_shown(found)}"
    return [UserError(what, file, "No surface has that: limit them")]


def _range(value: Any) -> tuple[float, float] | None:
    """The least and the largest of a number, a colour or a spectrum; None of all else."""
    if is_spectrum(value):
        value = value.values
    elif not (isinstance(value, int | float) or dr.is_array_v(value)):
        return None
    numbers = np.ravel(np.array(value, np.float64))
    return (float(numbers.min()), float(numbers.max())) if numbers.size else None


def _shown(found: tuple[float, float]) -> str:
    least, largest = found
    return f"{least:g}" if least == largest else f"{least:g} to {largest:g}"
