"""A field as a Mitsuba texture, so that stock BSDFs and stock integrators run on it (Sec. 5.1)."""

from __future__ import annotations

import re
from functools import cache

import drjit as dr
import mitsuba as mi

from ..quantities import QUANTITIES
from .materials import Materials, is_carrying, read_carried
from .shapes import met_shapes, registry_number

#: By which the BSDF's parameters tell the number of its material.
_NUMBER = "material_number"


@cache
def texture_base(variant: str) -> type[mi.Texture]:
    """A class for textures in Python that vary over surfaces, with values from 0 to 1.

    Args:
        variant: the one that is active; `mi.Texture` exists only once there is one.
    """

    class Varying(mi.Texture):
        def eval_3(self, si, active=True):
            return self.eval(si, active)

        def mean(self):
            return mi.Float(0.5)

        def max(self):
            return 1.0

        def is_spatially_varying(self):
            return True

    return Varying


def material_textures(materials: Materials, number: int = 0) -> dict[str, mi.Texture]:
    """A texture for each unknown quantity, by the slot of a `principled` BSDF that it is for.

    Within `carrying` they read what `carry` put on the surface interaction. Elsewhere they evaluate
    the field at the interaction, with cooperative vectors, so that any integrator of Mitsuba can
    render the scene; see `Materials.stand_alone`.

    Args:
        number: of the material, where materials have fields of their own; see `material_numbers`.

    Paper: Sec. 5.1.
    """

    # The class is made here because `mi.Texture` exists only once a variant has been chosen.
    class FieldTexture(texture_base(mi.variant())):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.quantity = props["quantity"]

        def lookup(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f | mi.Float:
            # A path that carried materials with gradients calls the textures again when it is
            # differentiated, which may be after `carrying`.
            carried = materials.carried or is_carrying() or dr.grad_enabled(si.dn_du, si.dn_dv)
            if carried:
                material = read_carried(si, materials)
            else:
                material = materials.evaluate(si, mi.Bool(active), engine="coopvec")
            return material[self.quantity]

        def eval(self, si, active=True):
            return mi.Color3f(self.lookup(si, active))

        def eval_1(self, si, active=True):
            value = self.lookup(si, active)
            return mi.luminance(value) if isinstance(value, mi.Color3f) else value

        def traverse(self, callback):
            callback.put(_NUMBER, number, mi.ParamFlags.NonDifferentiable)

        def to_string(self):
            return f"FieldTexture[{self.quantity}]"

    textures = {}
    for name in materials:
        props = mi.Properties()
        props["quantity"] = name
        textures[QUANTITIES[name].slot] = FieldTexture(props)
    return textures


def material_numbers(scene: mi.Scene) -> dict[int, int]:
    """The number of the material of each shape, from the textures of its BSDF.

    A shape whose BSDF holds several materials, as a blend does, has the first. Shapes without such
    textures are left out.

    Returns:
        Numbers of materials by the shapes' numbers in Dr.Jit's registry.
    """
    numbers = {registry_number(shape): _number_of(shape) for shape in met_shapes(scene)}
    return {shape: number for shape, number in numbers.items() if number is not None}


def painted_meshes_without_uv(scene: mi.Scene) -> list[str]:
    """The names of meshes that have textures of fields, but no texture coordinates."""
    meshes = [
        shape for shape in met_shapes(scene) if shape.is_mesh() and _number_of(shape) is not None
    ]
    bare = [mesh for mesh in meshes if not mesh.has_vertex_texcoords()]
    # Mitsuba tells the names of meshes in their printed form alone.
    names = [re.search(r'^  name = "(.*)"', str(mesh), re.MULTILINE) for mesh in bare]
    return [name[1] if name else "a mesh" for name in names]


def _number_of(shape: mi.Shape) -> int | None:
    bsdf = shape.bsdf()
    found = [] if bsdf is None else mi.traverse(bsdf).items()
    return next((value for key, value in found if key.endswith(_NUMBER)), None)
