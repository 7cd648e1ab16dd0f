"""Hot pixels: too bright to be measurements, as of a sensor or as fireflies of a renderer.

One such pixel is most of the mean radiance of all photographs, and of every batch that it is in.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ..errors import printable

#: A pixel is hot if it is so many times as bright as the brightest of the others. A lamp
#: that is seen in a dark room is some hundred times as bright as the room, a bare bulb some ten
#: thousand times. What is less extreme does no harm: errors are relative to how far it stands out.
EXTREME = 1e5
#: What has more such pixels than filters of renderers spread a firefly over, within so many pixels
#: of one of them, is seen and not hot.
_THING, _WITHIN = 25, 4
#: How many of the brightest pixels of a view may be hot: a share, but some of a small view.
_SHARE, _LEAST = 1e-3, 8
#: Views that are told; of more there is the number.
_TOLD = 3


@dataclass(frozen=True)
class HotPixels:
    """The hot pixels of a view.

    Args:
        view: its name.
        count: of hot pixels.
        column, row: of the brightest, from the top left.
        value: of the brightest: its largest channel, linear.
        limit: what the largest channel of hot pixels was set to.
    """

    view: str
    count: int
    column: int
    row: int
    value: float
    limit: float


def without_hot_pixels(
    pixels: np.ndarray, counted: np.ndarray, view: str, width: int
) -> tuple[np.ndarray, HotPixels | None]:
    """The pixels of a view, the hot ones as dark as the brightest of the others.

    Args:
        pixels: linear RGB and alpha, row by row, shape (pixels, 4).
        counted: the pixels to train on, shape (pixels,).
        view: its name.
        width: of the view, in pixels.

    Returns:
        The same array if there are no hot pixels; else a copy, with their hue as it was.
    """
    brightness = pixels[:, :3].max(axis=1)
    known = brightness[counted]
    few = max(_LEAST, int(_SHARE * len(known)))
    if len(known) <= 2 * few:
        return pixels, None
    limit = float(np.partition(known, len(known) - 1 - few)[len(known) - 1 - few])
    over = counted & (brightness > np.float64(EXTREME * limit))  # too large for 32 bits, maybe
    if limit <= 0 or not over.any():
        return pixels, None
    over &= ~_of_things(over, width)
    if not over.any():
        return pixels, None
    row, column = divmod(int(np.argmax(np.where(over, brightness, 0))), width)
    pixels = pixels.copy()
    pixels[over, :3] *= limit / brightness[over, None]
    value = float(brightness[row * width + column])
    return pixels, HotPixels(view, int(over.sum()), column, row, value, limit)


def _of_things(over: np.ndarray, width: int) -> np.ndarray:
    """Which of the pixels that are too bright belong to a lamp, or the sun, shape (pixels,)."""
    places = np.flatnonzero(over)
    found = np.zeros_like(over)
    rows, columns = np.divmod(places, width)
    for row, column in zip(rows, columns, strict=True):
        low, high = np.searchsorted(rows, (row - _WITHIN, row + _WITHIN + 1))
        near = low + np.flatnonzero(np.abs(columns[low:high] - column) <= _WITHIN)
        if len(near) > _THING:
            found[places[near]] = True
    return found


def told_hot_pixels(found: Iterable[HotPixels]) -> str | None:
    """One line on the hot pixels of all views; None where there are none."""
    views = list(found)
    if not views:
        return None
    told = [
        f"{printable(o.view)} at ({o.column}, {o.row}): {o.value:.3g}, taken as {o.limit:.3g}"
        for o in views[:_TOLD]
    ]
    if len(views) > _TOLD:
        told.append(f"and {len(views) - _TOLD} more")
    count = sum(o.count for o in views)
    pixels = "1 pixel is" if count == 1 else f"{count} pixels are"
    return f"{pixels} over {EXTREME:,.0f} times as bright as the others: " + "; ".join(told)
