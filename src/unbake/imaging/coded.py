"""Images of code values, 8 or 16 bits a channel: read, and decoded by the sRGB curve."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image
from PIL.JpegImagePlugin import get_sampling

from ..errors import UserError
from ..io import require_file
from .chroma import with_sharp_colour
from .headers import HeaderError, read_header
from .pillow import opened
from .srgb import from_srgb, to_srgb
from .windows import bands

#: What Pillow calls JPEG files; the second where small pictures, or those of another eye, follow.
_JPEG = ("JPEG", "MPO")
#: The tag of EXIF and of TIFF.
_ORIENTATION = 0x0112
#: The tag of TIFF that says how colours are meant.
_PHOTOMETRIC = 262
#: Pixels across and down that have one colour: 4:2:2 and 4:2:0, by Pillow's number.
_BLOCKS = {1: (2, 1), 2: (2, 2)}
#: What TIFF calls grey whose 0 is white; grey whose 0 is black, and RGB; alpha that colours have
#: been multiplied by; and alpha of either kind.
_WHITE_IS_ZERO, _TIFF_COLOURS, _ASSOCIATED, _TIFF_ALPHA = 0, (1, 2), 1, (1, 2)
#: Pillow's names of colours that become RGB without a profile.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")


class _Unreadable(ValueError):
    """Why an image of code values cannot be decoded, as the end of a sentence."""


class _OtherColours(_Unreadable):
    """It has colours that are not read."""

    def __init__(self, name: str) -> None:
        super().__init__(f"its colours are {name}, not RGB or grey")


def read_picture(path: Path) -> np.ndarray:
    """A picture of code values, decoded: (H, W, 4) as from `decode`; errors as in `read_codes`."""
    return decode(read_codes(path))


def read_codes(path: Path, remedy: str = "Write it again, or copy it again") -> np.ndarray:
    """The code values of a PNG, JPEG or TIFF file as they are stored, not turned by its EXIF.

    Args:
        path: the file.
        remedy: what the user can do where it cannot be read.

    Returns:
        (H, W, C) uint8 or uint16; C is 1 (grey), 2 (grey and alpha), 3 or 4.

    Raises:
        UserError: it is missing or damaged, has other colours than these, or needs a package that
            is not installed.
    """
    require_file(path, "image", remedy)
    try:
        return _codes(path)
    except OSError as error:
        said = error.strerror or error
    except MemoryError:
        said = "it does not fit into memory"
    except (_Unreadable, HeaderError) as error:
        said, remedy = error, "Convert it to RGB" if isinstance(error, _OtherColours) else remedy
    raise UserError(f"the image cannot be read ({said})", path, remedy)


def decode(codes: np.ndarray) -> np.ndarray:
    """Code values to linear RGB and alpha, premultiplied as in OpenEXR.

    Args:
        codes: (H, W, C) uint8 or uint16, C from 1 to 4, alpha last where C is 2 or 4.

    Returns:
        (H, W, 4) float32: values in [0, 1], the largest code being 1; alpha is 1 where there is
        none, and is not decoded by the curve.
    """
    table = _table(np.iinfo(codes.dtype).max)
    colours = codes.shape[2] - (codes.shape[2] in (2, 4))
    pixels = np.empty((*codes.shape[:2], 4), np.float32)
    pixels[..., 3] = 1
    for band, _, _ in bands(len(codes), 0):
        # Every code is in the table: "clip" only spares the question
        pixels[band, :, :3] = table.take(codes[band, :, :colours], mode="clip")
    if colours < codes.shape[2]:
        pixels[..., 3] = codes[..., -1] / np.float32(np.iinfo(codes.dtype).max)
        pixels[..., :3] *= pixels[..., 3:]
    return pixels


def encode(linear: np.ndarray) -> np.ndarray:
    """Linear values to 16-bit codes of the sRGB curve, clamped to [0, 1]; the inverse of `decode`.

    Args:
        linear: of any shape, not premultiplied.
    """
    value = np.clip(np.asarray(linear, np.float64), 0, 1)
    return np.round(65535 * to_srgb(value)).astype(np.uint16)


@cache
def _table(most: int) -> np.ndarray:
    """Linear values of all codes up to `most`, float32."""
    return from_srgb(np.arange(most + 1) / most).astype(np.float32)


def _codes(path: Path) -> np.ndarray:
    header = read_header(path)
    if header.bits == 16 and path.suffix.lower() == ".png":
        read = _read_png
    else:
        read = _read_by_pillow if header.bits == 8 else _read_tiff
    try:
        codes = read(path)
    except (_Unreadable, MemoryError):
        raise
    except Exception as error:  # decoders of damaged files raise whatever they meet
        told = " ".join(str(error).split())[:160] or type(error).__name__
        raise _Unreadable(told) from None
    codes = codes[..., None] if codes.ndim == 2 else codes
    if codes.ndim != 3 or codes.shape[:2] != (header.height, header.width):
        raise _Unreadable("it does not have the size that its header tells")
    if not 1 <= codes.shape[2] <= 4 or codes.dtype not in (np.uint8, np.uint16):
        raise _Unreadable("it has other channels than grey or RGB, and alpha")
    return codes


def _read_png(path: Path) -> np.ndarray:
    return np.array(mi.Bitmap(str(path), mi.Bitmap.FileFormat.PNG))


def _read_by_pillow(path: Path) -> np.ndarray:
    with opened(path) as image:
        # Pillow turns TIFF files while it reads them.
        image.getexif().pop(_ORIENTATION, None)
        if image.mode not in _MODES:
            raise _OtherColours(image.mode)
        blocks = _colour_blocks(image)
        if blocks is not None:
            image.draft("YCbCr", image.size)
        if image.mode == "YCbCr" and blocks is not None:
            return with_sharp_colour(np.array(image), *blocks)
        alpha = "A" in image.mode or "transparency" in image.info
        return np.array(image.convert("RGBA" if alpha else "RGB"))


def _colour_blocks(image: Image.Image) -> tuple[int, int] | None:
    """Pixels across and down that have one colour in a JPEG file; None where each has its own."""
    if image.format not in _JPEG or image.mode != "RGB":
        return None
    if image.info.get("adobe_transform", 1) != 1:  # files of Adobe that hold RGB say so
        return None
    return _BLOCKS.get(get_sampling(image))


def _read_tiff(path: Path) -> np.ndarray:
    try:
        from tifffile import TiffFile
    except ImportError:
        raise _Unreadable("16 bits of TIFF need tifffile: pip install 'unbake[import]'") from None
    with TiffFile(path) as file:
        page = file.pages[0]
        kind = int(page.photometric) if _PHOTOMETRIC in page.tags else _TIFF_COLOURS[0]
        more = tuple(map(int, page.extrasamples))
        if kind not in (_WHITE_IS_ZERO, *_TIFF_COLOURS):
            raise _OtherColours(getattr(page.photometric, "name", f"of the unknown kind {kind}"))
        codes = np.asarray(page.asarray())
        if page.planarconfig != 1 and page.samplesperpixel > 1:
            codes = np.moveaxis(codes, 0, 2)
    codes = codes[..., None] if codes.ndim == 2 else codes
    count = codes.shape[-1] - len(more)
    colours, most = codes[..., :count], np.iinfo(codes.dtype).max
    if kind == _WHITE_IS_ZERO:
        colours = most - colours
    alphas = [codes[..., count + i] for i, what in enumerate(more) if what in _TIFF_ALPHA]
    if not alphas:
        return np.ascontiguousarray(colours)
    alpha = alphas[0][..., None]
    if _ASSOCIATED in more:
        whole = colours.astype(np.float64) * (most / np.maximum(alpha, 1))
        colours = np.minimum(whole + 0.5, most).astype(codes.dtype)
    return np.concatenate([colours, alpha], axis=-1)
