"""A field as a Mitsuba texture, so that stock BSDFs and stock integrators run on it (Sec. 5.1)."""

from __future__ import annotations

import mitsuba as mi

from .materials import Material, Materials


def material_textures(materials: Materials) -> tuple[mi.Texture, mi.Texture]:
    """Two textures, for the albedo and for the roughness of a `principled` BSDF.

    They read what `carry` put on the surface interaction. After `materials.stand_alone()` they
    evaluate the field at the interaction's position instead, with cooperative vectors, so that any
    integrator of Mitsuba can render the recovered scene.

    Paper: Sec. 5.1.
    """

    # The class is made here because `mi.Texture` exists only once a variant has been chosen.
    class FieldTexture(mi.Texture):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.channel = props["channel"]

        def lookup(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> Material:
            if materials.carried:
                return Material(mi.Color3f(si.dn_du), si.dn_dv.x)
            return materials.evaluate(si.p, mi.Bool(active), engine="coopvec")

        def eval(self, si, active=True):
            material = self.lookup(si, active)
            if self.channel == "albedo":
                return material.albedo
            return mi.Color3f(material.roughness)

        def eval_1(self, si, active=True):
            material = self.lookup(si, active)
            return mi.luminance(material.albedo) if self.channel == "albedo" else material.roughness

        def eval_3(self, si, active=True):
            return self.eval(si, active)

        def mean(self):
            return mi.Float(0.5)

        def max(self):
            return 1.0

        def is_spatially_varying(self):
            return True

        def to_string(self):
            return f"FieldTexture[{self.channel}]"

    textures = []
    for channel in ("albedo", "roughness"):
        props = mi.Properties()
        props["channel"] = channel
        textures.append(FieldTexture(props))
    return textures[0], textures[1]
