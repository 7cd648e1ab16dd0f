"""EXR and PNG files, tone mapping, false colour, contact sheets."""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..io import require_file, write_atomically
from .srgb import to_srgb

#: How values become a picture: colours through the sRGB curve, other data without a curve.
Display = Literal["colour", "data"]

MAGMA = (
    (0, 0, 4), (10, 8, 34), (29, 17, 71), (54, 16, 107), (81, 18, 124), (106, 28, 129),
    (131, 38, 129), (156, 46, 127), (183, 55, 121), (208, 65, 111), (231, 82, 99),
    (245, 107, 92), (252, 137, 97), (254, 167, 114), (254, 196, 136), (253, 226, 163),
    (252, 253, 191),
)  # fmt: skip
"""Seventeen evenly spaced sRGB stops of the perceptually uniform map magma (Smith, van der Walt,
CC0); linear interpolation between them is within 3/255 of the full table."""

OUTSIDE_MASK = (128, 128, 128)
NOT_FINITE = (0, 255, 0)


def read_exr(path: Path) -> np.ndarray:
    """Read an OpenEXR picture.

    Returns:
        (H, W, C) float32, linear as stored, alpha premultiplied; C = 1 for a grey file.

    Raises:
        UserError: the file is missing, is not OpenEXR, or is cut off.
    """
    path = Path(path)
    require_file(path, "picture")
    try:
        bitmap = mi.Bitmap(str(path), mi.Bitmap.FileFormat.OpenEXR)
    except (RuntimeError, MemoryError, ValueError) as error:  # ValueError: a message of bad UTF-8
        raise UserError(
            "the picture cannot be read as OpenEXR", path, "Write it again, or copy it again"
        ) from error
    pixels = np.array(bitmap).astype(np.float32)
    return pixels[..., None] if pixels.ndim == 2 else pixels


def read_png(path: Path) -> np.ndarray:
    """Read a PNG picture of 8 bits.

    Returns:
        (H, W) or (H, W, C) uint8, as stored.

    Raises:
        UserError: the file is missing or no such PNG.
    """
    path = Path(path)
    require_file(path, "picture")
    try:
        pixels = np.array(mi.Bitmap(str(path), mi.Bitmap.FileFormat.PNG))
    except (RuntimeError, MemoryError, ValueError) as error:
        what = "the picture cannot be read as PNG"
        raise UserError(what, path, "Write it again, or copy it again") from error
    if pixels.dtype != np.uint8:
        raise UserError("the picture has more than 8 bits a channel", path, "Write it again")
    return pixels[..., 0] if pixels.ndim == 3 and pixels.shape[2] == 1 else pixels


def write_exr(path: Path, array: np.ndarray) -> None:
    """Write (H, W) or (H, W, C) linear values as float32 OpenEXR; C is 1, 3 or 4 (RGB + alpha).

    The file appears complete or not at all, and its folder is made where there is none.

    Raises:
        UserError: the folder cannot be written.
        ValueError: the shape is none of these.
    """
    array = np.asarray(array)
    _check_shape(array, channels=(1, 3, 4))
    bitmap = mi.Bitmap(np.ascontiguousarray(array, dtype=np.float32))
    write_atomically(path, lambda p: bitmap.write(str(p), mi.Bitmap.FileFormat.OpenEXR))


def write_png(path: Path, array: np.ndarray) -> None:
    """Write (H, W) or (H, W, C) uint8 sRGB values as PNG, complete or not at all; C is 1, 3 or 4.

    Raises:
        UserError: the folder cannot be written.
        ValueError: the array is not such a picture.
    """
    data = png_bytes(array)
    write_atomically(path, lambda p: p.write_bytes(data))


def png_data_uri(array: np.ndarray) -> str:
    """A `data:image/png;base64,…` address of an (H, W) or (H, W, C) uint8 sRGB picture."""
    return "data:image/png;base64," + base64.b64encode(png_bytes(array)).decode("ascii")


