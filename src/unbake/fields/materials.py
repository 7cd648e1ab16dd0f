"""The unknown materials φ: quantities as functions on surfaces (Sec. 5.1)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..errors import UserError
from ..quantities import CARRIED, QUANTITIES, Quantity, channels_of, in_order
from . import registry
from .domain import Domain, SurfacePoint
from .field import Engine, Field, FieldSpec
from .pieces import Pieces
from .settings import FieldSettings
from .shapes import registry_number

#: Values by the name of their quantity: linear RGB, or one number, within the quantity's bounds.
#: Roughness is perceptual (α_GGX = roughness²).
Material = dict[str, "mi.Color3f | mi.Float"]
_CARRYING = ContextVar("carrying", default=False)


class Materials(Mapping[str, Field]):
    """The fields of the unknown quantities, by name.

    Args:
        fields: by quantity, each with as many outputs as the quantity has channels, in (0, 1).

    Paper: Sec. 5.1, 5.3.
    """

    def __init__(self, fields: Mapping[str, Field]) -> None:
        #: Set once the scene's extent is known, before the first evaluation. (The scene is made
        #: with textures of these materials in it.)
        self.domain = Domain.unit()
        #: The number of each shape's material, by `registry_number`. It is needed where materials
        #: have fields of their own, and then set together with the domain.
        self.numbers: dict[int, int] = {}
        #: Of the scene; set together with the domain, where fields have values of pieces.
        self.pieces: Pieces | None = None
        #: Whether textures read what `carry` put on the surface interaction even outside of
        #: `carrying`, rather than evaluate the fields, which are not prepared for that. While it is
        #: set, integrators of Mitsuba render wrong materials; `stand_alone` clears it.
        self.carried = True
        self._fields = {name: fields[name] for name in in_order(fields)}

    def __getitem__(self, name: str) -> Field:
        return self._fields[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fields)

    def __len__(self) -> int:
        return len(self._fields)

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays φ by name; the first word is the quantity's."""
        return {
            f"{name}.{key}": value
            for name, field in self.items()
            for key, value in field.parameters().items()
        }

    def assign(self, parameters: Mapping[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; outside recorded steps, textures evaluate the fields."""
        for name, field in self.items():
            field.assign({k: parameters[f"{name}.{k}"] for k in field.parameters()})
        recorded = is_carrying() or dr.flag(dr.JitFlag.FreezingScope)
        if self.can_stand_alone and not recorded:
            self.stand_alone()

    @property
    def can_stand_alone(self) -> bool:
        """Whether all fields can be evaluated inside of loops."""
        return all(field.symbolic for field in self.values())

    def stand_alone(self) -> None:
        """From now on, textures evaluate the fields themselves, as stock integrators need it.

        They do so with the present parameters. `assign` of these materials calls it; call it again
        after `assign` of a single field, or in a frozen function.

        Raises:
            UserError: a field cannot be evaluated inside of loops.
        """
        for name, field in self.items():
            if not field.symbolic:
                what = (
                    f"the field of {name} cannot be evaluated inside of loops, as it must be here"
                )
                remedy = "Choose another representation, or a method that does not follow paths"
                raise UserError(what, remedy=remedy)
        for field in self.values():
            field.prepare()
        self.carried = False

    def evaluate(
        self, si: mi.SurfaceInteraction3f, valid: mi.Bool, engine: Engine | None = None
    ) -> Material:
        """The materials at surface interactions; see `Field.evaluate` for the engines."""
        return self.evaluate_at(self.locate(si, valid), engine)

    def evaluate_at(self, point: SurfacePoint, engine: Engine | None = None) -> Material:
        """The materials at points given in all coordinates that fields use."""
        found: Material = {}
        for name, field in self.items():
            found[name] = _bounded(QUANTITIES[name], field.evaluate(point, (), engine))
            if name == "albedo":  # the first in the table: the others may depend on it
                point = replace(point, albedo=dr.detach(found[name]))
        return found

    def evaluate_one(
        self, name: str, si: mi.SurfaceInteraction3f, valid: mi.Bool
    ) -> mi.Color3f | mi.Float:
        """One quantity alone, for points where no BSDF is evaluated."""
        if name != "albedo":
            return self.evaluate(si, valid)[name]
        return _bounded(QUANTITIES[name], self[name].evaluate(self.locate(si, valid)))

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
        return self.evaluate(self._moved(si, offset), valid)

    def evaluate_one_and_near(
        self,
        name: str,
        si: mi.SurfaceInteraction3f,
        valid: mi.Bool,
        sample: mi.Point2f,
        radius: float,
    ) -> tuple[mi.Color3f | mi.Float, mi.Color3f | mi.Float]:
        """One quantity at surface interactions, and at a random point near each.

        The field is asked once for both: its gradients are added up in its tables in one go, which
        takes longer than asking it. The arguments are those of `evaluate_near`.
        """
        lanes = dr.width(valid)
        lane = dr.arange(mi.UInt32, 2 * lanes)
        first = lane < lanes
        source = dr.select(first, lane, lane - lanes)
        si, valid, sample = (dr.gather(type(x), x, source) for x in (si, valid, sample))
        offset = dr.select(first, 0, radius * mi.warp.square_to_uniform_disk(sample))
        both = self.evaluate_one(name, self._moved(si, offset), valid)
        dr.eval(both)
        here = dr.arange(mi.UInt32, lanes)
        return dr.gather(type(both), both, here), dr.gather(type(both), both, here + lanes)

    def _moved(self, si: mi.SurfaceInteraction3f, offset: mi.Vector2f) -> mi.SurfaceInteraction3f:
        """Surface interactions moved in their tangent planes, in fractions of the domain's edge.

        Their texture coordinates move by as much.
        """
        along = self.domain.extent * offset
        near = mi.SurfaceInteraction3f(si)
        near.p = si.p + si.sh_frame.s * along.x + si.sh_frame.t * along.y
        near.uv = si.uv + offset
        return near

    def locate(self, si: mi.SurfaceInteraction3f, valid: mi.Bool) -> SurfacePoint:
        """Surface interactions in all coordinates that fields use, but for the albedo."""
        position = self.domain.to_unit(si.p, valid)
        number = self._number(si.shape) if self.numbers else mi.UInt32(0)
        piece = None if self.pieces is None else self.pieces.at(si, valid)
        return SurfacePoint(position, si.uv, number, piece)

    def _number(self, shape: mi.ShapePtr) -> mi.UInt32:
        # Each shape is asked once, while this is recorded. (A table would be an array that comes
        # from outside of a frozen function.)
        return dr.dispatch(shape, lambda s: mi.UInt32(self.numbers.get(registry_number(s), 0)))


def _bounded(quantity: Quantity, values: list[mi.Float]) -> mi.Color3f | mi.Float:
    """Values in (0, 1) to the quantity's bounds."""
    lower, span = quantity.lower, quantity.upper - quantity.lower
    if (lower, span) != (0, 1):
        values = [dr.fma(x, span, lower) for x in values]
    return mi.Color3f(values) if quantity.channels == 3 else values[0]


def with_joint_gradients(material: Material) -> Material:
    """The same material, whose gradients are computed together; not inside of loops.

    One after the other, those of each quantity would differentiate every BSDF that reads the
    material.
    """
    if not dr.grad_enabled(material):
        return material
    return dr.custom(_Together, material)


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


def make_materials(
    representation: str,
    settings: Mapping[str, FieldSettings],
    names: Sequence[str],
    *,
    seed: int,
    half: bool = False,
    least_slope: float = 0.0,
) -> Materials:
    """Fresh materials.

    Args:
        representation: name of the representation of all quantities.
        settings: of that representation, by quantity; they say which quantities are unknown.
        names: of the scene's materials, for representations with a field for each.
        seed: of initial parameters.
        half: products may be in half precision.
        least_slope: of what bounds quantities that come back; see `FieldSpec`.

    Raises:
        UserError: there is no such representation or quantity, or a field would be too large.

    Paper: Sec. 5.3, Fig. 5, Sec. 8.
    """
    fields = {}
    for number, (name, quantity) in enumerate(QUANTITIES.items()):
        if name not in settings:
            continue
        spec = FieldSpec(
            outputs=quantity.channels,
            bounded=True,
            initial=(quantity.initial - quantity.lower) / (quantity.upper - quantity.lower),
            seed=seed + number,
            half=half,
            least_slope=least_slope if quantity.comes_back else 0.0,
            materials=tuple(names),
        )
        fields[name] = registry.representation(representation).field(settings[name], spec)
    return Materials(fields)


@contextmanager
def carrying() -> Iterator[None]:
    """A context in which all textures of fields read what `carry` put on surface interactions.

    For our own integrators, whose vertices carry it: a field is then asked once a vertex. What is
    evaluated in it may be differentiated after it, where the materials themselves pass gradients.
    """
    token = _CARRYING.set(True)
    try:
        yield
    finally:
        _CARRYING.reset(token)


def is_carrying() -> bool:
    """Whether this is within `carrying`."""
    return _CARRYING.get()


def carry(si: mi.SurfaceInteraction3f, material: Material) -> None:
    """Put the materials of a vertex on its surface interaction, for the textures to read.

    They travel in `dn_du` and `dn_dv`, which no BSDF uses, in the order of the table `QUANTITIES`.
    So fields are asked once a vertex, outside of any virtual call, however often BSDFs ask for
    their textures.
    """
    numbers = []
    for name in in_order(material):
        value = material[name]
        numbers += list(value) if QUANTITIES[name].channels == 3 else [value]
    numbers += [0] * (CARRIED - len(numbers))
    si.dn_du, si.dn_dv = mi.Vector3f(numbers[:3]), mi.Vector3f(numbers[3:])


def read_carried(si: mi.SurfaceInteraction3f, names: Iterable[str]) -> Material:
    """The materials that `carry` put on a surface interaction."""
    numbers = [*si.dn_du, *si.dn_dv]
    found: Material = {}
    for name, part in channels_of(names).items():
        values = numbers[part]
        found[name] = mi.Color3f(values) if len(values) == 3 else values[0]
    return found
