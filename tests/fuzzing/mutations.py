"""Mutations of files: bytes, numbers, lines, and values of JSON, TOML and XML.

A mutation draws its choices from Hypothesis and returns the changed content.
"""

from __future__ import annotations

import copy
import json
import re
import struct
from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

Draw = Callable[[st.SearchStrategy[Any]], Any]
Mutation = Callable[[Draw, bytes], bytes]

#: Numbers as text that programs get wrong.
NUMBERS = (
    "nan", "NaN", "inf", "-inf", "Infinity", "-1", "0", "-0.0", "1", "2", "1e300", "-1e300",
    "1e-300", "1e400", "1e39", "1e-46", "2147483647", "2147483648", "4294967295", "-2147483649",
    "9223372036854775808", "18446744073709551616", "16777217", "0.1", "1e9", "100000", "7" * 400,
    "0." + "3" * 400, "0x10", "1_000", "١", "", "--1", "1,5", "true",
)  # fmt: skip
#: Texts in the place of names and paths.
TEXTS = (
    "", " ", "..", "/", "../../evil", "a/../../b", "\x00", "\x1b[2J", "line\nbreak", "é" * 300,
    "x" * 5000, "<script>", "%s%n{0}", "\ud800", "file:///x", "C:\\x", "CON", "\u202e", "nul\x00l",
)  # fmt: skip
_TEXTS = st.sampled_from(TEXTS)
#: Bytes that mean something to decoders.
PIECES = (
    b"\x00", b"\xff", b"\x00" * 16, b"\xff" * 8, b"\xef\xbb\xbf", b"\xff\xfe", b"\r\n", b"\x1b[31m",
    b"\xc3\x28", b"\x80\x81", b"\n", b" " * 300, b"{", b"[", b'"', b"<", b"&", b"#", b"'",
    *(struct.pack("<I", n) for n in (0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1, 1 << 20)),
    *(struct.pack("<f", x) for x in (float("nan"), float("inf"), -1.0, 1e38, 1e-40)),
    *(struct.pack("<Q", n) for n in (1 << 63, (1 << 64) - 1, 1 << 32)),
)  # fmt: skip
_NUMBER = re.compile(rb"(?<![\w.])[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?(?![\w.])")


def _index(draw: Draw, count: int) -> int:
    return draw(st.integers(0, count - 1))


def _part(draw: Draw, data: bytes, longest: int) -> tuple[int, int]:
    """Start and end of a part of the data."""
    start = draw(st.integers(0, len(data)))
    return start, min(len(data), start + draw(st.integers(0, longest)))


# --------------------------------------------------------------------------------------- any file


def flip(draw: Draw, data: bytes) -> bytes:
    """Flip a bit."""
    if not data:
        return b"\x01"
    at = _index(draw, len(data))
    return data[:at] + bytes([data[at] ^ (1 << _index(draw, 8))]) + data[at + 1 :]


def truncate(draw: Draw, data: bytes) -> bytes:
    """Cut the end off."""
    return data[: draw(st.integers(0, len(data)))]


def delete(draw: Draw, data: bytes) -> bytes:
    """Leave out a part."""
    start, end = _part(draw, data, 64)
    return data[:start] + data[end:]


def repeat(draw: Draw, data: bytes) -> bytes:
    """Write a part several times."""
    start, end = _part(draw, data, 256)
    return data[:start] + data[start:end] * draw(st.integers(2, 9)) + data[end:]


def move(draw: Draw, data: bytes) -> bytes:
    """Write a part over another place."""
    start, end = _part(draw, data, 256)
    at = draw(st.integers(0, len(data)))
    return data[:at] + data[start:end] + data[at + end - start :]


def insert(draw: Draw, data: bytes) -> bytes:
    """Put in bytes that mean something."""
    at = draw(st.integers(0, len(data)))
    return data[:at] + draw(st.sampled_from(PIECES)) + data[at:]


def overwrite(draw: Draw, data: bytes) -> bytes:
    """Write bytes that mean something over others."""
    at, piece = draw(st.integers(0, len(data))), draw(st.sampled_from(PIECES))
    return data[:at] + piece + data[at + len(piece) :]


def anything(draw: Draw, data: bytes) -> bytes:
    """Random bytes in the place of all."""
    return draw(st.binary(max_size=200))


BYTES: tuple[Mutation, ...] = (flip, truncate, delete, repeat, move, insert, overwrite)


