"""Which surfaces have a material that is optimized, or could be: its only definition."""

from __future__ import annotations

import mitsuba as mi

from ..fields.shapes import bsdf_classes, met_shapes, registry_number


def has_optimized_material(shape: mi.Shape) -> bool:
    """Whether a shape's BSDF is `principled`, or holds one, and the shape emits no light.

    BSDFs that hold others are `twosided`, `mask`, `bumpmap`, `normalmap` and `blendbsdf`. Diffuse
    and rough plastic count only once `scene.edit.to_principled` has changed them.
    """
    return not shape.is_emitter() and "Principled" in bsdf_classes(shape)


def optimized_shapes(scene: mi.Scene) -> frozenset[int]:
    """The shapes of optimized material, by their numbers in Dr.Jit's registry.

    Shapes of groups, which rays meet through instances, are among them.
    """
    shapes = filter(has_optimized_material, met_shapes(scene))
    return frozenset(registry_number(shape) for shape in shapes)
