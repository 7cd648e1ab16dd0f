"""Cameras of a solve are placed as those of a capture, and the scene is solved as it is."""

import numpy as np
import pytest

from unbake.fields.shapes import bsdf_classes
from unbake.solver.settings import SolveSettings
from unbake.solver.solve import _known_scene

SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><transform name="to_world">
    <lookat origin="{}" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
  <bsdf type="diffuse" id="grey"/>
  {}
</scene>
"""
ROOM = SCENE.format(
    "0.6, 0.3, 0.7",
    """<shape type="cube"><boolean name="flip_normals" value="true"/><ref id="grey"/></shape>
  <shape type="sphere"><point name="center" x="0" y="0.7" z="0"/><float name="radius" value="0.1"/>
    <emitter type="area"/></shape>""",
)
ON_A_GROUND = SCENE.format(
    "0, 3, 8",
    """<emitter type="constant"/>
  <shape type="cube"><ref id="grey"/></shape>
  <shape type="cube"><ref id="grey"/><transform name="to_world">
    <scale x="20" y="0.005" z="20"/><translate y="-1.005"/></transform></shape>""",
)


@pytest.fixture
def known(tmp_path):
    """What a solve knows of a scene without a camera file."""

    def load(text):
        (tmp_path / "scene.xml").write_text(text)
        settings = SolveSettings(views=2, resolution=8)
        path = str(tmp_path / "scene.xml")
        return _known_scene(path, settings, None, None, False, lambda line: None)

    return load


def test_a_room_of_diffuse_walls_is_solved_as_it_is(known):
    """Cameras were chosen by what could be fitted, of which there was nothing."""
    found = known(ROOM)
    assert found.room and list(found.cameras) == ["train_000", "train_001"]
    assert np.abs([camera.origin for camera in found.cameras.values()]).max() < 1
    shapes = found.scene_view.scene.shapes()
    assert len(shapes) == 2 and all("Principled" not in bsdf_classes(s) for s in shapes)


def test_a_ground_of_the_object_s_own_material_does_not_move_its_cameras(known):
    found = known(ON_A_GROUND)
    assert not found.room
    assert max(np.linalg.norm(camera.origin) for camera in found.cameras.values()) < 10
    assert len(found.scene_view.scene.shapes()) == 1, "meshes of one material are merged"
