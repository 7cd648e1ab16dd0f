"""Camera RAW, as LibRaw reads it: what the sensor counted, in the white balance of the camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..imaging.headers import ImageHeader

#: Of the files of cameras that photographers meet most.
SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef")
#: From this share of the largest value on a channel is taken for clipped.
CLIPPED = 0.99


def is_raw(path: Path) -> bool:
    """Whether a file is camera RAW, by its suffix."""
    return path.suffix.lower() in SUFFIXES


def raw_header(path: Path) -> ImageHeader:
    """Its size, as `read_raw` gives it; errors as there."""
    with _opened(path) as raw:
        return ImageHeader(raw.sizes.width, raw.sizes.height, 3, 16)


def read_raw(path: Path) -> np.ndarray:
    """Linear RGB of the sRGB primaries, (H, W, 3) float32, clipped at 1, not turned by its EXIF.

    The black level is taken away and the white balance of the camera applied. There is no curve,
    and no brightening: the values of photographs of one camera are in one unit.

    Raises:
        UserError: rawpy is missing, or LibRaw cannot read the file.
    """
    with _opened(path) as raw:
        pixels = raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            adjust_maximum_thr=0.0,
            use_camera_wb=True,
            output_bps=16,
            user_flip=0,
        )
    return (pixels / 65535).astype(np.float32)


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
