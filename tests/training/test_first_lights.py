"""Lights that photographs show begin as bright as they are."""

import dataclasses

import numpy as np
import pytest
from support import TINY_FIT

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import CameraConfig
from unbake.dataset.views import Dataset
from unbake.imaging.pictures import write_exr
from unbake.training.fresh_fit import begin_fit

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
    write_exr(folder / "screen.exr", np.float32([[[1, 2, 3], [3, 4, 5]]]).repeat(2, 0))
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
    # The mean of its picture
    np.testing.assert_allclose(found["screen"], (2, 3, 4), rtol=0.1)
    # One that is black may still become brighter, and of one that nobody sees nothing is known.
    assert (found["black"] >= 0.999e-3 * scale).all() and (found["black"] < 0.1 * scale).all()
    np.testing.assert_allclose(found["inside"], scale, rtol=1e-4)


def test_they_begin_alike_where_photographs_do_not_tell(data):
    camera = dataclasses.replace(UNKNOWN, camera=CameraConfig(exposure="per-image"))
    hidden = dataclasses.replace(data, background="hidden")
    for views, config in ((data, camera), (hidden, UNKNOWN)):
        found, scale = begun(views, config)
        for strength in found.values():
            np.testing.assert_allclose(strength, scale, rtol=1e-4)