def early(mutation: Mutation, size: int = 512) -> Mutation:
    """The same within the first bytes, where headers are."""

    def mutated(draw: Draw, data: bytes) -> bytes:
        return mutation(draw, data[:size]) + data[size:]

    return mutated


# -------------------------------------------------------------------------------------- text files


def number(draw: Draw, data: bytes) -> bytes:
    """Another number in the place of one."""
    found = list(_NUMBER.finditer(data))
    if not found:
        return insert(draw, data)
    match = found[_index(draw, len(found))]
    new = draw(st.sampled_from(NUMBERS)).encode()
    return data[: match.start()] + new + data[match.end() :]


def word(draw: Draw, data: bytes) -> bytes:
    """Another word of the file, or a bad text, in the place of a word."""
    found = list(re.finditer(rb"[A-Za-z_][\w./-]*", data))
    if not found:
        return insert(draw, data)
    match = found[_index(draw, len(found))]
    other = found[_index(draw, len(found))].group()
    new = draw(st.sampled_from((other, *(t.encode("utf-8", "surrogatepass") for t in TEXTS))))
    return data[: match.start()] + new + data[match.end() :]


def lines(draw: Draw, data: bytes) -> bytes:
    """Leave out, repeat or move a line."""
    rows = data.splitlines(keepends=True)
    if not rows:
        return data
    row = rows.pop(_index(draw, len(rows)))
    for _ in range(draw(st.integers(0, 3))):
        rows.insert(draw(st.integers(0, len(rows))), row)
    return b"".join(rows)


def encoding(draw: Draw, data: bytes) -> bytes:
    """Write the text in another encoding."""
    text = data.decode("utf-8", "replace")
    return text.encode(draw(st.sampled_from(("utf-16", "utf-32", "utf-8-sig", "cp037"))), "replace")


TEXT: tuple[Mutation, ...] = (number, number, word, lines, encoding, *BYTES)

# -------------------------------------------------------------------------------------------- JSON


def hostile(draw: Draw) -> Any:
    """A JSON value of any type, often one that programs get wrong."""
    kind = _index(draw, 8)
    if kind == 0:
        return draw(st.sampled_from((None, True, False, [], {}, [[]], [None], {"": None})))
    if kind == 1:
        return draw(_TEXTS)
    if kind == 2:
        return draw(
            st.sampled_from((float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 1e-300))
        )
    if kind == 3:
        return draw(
            st.sampled_from((-1, 0, 1, 2**31, -(2**31), 2**63, 2**64, 10**18, int("7" * 400)))
        )
    if kind == 4:
        return [hostile(draw) for _ in range(_index(draw, 4))]
    if kind == 5:
        return {draw(_TEXTS): hostile(draw)}
    return draw(st.one_of(st.integers(-3, 300), st.floats(), st.text(max_size=8)))


def _places(value: Any, path: tuple = ()) -> list[tuple]:
    """The paths of all values within a value."""
    found = []
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, inner in items:
        found.append((*path, key))
        if isinstance(inner, dict | list):
            found += _places(inner, (*path, key))
    return found


def in_json(draw: Draw, content: Any) -> Any:
    """A JSON value with one value in it changed, left out, renamed or repeated."""
    content = copy.deepcopy(content)
    places = _places(content) if isinstance(content, dict | list) else []
    if not places:
        return hostile(draw)
    path = places[_index(draw, len(places))]
    parent = content
    for key in path[:-1]:
        parent = parent[key]
    key, change = path[-1], _index(draw, 6)
    if change == 0:
        del parent[key]
    elif change == 1 and isinstance(parent, dict):
        parent[draw(_TEXTS)] = parent.pop(key)
    elif change == 2 and isinstance(parent, list):
        parent += [parent[key]]
        parent[:] = parent[draw(st.integers(0, 1)) :] * draw(st.integers(1, 3))
    elif change == 3:
        parent[key] = [parent[key]]
    else:
        parent[key] = hostile(draw)
    return content


def json_value(draw: Draw, data: bytes) -> bytes:
    """Change a value of a JSON file."""
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return insert(draw, data)
    return _dumped(in_json(draw, content))


def json_line(draw: Draw, data: bytes) -> bytes:
    """Change a value in a line of a file of JSON lines."""
    rows = data.splitlines(keepends=True)
    if not rows:
        return data
    at = _index(draw, len(rows))
    rows[at] = json_value(draw, rows[at]).strip() + b"\n"
    return b"".join(rows)


def _dumped(content: Any) -> bytes:
    return json.dumps(content).encode()


