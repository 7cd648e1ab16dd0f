"""Meshes of other programs: every corner of every triangle keeps its place, normal and texture."""

import base64
import json
import struct
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from layouts import APPLIED, quiet, write_blender, write_nerfstudio

from unbake.acquisition.new_light import axis_of
from unbake.dataset.camera import up_of
from unbake.dataset.mistakes import UNITS, usual_mistakes
from unbake.errors import UserError
from unbake.exports.gltf import Document
from unbake.exports.upright import Up
from unbake.importing import gltf
from unbake.importing import meshes as meshes_module
from unbake.importing.faults import Faults, ImportFaults
from unbake.importing.import_data import import_data
from unbake.importing.meshes import TO_Z_UP, Part, check_place, read_parts, write_scene
from unbake.importing.settings import ImportSettings
from unbake.importing.world import read_matrix
from unbake.scene.edit import material_names
from unbake.scene.parse import parse

#: A cube: corners of its sides, counterclockwise from outside, and their normals.
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
NORMALS = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))
#: In an atlas of a column for each side.
CHART = ((0.01, 0.1), (0.15, 0.1), (0.15, 0.9), (0.01, 0.9))


def parts_of(*files):
    faults = Faults()
    parts = read_parts(files, faults)
    check_place(parts, faults)
    faults.require_none(files[0])
    return parts


def cubes(names, *, normals=True, textured=True, materials=False):
    """An OBJ file of cubes beside each other, as photogrammetry writes it.

    Corners share positions, and normals of their sides, and have texture coordinates of their own.
    """
    lines = []
    for number, name in enumerate(names):
        lines.append(f"o {name}")
        lines += [f"v {x + 3 * number} {y} {z}" for x, y, z in CORNERS]
        for side in range(len(SIDES) if textured else 0):
            lines += [f"vt {side / 6 + u} {v}" for u, v in CHART]
        lines += [f"vn {x} {y} {z}" for x, y, z in NORMALS] if normals else []
        for side, corners in enumerate(SIDES):
            if materials and side in (0, 3):
                lines.append(f"usemtl {'first' if side == 0 else 'second'}")
            words = []
            for corner, place in enumerate(corners):
                word = f"{8 * number + place + 1}"
                texture = f"{24 * number + 4 * side + corner + 1}" if textured else ""
                word += f"/{texture}" if textured or normals else ""
                words.append(word + (f"/{6 * number + side + 1}" if normals else ""))
            lines.append(f"f {' '.join(words)}")
    return "\n".join(lines) + "\n"


def same_as_written(part, left, *, normals, textured):
    """Check all corners of all triangles of a cube against what it was written of."""
    sides = set()
    for triangle in part.faces:
        places = part.positions[triangle] - (left, 0, 0)
        normal = np.cross(places[1] - places[0], places[2] - places[0])
        side = NORMALS.index(tuple(np.round(normal).astype(int)))
        sides.add(side)
        for corner, place in zip(triangle, places, strict=True):
            number = [tuple(CORNERS[k]) for k in SIDES[side]].index(tuple(place))
            if normals:
                assert np.allclose(part.normals[corner], NORMALS[side])
            if textured:
                wanted = np.add(CHART[number], (side / 6, 0))
                assert np.allclose(part.uv[corner], wanted)
    assert (part.normals is None) == (not normals) and (part.uv is None) == (not textured)
    return sides


@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("textured", [True, False])
def test_parts_of_obj_files_are_as_written(normals, textured, tmp_path):
    file = tmp_path / "two.obj"
    file.write_text(cubes(("left", "right"), normals=normals, textured=textured))
    parts = parts_of(file)
    assert [part.name for part in parts] == ["left", "right"]
    for left, part in zip((0, 3), parts, strict=True):
        found = same_as_written(part, left, normals=normals, textured=textured)
        assert len(part.faces) == 12 and found == set(range(6))
        assert len(part.positions) <= 24, "no part has the vertices of others"


#: Two triangles, one after the other, that count their corners backwards.
BACKWARDS = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\n", "v 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"


