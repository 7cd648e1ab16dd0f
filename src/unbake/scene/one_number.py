"""A texture of one number as a colour, to be rendered as Mitsuba's BSDFs read it."""

from __future__ import annotations

from functools import cache

import mitsuba as mi

from ..fields.texture import texture_base

_PLUGIN = "unbake_one_number"


def one_number() -> str:
    """The name of a texture plugin that shows as grey what the texture `own` has as a number.

    BSDFs read roughness by `eval_1`. That is not `eval`: of colours it is the luminance, and the
    squares of a checkerboard change places.
    """
    _register(mi.variant())
    return _PLUGIN


@cache
def _register(variant: str) -> None:
    class OneNumber(texture_base(variant)):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.own = props.get_texture("own")

        def eval(self, si, active=True):
            return mi.Color3f(self.own.eval_1(si, active))

        def eval_1(self, si, active=True):
            return self.own.eval_1(si, active)

        def traverse(self, callback):
            callback.put("own", self.own, mi.ParamFlags.NonDifferentiable)

        def to_string(self):
            return "OneNumber"

    mi.register_texture(_PLUGIN, OneNumber)
