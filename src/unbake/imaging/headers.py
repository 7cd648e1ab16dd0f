"""What the header of an HDR image says, read without its pixels.

A file of a kilobyte may claim a picture of terabytes. Decoders take the memory before they find
that the rest is missing.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_EXR_MAGIC = b"\x76\x2f\x31\x01"
_EXR_DEEP, _EXR_TILED = 0x800, 0x200
#: Attributes of an OpenEXR header, and bytes of a name in it, that are read before giving up.
_ATTRIBUTES, _NAME = 10_000, 256
#: Bytes of a list of channels that is read: some hundreds of them.
_CHANNELS = 1 << 16
#: Lines that a block of OpenEXR has at most, and bytes that it takes at least.
_BLOCK_LINES, _BLOCK_BYTES = 256, 16
#: Bytes of the text at the beginning of Radiance HDR and PFM files.
_TEXT = 1 << 14


@dataclass(frozen=True)
class ImageHeader:
    """Size of a picture in pixels, and number of its channels."""

    width: int
    height: int
    channels: int


class HeaderError(ValueError):
    """What is wrong with a header, as the end of a sentence."""


def read_header(path: Path) -> ImageHeader:
    """The header of an OpenEXR, Radiance HDR or PFM file, by the suffix of its name.

    Raises:
        HeaderError: the file is of another format, damaged, or too short for its size.
        OSError: it cannot be read.
    """
    read = _READERS[path.suffix.lower()]
    with path.open("rb") as file:
        return read(file, path.stat().st_size)


def _read_exr(file: BinaryIO, size: int) -> ImageHeader:
    head = file.read(8)
    if not head.startswith(_EXR_MAGIC):
        raise HeaderError("it is not OpenEXR" if head else "it is empty")
    try:
        (version,) = struct.unpack_from("<I", head, 4)
        if version & _EXR_DEEP:
            raise HeaderError("it holds deep pixels")
        window = channels = None
        for _ in range(_ATTRIBUTES):
            name = _exr_name(file)
            if not name:
                break
            kind = _exr_name(file)
            (length,) = struct.unpack("<i", file.read(4))
            after = file.tell() + length
            if not 0 <= after <= size:
                raise HeaderError("it is cut off")
            if (name, kind, length) == (b"dataWindow", b"box2i", 16):
                window = struct.unpack("<4i", file.read(16))
            elif (name, kind) == (b"channels", b"chlist"):
                channels = _exr_channels(file.read(min(length, _CHANNELS)))
            file.seek(after)
    except struct.error:
        raise HeaderError("it is cut off") from None
    if window is None or channels is None:
        raise HeaderError("its header lacks a size or channels")
    left, top, right, bottom = window
    found = ImageHeader(right - left + 1, bottom - top + 1, channels)
    blocks = 1 if version & _EXR_TILED else -(-found.height // _BLOCK_LINES)
    if size < blocks * _BLOCK_BYTES:
        raise HeaderError(f"{size} bytes cannot hold {found.width} x {found.height} pixels")
    return found


def _exr_name(file: BinaryIO) -> bytes:
    """A text that ends with a zero byte, which is skipped."""
    start = file.tell()
    found, zero, _ = file.read(_NAME).partition(b"\0")
    if not zero:
        raise HeaderError("it is cut off")
    file.seek(start + len(found) + 1)
    return found


def _exr_channels(data: bytes) -> int:
    """The number of channels in a list: a name and 16 bytes each."""
    count, at = 0, 0
    while data[at : at + 1] not in (b"", b"\0"):
        end = data.find(b"\0", at)
        if end < 0:
            raise HeaderError("it is cut off")
        count, at = count + 1, end + 17
    return count


def _read_hdr(file: BinaryIO, size: int) -> ImageHeader:
    text = file.read(_TEXT)
    if not text.startswith(b"#?"):
        raise HeaderError("it is not Radiance HDR")
    found = re.search(rb"\n[-+]Y +(\d{1,9}) +[-+]X +(\d{1,9}) *\n", text)
    if found is None:
        raise HeaderError("its header lacks a size")
    height, width = int(found[1]), int(found[2])
    if size - found.end() < 4 * height:
        raise HeaderError(f"{size} bytes cannot hold {width} x {height} pixels")
    return ImageHeader(width, height, 3)


def _read_pfm(file: BinaryIO, size: int) -> ImageHeader:
    found = re.match(rb"P([Ff])\s+(\d{1,9})\s+(\d{1,9})\s+[-+.\deE]{1,40}\s", file.read(_TEXT))
    if found is None:
        raise HeaderError("it is not PFM")
    channels, width, height = 3 if found[1] == b"F" else 1, int(found[2]), int(found[3])
    if size - found.end() < 4 * channels * width * height:
        raise HeaderError(f"{size} bytes cannot hold {width} x {height} pixels")
    return ImageHeader(width, height, channels)


_READERS: dict[str, Callable[[BinaryIO, int], ImageHeader]] = {
    ".exr": _read_exr,
    ".hdr": _read_hdr,
    ".rgbe": _read_hdr,
    ".pfm": _read_pfm,
}
#: Suffixes of the files whose headers can be read.
SUFFIXES = tuple(_READERS)