def test_numbers_that_count_backwards_are_refused_where_they_would_be_misread(tmp_path):
    file = tmp_path / "mesh.obj"
    file.write_text("".join(BACKWARDS))
    with pytest.raises(ImportFaults, match="count vertices backwards"):
        parts_of(file)
    file.write_text(BACKWARDS[0])
    (part,) = parts_of(file)
    assert part.positions[part.faces[0]].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_a_vertex_without_a_normal_takes_that_of_its_triangles(tmp_path):
    """And a vertex that no triangle has does not count."""
    mesh = trimesh.creation.box()
    normals = np.array(mesh.vertices) / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    normals[3] = 0
    lines = [f"v {x} {y} {z}" for x, y, z in [*mesh.vertices, (9, 9, 9)]]
    lines += [f"vn {x} {y} {z}" for x, y, z in [*normals, (0, 0, 0)]]
    lines += ["f " + " ".join(f"{i + 1}//{i + 1}" for i in face) for face in mesh.faces]
    file = tmp_path / "box.obj"
    file.write_text("\n".join(lines) + "\n")
    (part,) = parts_of(file)
    assert part.normals is not None and len(part.positions) == 8
    expected = part.positions / np.linalg.norm(part.positions, axis=1, keepdims=True)
    cosine = (part.normals * expected).sum(1)
    assert (np.sort(cosine)[1:] > 0.999).all() and cosine.min() > 0.5


