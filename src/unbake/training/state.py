"""The state of a fit: the optimisers, which own φ and θ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.arrays import from_numpy
from .adam import GrowingAdam
from .loss_scaling import first_scale
from .problem import Problem

#: What `State.restore` brings back, by optimiser and parameter; and the scale of the loss.
Snapshot = tuple[dict[str, dict[str, Any]], "mi.Float | None"]


@dataclass
class State:
    """The optimisers, which own φ and θ, and the scale of the loss (`loss_scaling.py`)."""

    phi: mi.ad.Adam
    theta: mi.ad.Adam | None
    scale: mi.Float | None = None  # None: single precision, not scaled

    def optimizers(self) -> list[tuple[str, mi.ad.Adam]]:
        """The optimisers with their names, `phi` and `theta`."""
        both = [("phi", self.phi), ("theta", self.theta)]
        return [(name, optimizer) for name, optimizer in both if optimizer is not None]

    def set_learning_rates(self, rates: Mapping[str, float]) -> None:
        """Set Adam's rates, as arrays: a changed Python number would be traced anew.

        Each parameter gets an array of its own because Dr.Jit's Adam multiplies it in place.

        Args:
            rates: see `learning_rates`.
        """
        named = {key: rates[key.partition(".")[0]] for key in self.phi}
        self.phi.set_learning_rate({k: dr.opaque(mi.Float, r) for k, r in named.items()})
        if self.theta is not None:
            rate = rates["radiance"]
            self.theta.set_learning_rate({k: dr.opaque(mi.Float, rate) for k in self.theta})

    def publish(self, problem: Problem) -> None:
        """Assign the present parameters to the problem's fields."""
        problem.assign(dict(self.phi.items()))
        if problem.radiance is not None and self.theta is not None:
            problem.assign_learned(dict(self.theta.items()))

    def snapshot(self) -> Snapshot:
        """The present state. Nothing is copied: steps make new arrays, and do not change old ones.

        It takes memory from the next step on, as much as the state.
        """
        kept = {
            name: {
                key: (_same(value), tuple(map(_same, extra[:3])))
                for key, (value, _, _, extra) in optimizer.state.items()
            }
            for name, optimizer in self.optimizers()
        }
        return kept, None if self.scale is None else _same(self.scale)

    def restore(self, snapshot: Snapshot) -> None:
        """Go back to a snapshot, which can be used again."""
        kept, scale = snapshot
        self.scale = None if scale is None else _same(scale)
        for name, optimizer in self.optimizers():
            for key, (_, promoted, rate, _) in list(optimizer.state.items()):
                value, extra = kept[name][key]
                value = _same(value)
                dr.enable_grad(value)
                optimizer.state[key] = (value, promoted, rate, (*map(_same, extra), None))

    def replace(self, values: Mapping[str, mi.Float | mi.TensorXf]) -> None:
        """Use these values of some of φ from now on; moments stay as they are."""
        for key, value in values.items():
            _, promoted, rate, extra = self.phi.state[key]
            value = _same(value)
            dr.enable_grad(value)
            self.phi.state[key] = (value, promoted, rate, extra)

    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers by name: parameters, the optimisers' moments and counts, and the scale."""
        arrays = {}
        for name, optimizer in self.optimizers():
            for key, (value, _, _, extra) in optimizer.state.items():
                count, first, second, _ = extra
                arrays[f"{name}.{key}"] = value.numpy()
                arrays[f"{name}.{key}:m"] = first.numpy()
                arrays[f"{name}.{key}:v"] = second.numpy()
                arrays[f"{name}.{key}:t"] = np.asarray(count).astype(np.uint32).ravel()[:1]
        if self.scale is not None:
            arrays["scale"] = np.array(self.scale)
        return arrays

    def assign(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Use these numbers from now on, by the names and in the shapes of `arrays`.

        The scale may be missing, as of a fit in single precision.
        """
        if self.scale is not None and "scale" in arrays:
            self.scale = dr.opaque(mi.Float, float(arrays["scale"][0]))
        for name, optimizer in self.optimizers():
            for key, (value, promoted, rate, _) in list(optimizer.state.items()):
                full = f"{name}.{key}"
                first, second = (from_numpy(mi.Float, arrays[f"{full}:{x}"]) for x in "mv")
                count = dr.opaque(mi.UInt32, int(arrays[f"{full}:t"][0]))
                new = from_numpy(mi.Float, arrays[full])
                if dr.is_tensor_v(value):
                    new = mi.TensorXf(new, value.shape)
                dr.enable_grad(new)
                optimizer.state[key] = (new, promoted, rate, (count, first, second, None))

    def numbers(self) -> np.ndarray:
        """All numbers one after the other, float32; counts are exact up to 2^24 steps."""
        return np.concatenate([a.ravel() for a in self.arrays().values()], dtype=np.float32)

    def assign_numbers(self, numbers: np.ndarray) -> None:
        """Use these numbers from now on, in the order of `numbers`; counts are rounded."""
        now = self.arrays()
        ends = np.cumsum([array.size for array in now.values()])
        parts = np.split(numbers, ends[:-1])
        self.assign(
            {
                name: np.rint(part) if array.dtype == np.uint32 else part
                for (name, array), part in zip(now.items(), parts, strict=True)
            }
        )

    def moved(self) -> bool:
        """Whether any gradient has reached the unknowns, as Adam's moments tell."""
        moments = [extra[2] for _, _, _, extra in self.phi.state.values()]
        return any(dr.any(moment.array != 0)[0] for moment in moments)

    def unreached(self, key: str, width: int) -> np.ndarray:
        """Numbers of the rows of an unknown that no gradient has reached, as Adam's moments tell.

        Args:
            key: of a parameter.
            width: entries of a row.
        """
        _, _, _, extra = self.phi.state[key]
        return np.flatnonzero((np.array(extra[2].array).reshape(-1, width) == 0).all(axis=1))

    def broken(self) -> list[str]:
        """Names of the parameters that are not finite, or whose moments in Adam are not."""
        good = {}
        for name, optimizer in self.optimizers():
            for key, (value, _, _, (_, *moments, _)) in optimizer.state.items():
                finite = mi.Bool(True)
                for numbers in (dr.detach(value), *moments):
                    finite &= dr.all(dr.isfinite(numbers.array))
                good[key if name == "phi" else f"radiance.{key}"] = finite
        dr.eval(good)
        return [name for name, finite in good.items() if not finite[0]]


def initial_state(problem: Problem) -> State:
    """Optimisers that own the problem's parameters.

    Entries of the hash tables that a step does not touch keep their momentum (`mask_updates`).

    Paper: Sec. 5.4.
    """
    parameters, beta2 = problem.parameters(), problem.beta2
    phi = GrowingAdam(1e-3, parameters, beta_2=beta2, mask_updates=True)
    theta = None
    if problem.radiance is not None:
        theta = mi.ad.Adam(1e-3, problem.learned_parameters(), mask_updates=True)
    scale = first_scale() if problem.half_precision else None
    return State(phi, theta, scale)


def _same(array: Any) -> Any:
    """The same array as another Python object, which does not follow when that one is assigned."""
    return type(array)(dr.detach(array))
