"""Mesh and image files are checked before Mitsuba reads them."""

import struct
import time
import zlib

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import DIFFUSE, ROOM

from unbake.errors import UserError
from unbake.imaging.pictures import write_exr
from unbake.scene import parse as scenes
from unbake.scene.images import check_image
from unbake.scene.meshes import check_mesh

SQUARE = ["0 0 0", "1 0 0", "0 1 0", "1 1 0"]
FACES = ["3 0 1 2", "3 1 3 2"]


def ply(vertices=SQUARE, faces=FACES, index="int", **counts):
    counts = {"vertex": len(vertices), "face": len(faces)} | counts
    return "\n".join(
        [
            "ply",
            "format ascii 1.0",
            f"element vertex {counts['vertex']}",
            *(f"property float {axis}" for axis in "xyz"),
            f"element face {counts['face']}",
            f"property list uchar {index} vertex_indices",
            "end_header",
            *vertices,
            *faces,
            "",
        ]
    )


def binary_ply(order="<", index="int32", corners=((0, 1, 2), (1, 3, 2)), **counts):
    """The same square in binary; `counts` are those that the header tells."""
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    head = ply(index=index, **counts).split("end_header")[0].replace("ascii", name)
    positions = np.array([row.split() for row in SQUARE], f"{order}f4").tobytes()
    kind = {"int32": "i", "uint32": "I", "int16": "h"}[index]
    rows = b"".join(struct.pack(f"{order}B3{kind}", 3, *row) for row in corners)
    return (head + "end_header\n").encode() + positions + rows


def serialized(corners=(0, 1, 2, 1, 3, 2), vertices=4, faces=2, name=b"square\0", start=b""):
    positions = np.array([row.split() for row in SQUARE], "<f4").tobytes()
    content = struct.pack("<I", 0x1000) + name + struct.pack("<2Q", vertices, faces)
    packed = zlib.compress(content + positions + struct.pack(f"<{len(corners)}I", *corners))
    return struct.pack("<2H", 0x041C, 4) + packed + start


GOOD = {
    "text.ply": ply(),
    "little.ply": binary_ply(),
    "big.ply": binary_ply(">", "uint32"),
    "short.ply": binary_ply(index="int16"),
    "notes.ply": ply().replace("element vertex", "comment café\nelement vertex"),
    "windows.ply": ply().replace("\n", "\r\n"),
    "square.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "square.serialized": serialized(),
}
BAD = {
    "range.ply": (ply(faces=["3 0 1 2", "3 1 2 4000000"]), "1 of 2 triangles are of vertices that"),
    "negative.ply": (ply(faces=["3 0 1 -1"]), "1 of 1 triangles are of vertices that do not exist"),
    "far.ply": (binary_ply(corners=((0, 1, 2), (1, 3, 9))), "1 of 2 triangles are of vertices"),
    "nan.ply": (ply(["nan 0 0", *SQUARE[1:]]), "1 of 4 vertices are not finite"),
    "huge.ply": (ply(["1e30 0 0", *SQUARE[1:]]), "1 of 4 vertices are not finite, or beyond 1e+18"),
    "quads.ply": (ply(faces=["4 0 1 3 2"], face=1), "faces that are no triangles"),
    "empty.ply": (ply(faces=[]), "the mesh is empty: it has no face"),
    "nothing.ply": (ply([], []), "the mesh is empty: it has no vertex"),
    "count.ply": (ply(face=2_000_000_000), "its header counts 8000000012 numbers"),
    "counts.ply": (binary_ply(vertex=10**12), "its header counts 12000000"),
    "cut.ply": (binary_ply()[:-1], "the mesh is cut off: its header counts"),
    "less.ply": (ply(faces=["3 0 1 2", "3 1"], face=2), "has 18 numbers, its header counts 20"),
    "minus.ply": (ply(face=-1), "not a PLY file that Mitsuba reads: 'element face -1'"),
    "words.ply": (ply(["a b c", *SQUARE[1:]]), "the mesh "),
    "flat.ply": (ply().replace("property float z\n", ""), "no vertex with positions"),
    "points.ply": (ply().split("element face")[0] + "end_header\n", "no face with indices"),
    "half.ply": (ply()[:40], "its header is not readable"),
    "bytes.ply": (bytes(range(256)), "its header is not readable"),
    "unknown.ply": (ply().replace("float x", "colour x"), "reads: 'property colour x'"),
    "void.ply": (b"", "its header is not readable"),
    "void.obj": (b"", "the mesh cannot be read"),
    "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "the mesh is empty: it has no face"),
    "range.serialized": (serialized((0, 1, 2, 1, 3, 99)), "1 of 2 triangles are of vertices"),
    "bomb.serialized": (serialized(vertices=10**15), "counts more than the file can hold"),
    "cut.serialized": (serialized(corners=(0, 1, 2)), "the mesh is cut off"),
    "bytes.serialized": (b"\x1c\x04\x04\x00 no zlib", "the mesh is damaged"),
    "other.serialized": (b"PK", "not a serialized mesh that Mitsuba reads"),
    "name.serialized": (serialized(name=b"\xff\0"), "the name of the mesh is not UTF-8"),
    "empty.serialized": (serialized((), faces=0), "the mesh is empty"),
}


@pytest.fixture
def parse_mesh(tmp_path):
    """Parse a scene of one mesh file."""

    def run(name, content, more=""):
        path = tmp_path / name
        if isinstance(content, bytes):
            path.write_bytes(content)
        else:
            path.write_text(content, encoding="latin-1", newline="")
        shape = f'<string name="filename" value="{name}"/>{more}{DIFFUSE}'
        scene = ROOM.format(f'<shape type="{path.suffix[1:]}">{shape}</shape>')
        (tmp_path / "scene.xml").write_text(scene)
        return scenes.parse(tmp_path / "scene.xml")

    return run


