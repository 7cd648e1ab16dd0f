"""Bump maps on surfaces whose texture runs along the world's z axis.

Mitsuba 3.9.1's `bumpmap` makes the tangent of its frame from the normal in the frame of the surface
and a tangent in world space. Where the map is flat the former is (0, 0, 1), and a tangent along z
leaves nothing of it: the frame is NaN, as on the walls of an ordinary room. It is enough to turn
texture coordinates by a hundred-thousandth.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from ..fields.shapes import bsdf_classes, met_shapes

if TYPE_CHECKING:
    from .parse import ParsedScene

#: Radians that textures are turned by: more than rounding hides, and less than shows.
_TURN = 1e-5


def turn_rectangles(scene: ParsedScene) -> None:
    """Turn rectangles with a bump map in their own plane, about their middle.

    Args:
        scene: changed in place, before it is made; to be called once.
    """
    nodes = scene.state.nodes
    for place, node in enumerate(nodes):
        if node.props.plugin_name() != "rectangle":
            continue
        if not any(nodes[i].props.plugin_name() == "bumpmap" for i in scene.reachable(place)):
            continue
        turn = mi.ScalarTransform4d().rotate([0, 0, 1], math.degrees(_TURN))
        if "to_world" in node.props:
            turn = mi.ScalarTransform4d(node.props["to_world"].matrix) @ turn
        node.props["to_world"] = turn


def turn_textures(scene: mi.Scene) -> None:
    """Turn the texture coordinates of meshes with a bump map.

    Args:
        scene: changed in place.
    """
    for shape in met_shapes(scene):
        if not shape.is_mesh() or "BumpMap" not in bsdf_classes(shape):
            continue
        params = mi.traverse(shape)
        if "vertex_texcoords" not in params:
            continue  # it has none, or is a rectangle
        uv = np.array(params["vertex_texcoords"], np.float64).reshape(-1, 2)
        params["vertex_texcoords"] = turned(uv).astype(np.float32).ravel()
        params.update()


def turned(uv: np.ndarray, angle: float = _TURN) -> np.ndarray:
    """Texture coordinates (n, 2) float64, turned about (0, 0) by an angle in radians."""
    u, v = uv.T
    cos, sin = math.cos(angle), math.sin(angle)
    return np.stack([cos * u - sin * v, sin * u + cos * v], 1)
