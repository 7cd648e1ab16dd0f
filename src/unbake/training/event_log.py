"""Scalars in the format that TensorBoard reads.

A file of records: length, checksum, protocol buffer `Event`, checksum. Only what scalars need of
both formats is written here, so that no package is needed.

Source: TensorFlow, `record_writer.cc`, `event.proto`, `summary.proto`.
"""

from __future__ import annotations

import math
import os
import struct
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import Any

_POLYNOMIAL = 0x82F63B78  # CRC-32C, reflected


def _table() -> list[int]:
    table = []
    for byte in range(256):
        for _ in range(8):
            byte = byte >> 1 ^ (_POLYNOMIAL if byte & 1 else 0)
        table.append(byte)
    return table


_TABLE = _table()


class EventLog:
    """Appends scalars to a new file in a folder.

    Where a record cannot be written, on a full disk, the file ends before it, as readers stop at a
    torn one; nothing more is written.

    Args:
        folder: is made where there is none.
        first: the first step that follows; TensorBoard forgets later ones of other files.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, folder: Path, first: int) -> None:
        folder.mkdir(exist_ok=True)
        now = time.time()
        name = f"events.out.tfevents.{int(now)}.{os.getpid()}.unbake"
        self._file: FileIO | None = FileIO(folder / name, "ab")
        self._write(_event(now) + _bytes(3, b"brain.Event:2"))
        self._write(_event(now, first) + _bytes(7, b"\x08\x01"))  # a session starts

    def add(self, entry: Mapping[str, Any]) -> None:
        """Append a line of the log of a run: its numbers, at its step.

        Numbers of objects in it, such as scores, have names such as `validation/albedo_psnr`.
        """
        values = b"".join(
            _bytes(1, _bytes(1, name.encode()) + b"\x15" + struct.pack("<f", value))
            for name, value in _scalars(entry)
        )
        if values:
            self._write(_event(time.time(), int(entry["step"])) + _bytes(5, values))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, event: bytes) -> None:
        if self._file is None:
            return
        length = struct.pack("<Q", len(event))
        record = length + _checksum(length) + event + _checksum(event)
        start = self._file.tell()
        try:
            if self._file.write(record) == len(record):
                return
        except OSError:
            pass
        with suppress(OSError):
            self._file.truncate(start)
        self.close()


def _scalars(entry: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    for name, value in entry.items():
        if isinstance(value, Mapping):
            yield from _scalars(value, f"{prefix}{name}/")
        elif isinstance(value, int | float) and not isinstance(value, bool) and name != "step":
            # Beyond what four bytes hold: too large for a curve, too.
            yield prefix + name, value if abs(value) < 3e38 else math.copysign(math.inf, value)


def _event(wall_time: float, step: int | None = None) -> bytes:
    found = b"\x09" + struct.pack("<d", wall_time)
    return found if step is None else found + b"\x10" + _varint(step)


def _bytes(field: int, data: bytes) -> bytes:
    """A field of bytes, text or a message."""
    return bytes([field << 3 | 2]) + _varint(len(data)) + data


def _varint(number: int) -> bytes:
    found = bytearray()
    while number > 127:
        found.append(number & 127 | 128)
        number >>= 7
    return bytes([*found, number])


def _checksum(data: bytes) -> bytes:
    """The masked CRC-32C of a record."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = crc >> 8 ^ _TABLE[(crc ^ byte) & 255]
    crc ^= 0xFFFFFFFF
    return struct.pack("<I", ((crc >> 15 | crc << 17 & 0xFFFFFFFF) + 0xA282EAD8) & 0xFFFFFFFF)
