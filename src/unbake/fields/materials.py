"""The unknown materials φ: albedo and roughness as functions on surfaces (Sec. 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..config import FitConfig
from .bitmap import Bitmaps
from .domain import Domain, SurfacePoint
from .grid import DenseGrid
from .network import Engine, Network, sigmoid

ROUGHNESS_FLOOR = 0.02  #: below it, the microfacet density overflows single precision


@dataclass
class Material:
    """Albedo (linear RGB, [0,1]) and perceptual roughness (α_GGX = roughness², [0.02,1])."""

    albedo: mi.Color3f
    roughness: mi.Float


class Volume:
    """A function of the position alone, bounded to [0,1]: a network or a grid, as a field φ."""

    def __init__(self, function: Network | DenseGrid) -> None:
        self.function = function

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays by name."""
        return self.function.parameters()

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self.function.assign(parameters)

    def __call__(self, point: SurfacePoint, engine: Engine | None = None) -> list[mi.Float]:
        """One array for each output, [0,1]."""
        return [sigmoid(x) for x in self.function(point.position, [], engine)]


class Materials:
    """Albedo and roughness fields.

    Roughness shows far less in photographs than albedo does, so that its field may well be coarser.

    Args:
        albedo: a field of three outputs.
        roughness: a field of one output.

    Paper: Sec. 5.1, 5.3.
    """

    def __init__(self, albedo: Volume | Bitmaps, roughness: Volume | Bitmaps) -> None:
        #: Set once the scene's extent is known, before the first evaluation. (The scene is made
        #: with textures of these materials in it.)
        self.domain = Domain.unit()
        #: The number of each shape's material, by `registry_number`. It is needed where materials
        #: have fields of their own, and then set together with the domain.
        self.slots: dict[int, int] = {}
        self.fields = {"albedo": albedo, "roughness": roughness}
        #: Whether textures read the values put on the surface interaction by `carry`. It must not
        #: change between an evaluation and its differentiation, which calls the textures again.
        self.carried = True

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays φ by name."""
        return {
            f"{name}.{key}": value
            for name, field in self.fields.items()
            for key, value in field.parameters().items()
        }

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        for name, field in self.fields.items():
            field.assign({k: parameters[f"{name}.{k}"] for k in field.parameters()})

    def stand_alone(self) -> None:
        """From now on, textures evaluate the fields themselves, as stock integrators need it."""
        for field in self.fields.values():
            if isinstance(field, Volume) and isinstance(field.function, Network):
                field.function.pack()
        self.carried = False

    def albedo_at(self, si: mi.SurfaceInteraction3f, valid: mi.Bool) -> mi.Color3f:
        """The albedo alone, where no BSDF will be asked."""
        return mi.Color3f(self.fields["albedo"](self._locate(si, valid)))

    def evaluate(
        self, si: mi.SurfaceInteraction3f, valid: mi.Bool, engine: Engine | None = None
    ) -> Material:
        """The materials at surface interactions; see `Network.__call__` for the engines."""
        point = self._locate(si, valid)
        albedo = self.fields["albedo"](point, engine)
        (roughness,) = self.fields["roughness"](point, engine)
        roughness = dr.fma(roughness, 1 - ROUGHNESS_FLOOR, ROUGHNESS_FLOOR)
        return Material(mi.Color3f(albedo), roughness)

    def evaluate_near(
        self, si: mi.SurfaceInteraction3f, valid: mi.Bool, sample: mi.Point2f, radius: float
    ) -> Material:
        """The materials at random points near surface interactions.

        Args:
            sample: uniform random numbers, [0,1)².
            radius: largest distance, in the tangent plane as a fraction of the domain's edge, and
                in texture coordinates as it is.
        """
        offset = radius * mi.warp.square_to_uniform_disk(sample)
        along = self.domain.extent * offset
        near = mi.SurfaceInteraction3f(si)
        near.p = si.p + si.sh_frame.s * along.x + si.sh_frame.t * along.y
        near.uv = si.uv + offset
        return self.evaluate(near, valid)

    def _locate(self, si: mi.SurfaceInteraction3f, valid: mi.Bool) -> SurfacePoint:
        position = self.domain.to_unit(si.p, valid)
        slot = self._slot(si.shape) if self.slots else mi.UInt32(0)
        return SurfacePoint(position, si.uv, slot)

    def _slot(self, shape: mi.ShapePtr) -> mi.UInt32:
        # Each shape is asked once, while this is recorded. (A table would be an array that comes
        # from outside of a frozen function.)
        return dr.dispatch(shape, lambda s: mi.UInt32(self.slots.get(registry_number(s), 0)))


def with_joint_gradients(material: Material) -> Material:
    """The same material, whose gradients are computed together; not inside of loops.

    One after the other, those of albedo and of roughness would each differentiate every BSDF that
    reads the material.
    """
    if not dr.grad_enabled(material):
        return material
    return Material(*dr.custom(_Together, [material.albedo, material.roughness]))


class _Together(dr.CustomOp):
    """Passes values on, and evaluates their gradients in one kernel."""

    def eval(self, values):
        return values

    def backward(self):
        gradients = self.grad_out()
        dr.eval(gradients)
        self.set_grad_in("values", gradients)

    def name(self):
        return "together"


def registry_number(shape: mi.Shape) -> int:
    """The number by which arrays of shapes refer to this one."""
    return int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])


def make_materials(config: FitConfig, names: list[str], *, seed: int) -> Materials:
    """Fresh materials in the representation that the settings name.

    Args:
        names: of the scene's materials; bitmaps alone want to know them.
        seed: of the initial weights of networks.

    Raises:
        UserError: bitmaps would be larger than an array can be.

    Paper: Sec. 5.3, Fig. 5, Sec. 8.
    """
    match config.representation:
        case "neural":
            half = config.half_precision
            albedo = Network(config.albedo, extra=0, outputs=3, seed=seed, half=half)
            roughness = Network(config.roughness, extra=0, outputs=1, seed=seed + 1, half=half)
            return Materials(Volume(albedo), Volume(roughness))
        case "grid":
            albedo = DenseGrid(config.grid.albedo, outputs=3)
            roughness = DenseGrid(config.grid.roughness, outputs=1)
            return Materials(Volume(albedo), Volume(roughness))
        case "bitmap":
            return Materials(
                Bitmaps(config.bitmap.albedo, names, channels=3),
                Bitmaps(config.bitmap.roughness, names, channels=1),
            )


def carry(si: mi.SurfaceInteraction3f, material: Material) -> None:
    """Put the materials of a vertex on its surface interaction, for the textures to read.

    They travel in `dn_du` and `dn_dv`, which no BSDF uses. So fields are asked once a vertex,
    outside of any virtual call, however often BSDFs ask for their textures.
    """
    si.dn_du = mi.Vector3f(material.albedo)
    si.dn_dv = mi.Vector3f(material.roughness, 0, 0)
