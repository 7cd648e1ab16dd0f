"""The true materials that a view sees, and the pixels of a view that scores count."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from ..quantities import QUANTITIES
from .views import View, read_mask, read_view


@dataclass(frozen=True)
class GroundTruth:
    """The true materials that a view sees."""

    values: Mapping[str, np.ndarray]  # by quantity, (H, W, channels)
    known: np.ndarray  # (H, W) bool: unmasked, and all of it sees a material that is optimized

    @staticmethod
    def of(view: View, names: Iterable[str] | None = None) -> GroundTruth | None:
        """The truth images of a view; None where it has none.

        Args:
            names: quantities to read, as far as there are images of them; None: all.

        Raises:
            UserError: an image or the mask cannot be read.
        """
        chosen = set(view.truth if names is None else names)
        files = {name: file for name, file in view.truth.items() if name in chosen}
        images = {name: read_view(file, view) for name, file in files.items()}
        if not images:
            return None
        values = {name: x[..., : QUANTITIES[name].channels] for name, x in images.items()}
        known = np.all([x[..., 3] >= 1 for x in images.values()], axis=0)
        counted = read_mask(view)
        return GroundTruth(values, known if counted is None else known & counted)


def counted_pixels(photograph: np.ndarray, known: np.ndarray | None) -> np.ndarray:
    """The pixels of a view that scores of its rendering count, (H, W) bool.

    Args:
        photograph: (H, W, 4), with alpha, which is 0 where it is masked.
        known: the pixels whose materials are compared with the truth, (H, W) bool; None where there
            is no truth: every pixel counts that is not masked or transparent.
    """
    alpha = photograph[..., 3]
    return alpha >= 1 if known is None else known & (alpha > 0)
