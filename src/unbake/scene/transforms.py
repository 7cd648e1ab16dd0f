"""Scenes written as XML, with transforms as they are.

Mitsuba 3.9.1 writes a transform along the axes as a scale, a rotation and a translation, which it
finds by an iteration that ends too soon: a scale of 300 becomes 300.65, one of 3,000 becomes 9,128,
one of 0.001 becomes 0.0013. Some that mirror and turn a shape lose the mirror.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

if TYPE_CHECKING:
    from .parse import ParsedScene

#: Scales between these are written as they are; others become matrices.
_LEAST, _LARGEST = 0.05, 20.0
#: How a translation along x alone is written, by which transforms are found again.
_MARK = re.compile(r'<translate x="(\d+)"/>')


def write_nodes(scene: ParsedScene, file: Path) -> None:
    """Write a scene's nodes.

    Args:
        scene: is the same afterwards.
        file: to write.

    Raises:
        RuntimeError: Mitsuba cannot write it, or writes transforms in an unknown way.
    """
    kept: list[tuple[Any, str, Any]] = []
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
        mi.parser.write_file(scene.state, str(file))
    finally:
        for props, key, value in kept:
            props[key] = value
    if not marks:
        return
    found: set[int] = set()

    def exact(match: re.Match[str]) -> str:
        mark = int(match[1])
        if mark not in marks:
            return match[0]
        found.add(mark)
        return f'<matrix value="{marks[mark]}"/>'

    text = _MARK.sub(exact, file.read_text(encoding="utf-8"))
    if found != marks.keys():
        raise RuntimeError("Mitsuba writes transforms in an unknown way")
    file.write_text(text, encoding="utf-8")


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