def json_twice(draw: Draw, data: bytes) -> bytes:
    """Give a key twice."""
    found = list(re.finditer(rb'"[^"]*"\s*:', data))
    if not found:
        return insert(draw, data)
    match = found[_index(draw, len(found))]
    return data[: match.start()] + match.group() + b"0," + data[match.start() :]


def nested(draw: Draw, data: bytes) -> bytes:
    """Nest deeply, in the place of a value or of all."""
    depth = draw(st.sampled_from((30, 500, 5_000, 100_000)))
    before, after = draw(st.sampled_from(((b"[", b"]"), (b'{"a":', b"}"), (b"[", b""))))
    deep = before * depth + b"1" + after * depth
    found = list(_NUMBER.finditer(data))
    if not found:
        return deep
    match = found[_index(draw, len(found))]
    return data[: match.start()] + deep + data[match.end() :]


JSON: tuple[Mutation, ...] = (*(json_value,) * 8, json_twice, nested, anything, *TEXT)
JSON_LINES: tuple[Mutation, ...] = (*(json_line,) * 8, json_twice, nested, anything, *TEXT)

# -------------------------------------------------------------------------------------------- TOML

_VALUES = (
    *(f"{n}" for n in NUMBERS), "[]", "{}", "[1, 'a']", "'text'", '"\\u0000"', "1979-05-27",
    "{ a = 1 }", "[[[[1]]]]", "false", "07:32:00", '"""', "=", "[{}]",
)  # fmt: skip


def toml_value(draw: Draw, data: bytes) -> bytes:
    """Another value in the place of one."""
    found = list(re.finditer(rb"= *([^\n]*)", data))
    if not found:
        return insert(draw, data)
    match = found[_index(draw, len(found))]
    new = draw(st.sampled_from(_VALUES)).encode()
    return data[: match.start(1)] + new + data[match.end(1) :]


def toml_key(draw: Draw, data: bytes) -> bytes:
    """A key of the file with any value at its end, in the last table or in a dotted one."""
    keys = [m.group(1) for m in re.finditer(rb"(?m)^\[?([\w.]+)", data)] or [b"steps"]
    names = [keys[_index(draw, len(keys))] for _ in range(draw(st.integers(1, 3)))]
    value = draw(st.sampled_from(_VALUES)).encode()
    line = b".".join(names) + b" = " + value + b"\n"
    return data + line if draw(st.booleans()) else line + data


def toml_nested(draw: Draw, data: bytes) -> bytes:
    """Nest deeply."""
    depth = draw(st.sampled_from((50, 2_000, 50_000)))
    line = draw(
        st.sampled_from(
            (b"a = " + b"[" * depth + b"]" * depth, b"a = " + b"{a=" * depth + b"1" + b"}" * depth)
        )
    )
    return draw(
        st.sampled_from((line + b"\n" + data, b".".join([b"a"] * depth) + b" = 1\n" + data))
    )


TOML: tuple[Mutation, ...] = (*(toml_value,) * 8, *(toml_key,) * 3, toml_nested, anything, *TEXT)

# --------------------------------------------------------------------------------------------- XML


def attribute(draw: Draw, data: bytes) -> bytes:
    """Another value of an attribute: a number, a text, or that of another attribute."""
    found = list(re.finditer(rb'="([^"]*)"', data))
    if not found:
        return insert(draw, data)
    match, other = (found[_index(draw, len(found))] for _ in range(2))
    bad = (*NUMBERS, *(t for t in TEXTS if t.isprintable() and "<" not in t), "nan nan nan", "1 2")
    new = draw(st.one_of(st.just(other.group(1)), st.sampled_from([b.encode() for b in bad])))
    return data[: match.start(1)] + new + data[match.end(1) :]


_PLUGINS = (
    "sphere", "rectangle", "cube", "ply", "obj", "diffuse", "principled", "roughplastic",
    "conductor", "dielectric", "twosided", "mask", "bumpmap", "normalmap", "blendbsdf", "bitmap",
    "checkerboard", "area", "point", "constant", "envmap", "spot", "directional", "perspective",
    "thinlens", "hdrfilm", "path", "independent", "shapegroup", "instance", "cylinder", "disk",
    "homogeneous", "box", "uniform", "null", "../evil", "./x", "a b", "no-such-plugin",
)  # fmt: skip
_TAGS = (
    "shape", "bsdf", "emitter", "texture", "sensor", "film", "float", "integer", "string", "rgb",
    "transform", "point", "vector", "boolean", "ref", "include", "default", "spectrum", "medium",
    "integrator", "sampler", "rfilter", "scene", "path", "alias", "translate", "lookat", "matrix",
)  # fmt: skip


