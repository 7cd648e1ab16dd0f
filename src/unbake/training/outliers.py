"""Places of photographs that no material explains: people, trees, what the mesh lacks (ours).

Photographs are parted into blocks. The errors e of a block's pixels are multiplied by a weight w,
and what is taken away costs something, so that the objective has for each pixel

    w e + μ (√w − 1)²,    with its least value at √w = μ / (μ + e)

(Black and Rangarajan 1996; with w at its optimum this is the estimator of Geman and McClure). μ is
a multiple of the mean error of pixels that count. √w is learned with all other unknowns. A block is
drawn many times in a fit where a pixel is drawn once or twice, and things that are in the way are
larger than a pixel. Errors are those of independent samples, whose expectation has no noise of the
rendering in it, and weights are not told from the samples that they multiply: gradients of all
other unknowns stay unbiased.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.pixels import CameraRays
from ..fields.arrays import from_numpy, read_small, sigmoid
from ..transport.loss import as_weight

#: Log odds of √w before it is learned: w is 0.9.
_TRUSTED = 3.0
#: Blocks of less weight are outliers.
LEAST = 0.5
#: Bounds of the mean error that μ is a multiple of.
_LEAST_ERROR, _LARGEST_ERROR = 1e-6, 1.0


@dataclass
class Blocks:
    """Where the blocks of views are; a PyTree, which frozen functions take as an argument."""

    edge: int
    first: mi.UInt32  # number of each view's first block
    across: mi.UInt32  # blocks along a row of each view


@final
class OutlierModel:
    """The weights of blocks of pixels.

    Args:
        cameras: of the training views.
        edge: of a block, in pixels.
        tolerance: μ over the mean error.
    """

    def __init__(self, cameras: Sequence[Camera], edge: int, tolerance: float) -> None:
        self._cameras, self._tolerance = tuple(cameras), tolerance
        self._shapes = [(-(-c.height // edge), -(-c.width // edge)) for c in cameras]
        counts = [rows * columns for rows, columns in self._shapes]
        self.blocks = Blocks(
            edge,
            from_numpy(mi.UInt32, np.cumsum([0, *counts[:-1]])),
            from_numpy(mi.UInt32, np.array([columns for _, columns in self._shapes])),
        )
        self._odds = dr.opaque(mi.Float, 0, sum(counts))

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable array; `assign` takes it back."""
        return {"outliers.odds": self._odds}

    def assign(self, parameters: Mapping[str, Any]) -> None:
        """Use this array from now on; gradients arrive in the array given."""
        self._odds = parameters["outliers.odds"]

    def roots(self, rays: CameraRays, numbers: mi.UInt32, blocks: Blocks | None) -> mi.Float:
        """√w of pixels.

        Args:
            rays: through the pixels of the training views.
            numbers: of the pixels.
            blocks: `self.blocks`, as a frozen function was given them; None: those themselves.
        """
        blocks = blocks or self.blocks
        view = rays.view_of(numbers)
        column, row = rays.place_of(numbers, view)
        first, across = (dr.gather(mi.UInt32, x, view) for x in (blocks.first, blocks.across))
        index = first + row // blocks.edge * across + column // blocks.edge
        return sigmoid(read_small(self._odds, index) + _TRUSTED)

    def cost(self, roots: mi.Float, photometric: mi.Float) -> mi.Float:
        """What it costs to take pixels for outliers, μ (√w − 1)², a mean over pixels.

        Args:
            roots: √w of the pixels of a step.
            photometric: their photometric loss, with these weights.
        """
        kept = dr.mean(dr.square(dr.detach(roots)))
        error = as_weight(photometric / dr.maximum(kept, 1e-3), _LEAST_ERROR, _LARGEST_ERROR)
        return self._tolerance * error * dr.mean(dr.square(roots - 1))

    def taken(self) -> list[np.ndarray]:
        """Which blocks of each training view are outliers, (rows, columns) bool."""
        odds = np.array(dr.detach(self._odds), np.float64) + _TRUSTED
        weights = np.square(1 / (1 + np.exp(-odds)))
        ends = np.cumsum([rows * columns for rows, columns in self._shapes])
        parts = zip(np.split(weights, ends[:-1]), self._shapes, strict=True)
        return [part.reshape(shape) < LEAST for part, shape in parts]

    def masks(self) -> Iterator[np.ndarray]:
        """Which pixels of each training view are outliers, (height, width) bool, view by view."""
        return (self.mask(view, blocks) for view, blocks in enumerate(self.taken()))

    def mask(self, view: int, blocks: np.ndarray) -> np.ndarray:
        """The pixels of blocks of a training view, (height, width) bool; blocks as of `taken`."""
        camera, edge = self._cameras[view], self.blocks.edge
        pixels = blocks.repeat(edge, axis=0).repeat(edge, axis=1)
        return pixels[: camera.height, : camera.width]

    def pixels_in(self, view: int, counted: np.ndarray | None) -> np.ndarray:
        """How many pixels of each block of a training view count, (rows, columns).

        Args:
            counted: (height, width) bool; None: all.
        """
        camera, edge = self._cameras[view], self.blocks.edge
        rows, columns = (np.arange(0, side, edge) for side in (camera.height, camera.width))
        if counted is None:
            heights, widths = (
                np.diff(np.append(starts, side))
                for starts, side in ((rows, camera.height), (columns, camera.width))
            )
            return heights[:, None] * widths
        across = np.add.reduceat(counted, columns, axis=1, dtype=np.int64)
        return np.add.reduceat(across, rows, axis=0)
