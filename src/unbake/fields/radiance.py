"""The radiance field L_θ(x, ω): reflected radiance at surface points (Sec. 3.1, 5.3)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from . import registry
from .domain import Domain, SurfacePoint
from .field import Engine, Field, FieldSpec
from .settings import FieldSettings

#: Outputs of the function that is learned, and its inputs beside the position.
OUTPUTS, EXTRA = 6, 12


class RadianceField:
    """Reflected radiance as a function of position, direction, normal and albedo.

    L_θ = s · (3/2 · albedo · a + 1/4 · b) with two outputs a and b of the function that is learned:
    what a surface reflects diffusely has its texture, which need not be learned a second time. On a
    grid a and b depend on the position alone.

    Emission is not part of it: the rendering equation's E is known and added analytically.

    Args:
        function: `OUTPUTS` without bounds, of a position and `EXTRA` further inputs.
        scale: radiance of the untrained field, W·sr⁻¹·m⁻²; the level of the photographs is a good
            one.

    Paper: Sec. 3.1, 5.3.
    """

    def __init__(self, function: Field, domain: Domain, *, scale: float) -> None:
        self.domain = domain
        self.scale = scale
        self.function = function

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays θ by name."""
        return self.function.parameters()

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self.function.assign(parameters)

    def evaluate(
        self,
        p: mi.Point3f,
        w: mi.Vector3f,
        n: mi.Normal3f,
        albedo: mi.Color3f,
        valid: mi.Bool,
        engine: Engine | None = None,
    ) -> mi.Color3f:
        """L_θ at world positions `p` towards `w`.

        Args:
            p: positions, world units.
            w: unit directions that point away from the surface, world space.
            n: unit shading normals on the side of `w`, world space.
            albedo: linear RGB; taken as a constant.
            valid: lanes to evaluate; the others return zero.

        Returns:
            Linear RGB radiance, never negative, with a gradient that never vanishes.
        """
        unit = self.domain.to_unit(p, valid)
        extra = [*(2 * unit - 1), *w, *n, *dr.detach(albedo)]
        extra = [dr.select(valid, x, 0) for x in extra]
        outputs = self.function.evaluate(SurfacePoint(unit), extra, engine)
        raw = [self.scale * _squareplus(x) for x in outputs]
        diffuse, rest = mi.Color3f(raw[:3]), mi.Color3f(raw[3:])
        return dr.select(valid, 1.5 * dr.detach(albedo) * diffuse + 0.25 * rest, 0)


def make_radiance(
    representation: str,
    settings: FieldSettings,
    domain: Domain,
    *,
    scale: float,
    seed: int,
    half: bool = False,
) -> RadianceField:
    """A fresh radiance field.

    Args:
        representation: name of its representation.
        settings: of that representation.
        scale: see `RadianceField`.
        seed: of initial parameters.
        half: products may be in half precision.

    Paper: Sec. 5.3, Fig. 5.
    """
    spec = FieldSpec(outputs=OUTPUTS, extra=EXTRA, seed=seed, half=half)
    return RadianceField(
        registry.representation(representation).field(settings, spec), domain, scale=scale
    )


def _squareplus(x: mi.Float) -> mi.Float:
    """(x + √(x² + 4)) / 2: positive, 1 at zero, linear above, with a live gradient everywhere."""
    root = dr.sqrt(dr.fma(x, x, 4))
    # The same below zero, without the cancellation of two large numbers.
    return dr.select(x > 0, 0.5 * (x + root), 2 * dr.rcp(root - dr.minimum(x, 0)))