def plugin(draw: Draw, data: bytes) -> bytes:
    """Another plugin."""
    found = list(re.finditer(rb'type="([^"]*)"', data))
    if not found:
        return insert(draw, data)
    match = found[_index(draw, len(found))]
    new = draw(st.sampled_from(_PLUGINS)).encode()
    return data[: match.start(1)] + new + data[match.end(1) :]


def tag(draw: Draw, data: bytes) -> bytes:
    """Another tag, in one place of two."""
    found = list(re.finditer(rb"<(/?)(\w+)", data))
    if not found:
        return insert(draw, data)
    match = found[_index(draw, len(found))]
    new = draw(st.sampled_from(_TAGS)).encode()
    return data[: match.start(2)] + new + data[match.end(2) :]


def element(draw: Draw, data: bytes) -> bytes:
    """Leave out, repeat or move an element, or put it around itself."""
    found = list(re.finditer(rb"<(\w+)[^<>]*/>|<(\w+)[^<>]*>.*?</\2>", data, re.DOTALL))
    if not found:
        return insert(draw, data)
    match, other = (found[_index(draw, len(found))] for _ in range(2))
    text, place = match.group(), _index(draw, 4)
    if place == 0:
        return data[: match.start()] + data[match.end() :]
    if place == 1:
        return data[: match.start()] + text * draw(st.integers(2, 4)) + data[match.end() :]
    if place == 2:
        return data[: other.start()] + text + data[other.end() :]
    opening = other.group().split(b">", 1)[0].rstrip(b"/") + b">"
    return data[: other.start()] + opening + text + data[other.start() :]


def extra(draw: Draw, data: bytes) -> bytes:
    """A property that nothing asks for, or an element of its own, in any element."""
    found = list(re.finditer(rb"<\w+[^<>]*(?<!/)>", data))
    if not found:
        return insert(draw, data)
    at = found[_index(draw, len(found))].end()
    name, value = draw(st.sampled_from(_PLUGINS)), draw(st.sampled_from(NUMBERS))
    new = draw(
        st.sampled_from(
            (
                f'<float name="{name}" value="{value}"/>',
                f'<string name="filename" value="{name}"/>',
                f'<include filename="{name}"/>',
                '<include filename="scene.xml"/>',
                f'<ref id="{name}"/>',
                f'<bsdf type="{name}"/>',
                f'<shape type="{name}"/>',
                f'<rgb name="radiance" value="{value}"/>',
                f'<texture type="{name}" name="base_color"/>',
                f'<transform name="to_world"><scale value="{value}"/></transform>',
            )
        )
    )
    return data[:at] + new.encode() + data[at:]


def xml_nested(draw: Draw, data: bytes) -> bytes:
    """Nest materials deeply."""
    depth = draw(st.sampled_from((3, 12, 30, 200, 20_000)))
    opening = draw(st.sampled_from((b'<bsdf type="twosided">', b'<bsdf type="mask">', b"<a>")))
    closing = b"</a>" if opening == b"<a>" else b"</bsdf>"
    inner = b'<bsdf type="diffuse"/>'
    return data.replace(b"</shape>", opening * depth + inner + closing * depth + b"</shape>", 1)


XML: tuple[Mutation, ...] = (
    *(attribute,) * 6, *(plugin,) * 3, *(extra,) * 3, *(element,) * 2, tag, xml_nested, *TEXT,
)  # fmt: skip

# ------------------------------------------------------------------------------------ binary files

IMAGE: tuple[Mutation, ...] = (*(early(m) for m in (*BYTES, *BYTES, number)), *BYTES, anything)
MESH: tuple[Mutation, ...] = (
    *(early(m, 320) for m in (number, number, word, lines, *BYTES)), *BYTES, anything,
)  # fmt: skip


def safetensors_header(draw: Draw, data: bytes) -> bytes:
    """Change a value of the header of a safetensors file, whose length is then right."""
    size = int.from_bytes(data[:8], "little")
    try:
        header = json.loads(data[8 : 8 + size])
    except (ValueError, RecursionError):
        return insert(draw, data)
    changed = _dumped(in_json(draw, header))
    return len(changed).to_bytes(8, "little") + changed + data[8 + size :]


SAFETENSORS: tuple[Mutation, ...] = (*(safetensors_header,) * 6, *IMAGE, *BYTES, *BYTES)
