"""The interface of fields, which every representation implements."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol

if TYPE_CHECKING:
    import mitsuba as mi

    from .domain import SurfacePoint
    from .pieces import Piece

#: How networks multiply; see `network.py`. Other representations may do without.
Engine = Literal["fused", "tensor", "coopvec"]


@dataclass(frozen=True)
class FieldSpec:
    """The function that a field has to represent, whatever its representation.

    Args:
        outputs: numbers at a point.
        extra: inputs beside the point; representations of the position alone ignore them.
        bounded: every output lies in (0, 1), and `initial` between; otherwise outputs are any
            numbers, and start near zero.
        initial: value of every output of an untrained field that is bounded.
        least_slope: lower bound on the slope of bounded outputs, in gradients; see `sigmoid`.
        seed: of random initial parameters.
        half: products may be in half precision.
        materials: names of the scene's materials, in the order of `SurfacePoint.material`.
    """

    outputs: int
    extra: int = 0
    bounded: bool = False
    initial: float = 0.5
    least_slope: float = 0.0
    seed: int = 0
    half: bool = False
    materials: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cost:
    """Work of one evaluation at one point, without its gradient."""

    multiply_adds: float
    bytes: float  # read from tables of parameters

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.multiply_adds + other.multiply_adds, self.bytes + other.bytes)


class PlaceNumbers(NamedTuple):
    """Numbers of pieces at corners of one lattice over the unit cube."""

    piece: mi.UInt32  # its number, at each corner
    corner: mi.Point3u  # from 0 to the number of cells
    values: list[mi.Float]  # of each output


class Field(Protocol):
    """A trainable function of points on surfaces.

    Representations may inherit from it for the members that have a value here.
    """

    #: Whether `dr.freeze` can record `evaluate`; where it cannot, steps are traced each time.
    recordable: bool = True
    #: Whether it can record `prepare`, too; methods that evaluate fields in loops need it.
    prepare_recordable: bool = True
    #: Whether fields can be evaluated inside of virtual calls and loops.
    symbolic: bool = True
    #: How many pieces of surface have numbers of their own; all further ones share the last.
    most_pieces: int = 0
    #: Cells of the lattices by which pieces may differ from place to place, coarsest first.
    place_cells: tuple[int, ...] = ()

    def parameters(self) -> dict[str, mi.Float | mi.TensorXf]:
        """The trainable arrays by name; `assign` takes them back."""
        ...

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; gradients arrive in the very arrays given."""
        ...

    def shared(self) -> Set[str]:
        """Names of the parameters that many points share, wherever they are; here none."""
        return frozenset()

    def deviations(self, point: SurfacePoint) -> dict[str, mi.Float]:
        """How much numbers that points share differ, in units of outputs before their bounds.

        Args:
            point: points of the pieces that are asked for.

        Returns:
            `pieces`: the numbers of these pieces, beside what others have, too; `brightnesses`:
            differences between those of a piece that follow each other; `colours`: the same of what
            all pieces share; `own_colours`: what these pieces have for colours, beside all of it.
            Here none.
        """
        return {}

    def raised(self, piece: Piece, by: mi.Float) -> dict[str, mi.Float | mi.TensorXf]:
        """Shared parameters, changed to raise the outputs of pieces before their bounds.

        Args:
            piece: different pieces of surface.
            by: how much higher the outputs of each are, everywhere on it.

        Returns:
            Those that change; here none.
        """
        return {}

    def varied(
        self, piece: Piece, about: Sequence[mi.Float], factor: mi.Float
    ) -> dict[str, mi.Float | mi.TensorXf]:
        """Shared parameters, changed to scale how outputs before their bounds vary within pieces.

        Args:
            piece: different pieces of surface.
            about: of each output, the value on each piece that stays as it is.
            factor: how much others differ from it, in units of how much they would if no piece had
                a factor.

        Returns:
            Those that change; here none.
        """
        return {}

    def placed(self, levels: Sequence[PlaceNumbers]) -> dict[str, mi.Float | mi.TensorXf]:
        """Parameters with which outputs before their bounds differ from place to place.

        They are not among the shared ones: no descent moves them.

        Args:
            levels: what is added, of each lattice of `place_cells`, from the coarsest one on.
                Between corners it is linear; other pieces have nothing.

        Returns:
            Those that change; here none.
        """
        return {}

    def beside_shared(self, point: SurfacePoint) -> list[mi.Float]:
        """The part of the outputs at some points that stays while only shared parameters change.

        Args:
            point: as of `evaluate`.

        Returns:
            For `with_shared`; here the values themselves.
        """
        return self.evaluate(point)

    def with_shared(self, beside: list[mi.Float], point: SurfacePoint) -> list[mi.Float]:
        """`evaluate`, given the part that stays: only shared parameters are looked up again.

        Gradients reach all of these, also those that only searches move.

        Args:
            beside: from `beside_shared` of the same points.
        """
        return beside

    def prepare(self) -> None:
        """Prepare evaluations inside virtual calls and loops; needed after each `assign`."""

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Evaluate the field.

        Args:
            point: where; positions lie in [0,1]³.
            extra: the further inputs, as many as `FieldSpec` says.
            engine: `coopvec` inside of virtual calls and loops; None: the fastest one elsewhere.

        Returns:
            One array for each output.
        """
        ...

    def cost(self) -> Cost:
        """Work of one evaluation, for the least time that a step could take."""
        ...


@contextmanager
def holding(field: Field, numbers: Mapping[str, mi.Float | mi.TensorXf]) -> Iterator[None]:
    """A context in which a field has other numbers in the place of some of its parameters."""
    before = field.parameters()
    field.assign({**before, **numbers})
    try:
        yield
    finally:
        field.assign(before)
