"""Materials that lamps alone have are known to new fits, and keep their numbers."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT

from unbake.config.toml import from_toml
from unbake.errors import UserError
from unbake.fields.texture import material_numbers
from unbake.scene.triangles import write_mesh
from unbake.training.problem import make_problem

SCENE = """<scene version="3.0.0">
  <bsdf type="principled" id="lamp"><rgb name="base_color" value="0.9 0.1 0.3"/></bsdf>
  <bsdf type="principled" id="wall"/>
  <bsdf type="principled" id="floor"/>
  <shape type="sphere"><ref id="lamp"/><emitter type="area"/>
    <transform name="to_world"><translate y="3"/></transform></shape>
  <shape type="rectangle"><ref id="wall"/></shape>
  <shape type="cube"><ref id="floor"/>
    <transform name="to_world"><translate y="-3"/></transform></shape>
</scene>"""
OLD = replace(TINY_FIT, lamps="fitted")


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def colour_of_lamp(problem):
    problem.materials.stand_alone()
    ray = mi.Ray3f(mi.Point3f(0.1, 3.2, 9), mi.Vector3f(0, 0, -1))
    si = problem.scene_view.scene.ray_intersect(ray)
    assert np.array(si.shape.is_emitter()).all()
    return np.ravel(si.bsdf().eval_diffuse_reflectance(si))


@pytest.mark.parametrize("representation", ["neural", "bitmap"])
def test_a_new_fit_leaves_the_material_of_a_lamp_as_it_is(representation, path):
    new, old = (
        make_problem(path, "visible", replace(c, representation=representation), 0.2)
        for c in (TINY_FIT, OLD)
    )
    np.testing.assert_allclose(colour_of_lamp(new), [0.9, 0.1, 0.3], atol=1e-5)
    np.testing.assert_allclose(colour_of_lamp(old), [0.5] * 3, atol=0.1)
    arrays = [{k: np.shape(v) for k, v in p.parameters().items()} for p in (new, old)]
    assert arrays[0] == arrays[1]


def test_the_other_materials_keep_their_numbers(path):
    bitmaps = replace(TINY_FIT, representation="bitmap")
    problem = make_problem(path, "visible", bitmaps, 0.2)
    scene = problem.scene_view.scene
    assert sorted(material_numbers(scene).values()) == [1, 2]
    old = make_problem(path, "visible", replace(bitmaps, lamps="fitted"), 0.2)
    assert sorted(material_numbers(old.scene_view.scene).values()) == [0, 1, 2]


def test_a_lamp_needs_no_texture_coordinates(path):
    """Its shape cannot have bitmaps, which it is not given."""
    bare = '<shape type="ply"><string name="filename" value="bare.ply"/>'
    path.write_text(SCENE.replace('<shape type="sphere">', bare))
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    write_mesh(path.parent / "bare.ply", corners, np.array([[0, 1, 2]]))
    bitmaps = replace(TINY_FIT, representation="bitmap")
    make_problem(path, "visible", bitmaps, 0.2)
    with pytest.raises(UserError, match="meshes without texture coordinates"):
        make_problem(path, "visible", replace(bitmaps, lamps="fitted"), 0.2)


def test_a_furnace_of_lamps_alone_is_fitted(built_in):
    problem = make_problem(built_in("furnace"), "visible", TINY_FIT, 0.2)
    assert list(material_numbers(problem.scene_view.scene).values()) == [0]


def test_runs_begun_earlier_go_on_with_what_they_fitted():
    for version in (1, 2, 3, 4):
        assert from_toml(f'format = {version}\npreset = "cpu"\n').lamps == "fitted"
    assert from_toml('format = 6\npreset = "cpu"\n').lamps == "known"
