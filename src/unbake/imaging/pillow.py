"""Files of images, opened by Pillow without its warnings and its limit of size."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from PIL import Image

#: Formats that may be tried, by Pillow's names: it knows some that start other programs.
FORMATS = ("PNG", "JPEG", "TIFF")

_lock = threading.Lock()
#: How many images are open, and what is to be restored after the last one: filters of warnings and
#: the limit belong to the process, and several threads may have images open.
_open = 0
_before: tuple[Any, int | None]


@contextmanager
def opened(path: Path, formats: tuple[str, ...] = FORMATS) -> Iterator[Image.Image]:
    """An image file, of any size: that is known from headers, and compared with the free memory.

    Pillow refuses more than 179 million pixels, and there are cameras with 200 million. It warns of
    odd tags, and of half that size.

    Args:
        path: the file.
        formats: that may be tried, of `FORMATS`.
    """
    _enter()
    try:
        with Image.open(path, formats=formats) as image:
            yield image
    finally:
        _leave()


def _enter() -> None:
    global _open, _before
    with _lock:
        if not _open:
            quiet = warnings.catch_warnings()
            quiet.__enter__()
            warnings.simplefilter("ignore")
            _before, Image.MAX_IMAGE_PIXELS = (quiet, Image.MAX_IMAGE_PIXELS), None
        _open += 1


def _leave() -> None:
    global _open
    with _lock:
        _open -= 1
        if not _open:
            quiet, Image.MAX_IMAGE_PIXELS = _before
            quiet.__exit__(None, None, None)
