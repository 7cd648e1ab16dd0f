"""Emitters that light more of what is seen are sampled more often; expectations stay."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_same_expectation,
    pixel_rays,
    tiny_fields,
    whole_and_in_parts,
)

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import read_toml
from unbake.dataset.camera import Camera
from unbake.dataset.views import Dataset
from unbake.training.loop import fit
from unbake.training.problem import problem_of
from unbake.training.recovered import load_run
from unbake.transport.emitter_weights import chosen_alike, weigh_emitters
from unbake.transport.path_tracer import path_traced
from unbake.transport.vertex import SceneView

CAMERA = Camera.look_at((0, -3, 3), (0, 0, 0), (0, 0, 1), 40.0, 8, 8)
DEPTHS = {"max_depth": 6, "rr_depth": 5, "hide_emitters": False}


SCENE = """<scene version="3.0.0">
  <shape type="sphere"><point name="center" x="0" y="0.4" z="0"/><float name="radius" value="0.4"/>
    <bsdf type="diffuse"/></shape>
  <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/>
    <scale value="2"/></transform><bsdf type="diffuse"/></shape>
  <shape type="sphere"><point name="center" x="0.3" y="2" z="0"/><float name="radius" value="0.1"/>
    <emitter type="area"><rgb name="radiance" value="50"/></emitter></shape>
  <emitter type="constant"><rgb name="radiance" value="0.01"/></emitter>
</scene>"""


def lamp(x, radiance, **more):
    """A small lamp over the floor that shines down."""
    place = mi.ScalarTransform4f().look_at([x, 0, 2], [x, 0, 0], [0, 1, 0]).scale(0.1)
    emitter = {"type": "area", "radiance": radiance, **more}
    return {"type": "rectangle", "to_world": place, "emitter": emitter}


def room(*lamps, **more):
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)}
    numbered = {f"lamp {number}": one for number, one in enumerate(lamps)}
    return mi.load_dict({"type": "scene", "floor": floor, **numbered, **more})


def weights(scene):
    return [float(mi.traverse(emitter)["sampling_weight"]) for emitter in scene.emitters()]


def weigh(scene):
    view = SceneView.of(scene, None, 8)
    weigh_emitters(view, pixel_rays([CAMERA], 16, seed=3), hide_emitters=False, seed=0)
    return view


def test_most_samples_are_of_the_lamp_that_gives_most_light():
    lamps = lamp(0.3, 40.0), *(lamp(x, 0.2) for x in (-1.2, -0.8, -0.4, 0.8, 1.2))
    ray = pixel_rays([CAMERA], 512, seed=1)
    before = path_traced(SceneView.of(room(*lamps), None, 8), ray, 2, **DEPTHS)
    scene = room(*lamps)
    assert chosen_alike(scene) and weights(scene) == [1.0] * 6
    view = weigh(scene)
    assert not chosen_alike(scene) and sum(weights(scene)) == pytest.approx(6, rel=1e-4)
    assert max(weights(scene)) > 4 and min(weights(scene)) >= 0.2 * 0.99
    after = path_traced(view, ray, 4, **DEPTHS)
    assert_same_expectation(after, before, 512)
    spread = [np.array(x).mean(0).reshape(-1, 512).var(1).mean() for x in (before, after)]
    assert spread[1] < spread[0] / 3
    # Mitsuba's integrators go by the same weights.
    path = mi.load_dict({"type": "path", "max_depth": 6})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(5, dr.width(ray))
    theirs, _, _ = path.sample(scene, sampler, mi.RayDifferential3f(ray), None, True)
    assert_same_expectation(mi.Color3f(theirs), before, 512)
    assert np.array(theirs).mean(0).reshape(-1, 512).var(1).mean() < spread[0] / 3


def test_lamps_of_one_kind_stay_alike():
    scene = room(lamp(-0.5, 3.0), lamp(0.5, 3.0))
    weigh(scene)
    np.testing.assert_allclose(weights(scene), 1, atol=0.1)


def test_lamps_that_light_what_is_seen_by_a_bounce_alone_count_too():
    """A lamp that shines at a ceiling, which no camera sees, is most of the light."""
    up = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 9], [0, 1, 0]).scale(0.3)
    bright = {"type": "rectangle", "to_world": up, "emitter": {"type": "area", "radiance": 60.0}}
    over = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]).scale(3)
    ceiling = {"type": "rectangle", "to_world": over}
    scene = room(lamp(0.5, 1.0), bright, ceiling=ceiling)
    weigh(scene)
    assert min(weights(scene)) > 0.4


def test_what_is_turned_off_or_chosen_by_hand_stays():
    off = room(lamp(-0.5, 3.0), lamp(0.5, 3.0, sampling_weight=0.0), lamp(0.9, 1.0))
    assert chosen_alike(off)
    weigh(off)
    assert min(weights(off)) == 0 and sum(weights(off)) == pytest.approx(2, rel=1e-4)
    assert not chosen_alike(room(lamp(0, 1.0, sampling_weight=3.0), lamp(1, 1.0)))
    assert not chosen_alike(room(lamp(0, 1.0)))
    assert not chosen_alike(room(lamp(0, 1.0), lamp(1, 1.0, sampling_weight=0.0)))


def test_where_no_light_arrives_all_stay_alike():
    dark = room(lamp(-0.5, 0.0), lamp(0.5, 0.0))
    weigh(dark)
    assert weights(dark) == [1.0, 1.0]


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    """A captured data set with a lamp and a dim sky, to be read alone."""
    folder = tmp_path_factory.mktemp("lit")
    file = folder / "scene.xml"
    file.write_text(SCENE)
    small = CaptureSettings(views=2, held_out=1, resolution=8, spp=4, max_depth=4)
    capture(file, folder / "data", small, tell=lambda line: None)
    return folder / "data"


def test_a_fit_weighs_lights_that_are_known(lit):
    dataset = Dataset.load(lit)
    found = weights(problem_of(dataset, TINY_FIT, 0.2).scene_view.scene)
    again = weights(problem_of(dataset, TINY_FIT, 0.2).scene_view.scene)
    assert sorted(found)[1] > 1.2 and found == again
    config = dataclasses.replace(TINY_FIT, unknown="emission")
    assert weights(problem_of(dataset, config, 0.2).scene_view.scene) == [1.0, 1.0]


@pytest.mark.parametrize("method", ["ours", "prb"])
def test_a_fit_with_weighed_lights_is_replayed_and_goes_on_bit_for_bit(
    lit, tiny, tmp_path, monkeypatch, method
):
    settings = dataclasses.replace(read_toml(tiny), method=method, steps=8)
    whole, parts, step = whole_and_in_parts(lit, tmp_path, settings, monkeypatch)
    assert 1 <= step.recordings() <= 3
    for key, value in whole.items():
        assert np.array_equal(value, parts[key]), key


def test_a_recovered_scene_weighs_lights_by_the_strengths_that_were_found(lit, tmp_path):
    """The fit itself samples them alike: it does not know yet."""
    config = dataclasses.replace(tiny_fields("grid"), method="direct", unknown="emission", steps=1)
    fit(lit, tmp_path / "run", config)
    found = weights(load_run(tmp_path / "run").problem.scene_view.scene)
    assert min(found) < 0.9 and sum(found) == pytest.approx(2, rel=1e-4)
