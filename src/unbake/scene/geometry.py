"""What a scene's geometry is like, in a few numbers that materials and lights do not change."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from ..fields.domain import Domain
from . import free_space

#: Rays that are traced.
RAYS = 256
#: A ray that hits nothing.
_NOTHING = -1.0
#: Distances that count as equal, as a fraction of the extent.
_SAME = 1e-3
#: Share of rays that end elsewhere above which one is told that scenes may not be the same.
CHANGED = 0.02


def probe(scene: mi.Scene) -> list[float]:
    """How far fixed rays inside of the scene's bounding box go, as fractions of its extent.

    Returns:
        `RAYS` numbers; -1 where a ray hits nothing.
    """
    low, high, _ = free_space.bounds(scene)
    start = np.random.default_rng(0).random((RAYS, 3))
    hits = free_space.trace(scene, low + start * (high - low), free_space.sphere_directions(RAYS))
    share = hits.distance / Domain.of(scene.bbox()).extent
    return [round(float(x), 5) if np.isfinite(x) else _NOTHING for x in share]


def differing(first: Sequence[float], second: Sequence[float]) -> float:
    """The share of rays, from 0 to 1, that end elsewhere in one scene than in another.

    Args:
        first, second: from `probe`.
    """
    return float(np.mean(np.abs(np.subtract(first, second)) > _SAME))
