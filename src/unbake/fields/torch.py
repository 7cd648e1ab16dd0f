"""A PyTorch module as a field. Needs PyTorch: `pip install "unbake[torch]"`.

For experiments with what PyTorch has and Dr.Jit has not. PyTorch evaluates and differentiates the
module, with kernels of its own, and nothing of it can be recorded: steps are traced anew each time,
which takes longer; `benchmarks/torch_field.py` measures how much.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi

from ..errors import UserError
from .arrays import first_value, from_numpy, sigmoid
from .domain import SurfacePoint
from .field import Cost, Engine, Field, FieldSpec

if TYPE_CHECKING:
    import torch


class TorchField(Field):
    """A function of a position in [0,1]³ and of further inputs, by a PyTorch module.

    A representation needs settings and one call:

        def make(settings, spec):
            return TorchField(lambda ins, outs: MyModule(ins, settings.width, outs), spec)

        register_representation(Representation("mine", "my module", MySettings(), make))

    The optimiser owns the parameters as Dr.Jit arrays, so that checkpoints and learning rates are
    like those of other fields. Values that the module registers as buffers stay as they are.

    Args:
        build: makes the module of a number of inputs and one of outputs: from (points, inputs), the
            position first, to (points, outputs), both float32. It is called with PyTorch's random
            numbers seeded by `spec.seed`. Where outputs are bounded, they are bounded afterwards.
        spec: what the field is asked to be.

    Raises:
        UserError: there is no PyTorch.
        TypeError: a parameter is not float32.
    """

    recordable = False
    prepare_recordable = False
    symbolic = False

    def __init__(self, build: Callable[[int, int], torch.nn.Module], spec: FieldSpec) -> None:
        torch = _import_torch()
        with torch.random.fork_rng():
            torch.manual_seed(spec.seed)
            self.module = build(3 + spec.extra, spec.outputs)
        self.outputs = spec.outputs
        self.bounded = spec.bounded
        self._least_slope = spec.least_slope
        self._first = first_value(spec)
        self._parameters: dict[str, mi.TensorXf] = {}
        for name, value in self.module.named_parameters():
            if value.dtype != torch.float32:
                raise TypeError(f"the parameter {name} is {value.dtype}, not torch.float32")
            flat = from_numpy(mi.Float, value.detach().cpu().numpy())
            self._parameters[name] = mi.TensorXf(flat, tuple(value.shape))
        on_gpu = dr.backend_v(mi.Float) == dr.JitBackend.CUDA
        self.module.to("cuda" if on_gpu else "cpu")
        self._call = dr.wrap(source="drjit", target="torch")(self._forward)

    def parameters(self) -> dict[str, mi.TensorXf]:
        """The module's parameters by its own names and of its own shapes."""
        return dict(self._parameters)

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on."""
        self._parameters = {name: parameters[name] for name in self._parameters}

    def evaluate(
        self,
        point: SurfacePoint,
        extra: Sequence[mi.Float] = (),
        engine: Engine | None = None,
    ) -> list[mi.Float]:
        """Evaluate the module; it has no other engine."""
        inputs = mi.TensorXf(mi.ArrayXf([*point.position, *extra]))
        found = self._call(self._parameters, inputs)
        lanes = found.shape[1]
        lane = dr.arange(mi.UInt32, lanes)
        values = [dr.gather(mi.Float, found.array, lane + i * lanes) for i in range(self.outputs)]
        values = [x + self._first for x in values]
        return [sigmoid(x, self._least_slope) for x in values] if self.bounded else values

    def cost(self) -> Cost:
        """One product a parameter, as if all of them were weights of dense layers."""
        return Cost(sum(dr.width(value.array) for value in self._parameters.values()), 0)

    def _forward(self, parameters: dict[str, torch.Tensor], inputs: torch.Tensor) -> torch.Tensor:
        """The module on (inputs, points); (outputs, points)."""
        torch = _import_torch()
        outputs = torch.func.functional_call(self.module, parameters, (inputs.T,))
        return outputs.T.contiguous()


def _import_torch():
    try:
        import torch
    except ImportError:
        what = "a field is a PyTorch module, and there is no PyTorch"
        raise UserError(what, remedy='pip install "unbake[torch]"') from None
    return torch
