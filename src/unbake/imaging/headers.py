"""What the header of an image says, read without its pixels.

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
#: Bytes in which a JPEG file must tell its size, behind profiles of colours and small pictures.
_JPEG = 1 << 22
#: Pixels that a byte of a PNG, JPEG or TIFF file holds at most: black ones, packed by zlib.
_DENSEST = 1 << 14
#: Tags of a TIFF directory, and bytes of a number by its type.
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES, _TIFF_KIND = 256, 257, 258, 277, 339
_TIFF_NUMBERS = {1: "B", 3: "H", 4: "I"}


@dataclass(frozen=True)
class ImageHeader:
    """Size of a picture in pixels, number of its channels, and bits of a code value.

    `bits` is None where values are floating point, as they are in HDR images. `whole` is false
    where OpenEXR tells of another picture, of which these pixels are a part or go beyond it.
    """

    width: int
    height: int
    channels: int
    bits: int | None = None
    whole: bool = True


#: How files begin, by their formats.
_MAGIC = {
    _EXR_MAGIC: "OpenEXR",
    b"\x89PNG": "PNG",
    b"\xff\xd8\xff": "JPEG",
    b"II*\0": "TIFF",
    b"MM\0*": "TIFF",
    b"#?": "Radiance HDR",
}


class HeaderError(ValueError):
    """What is wrong with a header, as the end of a sentence."""


def read_header(path: Path) -> ImageHeader:
    """The header of a file of `SUFFIXES` or `CODED_SUFFIXES`, by the suffix of its name.

    Raises:
        HeaderError: the file is of another format, damaged, or too short for its size.
        OSError: it cannot be read.
    """
    read = _READERS[path.suffix.lower()]
    with path.open("rb") as file:
        return read(file, path.stat().st_size)


def _another(wanted: str, head: bytes) -> str:
    """That a file is not of the format that its suffix names, and of which it is, if that is known.

    Args:
        head: its first bytes.
    """
    if not head:
        return "it is empty"
    found = next((name for magic, name in _MAGIC.items() if head.startswith(magic)), None)
    if found is None:
        return f"it is not {wanted}"
    if wanted.startswith(found):
        return "it is cut off or damaged"
    return f"it is not {wanted} but {found}: rename it"


def _read_exr(file: BinaryIO, size: int) -> ImageHeader:
    head = file.read(8)
    if not head.startswith(_EXR_MAGIC):
        raise HeaderError(_another("OpenEXR", head))
    try:
        (version,) = struct.unpack_from("<I", head, 4)
        if version & _EXR_DEEP:
            raise HeaderError("it holds deep pixels")
        window = shown = channels = None
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
            elif (name, kind, length) == (b"displayWindow", b"box2i", 16):
                shown = struct.unpack("<4i", file.read(16))
            elif (name, kind) == (b"channels", b"chlist"):
                channels = _exr_channels(file.read(min(length, _CHANNELS)))
            file.seek(after)
    except struct.error:
        raise HeaderError("it is cut off") from None
    if window is None or channels is None:
        raise HeaderError("its header lacks a size or channels")
    left, top, right, bottom = window
    whole = shown in (None, window)
    found = ImageHeader(right - left + 1, bottom - top + 1, channels, whole=whole)
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


def _read_png(file: BinaryIO, size: int) -> ImageHeader:
    head = file.read(33)
    if not head.startswith(b"\x89PNG\r\n\x1a\n"):
        raise HeaderError(_another("PNG", head))
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise HeaderError("it is cut off")
    width, height, bits, kind = struct.unpack_from(">2I2B", head, 16)
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(kind)
    if channels is None or bits not in (1, 2, 4, 8, 16):
        raise HeaderError("its header is damaged")
    return _coded(width, height, channels, max(bits, 8), size)


def _read_jpeg(file: BinaryIO, size: int) -> ImageHeader:
    head = file.read(_JPEG)
    if not head.startswith(b"\xff\xd8"):
        raise HeaderError(_another("JPEG", head))
    at = 2
    while at + 10 <= len(head) and head[at] == 0xFF:
        kind = head[at + 1]
        if kind == 0xFF:  # a byte that only fills up
            at += 1
            continue
        length = int.from_bytes(head[at + 2 : at + 4], "big")
        if 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            bits, height, width, channels = struct.unpack_from(">B2HB", head, at + 4)
            return _coded(width, height, channels, bits, size)
        at += 2 + length
    raise HeaderError("its header lacks a size")


def _read_tiff(file: BinaryIO, size: int) -> ImageHeader:
    head = file.read(8)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
    if order is None or len(head) < 8:
        raise HeaderError(_another("TIFF (or a BigTIFF)", head))
    found: dict[int, int] = {}
    try:
        file.seek(struct.unpack_from(f"{order}I", head, 4)[0])
        (count,) = struct.unpack(f"{order}H", file.read(2))
        entries = file.read(12 * count)
        for at in range(0, 12 * count, 12):
            tag, kind, length = struct.unpack_from(f"{order}2HI", entries, at)
            number = _TIFF_NUMBERS.get(kind)
            if number is None or not length:
                continue
            field = entries[at + 8 : at + 12]
            if length * struct.calcsize(number) > 4:  # of each channel; the first one tells
                file.seek(struct.unpack(f"{order}I", field)[0])
                field = file.read(4)
            found[tag] = struct.unpack_from(f"{order}{number}", field)[0]
    except struct.error:
        raise HeaderError("it is cut off") from None
    if _TIFF_WIDTH not in found or _TIFF_HEIGHT not in found:
        raise HeaderError("its header lacks a size")
    if found.get(_TIFF_KIND, 1) != 1:
        raise HeaderError("its values are no code values: write OpenEXR")
    channels, bits = found.get(_TIFF_SAMPLES, 1), max(found.get(_TIFF_BITS, 1), 8)
    return _coded(found[_TIFF_WIDTH], found[_TIFF_HEIGHT], channels, bits, size)


def _coded(width: int, height: int, channels: int, bits: int, size: int) -> ImageHeader:
    if width < 1 or height < 1 or width * height > size * _DENSEST:
        raise HeaderError(f"{size} bytes cannot hold {width} x {height} pixels")
    if bits not in (8, 16):
        raise HeaderError(f"it has {bits} bits a channel, not 8 or 16")
    return ImageHeader(width, height, channels, bits)


_READERS: dict[str, Callable[[BinaryIO, int], ImageHeader]] = {
    ".exr": _read_exr,
    ".hdr": _read_hdr,
    ".rgbe": _read_hdr,
    ".pfm": _read_pfm,
    ".png": _read_png,
    ".jpg": _read_jpeg,
    ".jpeg": _read_jpeg,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
}
#: Suffixes of HDR images, which hold linear radiance.
SUFFIXES = (".exr", ".hdr", ".rgbe", ".pfm")
#: Suffixes of images of code values, of 8 or 16 bits a channel.
CODED_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
