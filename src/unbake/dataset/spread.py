"""Some of many, evenly spread."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def evenly(items: Sequence[Item], most: int) -> list[Item]:
    """So many items at most, evenly spread from the first to the last, in their order."""
    numbers = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return [items[i] for i in numbers.tolist()]