def test_normals_of_ply_files_stay_where_corners_have_textures(tmp_path):
    """Quads, and texture coordinates of corners, are read by trimesh."""
    head = ["ply", "format ascii 1.0", "element vertex 4"]
    head += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    slope = "0.6 0 0.8"
    corners = [f"{x} {y} 0 {slope}" for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
    file = tmp_path / "quad.ply"
    file.write_text("\n".join([*head, *corners, "4 0 1 2 3"]) + "\n")
    (part,) = parts_of(file)
    assert len(part.faces) == 2 and np.allclose(part.normals, (0.6, 0, 0.8))
    head[-1:] = ["property list uchar float texcoord", "end_header"]
    head[-4] = "element face 2"
    faces = ["3 0 1 2 6 0 0 1 0 1 1", "3 0 2 3 6 0.5 0 0.7 1 0 1"]
    file.write_text("\n".join([*head, *corners, *faces]) + "\n")
    (part,) = parts_of(file)
    assert len(part.faces) == 2 and np.allclose(part.normals, (0.6, 0, 0.8)) and part.uv is None


def test_materials_of_obj_files_part_a_mesh(tmp_path):
    file = tmp_path / "one.obj"
    file.write_text(cubes(("cube",), materials=True))
    found = [same_as_written(part, 0, normals=True, textured=True) for part in parts_of(file)]
    assert sorted(side for sides in found for side in sides) == list(range(6))


def test_names_of_parts_are_none_that_the_scene_has(tmp_path):
    names = ("wall", "wall_sides", "Wall", "environment", "wall_shape")
    (tmp_path / "a.obj").write_text(cubes(names))
    parts = parts_of(tmp_path / "a.obj")
    scene = parse(write_scene(parts, tmp_path / "scene", environment=True))
    assert len(material_names(scene)) == 5
    files = [file.name.lower() for file in (tmp_path / "scene" / "meshes").iterdir()]
    assert len(set(files)) == 5
    assert sum(shape.face_count() for shape in scene.instantiate().shapes()) == 5 * 12


def test_a_mesh_far_from_the_origin_is_a_fault(tmp_path):
    file = tmp_path / "a.ply"
    sphere = trimesh.creation.icosphere(2)
    sphere.apply_translation([450_000, 5_400_000, 100])
    sphere.export(tmp_path / "a.obj")
    with pytest.raises(
        ImportFaults, match=r"5.4e\+06 units from the origin.*to the origin together"
    ):
        parts_of(tmp_path / "a.obj")
    sphere = trimesh.creation.icosphere(2)
    sphere.apply_translation([100, 0, 0])
    sphere.export(file)
    assert len(parts_of(file)) == 1


def test_a_part_far_from_the_others_is_a_fault(tmp_path):
    """All parts together are then as wide as they are far from the origin."""
    near, far = trimesh.creation.icosphere(2), trimesh.creation.icosphere(2)
    far.apply_translation([450_000, 5_400_000, 100])
    near.export(tmp_path / "near.obj")
    far.export(tmp_path / "far.obj")
    with pytest.raises(
        ImportFaults, match=r"5.4e\+06 units from the origin.* units: far. Remove these parts"
    ):
        parts_of(tmp_path / "near.obj", tmp_path / "far.obj")
    far.apply_translation([-450_000, -5_399_000, 0])
    far.export(tmp_path / "far.obj")
    assert len(parts_of(tmp_path / "near.obj", tmp_path / "far.obj")) == 2


#: Where UTM coordinates are.
UTM = (450_000, 5_400_000, 100)


def place_after(move, *files):
    """Faults of the place of a mesh after a move, as import finds them."""
    faults = Faults()
    check_place([part.moved(move) for part in read_parts(files, faults)], faults)
    return faults


def test_a_mesh_in_double_precision_may_be_moved_to_the_origin_and_not_away(tmp_path):
    sphere, move = trimesh.creation.icosphere(2), trimesh.transformations.translation_matrix(UTM)
    sphere.export(tmp_path / "near.obj")
    with pytest.raises(ImportFaults, match=r"2 units wide.*5.4e\+06 units from the origin"):
        place_after(move, tmp_path / "near.obj").require_none(tmp_path)
    sphere.apply_transform(move)
    sphere.export(tmp_path / "far.obj")
    assert place_after(np.eye(4), tmp_path / "far.obj")
    assert not place_after(np.linalg.inv(move), tmp_path / "far.obj")


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_a_mesh_that_has_lost_its_shape_in_the_file_cannot_be_moved_back(suffix, tmp_path):
    """Told in units of after the move, which may be other ones."""
    move = np.linalg.inv(trimesh.transformations.translation_matrix(UTM))
    move[:3] *= 10
    sphere = trimesh.creation.icosphere(2)
    sphere.apply_translation(UTM)
    file = tmp_path / f"far{suffix}"
    sphere.export(file)
    with pytest.raises(ImportFaults, match=r"2\d units wide.*read in steps of 5 units.*as OBJ"):
        place_after(move, file).require_none(tmp_path)


def test_polygons_of_a_ply_file_cannot_be_moved_back_either(tmp_path):
    """Another reader has them."""
    head = ["ply", "format ascii 1.0", f"element vertex {len(LETTER)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    rows = [f"{x + UTM[0]} {y + UTM[1]} 0" for x, y in LETTER]
    face = f"{len(LETTER)} {' '.join(map(str, range(len(LETTER))))}"
    (tmp_path / "a.ply").write_text("\n".join([*head, *rows, face]) + "\n")
    move = np.linalg.inv(trimesh.transformations.translation_matrix(UTM))
    with pytest.raises(ImportFaults, match=r"2 units wide.*read in steps of 0.5 units"):
        place_after(move, tmp_path / "a.ply").require_none(tmp_path)


def test_a_node_may_take_its_mesh_far_from_the_origin_where_it_is_moved_back(tmp_path):
    """As tiles of the globe have it: positions in the file are near its own origin."""
    move = trimesh.transformations.translation_matrix(UTM)
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.icosphere(2), transform=move)
    scene.export(tmp_path / "tile.glb")
    assert place_after(np.eye(4), tmp_path / "tile.glb")
    assert not place_after(np.linalg.inv(move), tmp_path / "tile.glb")


def test_positions_beyond_single_precision_are_a_fault(tmp_path):
    trimesh.creation.box().export(tmp_path / "a.obj")
    with pytest.raises(ImportFaults, match="too large for single precision"):
        place_after(np.diag([1e60, 1e60, 1e60, 1]), tmp_path / "a.obj").require_none(tmp_path)


def test_a_node_that_flattens_its_mesh_is_a_fault(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), node_name="flat", transform=np.diag([1.0, 0, 1, 1]))
    scene.export(tmp_path / "a.glb")
    with pytest.raises(UserError, match="the transform of 'flat' flattens it"):
        parts_of(tmp_path / "a.glb")


@pytest.mark.parametrize(
    ("extension", "told"),
    [("KHR_draco_mesh_compression", "Draco"), ("EXT_meshopt_compression", "meshopt"),
     ("KHR_mesh_quantization", "quantized")],
)  # fmt: skip
@pytest.mark.parametrize("suffix", [".glb", ".gltf"])
def test_packed_gltf_files_are_faults(extension, told, suffix, tmp_path):
    content = json.dumps({"asset": {"version": "2.0"}, "extensionsRequired": [extension]}).encode()
    content += b" " * (-len(content) % 4)
    file = tmp_path / f"packed{suffix}"
    head = b"glTF" + struct.pack("<III4s", 2, 20 + len(content), len(content), b"JSON")
    file.write_bytes(head + content if suffix == ".glb" else content)
    faults = Faults()
    read_parts([file], faults)
    with pytest.raises(ImportFaults, match=rf"compressed \({told}\).*without compression"):
        faults.require_none(file)


