"""The state of a fit: the optimisers, which own φ and θ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .loss_scaling import first_scale
from .problem import Problem


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
            problem.radiance.assign(dict(self.theta.items()))


def initial_state(problem: Problem) -> State:
    """Optimisers that own the problem's parameters.

    Entries of the hash tables that a step does not touch keep their momentum (`mask_updates`).

    Paper: Sec. 5.4.
    """
    phi = mi.ad.Adam(1e-3, problem.parameters(), mask_updates=True)
    theta = None
    if problem.radiance is not None:
        theta = mi.ad.Adam(1e-3, problem.radiance.parameters(), mask_updates=True)
    scale = first_scale() if problem.half_precision else None
    return State(phi, theta, scale)
