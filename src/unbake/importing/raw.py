"""Camera RAW, as LibRaw reads it: what the sensor counted, in one white balance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..imaging.headers import ImageHeader

#: Factors of red, green, blue and the other green.
Balance = tuple[float, float, float, float]
#: Of the files of cameras that photographers meet most.
SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef")
#: Of its width and height, what camera RAW may have more than the photograph, at most.
_EDGES = 0.02
#: From this share of the largest value on a channel is taken for clipped.
CLIPPED = 0.99


def is_raw(path: Path) -> bool:
    """Whether a file is camera RAW, by its suffix."""
    return path.suffix.lower() in SUFFIXES


def is_cut(raw: tuple[int, int], photograph: tuple[int, int]) -> bool:
    """Whether a photograph may be the camera's own, of this size, without the edges of its RAW."""
    return all(b <= a <= (1 + _EDGES) * b for a, b in zip(raw, photograph, strict=True))


def raw_header(path: Path) -> ImageHeader:
    """Its size, as `read_raw` gives it; errors as there."""
    with _opened(path) as raw:
        return ImageHeader(raw.sizes.width, raw.sizes.height, 3, 16)


def read_raw(
    path: Path, balance: Balance | None = None, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Linear RGB of the sRGB primaries, (H, W, 3) float32, clipped at 1, not turned by its EXIF.

    The black level is taken away and a white balance applied. There is no curve, and no
    brightening: the values of photographs of one camera and balance are in one unit.

    Args:
        path: the file.
        balance: as from `raw_balances`; None: that of daylight, as LibRaw knows it of the camera.
        size: width and height of the camera's photograph; what the RAW file has beyond it is cut
            off, where the file says, else alike on both sides. None: all of it.

    Raises:
        UserError: rawpy is missing, or LibRaw cannot read the file.
    """
    with _opened(path) as raw:
        pixels = raw.postprocess(**_as_it_is(balance))[_part(raw.sizes, size)]
    return (pixels / 65535).astype(np.float32)


def raw_told(
    path: Path, balance: Balance | None = None, size: tuple[int, int] | None = None
) -> np.ndarray:
    """Which pixels of `read_raw` say what they say, or that they are clipped, (H, W) bool.

    The colours of the sensor are mixed to those of sRGB. Where some of them are clipped and others
    are not, no mixture is true, nor the least that it can be.

    Args:
        path, balance, size: as of `read_raw`; errors as there.
    """
    with _opened(path) as raw:
        import rawpy

        colours = rawpy.ColorSpace.raw  # pyright: ignore[reportAttributeAccessIssue]
        sensor = raw.postprocess(output_color=colours, **_as_it_is(balance))
        sensor = sensor[_part(raw.sizes, size)]
        clipped = sensor >= round(65535 * CLIPPED)
    return clipped.all(2) | ~clipped.any(2)


def _part(sizes: Any, size: tuple[int, int] | None) -> tuple[slice, slice]:
    """The rows and columns of a picture that belong to the photograph."""
    width, height = size or (sizes.width, sizes.height)
    left, top = (sizes.width - width) // 2, (sizes.height - height) // 2
    if (sizes.crop_width, sizes.crop_height) == (width, height):
        told = (
            sizes.crop_left_margin - sizes.left_margin,
            sizes.crop_top_margin - sizes.top_margin,
        )
        if 0 <= told[0] <= sizes.width - width and 0 <= told[1] <= sizes.height - height:
            left, top = told
    return slice(top, top + height), slice(left, left + width)


def _as_it_is(balance: Balance | None) -> dict[str, Any]:
    """Options of LibRaw for linear values in one unit."""
    return {
        "gamma": (1, 1),
        "no_auto_bright": True,
        "adjust_maximum_thr": 0.0,
        "user_wb": None if balance is None else list(balance),
        "output_bps": 16,
        "user_flip": 0,
    }


def raw_balances(path: Path) -> tuple[Balance | None, Balance | None]:
    """The white balance that the camera chose, and that of daylight, as LibRaw knows it.

    They are None where they are not known; errors as there.
    """
    with _opened(path) as raw:
        return _balance(raw.camera_whitebalance), _balance(raw.daylight_whitebalance)


def for_sensor(balance: Balance, daylight: Balance | None, other: Balance | None) -> Balance:
    """A white balance in the factors of another sensor, which sees the same light otherwise.

    Args:
        balance: of a sensor.
        daylight: of the same sensor; None: it is not known, and both are taken for alike.
        other: that of the other one.
    """
    if daylight is None or other is None or daylight == other:
        return balance
    red, green, blue, green_2 = (
        value * theirs / ours for value, ours, theirs in zip(balance, daylight, other, strict=True)
    )
    return red, green, blue, green_2


def _balance(factors: Sequence[float]) -> Balance | None:
    """Factors as LibRaw tells them, of which the fourth may be 0; None where the others are."""
    red, green, blue, green_2 = map(float, factors)
    known = all(0 < value < math.inf for value in (red, green, blue))
    return (red, green, blue, green_2 or green) if known else None


def raw_exposure(path: Path) -> tuple[float, float, float]:
    """Seconds, ISO and f-number, 0 where they are not told; errors as in `read_raw`."""
    with _opened(path) as raw:
        told = raw.other
        return told.shutter_speed, told.iso_speed, told.aperture


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        import rawpy
    except ImportError:
        raise UserError("camera RAW needs rawpy", path, "pip install 'unbake[raw]'") from None
    try:
        with rawpy.imread(str(path)) as raw:
            yield raw
    except (rawpy.LibRawError, OSError, MemoryError) as error:
        told = error.args[0] if error.args else type(error).__name__
        told = told.decode(errors="replace") if isinstance(told, bytes) else told
        raise UserError(f"the image cannot be read ({told})", path) from None