def test_a_gltf_file_that_is_none_is_a_fault(tmp_path):
    for name, content in (
        ("deep.gltf", b"[" * 100_000),
        ("none.glb", b"glTF"),
        ("list.gltf", b"[]"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ImportFaults, match="cannot be read"):
            parts_of(tmp_path / name)


def test_a_mesh_at_one_point_is_a_fault(tmp_path):
    mesh = trimesh.creation.box()
    mesh.vertices[:] = 2.0
    mesh.export(tmp_path / "point.glb")
    with pytest.raises(ImportFaults, match="all vertices of the mesh lie at one point"):
        parts_of(tmp_path / "point.glb")


def test_meshes_with_y_up_are_turned(captured, tmp_path):
    """Blender's glTF export turns z up into y up: (x, y, z) into (x, z, -y)."""
    write_blender(captured, tmp_path / "blender")
    box = trimesh.creation.box((1, 2, 3))
    box.apply_translation((0.1, 0.2, 0.3))
    turned = box.copy()
    turned.apply_transform(np.linalg.inv(TO_Z_UP))
    turned.export(tmp_path / "turned.glb")
    settings = ImportSettings(mesh_y_up=True)
    source, out = tmp_path / "blender", tmp_path / "data"
    import_data(source, out, [tmp_path / "turned.glb"], settings, tell=quiet)
    (part,) = parts_of(*(out / "scene" / "meshes").iterdir())
    # Vertices of the box have three normals each.
    places = np.unique(np.round(part.positions, 5), axis=0)
    assert np.allclose(places, sorted(box.vertices.tolist()), atol=1e-5)
    corners = part.positions[part.faces]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ni,ni->n", outwards, corners.mean(1) - (0.1, 0.2, 0.3)) > 0).all()
    assert len(part.positions) == 24
    assert np.allclose(np.abs(part.normals).max(1), 1, atol=1e-5), "edges are sharp"


@pytest.mark.parametrize("mistake", usual_mistakes((1.0, *UNITS)), ids=lambda m: m.told[:60])
def test_what_is_told_of_the_mesh_cures_as_much_as_other_poses(mistake, captured):
    """A mesh that is moved is seen from given cameras as it was from corrected ones, but for s."""
    told = mistake.told
    options = told.partition("; or the mesh: import ")[2]
    camera = captured.views[0].camera
    corrected = mistake.corrected(camera)
    if not np.array_equal(mistake.flip, np.eye(3)):
        corrected = replace(corrected, to_world=corrected.to_world @ with_corner(mistake.flip))
    if mistake.scale == 1 and np.array_equal(mistake.turn, np.eye(3)):
        assert not options
        return
    assert options.endswith(")") and told.count("import") == 1
    plain, _, otherwise = options.removesuffix(")").partition("; if it ")
    points = np.random.default_rng(0).normal(size=(20, 3))
    to_z_up = TO_Z_UP[:3, :3]
    # As the mesh was imported, and is to be: each with --mesh-y-up, or without.
    before, after = {
        "without --mesh-y-up": (to_z_up, np.eye(3)),
        "--mesh-y-up": (np.eye(3), to_z_up),
    }.get(plain.partition("--mesh-scale ")[2].partition(" ")[2] or plain, (np.eye(3),) * 2)
    scale = float(plain.partition("--mesh-scale ")[2].partition(" ")[0] or 1)
    ways = [after @ before.T]
    if otherwise:
        ways.append(read_matrix(otherwise.partition("--mesh-matrix ")[2].split())[:3, :3])
        was = "was without, add" if "without" in plain else "had that already, keep it and add"
        assert otherwise.startswith(f"{was} --mesh-matrix ")
    for way in ways:
        moved = scale * points @ way.T
        here, there = (
            (at - c.origin) @ c.to_world[:3, :3] for at, c in ((moved, camera), (points, corrected))
        )
        assert np.allclose(mistake.scale * here, there, rtol=1e-4, atol=1e-4 * mistake.scale)


def exported(points, file, direction, generator=None, metres=1.0):
    """Write triangles as an export does, of a scene with this direction up.

    Args:
        metres: of a unit of the scene.
        generator: that the file tells; None: its own.
    """
    document = Document()
    corners = document.array(points.astype(np.float32), "VEC3", bounds=True)
    mesh = document.add("meshes", {"primitives": [{"attributes": {"POSITION": corners}}]})
    node = document.add("nodes", {"name": "thing", "mesh": mesh})
    document.json["scenes"][0]["nodes"].append(node)
    document.turn(Up(np.array(direction, float), "", 0.0), metres)
    if generator is not None:
        document.json["asset"]["generator"] = generator
    document.write(file)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (0, -1, 0), (1, 0, 0), (0.6, 0, 0.8)])
