"""Parsed scenes of given shapes and emitters."""

import numpy as np
import pytest
from scene_texts import BALL, DIFFUSE, ROOM

from unbake.imaging.pictures import write_exr
from unbake.scene import parse as scenes


@pytest.fixture
def parse(tmp_path):
    """A parsed scene of these shapes."""

    def run(content):
        write_exr(tmp_path / "bump.exr", np.random.default_rng(5).random((8, 8)) / 20)
        path = tmp_path / "scene.xml"
        path.write_text(ROOM.format(content))
        return scenes.parse(path)

    return run


@pytest.fixture
def parse_lit(tmp_path):
    """A parsed scene of a ball and these emitters alone."""

    def run(content):
        write_exr(tmp_path / "bump.exr", np.random.default_rng(5).random((8, 16, 3)))
        path = tmp_path / "scene.xml"
        sky = '<emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>'
        path.write_text(ROOM.replace(sky, "").format(BALL.format(DIFFUSE) + content))
        return scenes.parse(path)

    return run
