"""Adam with a memory that grows (ours)."""

from __future__ import annotations

from typing import Any, final

import drjit as dr
import mitsuba as mi
from drjit.opt import Adam

from ..config.fit import OWN_BETA2

#: The memory of squared gradients in steps, over the steps taken.
MEMORY = 0.3


@final
class GrowingAdam(Adam):
    """Adam whose β₂ grows with the steps taken: 1 − 1 / (`MEMORY` t), from `beta_2` to 0.999.

    The squares of a fit's first gradients, which may be ten thousand times as large as later ones,
    are soon forgotten; later, steps are as even as with the usual β₂. A `beta_2` that is at least
    0.999 stays as it is.

    As in Adafactor (Shazeer and Stern 2018), whose β₂ is 1 − t^−0.8.
    """

    def step(self, **options: Any) -> None:
        """Take a step; see `drjit.opt.Adam`."""
        first = self.beta_2
        if first < OWN_BETA2:
            _, _, _, (count, *_) = next(iter(self.state.values()))
            memory = MEMORY * (mi.Float(count) + 1)
            self.beta_2 = dr.clip(1 - dr.rcp(memory), first, OWN_BETA2)
        try:
            super().step(**options)
        finally:
            self.beta_2 = first