def test_what_was_exported_upright_is_turned_back(up, tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3))
    exported(points, tmp_path / "own.glb", up)
    (part,) = parts_of(tmp_path / "own.glb")
    assert np.abs(part.positions - points).max() < 1e-6
    (upright,) = read_parts([tmp_path / "own.glb"], Faults(), upright=True)
    assert np.abs(upright.positions - points).max() > 0.1
    assert np.abs(upright.positions @ (0, 1, 0) - points @ up).max() < 1e-6
    exported(points, tmp_path / "other.glb", up, "another program")
    (other,) = parts_of(tmp_path / "other.glb")
    assert np.abs(other.positions - upright.positions).max() < 1e-6


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0)])
def test_what_was_exported_in_metres_has_its_units_again(up, tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3))
    exported(points, tmp_path / "own.glb", up, metres=0.001)
    (part,) = parts_of(tmp_path / "own.glb")
    np.testing.assert_allclose(part.positions, points, rtol=1e-4, atol=1e-6)
    (small,) = read_parts([tmp_path / "own.glb"], Faults(), upright=True)
    assert np.ptp(small.positions) == pytest.approx(0.001 * np.ptp(points), rel=1e-4)


def test_what_an_export_did_not_turn_stays(tmp_path):
    points = np.random.default_rng(0).normal(size=(9, 3))
    exported(points, tmp_path / "own.glb", (0, 1, 0))
    (part,) = parts_of(tmp_path / "own.glb")
    assert np.abs(part.positions - points).max() < 1e-6


def test_an_import_turns_back_what_was_exported(captured, tmp_path):
    write_blender(captured, tmp_path / "blender")
    points = trimesh.creation.box((1, 2, 3)).triangles.reshape(-1, 3)
    lines, found = {}, {}
    for name, generator in (("own", None), ("other", "another program")):
        exported(points, tmp_path / f"{name}.glb", (0, 0, 1), generator)
        lines[name], out = [], tmp_path / name
        given = [tmp_path / f"{name}.glb"]
        import_data(tmp_path / "blender", out, given, tell=lines[name].append)
        (part,) = parts_of(*(out / "scene" / "meshes").iterdir())
        found[name] = np.ptp(part.positions, axis=0)
    assert np.allclose(found["own"], (1, 2, 3)) and np.allclose(found["other"], (1, 3, 2))
    assert sum("of an export of unbake" in line for line in lines["own"]) == 1
    assert sum("with --mesh-y-up" in line for line in lines["other"]) == 1
    assert not any("--mesh-y-up" in line for line in lines["own"])


@pytest.mark.parametrize("rotation", [None, [0, 0, 0, 0], [0, 1], ["x", 0, 0, 1]])
def test_a_damaged_turn_is_not_taken_back(rotation, tmp_path):
    top = {"asset": {"generator": "unbake 1"}, "nodes": [{"name": "upright"}]}
    top |= {"scenes": [{"nodes": [0]}]}
    if rotation is not None:
        top["nodes"][0]["rotation"] = rotation
    (tmp_path / "own.gltf").write_text(json.dumps(top))
    assert gltf.turned_back(tmp_path / "own.gltf") is None


def test_ways_up_that_may_differ_are_told(captured, tmp_path):
    """Where cameras have z up, and the user did not say how a GLB file lies."""
    tall = [view.camera for view in captured.views]
    level = [replace(camera, to_world=TO_Z_UP.T @ camera.to_world) for camera in tall]
    assert axis_of(up_of(level)) == "+y" and axis_of(up_of(tall)) == "+z"
    points = np.random.default_rng(0).normal(size=(9, 3))
    own, plain, other = (tmp_path / name for name in ("own.glb", "plain.glb", "other.glb"))
    exported(points, own, (0, 0, 1))
    exported(points, plain, (0, 1, 0))
    exported(points, other, (0, 1, 0), "another program")

    def told(file, cameras=tall, *, upright=False, moved=False):
        return gltf.told_up([file], cameras, upright=upright, moved=moved)

    back = "mesh: of an export of unbake, taken back to the axes and units there"
    assert told(own) == [f"{back}: {own}"]
    assert told(own, upright=True) == told(plain) == told(tmp_path / "mesh.ply") == []
    (line,) = told(other)
    assert line.startswith("GLB files have y up") and line.endswith("with --mesh-y-up")
    assert told(other, level) == told(other, upright=True) == told(other, moved=True) == []


