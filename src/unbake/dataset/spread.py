"""Some of many, evenly spread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def places(count: int, most: int) -> np.ndarray:
    """So many numbers from 0 to `count` - 1 at most, evenly spread, in rising order; int64."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def evenly(items: Sequence[Item], most: int) -> list[Item]:
    """So many items at most, evenly spread from the first to the last, in their order."""
    numbers = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[i] for i in numbers.tolist()]
