"""Colour profiles in images of code values: what makes linear sRGB of them.

Cameras and phones write Display P3 or Adobe RGB, raw converters ProPhoto RGB. Little CMS converts
them, as imagecodecs has it.
"""

from __future__ import annotations

import io
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageCms, TiffImagePlugin

from ..errors import UserError
from .pillow import opened
from .srgb import from_srgb

#: The largest difference of linear values, up to which a profile is that of sRGB.
_SAME = 4e-3
#: Codes of each channel that are compared.
_COMPARED = 9
_TIFF = (".tif", ".tiff")
#: Formats that Pillow may try, by its names.
_FORMATS = ("PNG", "JPEG")
#: The place of the colour space in a profile, and that of three colours.
_SPACE, _RGB = slice(16, 20), b"RGB "
#: CIE xy of D65 and of the primaries of sRGB, as Little CMS takes them, with Y = 1.
_WHITE = (0.3127, 0.3290, 1.0)
_PRIMARIES = (0.64, 0.33, 1.0, 0.30, 0.60, 1.0, 0.15, 0.06, 1.0)


def read_profile(path: Path) -> bytes | None:
    """The colour profile of a PNG, JPEG or TIFF file; None where it has none but that of sRGB.

    Cameras that write Adobe RGB may say so in EXIF alone. Profiles of grey images are not read.

    Raises:
        UserError: imagecodecs is missing.
    """
    about = path.stat()
    return _profile_of(path, about.st_mtime_ns, about.st_size)


@lru_cache(maxsize=4096)
def _profile_of(path: Path, *_state: int) -> bytes | None:
    data = _embedded(path)
    if data is None or data[_SPACE] != _RGB or _is_srgb(data):
        return None
    return data


def profile_name(profile: bytes) -> str:
    """What a profile calls itself, such as "Display P3"."""
    try:
        told = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
    except (ImageCms.PyCMSError, OSError):
        return "without a name"
    return told.strip() or "without a name"


def linear_srgb(codes: np.ndarray, profile: bytes) -> np.ndarray:
    """Code values to linear RGB of the sRGB primaries.

    Args:
        codes: (H, W, 3) uint8 or uint16.
        profile: of RGB.

    Returns:
        (H, W, 3) float32, white being 1. Colours that sRGB lacks have values below 0 or above 1.

    Raises:
        UserError: imagecodecs is missing, or the profile is damaged.
    """
    codecs = _codecs(profile_name(profile))
    # Eight bits would come back in steps of 1/255.
    deep = codes.astype(np.uint16) * np.uint16(257) if codes.dtype == np.uint8 else codes
    try:
        return codecs.cms_transform(
            np.ascontiguousarray(deep),
            profile,
            _linear_profile(),
            colorspace="rgb",
            outcolorspace="rgb",
            outdtype="f4",
        )
    except (RuntimeError, ValueError) as error:
        told = " ".join(str(error).split())[:160]
        raise UserError(f"its colour profile cannot be used ({told})") from None


def _embedded(path: Path) -> bytes | None:
    """The profile in a file, of any colours; that of Adobe RGB where EXIF says so."""
    if path.suffix.lower() in _TIFF:
        return _of_tiff(path)
    try:
        with opened(path, _FORMATS) as image:
            found = image.info.get("icc_profile")
            return found or (_adobe_rgb() if _says_adobe_rgb(image.getexif()) else None)
    except Exception:  # decoders of damaged files raise whatever they meet; pixels tell why
        return None


def _says_adobe_rgb(exif: Image.Exif) -> bool:
    """Whether EXIF has no colour space of its own, and the sign of Adobe RGB beside it."""
    uncalibrated = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace) == 0xFFFF
    return uncalibrated and exif.get_ifd(ExifTags.IFD.Interop).get(1) == "R03"


def _of_tiff(path: Path) -> bytes | None:
    # Pillow opens no TIFF of 16 bits and three colours; it reads the tags alone.
    try:
        with path.open("rb") as file:
            head = file.read(8)
            tags = TiffImagePlugin.ImageFileDirectory_v2(head)
            file.seek(tags.next)
            tags.load(file)
            found: Any = tags.get(TiffImagePlugin.ICCPROFILE)
    except (OSError, ValueError, SyntaxError, TypeError):
        return None
    return found if isinstance(found, bytes) and found else None


@cache
def _is_srgb(profile: bytes) -> bool:
    levels = np.linspace(0, 65535, _COMPARED).round().astype(np.uint16)
    codes = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3)
    difference = linear_srgb(codes, profile) - from_srgb(codes / 65535)
    return bool(np.abs(difference).max() <= _SAME)


@cache
def _adobe_rgb() -> bytes:
    return _codecs("Adobe RGB").cms_profile("adobergb")


@cache
def _linear_profile() -> bytes:
    codecs = _codecs("")
    return codecs.cms_profile("rgb", whitepoint=_WHITE, primaries=_PRIMARIES, gamma=1.0)


def _codecs(name: str) -> Any:
    try:
        import imagecodecs
    except ImportError:
        remedy = "pip install 'unbake[import]'"
        raise UserError(f"the colour profile {name!r} needs imagecodecs", None, remedy) from None
    return imagecodecs