def with_corner(matrix):
    """A (3, 3) matrix as (4, 4)."""
    full = np.eye(4)
    full[:3, :3] = matrix
    return full


def test_meshes_of_ns_export_are_taken_back(captured, tmp_path):
    """Nerfstudio trains where `scale * transform` takes the cameras of COLMAP."""
    write_nerfstudio(captured, tmp_path / "nerf")
    angle, scale = 0.7, 0.25
    transform = np.eye(4)
    transform[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    transform[:3, 3] = (0.5, -1.0, 2.0)
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": transform[:3].tolist(), "scale": scale}))
    box = trimesh.creation.icosphere(1)
    trained = box.copy()
    trained.apply_transform(np.diag([scale, scale, scale, 1]) @ transform)
    trained.export(tmp_path / "trained.ply", vertex_normal=True)
    given = [tmp_path / "trained.ply"]
    more = {"mesh_transform": file, "tell": quiet}
    import_data(tmp_path / "nerf", tmp_path / "data", given, **more)
    (part,) = parts_of(*(tmp_path / "data" / "scene" / "meshes").iterdir())
    assert np.allclose(part.positions, box.vertices, atol=1e-5)
    assert np.allclose(part.normals, box.vertex_normals, atol=1e-5)
    both = ImportSettings(keep_applied_transform=True)
    import_data(tmp_path / "nerf", tmp_path / "kept", given, both, **more)
    (part,) = parts_of(*(tmp_path / "kept" / "scene" / "meshes").iterdir())
    moved = box.copy()
    moved.apply_transform(APPLIED)
    assert np.allclose(part.positions, moved.vertices, atol=1e-5), "where cameras stay"
    for wrong, told in (({"scale": 0.0}, "'scale' is not positive"), ({"transform": 1}, "3 x 4")):
        file.write_text(json.dumps({"transform": transform[:3].tolist(), "scale": 1} | wrong))
        with pytest.raises(ImportFaults, match=told):
            import_data(tmp_path / "nerf", tmp_path / "none", given, **more)


def test_parts_of_a_gltf_node_are_called_by_its_materials(tmp_path):
    """Names become those of textures, and have to be the same at each import."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    indices = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    data = corners.tobytes() + indices.tobytes()
    buffer = base64.b64encode(data).decode()
    parts = [{"attributes": {"POSITION": 0}, "indices": 1 + i, "material": i} for i in (0, 1)]
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "Mug", "mesh": 0}],
        "meshes": [{"name": "shape", "primitives": parts}],
        "materials": [{"name": "white"}, {"name": "inside"}],
        "buffers": [
            {"uri": f"data:application/octet-stream;base64,{buffer}", "byteLength": len(data)}
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 12},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
            {"bufferView": 1, "byteOffset": 6, "componentType": 5123, "count": 3,
             "type": "SCALAR"},
        ],
    }  # fmt: skip
    content["accessors"][0] |= {"min": [0, 0, 0], "max": [1, 1, 0]}
    (tmp_path / "mug.gltf").write_text(json.dumps(content))
    for _ in range(2):
        found = parts_of(tmp_path / "mug.gltf")
        assert [part.name for part in found] == ["Mug_inside", "Mug_white"]
    assert found[0].positions.tolist() == corners[[0, 2, 3]].tolist()


@pytest.mark.parametrize("suffix", ["obj", "glb", "ply"])
def test_texture_coordinates_are_those_that_mitsuba_reads_of_an_obj_file(suffix, tmp_path):
    """Textures of an export are shown on the user's own mesh, so that they may not be mirrored."""
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 0, 3], [0, 0, 3]], float)
    uv = np.array([[0.1, 0.2], [0.7, 0.2], [0.7, 0.9], [0.1, 0.9]])
    lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"vt {u} {v}" for u, v in uv]
    (tmp_path / "wall.obj").write_text("\n".join([*lines, "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]))
    file = tmp_path / f"wall.{suffix}"
    if suffix != "obj":
        visual = trimesh.visual.TextureVisuals(uv=uv)
        mesh = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)], visual=visual, process=False)
        mesh.export(file)
    scene = write_scene(parts_of(file), tmp_path / "scene", environment=True)
    (written,) = (scene.parent / "meshes").glob("*.ply")

    def by_corner(kind, path):
        params = mi.traverse(mi.load_dict({"type": kind, "filename": str(path)}))
        places = np.array(params["vertex_positions"]).reshape(-1, 3)
        found = np.array(params["vertex_texcoords"]).reshape(-1, 2)
        return {tuple(np.round(p).astype(int)): u for p, u in zip(places, found, strict=True)}

    theirs, ours = by_corner("obj", tmp_path / "wall.obj"), by_corner("ply", written)
    # glTF has the same frame here: nothing is turned unless that is asked for.
    if suffix == "glb":
        ours = {
            (x, -z, y) if (x, -z, y) in theirs else (x, y, z): u for (x, y, z), u in ours.items()
        }
    assert ours.keys() == theirs.keys()
    for corner, found in ours.items():
        np.testing.assert_allclose(found, theirs[corner], atol=1e-6)


