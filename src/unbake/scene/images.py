"""What is checked of an image before Mitsuba decodes it: whether it fits into memory."""

from __future__ import annotations

import re
import struct
from pathlib import Path

from ..errors import UserError
from ..memory import require_memory

#: Plugins that read images.
IMAGES = ("bitmap", "envmap")
#: Bytes in which an image must tell its size, which a long profile of colours precedes at times.
HEAD = 1 << 20
#: Bytes of a pixel while it is decoded: four channels of float32, and a copy of them.
PIXEL = 32
#: The most pixels that a byte of a file holds, of all formats: black ones in wide OpenEXR files.
DENSEST = 1 << 20


def check_image(path: Path) -> None:
    """Refuse an image whose header tells more pixels than the file or memory can hold.

    A format that is not known is left to Mitsuba.

    Raises:
        UserError: it tells the size of the image.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
        length = path.stat().st_size
    except OSError as error:
        raise UserError(f"the image cannot be read ({error.strerror})", path) from None
    size = _size(head)
    if size is None:
        return
    width, height = size
    told = f"the image of {width} x {height} pixels"
    if width < 1 or height < 1 or width * height > length * DENSEST:
        raise UserError(f"{told} is damaged: it has {length} bytes", path, "Write it again")
    require_memory(width * height * PIXEL, f"{told} needs", "Make it smaller", path)


def _size(head: bytes) -> tuple[int, int] | None:
    """Width and height; None where the format is not known, or tells them later."""
    if head.startswith(b"\x76\x2f\x31\x01"):
        return _exr_size(head)
    if head.startswith(b"\x89PNG\r\n\x1a\n") and len(head) >= 24:
        return struct.unpack_from(">2I", head, 16)
    if head.startswith(b"\xff\xd8"):
        return _jpeg_size(head)
    if head.startswith(b"BM") and len(head) >= 26:
        width, height = struct.unpack_from("<2i", head, 18)
        return width, abs(height)
    if head.startswith((b"#?RADIANCE", b"#?RGBE")):
        found = re.search(rb"\n[-+]Y (\d{1,10}) [-+]X (\d{1,10})\n", head)
        return None if found is None else (int(found[2]), int(found[1]))
    found = re.match(rb"P[Ff1-6]\s+(?:#[^\n]*\n\s*)*(\d{1,10})\s+(\d{1,10})\s", head)
    return None if found is None else (int(found[1]), int(found[2]))


def _exr_size(head: bytes) -> tuple[int, int] | None:
    key = b"dataWindow\0box2i\0\x10\0\0\0"
    at = head.find(key)
    if at < 0 or len(head) < at + len(key) + 16:
        return None
    left, top, right, bottom = struct.unpack_from("<4i", head, at + len(key))
    return right - left + 1, bottom - top + 1


def _jpeg_size(head: bytes) -> tuple[int, int] | None:
    """The size in the first frame's header, behind segments of other kinds."""
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        kind, length = head[at + 1], int.from_bytes(head[at + 2 : at + 4], "big")
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">2H", head, at + 5)
            return width, height
        at += 2 + length
    return None
