"""What is checked of a mesh file before Mitsuba reads it.

Mitsuba 3.9 takes indices as they are: those out of range end the process, when a hit is computed or
when the acceleration structure is built. It reserves as much memory as a header asks for.
"""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from mmap import ACCESS_READ, mmap
from os import SEEK_END
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np

from ..errors import UserError
from ..memory import require_memory

#: Plugins that read mesh files which are checked.
FORMATS = ("ply", "obj", "serialized")
#: Bytes in which the header of a PLY file must end.
HEADER = 1 << 16
#: Coordinates beyond this overflow when areas are computed.
LARGEST = 1e18

_REPAIR = "Export the mesh again, as triangles"
_TYPES = {
    name: code
    for code, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "i8": ("long", "int64"),
        "u8": ("ulong", "uint64"),
        "f2": ("half", "float16"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
_CORNERS = ("i0", "i1", "i2")
_INDICES = ("vertex_indices", "vertex_index")
#: The most that zlib packs into a byte.
_RATIO = 1032
# Of the serialized format.
_MAGIC, _WITHOUT_NAMES, _WITH_NAMES = 0x041C, 3, 4
_NORMALS, _COORDINATES, _COLOURS, _DOUBLE = 0x1, 0x2, 0x8, 0x2000


def check_mesh(kind: str, path: Path, number: int = 0) -> None:
    """Check a mesh file, once for each content: what it counts, its positions and indices.

    Args:
        kind: the plugin that reads it, of `FORMATS`.
        number: of the mesh, where a file has several.

    Raises:
        UserError: the file is damaged, has no triangles, or one of a vertex that it does not have.
    """
    status = path.stat()
    _check(kind, path, number, status.st_mtime_ns, status.st_size, status.st_ino)


@lru_cache(maxsize=1 << 14)
def _check(kind: str, path: Path, number: int, *_: int) -> None:
    try:
        if kind == "serialized":
            _check_serialized(path, number)
        elif kind == "ply":
            _check_ply(path)
        else:
            _check_obj(path)
    except OSError as error:
        raise UserError(f"the mesh cannot be read ({error.strerror})", path) from None
    except ValueError as error:
        _refuse(f"the mesh cannot be read ({error})", path)
    except MemoryError:
        raise UserError("the mesh does not fit into memory", path, "Use a smaller one") from None


# --------------------------------------------------------------------------------------------- PLY


_Tables = Mapping[str, Mapping[str, np.ndarray] | np.ndarray]


@dataclass
class _Element:
    """An element of a PLY file."""

    name: str
    count: int
    fields: list[tuple[str, str]]  # names and types; of lists, the three entries of a triangle

    @property
    def dtype(self) -> np.dtype:
        return np.dtype(self.fields)


def _check_ply(path: Path) -> None:
    with path.open("rb") as file:
        order, elements = _ply_header(file, path)
        _require_triangles(elements, path)
        if order is None:
            tables = _ply_text(file.read(), elements, path)
        else:
            tables = _ply_binary(path, file.tell(), elements)
    vertices, faces = tables["vertex"], tables["face"]
    if (faces["count"] != 3).any():
        _refuse("the mesh has faces that are no triangles", path)
    positions = np.stack([vertices[axis] for axis in "xyz"], -1)
    indices = np.stack([faces[corner] for corner in _CORNERS], -1)
    _require_sound(positions, indices, path)


def _require_triangles(elements: list[_Element], path: Path) -> None:
    """Raise a `UserError` unless the header tells of vertices and faces."""
    named = {element.name: element for element in elements}
    if len(named) != len(elements):
        _refuse("the mesh has elements of one name", path)
    for name, fields in {"vertex": set("xyz"), "face": set(_CORNERS)}.items():
        known = [] if name not in named else [field for field, _ in named[name].fields]
        if not fields <= set(known):
            what = "positions" if name == "vertex" else "indices of triangles"
            _refuse(f"the mesh has no {name} with {what}", path)
        if not named[name].count:
            _refuse(f"the mesh is empty: it has no {name}", path)


def ply_fields(path: Path) -> dict[str, dict[str, str]]:
    """The properties in a PLY file with their types of NumPy, by element, in their order."""
    with path.open("rb") as file:
        _, elements = _ply_header(file, path)
    return {element.name: dict(element.fields) for element in elements}


def _ply_header(file: BinaryIO, path: Path) -> tuple[str | None, list[_Element]]:
    """The byte order, which text has not, and the elements."""
    head = file.read(HEADER)
    ending = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if not re.match(rb"ply[ \t]*\r?\n", head) or ending is None:
        _refuse("not a PLY file: its header is not readable", path)
    order, elements = "", []
    for line in head[: ending.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        match words:
            case [] | ["comment", *_]:
                pass
            case ["format", "ascii" | "binary_little_endian" | "binary_big_endian" as kind, _]:
                order = {"ascii": None, "binary_big_endian": ">"}.get(kind, "<")
            case ["element", name, count] if re.fullmatch(r"\d{1,18}", count):
                elements.append(_Element(name, int(count), []))
            case ["property", "list", count, item, name] if (
                elements and name in _INDICES and {count, item} <= set(_TYPES)
            ):
                kinds = {"count": count} | dict.fromkeys(_CORNERS, item)
                elements[-1].fields += [(k, (order or "=") + _TYPES[t]) for k, t in kinds.items()]
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].fields.append((name, (order or "=") + _TYPES[kind]))
            case _:
                _refuse(f"not a PLY file that Mitsuba reads: {line[:60]!r}", path)
    if order == "":
        _refuse("not a PLY file: it tells no format", path)
    for element in elements:
        if len({name for name, _ in element.fields}) != len(element.fields):
            _refuse(f"the mesh has properties of one name in {element.name!r}", path)
    file.seek(ending.end())
    return order, elements


def _ply_text(content: bytes, elements: list[_Element], path: Path) -> _Tables:
    wanted = sum(element.count * len(element.fields) for element in elements)
    if wanted > len(content):
        _refuse(f"the mesh is cut off: its header counts {wanted} numbers", path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numpy warns of what is no number, and stops there
        numbers = np.fromstring(content, sep=" ")
    if len(numbers) < wanted:
        _refuse(f"the mesh has {len(numbers)} numbers, its header counts {wanted}", path)
    tables, at = {}, 0
    for element in elements:
        names = [name for name, _ in element.fields]
        rows = numbers[at : at + element.count * len(names)].reshape(element.count, len(names))
        tables[element.name] = dict(zip(names, rows.T, strict=True))
        at += rows.size
    return tables


def _ply_binary(path: Path, at: int, elements: list[_Element]) -> _Tables:
    size, wanted = path.stat().st_size, at + sum(e.count * e.dtype.itemsize for e in elements)
    if wanted > size:
        _refuse(f"the mesh is cut off: its header counts {wanted} bytes of {size}", path)
    tables = {}
    for element in elements:
        if element.name in ("vertex", "face"):
            tables[element.name] = np.memmap(path, element.dtype, "r", at, (element.count,))
        at += element.count * element.dtype.itemsize
    return tables


# ----------------------------------------------------------------------------------- other formats


def _check_obj(path: Path) -> None:
    """Mitsuba checks numbers and indices of an OBJ file itself."""
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        if re.search(rb"^[ \t]*f[ \t]", content, re.MULTILINE) is None:
            _refuse("the mesh is empty: it has no face", path)


def _check_serialized(path: Path, number: int) -> None:
    with path.open("rb") as file:
        version = _serialized_version(file.read(4), path)
        if number:
            file.seek(_serialized_start(file, number, version, path))
            _serialized_version(file.read(4), path)
        packed = _Packed(file, path)
        flags = int(packed.array("<u4", 1)[0])
        if version == _WITH_NAMES:
            name = b"".join(iter(lambda: packed.bytes(1), b"\0"))
            try:
                name.decode()
            except UnicodeDecodeError:
                _refuse("the name of the mesh is not UTF-8", path)
        vertices, faces = (int(count) for count in packed.array("<u8", 2))
        if not vertices or not faces:
            _refuse("the mesh is empty", path)
        real = "<f8" if flags & _DOUBLE else "<f4"
        positions = packed.array(real, 3 * vertices)
        for flag, each in ((_NORMALS, 3), (_COORDINATES, 2), (_COLOURS, 3)):
            if flags & flag:
                packed.array(real, each * vertices)
        index = "<u8" if vertices > 0xFFFFFFFF else "<u4"
        indices = packed.array(index, 3 * faces)
    _require_sound(positions.reshape(-1, 3), indices.reshape(-1, 3), path)


def _serialized_version(head: bytes, path: Path) -> int:
    magic, version = (int(n) for n in np.frombuffer(head.ljust(4, b"\0"), "<u2"))
    if magic != _MAGIC or version not in (_WITHOUT_NAMES, _WITH_NAMES):
        _refuse("not a serialized mesh that Mitsuba reads", path)
    return version


def _serialized_start(file: BinaryIO, number: int, version: int, path: Path) -> int:
    """Where a mesh begins, by the list at the end of the file."""
    size = file.seek(0, SEEK_END)
    file.seek(max(0, size - 4))
    count = int.from_bytes(file.read(4), "little")
    each = 8 if version == _WITH_NAMES else 4
    if not 0 <= number < count or count * each + 4 > size:
        _refuse(f"the file has no mesh number {number}", path)
    file.seek(size - 4 - each * (count - number))
    start = int.from_bytes(file.read(each), "little")
    if start >= size:
        _refuse(f"the file has no mesh number {number}", path)
    return start


class _Packed:
    """Reads what is packed by zlib, no more at a time than is asked for."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        self._unpack = zlib.decompressobj()
        self._left = path.stat().st_size * _RATIO

    def array(self, dtype: str, count: int) -> np.ndarray:
        return np.frombuffer(self.bytes(np.dtype(dtype).itemsize * count), dtype)

    def bytes(self, count: int) -> bytes:
        self._left -= count
        if self._left < 0:
            _refuse("the mesh is cut off: it counts more than the file can hold", self._path)
        require_memory(2 * count, "the mesh needs", "Use a smaller one", self._path)
        parts = []
        while count:
            packed = self._unpack.unconsumed_tail or self._file.read(1 << 20)
            try:
                part = self._unpack.decompress(packed, count) if packed else b""
            except zlib.error as error:
                _refuse(f"the mesh is damaged ({error})", self._path)
            if not part and not packed:
                _refuse("the mesh is cut off", self._path)
            parts.append(part)
            count -= len(part)
        return b"".join(parts)


# --------------------------------------------------------------------------------------- triangles


def _require_sound(positions: np.ndarray, indices: np.ndarray, path: Path) -> None:
    """Raise a `UserError` for positions (n, 3) or indices (m, 3) that no mesh has."""
    bad = int((~(np.abs(positions) <= LARGEST)).any(1).sum())
    if bad:
        _refuse(f"{bad} of {len(positions)} vertices are not finite, or beyond {LARGEST:g}", path)
    bad = int(((indices < 0) | (indices >= len(positions))).any(1).sum())
    if bad:
        _refuse(f"{bad} of {len(indices)} triangles are of vertices that do not exist", path)


def _refuse(what: str, path: Path) -> NoReturn:
    raise UserError(what, path, _REPAIR)