def test_texture_coordinates_follow_vertices_that_get_several_normals(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    uv = np.random.default_rng(0).random((8, 2))
    part = Part("box", np.array(box.vertices), np.array(box.faces), None, uv)
    part.write(tmp_path / "box.ply")
    (found,) = parts_of(tmp_path / "box.ply")
    assert len(found.positions) == 24
    corners = found.faces.ravel()
    places = np.abs(found.positions[corners, None] - box.vertices).sum(2).argmin(1)
    np.testing.assert_array_equal(places, box.faces.ravel())
    # To Mitsuba, v = 0 is the first row of an image.
    np.testing.assert_allclose(found.uv[corners] * (1, -1) + (0, 1), uv[places], atol=1e-6)


#: An L, whose area is 3, and a wall of 4 x 3 with a window of 2 x 1, to which its edge goes.
LETTER = ((0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2))
WALL = ((0, 0), (4, 0), (4, 3), (0, 3), (0, 0), (1, 1), (1, 2), (3, 2), (3, 1), (1, 1))
POLYGONS = {"letter": (LETTER, 3), "wall": (WALL, 10)}


def area_of(part):
    a, b, c = part.positions[part.faces].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def polygon_files(points, folder):
    """A polygon on a slope as one face, beside a triangle: OBJ and PLY, each with uv = (x, y) / 4.

    OBJ has it with and without normals; PLY with and without a texture of each vertex, and with
    colours of faces.
    """
    places = [(x, y, x + 2 * y) for x, y in (*points, (0, -1))]
    numbers = [range(1, len(points) + 1), (1, 2, len(points) + 1)]
    lines = [f"v {x} {y} {z}" for x, y, z in places]
    lines += [f"vt {x / 4} {y / 4}" for x, y, _ in places] + ["vn 0.6 0 0.8"]
    for kind, word in (("normals", "{0}/{0}/1"), ("textured", "{0}/{0}"), ("bare", "{0}")):
        faces = ["f " + " ".join(word.format(k) for k in face) for face in numbers]
        (folder / f"{kind}.obj").write_text("\n".join([*lines, "usemtl clay", *faces]) + "\n")
    for kind in ("textured", "bare", "coloured"):
        columns = ("x", "y", "z", "s", "t")[: 5 if kind == "textured" else 3]
        head = ["ply", "format ascii 1.0", f"element vertex {len(places)}"]
        head += [f"property float {name}" for name in columns]
        colours = ("red", "green", "blue") if kind == "coloured" else ()
        head += ["element face 2", "property list uchar int vertex_indices"]
        head += [*(f"property uchar {name}" for name in colours), "end_header"]
        rows = [(x, y, z, x / 4, y / 4)[: len(columns)] for x, y, z in places]
        rows += [(len(face), *(k - 1 for k in face), *(200 for _ in colours)) for face in numbers]
        body = [" ".join(map(str, row)) for row in rows]
        (folder / f"{kind}.ply").write_text("\n".join([*head, *body]) + "\n")
    return sorted(file for file in folder.iterdir() if file.suffix in (".obj", ".ply"))


@pytest.mark.parametrize("shape", POLYGONS)
def test_polygons_that_are_not_convex_are_filled_and_nothing_else(shape, tmp_path):
    """Whatever their first corner is, with texture coordinates and normals of their corners."""
    points, area = POLYGONS[shape]
    for first in range(len(points)):
        turned = points[first:] + points[:first]
        beside = 0.5 * abs(np.linalg.det([np.subtract(p, (0, -1)) for p in turned[:2]]))
        for file in polygon_files(turned, tmp_path):
            (part,) = parts_of(file)
            assert np.isclose(area_of(part), (area + beside) * np.sqrt(6)), file
            assert len(part.faces) == len(points) - 1
            if file.stem not in ("bare", "coloured"):
                assert np.allclose(part.uv, part.positions[:, :2] / 4)
            if file.stem == "normals":
                assert np.allclose(part.normals, (0.6, 0, 0.8))


def test_corners_of_a_ply_files_quads_keep_their_textures(tmp_path):
    """A quad with a corner that points inwards, with texture coordinates of its corners."""
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\n"
    head += b"property float y\nproperty float z\nelement face 1\nproperty list uchar int "
    head += b"vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    body = np.array([(0, 0, 0), (4, 0, 0), (1, 1, 0), (0, 4, 0)], "<f4").tobytes()
    body += struct.pack("<B4iB8f", 4, 1, 2, 3, 0, 8, 1, 0, 0.25, 0.25, 0, 1, 0, 0)
    (tmp_path / "dart.ply").write_bytes(head + body)
    (part,) = parts_of(tmp_path / "dart.ply")
    assert np.isclose(area_of(part), 4) and np.allclose(part.uv, part.positions[:, :2] / 4)


def test_a_face_that_crosses_itself_is_a_fault(tmp_path):
    star = [(np.cos(a), np.sin(a)) for a in np.arange(5) * 0.8 * np.pi]
    lines = [f"v {x} {y} 0" for x, y in [*star[:2], (-2, 0.5), *star[2:]]]
    (tmp_path / "star.obj").write_text("\n".join([*lines, "f 1 2 3 4 5 6"]) + "\n")
    with pytest.raises(ImportFaults, match=r"cross themselves \(1\).*with triangulated faces"):
        parts_of(tmp_path / "star.obj")


def test_a_ply_file_that_is_not_read_names_what_to_export(tmp_path):
    """The reader takes no binary files of triangles and quads."""
    head = b"ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\n"
    head += b"property float y\nproperty float z\nelement face 2\n"
    head += b"property list uchar int vertex_indices\nend_header\n"
    body = np.array(CORNERS[:4], "<f4").tobytes()
    body += struct.pack("<B4iB3i", 4, 0, 1, 3, 2, 3, 0, 1, 3)
    (tmp_path / "mixed.ply").write_bytes(head + body)
    with pytest.raises(ImportFaults, match=r"cannot be read .*with triangulated faces, or as GLB"):
        parts_of(tmp_path / "mixed.ply")


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_a_mesh_that_is_cut_off_may_be_incomplete(suffix, tmp_path):
    whole = tmp_path / f"whole{suffix}"
    trimesh.creation.icosphere(2).export(whole)
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole.read_bytes()[:-1000])
    with pytest.raises(ImportFaults, match=r"cannot be read .*It may be incomplete: export it ag"):
        parts_of(cut)


def test_many_parts_are_named_in_no_time_and_told(captured, tmp_path, monkeypatch):
    """A name asks a set, and not every part before it."""
    asked = []

    def ids(name):
        asked.append(name)
        return name, f"{name}_sides", f"{name}_shape"

    monkeypatch.setattr(meshes_module, "_ids", ids)
    lines = [f"v {x} {y} 0" for x, y in ((0, 0), (1, 0), (0, 1))]
    for number in range(300):
        lines += [f"o {'part' if number % 2 else 'PART'}", f"g {number % 3}"]
        lines += ["f 1 2 3", f"o rest {number}", "f 1 2 3"]
    (tmp_path / "many.obj").write_text("\n".join(lines) + "\n")
    files = [tmp_path / "many.obj"] * 3
    parts = parts_of(*files)
    assert len({part.name.lower() for part in parts}) == len(parts) > 900
    assert len(asked) < 4 * len(parts)
    monkeypatch.undo()
    write_blender(captured, tmp_path / "blender")
    told = []
    import_data(tmp_path / "blender", tmp_path / "data", files[:1], tell=told.append)
    assert any("parts has a BSDF of its own" in line for line in told)