def tonemap(linear: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Linear RGB to 8-bit sRGB: times 2^exposure, clamped to [0, 1], through the sRGB curve.

    Args:
        linear: (H, W, 3) linear RGB (any trailing shape works).
        exposure: stops.

    Returns:
        uint8 of the same shape. NaN becomes 0.
    """
    return to_bytes(encoded(linear, exposure))


def encoded(linear: np.ndarray, exposure: float = 0.0) -> np.ndarray:
    """Linear RGB to sRGB values in [0, 1], float32, not rounded; else as `tonemap`."""
    return to_srgb(_unit(np.asarray(linear, dtype=np.float32) * np.float32(2.0**exposure)))


def fitting_exposure(radiance: Sequence[np.ndarray]) -> float:
    """The exposure in half stops that maps the 95th percentile of radiance to about 0.8.

    Args:
        radiance: means of channels; see `sample`.
    """
    bright = percentile(radiance, 95)
    return round(2 * math.log2(0.8 / bright)) / 2 if bright > 0 else 0.0


def sample(values: np.ndarray, limit: int = 4096) -> np.ndarray:
    """About `limit` of the finite values, evenly spaced."""
    values = values[np.isfinite(values)]
    return values[:: max(1, len(values) // limit)]


def percentile(parts: Sequence[np.ndarray], percent: float) -> float:
    """A percentile of all values; 0 where there are none."""
    values = np.concatenate([np.zeros(0), *parts])
    return float(np.percentile(values, percent)) if len(values) else 0.0


def shown(values: np.ndarray, display: Display) -> np.ndarray:
    """Values (H, W, 1 or 3) as a picture: colours through the sRGB curve, data as they are.

    Returns:
        uint8, (H, W, 3).
    """
    rgb = np.repeat(values, 3, -1) if values.shape[-1] == 1 else values
    return tonemap(rgb) if display == "colour" else to_bytes(rgb)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] to uint8 without the sRGB curve, clamped, for data such as roughness."""
    return np.round(_unit(np.asarray(values, dtype=np.float32)) * 255).astype(np.uint8)


def absolute_error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """|image − reference| averaged over channels: (H, W, C) twice to (H, W), linear.

    Raises:
        ValueError: the shapes differ.
    """
    if image.shape != reference.shape:
        raise ValueError(
            f"a picture of shape {image.shape} cannot be compared with one of {reference.shape}"
        )
    with np.errstate(invalid="ignore"):  # inf − inf is not finite, and is painted so
        return np.abs(image - reference).mean(axis=2)


def false_colour(values: np.ndarray, scale: float, mask: np.ndarray | None = None) -> np.ndarray:
    """Paint (H, W) values with magma, from 0 (black) to `scale` and above (pale yellow).

    Args:
        values: non-negative; what is not finite becomes bright green.
        scale: the value at the bright end, in the units of `values`.
        mask: (H, W) bool; mid grey where False.

    Returns:
        (H, W, 3) uint8 sRGB.

    Raises:
        ValueError: `scale` is not positive.
    """
    if not scale > 0:
        raise ValueError(f"the scale of a false-colour picture must be positive, not {scale}")
    finite = np.isfinite(values)
    position = _unit(np.where(finite, values, 0) / scale) * (len(MAGMA) - 1)
    stops = np.array(MAGMA, dtype=np.float32)
    knots = np.arange(len(MAGMA))
    painted = np.stack([np.interp(position, knots, stops[:, c]) for c in range(3)], axis=-1)
    painted = np.round(painted).astype(np.uint8)
    painted[~finite] = NOT_FINITE
    if mask is not None:
        painted[~mask] = OUTSIDE_MASK
    return painted


def shrink(picture: np.ndarray, longest: int) -> np.ndarray:
    """Average (H, W) or (H, W, C) over square blocks until no side is longer than `longest`.

    The block is the smallest whole number of pixels that suffices; a remainder at the right and
    bottom edge is cut. A picture that already fits is returned as it is.
    """
    height, width = picture.shape[:2]
    block = -(-max(height, width) // longest)
    return picture if block == 1 else block_means(picture, block)


def block_means(picture: np.ndarray, block: int) -> np.ndarray:
    """Average (H, W) or (H, W, C) over squares of `block` pixels; a remainder is cut as above."""
    rows, columns = (side // block for side in picture.shape[:2])
    cut = picture[: rows * block, : columns * block]
    return cut.reshape(rows, block, columns, block, *picture.shape[2:]).mean(axis=(1, 3))


def montage(rows: Sequence[Sequence[np.ndarray]], gap: int = 2, paper: int = 255) -> np.ndarray:
    """Lay pictures out as a grid with thin gaps.

    Args:
        rows: (H, W, 3) uint8 pictures. Rows may differ in length; a column is as wide as its
            widest picture, a row as high as its highest, pictures sit at the top left.
        gap: pixels between neighbours and around the sheet.
        paper: grey level of gaps and empty places.

    Raises:
        ValueError: there is no picture, or one is not (H, W, 3) uint8.
    """
    cells = [cell for row in rows for cell in row]
    if not cells:
        raise ValueError("a montage needs at least one picture")
    for cell in cells:
        _check_bytes(cell, channels=(3,))
    count = max(len(row) for row in rows)
    heights = [max((cell.shape[0] for cell in row), default=0) for row in rows]
    widths = [max(row[i].shape[1] for row in rows if i < len(row)) for i in range(count)]
    tops = np.cumsum([gap] + [height + gap for height in heights])
    lefts = np.cumsum([gap] + [width + gap for width in widths])
    sheet = np.full((tops[-1], lefts[-1], 3), paper, dtype=np.uint8)
    for row, top in zip(rows, tops, strict=False):
        for cell, left in zip(row, lefts, strict=False):
            sheet[top : top + cell.shape[0], left : left + cell.shape[1]] = cell
    return sheet


def png_bytes(array: np.ndarray) -> bytes:
    """A PNG file of (H, W) or (H, W, C) uint8 values; C is 1, 3 or 4."""
    _check_bytes(array, channels=(1, 3, 4))
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(array)).write(stream, mi.Bitmap.FileFormat.PNG)
    return stream.raw_buffer()


def _unit(values: np.ndarray) -> np.ndarray:
    """Clamp to [0, 1]; NaN and −inf become 0, inf becomes 1."""
    return np.clip(np.nan_to_num(values, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)


def _check_bytes(array: np.ndarray, channels: tuple[int, ...]) -> None:
    if array.dtype != np.uint8:
        raise ValueError(f"an 8-bit picture is needed, not one of {array.dtype}")
    _check_shape(array, channels)


def _check_shape(array: np.ndarray, channels: tuple[int, ...]) -> None:
    flat = array.ndim == 2 and 1 in channels
    if array.size == 0 or not (flat or (array.ndim == 3 and array.shape[2] in channels)):
        raise ValueError(f"an array of shape {array.shape} is not a picture")
