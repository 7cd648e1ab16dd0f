"""Vertices whose normal is not a number get that of their triangles."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scene_texts import ROOM

from unbake.scene.normals import repair_normals
from unbake.scene.parse import parse
from unbake.scene.triangles import write_mesh

#: A square in the plane z = 0, seen from above, and a triangle without area at its last vertex.
POSITIONS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [3, 3, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 4, 4]])


@pytest.fixture
def scene(tmp_path):
    """A scene with the square, its mesh with these normals; further properties as XML."""

    def make(normals, more=""):
        write_mesh(tmp_path / "square.ply", POSITIONS, FACES, normals)
        shape = '<shape type="ply"><string name="filename" value="square.ply"/>{}'
        bsdf = '<bsdf type="twosided"><bsdf type="principled"/></bsdf></shape>'
        (tmp_path / "scene.xml").write_text(ROOM.format(shape.format(more) + bsdf))
        return parse(tmp_path / "scene.xml")

    return make


def normals_of(scene):
    (mesh,) = (shape for shape in scene.shapes() if shape.is_mesh())
    return np.array(mesh.vertex_normals_buffer()).reshape(-1, 3)


def tilted(sign=1.0):
    """Smooth normals, which are not those of the triangles."""
    normals = POSITIONS * 0.2 + [0, 0, 1]
    return sign * normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_broken_normals_become_those_of_triangles_and_others_stay(scene, sign):
    given = tilted(sign)
    given[[1, 4]] = np.nan
    found = normals_of(scene(given).instantiate())
    np.testing.assert_allclose(found[[0, 2, 3]], given[[0, 2, 3]], atol=1e-6)
    np.testing.assert_allclose(found[1], [0, 0, sign], atol=1e-6)
    assert np.linalg.norm(found[4]) == pytest.approx(1)


def test_rays_have_a_shading_frame_beside_broken_normals(scene):
    given = tilted()
    given[1] = np.nan
    made = scene(given).instantiate()
    x = dr.linspace(mi.Float, -0.9, 0.8, 16)
    hit = made.ray_intersect(mi.Ray3f(mi.Point3f(x, -0.95, 2), mi.Vector3f(0, 0, -1)))
    assert dr.all(hit.is_valid())
    assert np.isfinite(np.array(hit.sh_frame.n)).all()


def test_meshes_whose_normals_are_numbers_are_not_touched(scene):
    made = scene(tilted()).instantiate()
    assert repair_normals(made) == 0
    np.testing.assert_allclose(normals_of(made), tilted(), atol=1e-6)
