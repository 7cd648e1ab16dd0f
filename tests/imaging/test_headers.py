"""Headers of HDR images: sizes as decoders read them, and lies found without a decoder."""

import struct

import mitsuba as mi
import numpy as np
import pytest

from unbake.imaging.headers import HeaderError, ImageHeader, read_header

FORMATS = {
    "exr": mi.Bitmap.FileFormat.OpenEXR,
    "hdr": mi.Bitmap.FileFormat.RGBE,
    "pfm": mi.Bitmap.FileFormat.PFM,
}


@pytest.fixture
def written(tmp_path):
    def make(suffix, height, width, channels):
        file = tmp_path / f"a.{suffix}"
        pixels = np.ones((height, width, channels), np.float32)
        mi.Bitmap(pixels).write(str(file), FORMATS[suffix])
        return file

    return make


@pytest.mark.parametrize(
    ("suffix", "channels"),
    [*(("exr", n) for n in (1, 3, 4, 7)), ("hdr", 3), ("pfm", 1), ("pfm", 3)],
)
@pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 3), (300, 700)])
def test_sizes_are_those_of_the_decoder(written, suffix, height, width, channels):
    found = read_header(written(suffix, height, width, channels))
    assert found == ImageHeader(width, height, channels)


def refused(file, reason):
    with pytest.raises(HeaderError, match=reason):
        read_header(file)


@pytest.mark.parametrize("size", [100_000, 1 << 29, (1 << 31) - 2])
def test_an_exr_of_a_kilobyte_holds_no_gigapixels(written, size):
    file = written("exr", 4, 6, 3)
    data = bytearray(file.read_bytes())
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    struct.pack_into("<4i", data, at, 0, 0, size, size)
    file.write_bytes(data)
    refused(file, f"bytes cannot hold {size + 1} x {size + 1} pixels")


@pytest.mark.parametrize("shown", [(0, 0, 11, 3), (1, 0, 5, 3), (-2, 0, 5, 3)])
def test_an_exr_that_is_not_its_whole_picture_says_so(written, shown):
    file = written("exr", 4, 6, 3)
    assert read_header(file).whole
    data = bytearray(file.read_bytes())
    at = data.index(b"displayWindow\0box2i\0") + len(b"displayWindow\0box2i\0") + 4
    struct.pack_into("<4i", data, at, *shown)
    file.write_bytes(data)
    assert read_header(file) == ImageHeader(6, 4, 3, whole=False)


@pytest.mark.parametrize(
    ("suffix", "old", "new"),
    [
        ("hdr", b"-Y 4 +X 6", b"-Y 99999 +X 99999"),
        ("pfm", b"6 4", b"99999 99999"),
    ],
)
def test_texts_may_lie_as_well(written, suffix, old, new):
    file = written(suffix, 4, 6, 3)
    file.write_bytes(file.read_bytes().replace(old, new))
    refused(file, "bytes cannot hold 99999 x 99999 pixels")


@pytest.mark.parametrize("suffix", FORMATS)
def test_what_is_cut_off_or_something_else_is_named(written, suffix):
    file = written(suffix, 4, 6, 3)
    whole = file.read_bytes()
    for length in (0, 1, 3, 7, 8, 9, 12, 20):
        file.write_bytes(whole[:length])
        refused(file, "it is|its header|bytes cannot hold")
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    refused(file, "it is not OpenEXR but PNG: rename it|it is not (Radiance HDR|PFM)")


def test_a_size_behind_long_notes_is_found(written):
    file = written("exr", 4, 6, 3)
    data = file.read_bytes()
    note = b"note\0string\0" + struct.pack("<i", 1 << 18) + b"x" * (1 << 18)
    file.write_bytes(data[:8] + note + data[8:])
    assert read_header(file) == ImageHeader(6, 4, 3)


@pytest.mark.parametrize("length", [-1, -(1 << 31), (1 << 31) - 1])
def test_a_note_with_an_impossible_length_is_refused(written, length):
    file = written("exr", 4, 6, 3)
    data = file.read_bytes()
    note = b"note\0string\0" + struct.pack("<i", length)
    file.write_bytes(data[:8] + note + data[8:])
    refused(file, "it is cut off|its header lacks|bytes cannot hold")


def test_random_changes_of_headers_are_read_or_refused(written):
    rng = np.random.default_rng(0)
    for suffix in FORMATS:
        file = written(suffix, 4, 6, 3)
        whole = np.frombuffer(file.read_bytes(), np.uint8)
        for _ in range(300):
            data = whole.copy()
            places = rng.integers(0, min(len(data), 330), rng.integers(1, 6))
            data[places] = rng.integers(0, 256, len(places))
            file.write_bytes(data.tobytes())
            try:
                found = read_header(file)
            except HeaderError:
                continue
            assert isinstance(found.width, int) and isinstance(found.channels, int)
