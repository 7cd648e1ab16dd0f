"""The files of photographs, masks and true pictures: checked by their headers, and decoded."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..imaging.coded import decode, read_codes
from ..imaging.headers import CODED_SUFFIXES, SUFFIXES, HeaderError, read_header
from ..io import require_file
from ..memory import require_memory
from .data_folder import TRANSFORMS

#: How photographs hold radiance: as it is, or as code values of the sRGB curve.
ENCODINGS = ("linear", "srgb")

_LDR_SUFFIXES = (*CODED_SUFFIXES, ".bmp", ".tga", ".webp", ".gif", ".ppm")
_MOST_CHANNELS = 4
#: Suffixes of JPEG files, which change pixels.
JPEG = (".jpg", ".jpeg")
_OTHER_CHANNELS = "the image has other channels than RGB and alpha"
#: Memory in bytes that takes part in decoding a pixel, blurring it included.
PIXEL_BYTES = 100
_NEED_HDR = (
    "Give linear HDR images (OpenEXR); PNG, JPEG and TIFF files of a camera are read where "
    f'{TRANSFORMS} has "encoding": "srgb", as `unbake import` writes it'
)
_CODED = "Code values of the sRGB curve are read from PNG, JPEG and TIFF files"
REPLACE = f"Write the image again, or remove its frame from {TRANSFORMS}"


def read_image(
    path: Path, width: int, height: int, clip_negative: bool = False, encoding: str = "linear"
) -> np.ndarray:
    """One image, row by row: (width * height, 4) float32, linear RGB and alpha (1 if absent).

    Args:
        path: the image.
        width, height: in pixels, as they must be.
        clip_negative: take negative pixels as zero.
        encoding: "srgb": it holds code values, and is decoded to [0, 1].

    Raises:
        UserError: it is missing, unreadable, of another kind or size, or has pixels that are NaN,
            infinite, or (without `clip_negative`) negative.
    """
    if encoding == "srgb":
        _require_readable(path, width, height, encoding)
        return decode(read_codes(path, REPLACE)).reshape(-1, 4)
    pixels = read_radiance(path, width, height)
    count = int((pixels < 0).any(axis=1).sum())
    if count and not clip_negative:
        what = f"{count} of {len(pixels)} pixels are negative"
        raise UserError(what, path, "Pass --clip-negative to take them as zero")
    return np.maximum(pixels, 0)


def read_radiance(path: Path, width: int, height: int) -> np.ndarray:
    """One image of radiance as it is, negative pixels too; (width * height, 4) as in `read_image`.

    Raises:
        UserError: as in `read_image`, but for negative pixels.
    """
    _require_readable(path, width, height, "linear")
    try:
        bitmap = mi.Bitmap(str(path))
        size = tuple(bitmap.size())
        _check_size((int(size[0]), int(size[1])), width, height, path)
        kind = mi.Bitmap.PixelFormat
        if bitmap.pixel_format() not in (kind.RGB, kind.RGBA, kind.Y, kind.YA):
            raise UserError(_OTHER_CHANNELS, path, REPLACE)
        bitmap = bitmap.convert(mi.Bitmap.PixelFormat.RGBA, mi.Struct.Type.Float32, False)
    except (RuntimeError, MemoryError, ValueError) as error:
        reason = " ".join(str(error).split())[:160]
        raise UserError(f"the image cannot be read ({reason})", path, REPLACE) from None
    pixels = np.array(bitmap).reshape(-1, 4)
    count = int((~np.isfinite(pixels)).any(axis=1).sum())
    if count:
        what = f"{count} of {len(pixels)} pixels are NaN or infinite"
        remedy = "No measurement is like that: render or convert the image again"
        raise UserError(what, path, remedy)
    return pixels


def counted_in(path: Path, remedy: str = REPLACE) -> np.ndarray:
    """Whether pixels count by a mask, (H, W) bool.

    Args:
        path: a PNG, JPEG or TIFF file. Of JPEG, codes count from half the largest one on: it leaves
            noise beside edges, black and white.
        remedy: of the error message.

    Raises:
        UserError: it cannot be read.
    """
    codes = read_codes(path, remedy)
    if path.suffix.lower() in JPEG:
        codes = np.where(codes > np.iinfo(codes.dtype).max // 2, codes, 0)
    return counted_by(codes)


def counted_by(codes: np.ndarray) -> np.ndarray:
    """Whether pixels count by the code values of a mask, (H, W, C): (H, W) bool.

    Where it is black all over and has an alpha channel, that tells it alone, and else as well.
    """
    light = codes[..., : 1 if codes.shape[2] < 3 else 3].max(axis=2) > 0
    if codes.shape[2] not in (2, 4):
        return light
    opaque = codes[..., -1] > 0
    return light & opaque if light.any() or opaque.all() else opaque


def _require_readable(path: Path, width: int, height: int, encoding: str) -> None:
    # The header first: a damaged one may ask for more memory than there is
    check_header(path, width, height, encoding)
    require_memory(PIXEL_BYTES * width * height, "the image needs", "Use a smaller image", path)


def check_header(path: Path, width: int, height: int, encoding: str = "linear") -> None:
    """Refuse what cannot be an image of that size and encoding, without reading its pixels."""
    suffix, coded = path.suffix.lower(), encoding == "srgb"
    if suffix in _LDR_SUFFIXES and not coded:
        raise UserError("the image is low dynamic range", path, _NEED_HDR)
    require_file(path, "image", REPLACE)
    if coded and suffix in SUFFIXES:
        raise UserError(f"the image holds no code values: it is {suffix}", path, _CODED)
    if suffix not in (CODED_SUFFIXES if coded else SUFFIXES):
        remedy = _CODED if coded else _NEED_HDR
        raise UserError(f"unknown image format {path.suffix!r}", path, remedy)
    try:
        header = read_header(path)
    except HeaderError as error:
        raise UserError(f"the image cannot be read ({error})", path, REPLACE) from None
    except OSError as error:
        raise UserError(f"the image cannot be read ({error.strerror})", path, REPLACE) from None
    _check_size((header.width, header.height), width, height, path)
    if header.channels > _MOST_CHANNELS:
        raise UserError(_OTHER_CHANNELS, path, REPLACE)


def _check_size(size: tuple[int, int], width: int, height: int, path: Path) -> None:
    if size != (width, height):
        raise UserError(
            f"the image has {size[0]} x {size[1]} pixels, its frame says {width} x {height}",
            path,
            "Correct 'w' and 'h', or use the image that belongs to the camera",
        )
