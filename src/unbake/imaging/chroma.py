"""The colour of JPEG files at the resolution of their brightness.

Most JPEG files hold colour (Cb, Cr) at half the resolution of brightness (Y), as means of two or
four pixels, and decoders put smooth colour through these. Where two surfaces meet, each then has
some of the other's colour. Brightness tells where the edge is: colour is taken to be a smooth
multiple of it, as it is where more or less light falls on a surface, with the means of the file.
"""

from __future__ import annotations

import numpy as np

#: Corrections of colour towards the means; more bring back as much noise of the file.
_CORRECTIONS = 2
#: Brightness, [0,1], below which colour is not divided by it.
_DARK = 0.03
#: Code of Cb and Cr that is grey.
_GREY = 128


def with_sharp_colour(codes: np.ndarray, across: int, down: int) -> np.ndarray:
    """An image whose colour has a lower resolution than its brightness, with edges in its colour.

    Args:
        codes: Y, Cb and Cr as decoded with smooth colour ("fancy upsampling" of libjpeg),
            (H, W, 3) uint8.
        across: pixels of a row that have one colour, 1 or 2.
        down: the same of a column.

    Returns:
        RGB, (H, W, 3) uint8.
    """
    height, width = codes.shape[:2]
    steps, padding = (down, across), [(0, -height % down), (0, -width % across), (0, 0)]
    padded = np.pad(codes, padding, mode="edge").astype(np.float32)
    y, smooth = padded[..., :1], padded[..., 1:] - np.float32(_GREY)
    means = _means_in_file(_means(smooth, steps), steps)
    sharp = y * _smooth(means / np.maximum(_means(y, steps), 255 * _DARK), steps)
    for _ in range(_CORRECTIONS):
        sharp += _smooth(means - _means(sharp, steps), steps)
    # ITU-R BT.601, as JFIF has it
    blue, red = sharp[:height, :width, 0], sharp[:height, :width, 1]
    rgb = np.empty((height, width, 3), np.float32)
    rgb[...] = y[:height, :width]
    rgb[..., 0] += 1.402 * red
    rgb[..., 1] -= 0.344136 * blue + 0.714136 * red
    rgb[..., 2] += 1.772 * blue
    return np.clip(rgb + 0.5, 0, 255).astype(np.uint8)


def _means_in_file(wanted: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """The colour that a file has, of whose smooth copy these are the means."""
    found = wanted
    for _ in range(_CORRECTIONS):
        found = found + wanted - _means(_smooth(found, steps), steps)
    return found


def _means(image: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """Means of blocks of pixels."""
    for axis, step in enumerate(steps):
        if step == 2:
            even, odd = _every_second(image, axis)
            image = np.float32(0.5) * (even + odd)
    return image


def _smooth(means: np.ndarray, steps: tuple[int, int]) -> np.ndarray:
    """Linear interpolation between the middles of blocks, as libjpeg has it."""
    for axis, step in enumerate(steps):
        if step == 2:
            shape = list(means.shape)
            shape[axis] *= 2
            found = np.empty(shape, means.dtype)
            even, odd = _every_second(found, axis)
            even[...] = odd[...] = np.float32(0.75) * means
            # The first and the last block have no neighbour on one side.
            inner, outer = (slice(None),) * axis, np.float32(0.25) * means
            even[(*inner, slice(1, None))] += outer[(*inner, slice(None, -1))]
            even[(*inner, slice(1))] += outer[(*inner, slice(1))]
            odd[(*inner, slice(None, -1))] += outer[(*inner, slice(1, None))]
            odd[(*inner, slice(-1, None))] += outer[(*inner, slice(-1, None))]
            means = found
    return means


def _every_second(image: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Views of the even and of the odd rows, or columns."""
    inner = (slice(None),) * axis
    return image[(*inner, slice(0, None, 2))], image[(*inner, slice(1, None, 2))]