@pytest.mark.parametrize("name", GOOD)
def test_meshes_are_read(name, parse_mesh):
    (shape,) = parse_mesh(name, GOOD[name]).instantiate().shapes()
    assert shape.face_count() == (1 if name.endswith("obj") else 2)


@pytest.mark.parametrize("name", BAD)
def test_damaged_meshes_are_refused(name, parse_mesh):
    content, message = BAD[name]
    with pytest.raises(UserError) as caught:
        parse_mesh(name, content)
    told = str(caught.value)
    assert name in told and message in told and "\n" not in told


@pytest.mark.parametrize(
    ("number", "message"),
    [(0, None), (1, None), (2, "has no mesh number 2"), (-1, "has no mesh number -1")],
)
def test_the_meshes_of_a_file_are_checked_each(number, message, parse_mesh):
    first, second = serialized(), serialized((0, 1, 3, 1, 3, 2))
    content = first + second + struct.pack("<2QI", 0, len(first), 2)
    chosen = f'<integer name="shape_index" value="{number}"/>'
    if message is None:
        assert parse_mesh("two.serialized", content, chosen).instantiate().shapes()
        return
    with pytest.raises(UserError, match=message):
        parse_mesh("two.serialized", content, chosen)


def test_a_million_triangles_are_checked_in_no_time(tmp_path):
    triangles = 1_000_000
    faces = np.zeros(triangles, [("n", "u1"), ("i", "<i4", 3)])
    faces["n"], faces["i"] = 3, np.arange(3 * triangles).reshape(-1, 3)
    head = binary_ply(vertex=3 * triangles, face=triangles).split(b"end_header\n")[0]
    points = np.random.default_rng(0).random((3 * triangles, 3)).astype("<f4")
    (tmp_path / "mesh.ply").write_bytes(head + b"end_header\n" + points.tobytes() + faces.tobytes())
    started = time.process_time()
    check_mesh("ply", tmp_path / "mesh.ply")
    assert time.process_time() - started < 2


def test_a_mesh_that_cannot_be_opened_is_not_called_damaged(tmp_path, monkeypatch):
    def refuse(*words, **named):
        raise OSError(24, "Too many open files")

    file = tmp_path / "mesh.ply"
    file.write_text(ply())
    monkeypatch.setattr("pathlib.Path.open", refuse)
    with pytest.raises(UserError) as caught:
        check_mesh("ply", file)
    assert str(caught.value) == f"{file}: the mesh cannot be read (Too many open files)"


# ------------------------------------------------------------------------------------------ images


def png(width, height):
    return b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">2I", width, height) + bytes(100)


def exr(width, height):
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    return b"\x76\x2f\x31\x01\2\0\0\0dataWindow\0box2i\0\x10\0\0\0" + window + bytes(100)


def jpeg(width, height):
    frame = b"\xff\xc0\0\x11\x08" + struct.pack(">2H", height, width)
    return b"\xff\xd8\xff\xe0\0\x10" + bytes(14) + frame + bytes(20)


HUGE = {
    "png": png(100_000, 100_000),
    "exr": exr(100_000, 100_000),
    "jpg": jpeg(60_000, 60_000),
    "hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 100000 +X 100000\n" + bytes(100),
    "pfm": b"PF\n100000 100000\n-1.0\n" + bytes(100),
    "ppm": b"P6\n# a note\n100000 100000\n255\n" + bytes(100),
    "bmp": b"BM" + bytes(16) + struct.pack("<2i", 100_000, -100_000) + bytes(100),
}


@pytest.mark.parametrize("suffix", HUGE)
def test_an_image_of_impossible_size_is_not_decoded(suffix, tmp_path):
    (tmp_path / f"paint.{suffix}").write_bytes(HUGE[suffix])
    texture = (
        '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
        f'<string name="filename" value="paint.{suffix}"/></texture></bsdf>'
    )
    (tmp_path / "scene.xml").write_text(ROOM.format(f'<shape type="sphere">{texture}</shape>'))
    with pytest.raises(UserError, match=r"the image of \d+ x \d+ pixels is damaged: it has \d+ b"):
        scenes.parse(tmp_path / "scene.xml")


def test_an_image_must_fit_into_memory(tmp_path, monkeypatch):
    write_exr(tmp_path / "paint.exr", np.zeros((64, 64, 3)))
    check_image(tmp_path / "paint.exr")
    monkeypatch.setattr("unbake.memory.free_bytes", lambda: 1 << 16)
    with pytest.raises(UserError, match="the image of 64 x 64 pixels needs about 0 MB of memory"):
        check_image(tmp_path / "paint.exr")


@pytest.mark.parametrize("suffix", ["png", "jpg", "exr", "hdr", "pfm", "ppm"])
def test_images_that_mitsuba_writes_pass(suffix, tmp_path):
    """Also black ones, which are packed best."""
    kind = np.float32 if suffix in ("exr", "hdr", "pfm") else np.uint8
    file = tmp_path / f"paint.{suffix}"
    mi.Bitmap(np.zeros((512, 1024, 3), kind)).write(str(file))
    check_image(file)


def test_what_is_no_known_image_is_left_to_mitsuba(tmp_path):
    for head in (b"", b"\xff\xd8\xff", b"\x76\x2f\x31\x01", b"BM", b"#?RGBE\n", b"P6\n", b"RIFF"):
        (tmp_path / "paint").write_bytes(head)
        check_image(tmp_path / "paint")
