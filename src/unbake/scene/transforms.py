"""Scenes written as XML, with transforms and names as they are.

Mitsuba 3.9.1 writes a transform along the axes as a scale, a rotation and a translation, which it
finds by an iteration that ends too soon: a scale of 300 becomes 300.65, one of 3,000 becomes 9,128,
one of 0.001 becomes 0.0013. Some that mirror and turn a shape lose the mirror. It drops ids that
nothing refers to, by which people know shapes, materials and lights; those are kept.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from .parse import ParsedScene

#: Scales between these are written as they are; others become matrices.
_LEAST, _LARGEST = 0.05, 20.0
#: How a translation along x alone is written, by which transforms are found again.
_MARK = re.compile(r'<translate x="(\d+)"/>')
#: A parameter of a scene.
_DECLARED = re.compile(r'<default name="(\w+)"')
#: A property that shapes have while they are written, by which they are found again.
_NUMBER = "unbake number"
#: Ids that nobody chose: of Mitsuba, and of its add-on for Blender.
_UNNAMED = re.compile(r"_+(unnamed_|arg_)?\d+$|elm__\d+$")


def write_nodes(scene: ParsedScene, file: Path) -> None:
    """Write a scene's nodes, shapes, materials and lights with their ids, each once.

    Ids that nobody chose are left out unless references need them.

    Args:
        scene: is the same afterwards.
        file: to write.

    Raises:
        RuntimeError: Mitsuba cannot write it, or writes it in an unknown way.
    """
    kept: list[tuple[Any, str, Any]] = []
    named: list[Any] = []
    marks: dict[int, str] = {}
    try:
        # Nodes that nothing refers to are not written.
        for node in (scene.state.nodes[i] for i in scene.reachable(0)):
            for key in list(node.props):
                value = node.props[key]
                if node.type == mi.ObjectType.Sensor or not _is_misread(value):
                    continue  # sensors have no scale
                kept.append((node.props, key, value))
                # Numbers that no scene has as a translation of its own, along x alone.
                mark = 987_654_000 + len(kept)
                marks[mark] = " ".join(repr(x) for x in matrix_of(value).ravel().tolist())
                node.props[key] = mi.ScalarTransform4d().translate([mark, 0, 0])
            if _is_named(node):
                node.props[_NUMBER] = len(named)
                named.append(node.props)
        mi.parser.write_file(scene.state, str(file))
    finally:
        for props, key, value in kept:
            props[key] = value
        for props in named:
            del props[_NUMBER]
    text = file.read_text(encoding="utf-8")
    if not marks and not named and "$" not in text:
        return
    found: set[int] = set()

    def exact(match: re.Match[str]) -> str:
        mark = int(match[1])
        if mark not in marks:
            return match[0]
        found.add(mark)
        return f'<matrix value="{marks[mark]}"/>'

    text = _MARK.sub(exact, text)
    if found != marks.keys():
        raise RuntimeError("Mitsuba writes transforms in an unknown way")
    if named:
        text = _with_ids(text, [props.id() for props in named])
    file.write_text(_with_own_dollars(text), encoding="utf-8")


def _with_own_dollars(text: str) -> str:
    """A scene's XML with dollars of names escaped: they do not begin a parameter.

    Mitsuba writes names as they are, beside some parameters of its own, which it declares.
    """
    declared = "|".join(map(re.escape, _DECLARED.findall(text)))
    own = rf"(?!(?:{declared})\b)" if declared else ""
    return re.sub(rf"\${own}", r"\$", text)


def _is_named(node: Any) -> bool:
    """Whether a node is a shape, a material or a light with an id by which people know it."""
    if node.type not in (mi.ObjectType.Shape, mi.ObjectType.BSDF, mi.ObjectType.Emitter):
        return False
    return bool(chosen_id(node))


def chosen_id(node: Any) -> str:
    """The id of a node that somebody chose for it; empty where nobody did.

    The built-in scenes call the shape of `lamp.ply` `lamp_shape`, and all know it as `lamp`.
    """
    name, file = node.props.id(), Path(str(node.props.get("filename", "")))
    return "" if _UNNAMED.match(name) or name == f"{file.stem}_shape" else name


def _with_ids(text: str, ids: list[str]) -> str:
    """A scene's XML with the ids of its numbered elements in place of their numbers.

    Raises:
        RuntimeError: it is no XML.
    """
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise RuntimeError(f"Mitsuba writes what is no XML: {error}") from None
    taken = {element.get("id") for element in root.iter()}
    for element in root.iter():
        number = element.find(f"integer[@name='{_NUMBER}']")
        if number is None:
            continue
        element.remove(number)
        if not len(element):
            element.text = None
        name = ids[int(number.get("value", ""))]
        if name not in taken and not element.get("id"):
            taken.add(name)
            element.set("id", name)
    ElementTree.indent(root, "    ")
    return ElementTree.tostring(root, encoding="unicode")


def _is_misread(value: object) -> bool:
    """Whether a property is a transform that Mitsuba would write as another one."""
    if not isinstance(value, (mi.ScalarAffineTransform4d, mi.ScalarProjectiveTransform4d)):
        return False
    linear = matrix_of(value)[:3, :3]
    scales = np.linalg.svd(linear, compute_uv=False)
    usual = _LEAST <= scales[-1] and scales[0] <= _LARGEST
    return not usual or np.linalg.det(linear) < 0


def matrix_of(value: Any) -> np.ndarray:
    """The matrix of a transform among a node's properties, (4, 4) float64."""
    return np.array(value.matrix, np.float64).reshape(4, 4)
