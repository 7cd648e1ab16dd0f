"""Meshes of other programs: every corner of every triangle keeps its place, normal and texture."""

import numpy as np
import pytest
import trimesh

from unbake.errors import UserError
from unbake.importing.faults import Faults, ImportFaults
from unbake.importing.meshes import read_parts, write_scene
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


def test_a_node_that_flattens_its_mesh_is_a_fault(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), node_name="flat", transform=np.diag([1.0, 0, 1, 1]))
    scene.export(tmp_path / "a.glb")
    with pytest.raises(UserError, match="the transform of 'flat' flattens it"):
        parts_of(tmp_path / "a.glb")
