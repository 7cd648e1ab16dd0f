"""The colour of JPEG files at the resolution of their brightness.

Most JPEG files hold colour (Cb, Cr) at half the resolution of brightness (Y), as means of two or
four pixels, and decoders put smooth colour through these. Where two surfaces meet, each then has
some of the other's colour, in all photographs alike. Brightness tells where the edge is. Colour is
taken to be a multiple of it, as it is where more or less light falls on a surface. The multiple is
a line of brightness, by least squares in each 3 x 3 blocks of pixels (a guided filter, He et al.
2010), so that it may jump where two surfaces meet. It stays within that of the blocks around, and
colour has the means of the file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .windows import bands

#: Corrections of colour towards the means; more bring back as much noise of the file.
_CORRECTIONS = 2
#: Brightness, [0,1], below which colour is not divided by it.
_DARK = 0.03
#: Variance of brightness, code values squared, from which on the multiple follows it.
_FLAT = 100.0
#: Rows that are made at once, and rows above and below that they depend on: each correction looks
#: at a block more than the one before, and so does each mean of blocks. Both are even.
_ROWS, _REACH = 128, 20
#: Code of Cb and Cr that is grey.
_GREY = 128


def with_sharp_colour(codes: np.ndarray, across: int, down: int) -> np.ndarray:
    """An image whose colour has a lower resolution than its brightness, with edges in its colour.

    It is made in bands of rows: their numbers stay in the caches of a core.

    Args:
        codes: Y, Cb and Cr as decoded with smooth colour ("fancy upsampling" of libjpeg),
            (H, W, 3) uint8.
        across: pixels of a row that have one colour, 1 or 2.
        down: the same of a column.

    Returns:
        RGB, (H, W, 3) uint8.
    """
    rgb = np.empty_like(codes)
    for band, needed, made in bands(len(codes), _REACH, _ROWS):
        rgb[band] = _sharp(codes[needed], across, down)[made]
    return rgb


def _sharp(codes: np.ndarray, across: int, down: int) -> np.ndarray:
    """The same of some rows of an image, of which the first is even."""
    height, width = codes.shape[:2]
    steps, padding = (down, across), [(0, -height % down), (0, -width % across), (0, 0)]
    planes = np.moveaxis(np.pad(codes, padding, mode="edge"), 2, 0).astype(np.float32)
    y, lowest = planes[0], np.float32(255 * _DARK)
    guide = _Guide.of(y, steps, lowest)
    blue, red = (
        _sharp_plane(plane - np.float32(_GREY), guide, steps)[:height, :width]
        for plane in planes[1:]
    )
    y = y[:height, :width] + np.float32(0.5)
    # ITU-R BT.601, as JFIF has it
    rgb = (
        y + np.float32(1.402) * red,
        y - np.float32(0.344136) * blue - np.float32(0.714136) * red,
        y + np.float32(1.772) * blue,
    )
    return np.stack([np.clip(x, 0, 255).astype(np.uint8) for x in rgb], -1)


@dataclass(frozen=True, eq=False)
class _Guide:
    """What colour follows.

    Args:
        y: brightness, (H, W).
        means: of its blocks, at least the darkest that is divided by.
        near: means of the 3 x 3 about each of them.
        variance: of these.
    """

    y: np.ndarray
    means: np.ndarray
    near: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, y: np.ndarray, steps: tuple[int, int], lowest: np.float32) -> _Guide:
        means = np.maximum(_means(y, steps), lowest)
        near = _near(means)
        return cls(y, means, near, _near(means * means) - near * near)


def _sharp_plane(smooth: np.ndarray, guide: _Guide, steps: tuple[int, int]) -> np.ndarray:
    """Cb or Cr with the edges of Y, and with the means of the file.

    Args:
        smooth: less the code of grey, (H, W) as brightness; sides are multiples of the steps.
        guide: brightness.
        steps: rows and columns of a block.
    """
    means = _means_in_file(_means(smooth, steps), steps)
    sharp = guide.y * _multiple(means / guide.means, guide, steps)
    # Corrections are smooth: what is left after each is known without making its picture.
    left = means - _means(sharp, steps)
    corrections = left
    for _ in range(_CORRECTIONS - 1):
        left = left - _means_of_smooth(left, steps)
        corrections = corrections + left
    return sharp + _smooth(corrections, steps)


def _multiple(ratio: np.ndarray, guide: _Guide, steps: tuple[int, int]) -> np.ndarray:
    """Colour over brightness at each pixel, by that of blocks."""
    near = _near(ratio)
    slope = (_near(guide.means * ratio) - guide.near * near) / (guide.variance + np.float32(_FLAT))
    slope = _near(slope)
    multiple = guide.y * _smooth(slope, steps) + _smooth(ratio - slope * guide.means, steps)
    for limit, bound in ((np.minimum, np.maximum), (np.maximum, np.minimum)):
        bounds = ratio
        for axis in range(2):
            before, after = _neighbours(bounds, axis)
            bounds = limit(limit(before, after), bounds)
        bound(multiple, bounds.repeat(steps[0], 0).repeat(steps[1], 1), out=multiple)
    return multiple


def _near(means: np.ndarray) -> np.ndarray:
    """Means of 3 x 3 blocks about each one."""
    for axis in range(2):
        before, after = _neighbours(means, axis)
        means = np.float32(1 / 3) * (before + means + after)
    return means


def _means_in_file(wanted: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """The colour that a file has, of whose smooth copy these are the means."""
    found = wanted
    for _ in range(_CORRECTIONS):
        found = found + wanted - _means_of_smooth(found, steps)
    return found


def _means(image: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """Means of blocks of pixels."""
    if steps[0] == 2:
        image = np.float32(0.5) * (image[::2] + image[1::2])
    if steps[1] == 2:
        image = np.float32(0.5) * (image[:, ::2] + image[:, 1::2])
    return image


def _smooth(means: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """Linear interpolation between the middles of blocks, as libjpeg has it."""
    for axis, step in enumerate(steps):
        if step == 2:
            before, after = _neighbours(means, axis)
            near = np.float32(0.75) * means
            pairs = (near + np.float32(0.25) * before, near + np.float32(0.25) * after)
            # Rows follow each other as wholes, columns take turns
            means = np.stack(pairs, axis + 1).reshape(
                [side * (2 if i == axis else 1) for i, side in enumerate(means.shape)]
            )
    return means


def _means_of_smooth(means: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """`_means` of what `_smooth` makes of an image."""
    for axis, step in enumerate(steps):
        if step == 2:
            before, after = _neighbours(means, axis)
            means = np.float32(0.75) * means + np.float32(0.125) * (before + after)
    return means


def _neighbours(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """The image moved by one pixel along an axis, either way; the edge is its own neighbour."""
    padded = np.pad(image, [(1, 1) if i == axis else (0, 0) for i in range(2)], mode="edge")
    return (padded[:-2], padded[2:]) if axis == 0 else (padded[:, :-2], padded[:, 2:])
