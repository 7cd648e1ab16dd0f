"""Which surfaces have a material that is optimized, or could be: its only definition."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

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


def is_one_sided(shape: mi.Shape) -> bool:
    """Whether a shape's back is black, and could be fitted were it not."""
    if not has_optimized_material(shape):
        return False
    if "TwoSidedBRDF" in bsdf_classes(shape):
        return False
    params = mi.traverse(shape.bsdf())
    # Principled BSDFs say that they have a back; without transmission it is black.
    transmitting = [params[key] for key in params.keys() if "spec_trans" in key]  # noqa: SIM118
    return not any(np.max(np.array(value)) > 0 for value in transmitting)


def one_sided_shapes(scene: mi.Scene) -> frozenset[int]:
    """The shapes whose backs are black by `is_one_sided`, by their numbers in Dr.Jit's registry."""
    return frozenset(registry_number(shape) for shape in met_shapes(scene) if is_one_sided(shape))
