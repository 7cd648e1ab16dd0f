"""The shapes of a scene that rays meet, also through instances."""

from __future__ import annotations

import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

_GROUP = re.compile(r'ShapeGroup\[\s*name = "(.*)"')


@dataclass(frozen=True)
class PlacedShape:
    """A shape where rays meet it: once, or once an instance."""

    shape: mi.Shape
    to_world: np.ndarray | None  #: (4, 4), of the instance; None: there is none
    instance: mi.Shape | None = None  #: that places it


def registry_number(shape: mi.Shape) -> int:
    """The number by which arrays of shapes refer to this one."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def bsdf_classes(shape: mi.Shape) -> frozenset[str]:
    """The names of Mitsuba's classes of a shape's BSDF and of all that is in it; empty without."""
    bsdf = shape.bsdf()
    if bsdf is None:
        return frozenset()
    return frozenset(node.class_name() for node in mi.traverse(bsdf).hierarchy)


def placed_shapes(scene: mi.Scene) -> list[PlacedShape]:
    """All shapes that rays meet, in the order of `scene.shapes()`, as often as they are placed.

    An `instance` stands for the shapes of its group: those are what interactions name. Mitsuba
    refuses groups of instances and emitters in groups, so there is one level, and it is dark.
    """
    groups: dict[str, list[mi.Shape]] | None = None
    placed = []
    for shape in scene.shapes():
        if shape.class_name() != "Instance":
            placed.append(PlacedShape(shape, None))
            continue
        groups = _groups(scene) if groups is None else groups
        # Mitsuba 3.9 tells the group of an instance in its printed form alone.
        name = _GROUP.search(str(shape))
        if name is None or name[1] not in groups:
            raise ValueError(f"an instance of no known group: {shape}")
        matrix = np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)
        placed += [PlacedShape(one, matrix, shape) for one in groups[name[1]]]
    return placed


def met_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """The shapes that interactions with a scene can name, each once."""
    by_number = {registry_number(placed.shape): placed.shape for placed in placed_shapes(scene)}
    return list(by_number.values())


def _groups(scene: mi.Scene) -> dict[str, list[mi.Shape]]:
    """The shapes of each shape group, by its id."""
    nodes = [n for n in mi.traverse(scene).hierarchy if isinstance(n, mi.Shape)]
    return {
        group.id(): [
            node
            for node in mi.traverse(group).hierarchy
            if isinstance(node, mi.Shape) and node.class_name() != "ShapeGroupPlugin"
        ]
        for group in nodes
        if group.class_name() == "ShapeGroupPlugin"
    }
