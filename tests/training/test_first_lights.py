"""Lights that photographs show begin as bright as they are."""

import dataclasses

import drjit as dr
import numpy as np
import pytest
from support import TINY_FIT

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import CameraConfig
from unbake.dataset.photographs import Photographs
from unbake.dataset.views import Dataset
from unbake.imaging.pictures import write_exr
from unbake.training.first_lights import WAITS, release_lights
from unbake.training.fresh_fit import begin_fit
from unbake.training.problem import problem_of

LAMPS = {
    "bright": ("-0.9 0 0.5", "30 20 10"),
    "dim": ("0.9 0 0.5", "0.2 0.3 0.4"),
    "black": ("0 0.9 0.5", "0 0 0"),
    "inside": ("0 -0.9 0.5", "5 5 5"),
}
SCENE = """<scene version="3.0.0">
  <shape type="cube"><transform name="to_world"><scale value="2"/>
    <translate z="2"/></transform><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>
  <shape type="cube"><transform name="to_world"><scale value="0.4"/>
    <translate x="0" y="-0.9" z="0.5"/></transform><bsdf type="diffuse"/></shape>
  {lamps}
  <shape type="rectangle"><transform name="to_world"><scale value="0.3"/>
    <translate x="0" y="0" z="0.3"/></transform><bsdf type="diffuse">
      <rgb name="reflectance" value="0"/></bsdf>
    <emitter type="area" id="screen"><texture name="radiance" type="bitmap">
      <string name="filename" value="screen.exr"/></texture></emitter>
  </shape>
</scene>"""
LAMP = """<shape type="sphere"><point name="center" x="{}" y="{}" z="{}"/>
    <float name="radius" value="0.3"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
    <emitter type="area" id="{}"><rgb name="radiance" value="{}"/></emitter></shape>"""
UNKNOWN = dataclasses.replace(TINY_FIT, unknown="emission")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Photographs of a room with four lamps and a screen; one lamp is inside of a box."""
    folder = tmp_path_factory.mktemp("lamps")
    lamps = [LAMP.format(*place.split(), name, rgb) for name, (place, rgb) in LAMPS.items()]
    write_exr(folder / "screen.exr", np.float32([[[0, 0, 0]] * 3 + [[8, 12, 16]]]).repeat(4, 0))
    (folder / "scene.xml").write_text(SCENE.format(lamps="\n".join(lamps)))
    small = CaptureSettings(views=8, held_out=1, resolution=48, spp=16, max_depth=4)
    capture(folder / "scene.xml", folder / "data", small, tell=lambda line: None)
    return Dataset.load(folder / "data")


def begun(data, config):
    problem = begin_fit(data, config).problem
    strengths = np.array(problem.emission.values).T
    return dict(zip(problem.emitter_names, strengths, strict=True)), problem.emission.scale


def test_lights_in_view_begin_at_what_photographs_show(data):
    found, scale = begun(data, UNKNOWN)
    for name in ("bright", "dim"):
        true = np.array(LAMPS[name][1].split(), float)
        np.testing.assert_allclose(found[name], true, rtol=0.1)  # with what it reflects
    # The mean of its picture, most of which is dark
    np.testing.assert_allclose(found["screen"], (2, 3, 4), rtol=0.1)
    # One that is black may still become brighter, and of one that nobody sees nothing is known.
    assert (found["black"] >= 0.999e-3 * scale).all() and (found["black"] < 0.1 * scale).all()
    np.testing.assert_allclose(found["inside"], scale, rtol=1e-4)


def test_what_is_known_is_no_light_that_begins(data, tmp_path):
    """A known environment in view stays as it is, and a point that nobody sees begins as before."""
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    point = """<emitter type="point" id="point"><point name="position" x="0" y="0" z="3"/>
      <rgb name="intensity" value="5"/></emitter>"""
    floor = """<shape type="rectangle"><transform name="to_world"><scale value="0.5"/></transform>
      <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""
    write_exr(tmp_path / "sky.exr", np.full((8, 16, 3), 0.7, np.float32))
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{sky}{point}{floor}</scene>')
    small = CaptureSettings(views=2, held_out=1, resolution=16, spp=4, max_depth=3)
    capture(tmp_path / "scene.xml", tmp_path / "data", small, tell=lambda line: None)
    made = dataclasses.replace(Dataset.load(tmp_path / "data"), background="visible")
    problem = problem_of(made, UNKNOWN, 0.5)
    before = np.array(problem.emission.values)
    found, _ = begun(made, UNKNOWN)
    assert list(found) == ["point"]
    level = Photographs.load(made, False).level
    np.testing.assert_allclose(found["point"], before[:, 0] * level / 0.5, rtol=1e-4)


def test_they_begin_alike_where_photographs_do_not_tell(data):
    camera = dataclasses.replace(UNKNOWN, camera=CameraConfig(exposure="per-image"))
    hidden = dataclasses.replace(data, background="hidden")
    for views, config in ((data, camera), (hidden, UNKNOWN)):
        found, scale = begun(views, config)
        for strength in found.values():
            np.testing.assert_allclose(strength, scale, rtol=1e-4)


def gradients(problem):
    """What a gradient of all strengths does to each of them, (lights, 3)."""
    array = problem.emission.parameters()["log"]
    dr.enable_grad(array)
    problem.assign(problem.parameters())
    dr.backward(dr.sum(problem.emission.values, axis=None))
    return np.array(dr.grad(array)).reshape(-1, 3)


def test_lights_in_view_are_held_until_albedo_is_near(data):
    """Bright ones to the end: what they reflect is nothing beside what they are."""
    problem = begin_fit(data, dataclasses.replace(UNKNOWN, unknown="materials+emission")).problem
    names, free = problem.emitter_names, {"inside"}
    assert {names[i] for i in problem.emission.held} == {*names} - free
    release_lights(problem, 0.9 * WAITS)
    assert {names[i] for i in problem.emission.held} == {*names} - free
    release_lights(problem, WAITS)
    sure = {"bright", "screen"}
    assert {names[i] for i in problem.emission.held} == sure
    for name, moved in zip(names, gradients(problem), strict=True):
        assert (moved == 0).all() if name in sure else (moved > 0).all()
    release_lights(problem, 1.0)
    assert {names[i] for i in problem.emission.held} == sure


def test_lights_alone_are_free_and_so_are_clipped_ones(data):
    assert not begin_fit(data, UNKNOWN).problem.emission.held
    views = tuple(dataclasses.replace(view, clipped=1.0) for view in data.views)
    both = dataclasses.replace(UNKNOWN, unknown="materials+emission")
    problem = begin_fit(dataclasses.replace(data, views=views), both).problem
    held = {problem.emitter_names[i] for i in problem.emission.held}
    assert "bright" not in held and "dim" in held
