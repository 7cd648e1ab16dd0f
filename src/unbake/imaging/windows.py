"""Means over windows of pixels around each pixel of a picture."""

from __future__ import annotations

from collections.abc import Iterator
from functools import reduce
from itertools import compress
from typing import Literal

import numpy as np

Beyond = Literal["edge", "constant"]
#: Rows that are made at once: what they need stays in the caches of a core.
_ROWS = 64


def bands(height: int, reach: int, rows: int = _ROWS) -> Iterator[tuple[slice, slice, slice]]:
    """A picture in bands of rows, for what looks at neighbours of each pixel.

    Args:
        height: of the picture.
        reach: rows above and below a pixel that are looked at.
        rows: of a band.

    Yields:
        The rows of a band; those that it needs; and where the band lies in these.
    """
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        first = max(0, start - reach)
        yield slice(start, stop), slice(first, stop + reach), slice(start - first, stop - first)


def mean_of_counted(
    image: np.ndarray, weight: np.ndarray, radius: int, *, without: int | None = None
) -> np.ndarray:
    """The mean of those pixels of a window around each one that have weight 1.

    Args:
        image: shape (height, width, channels).
        weight: 0 or 1, shape (height, width, 1).
        radius: of the window, whose edge has 2 radius + 1 pixels.
        without: radius of a smaller window in its middle that does not count, 0 for the pixel
            alone; beyond edges there is nothing then. None: all of it counts, and edges are
            repeated.

    Returns:
        Of the shape of the image; NaN where no pixel has weight.
    """
    if weight.all() and without is None:
        return _sums(image, radius) / np.float32((2 * radius + 1) ** 2)
    share, total = (_sums(x, radius, without) for x in (weight, image * weight))
    return total / np.where(share > 0, share, np.nan)


def around(image: np.ndarray, radius: int) -> Iterator[np.ndarray]:
    """The image moved to every place of a window, row by row, edges repeated."""
    for moved in along(image, 0, radius):
        yield from along(moved, 1, radius)


def along(
    image: np.ndarray, axis: int, radius: int, beyond: Beyond = "edge"
) -> Iterator[np.ndarray]:
    """The image moved along an axis by -radius to radius pixels; beyond edges as NumPy's pad."""
    padded = np.pad(image, [(radius, radius) if i == axis else (0, 0) for i in range(3)], beyond)
    for start in range(2 * radius + 1):
        part = slice(start, start + image.shape[axis])
        yield padded[part] if axis == 0 else padded[:, part]


def _sums(image: np.ndarray, radius: int, without: int | None = None) -> np.ndarray:
    """Sums over windows, as of `mean_of_counted`.

    What does not count is never added: taken away again it would leave the rounding errors of a
    pixel that is far brighter than all others.
    """
    if without is None:
        for axis in (0, 1):
            image = reduce(np.add, along(image, axis, radius))
        return image
    places = [abs(place) > without for place in range(-radius, radius + 1)]
    columns = list(along(image, 1, radius, "constant"))
    whole = reduce(np.add, columns)
    beside = reduce(np.add, compress(columns, places))
    every = zip(*(along(rows, 0, radius, "constant") for rows in (whole, beside)), strict=True)
    return reduce(np.add, (rows[not beyond] for beyond, rows in zip(places, every, strict=True)))
