"""Photographs in other units than the lights are told, and good data are not doubted."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from support import TINY_FIT

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import update
from unbake.dataset.views import Dataset
from unbake.imaging.pictures import read_exr, write_exr
from unbake.training import plausibility
from unbake.training.fresh_fit import begin_fit
from unbake.training.plausibility import data_warnings
from unbake.training.problem import make_problem
from unbake.training.run_folder import RunFolder


def told(folder, config=TINY_FIT):
    dataset = Dataset.load(folder)
    fit = begin_fit(dataset, config)
    return data_warnings(dataset, fit.pixels, fit.problem)


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """A data set under an environment whose light is said to be unknown, to be read alone."""
    data = tmp_path_factory.mktemp("sky") / "data"
    small = CaptureSettings(views=2, held_out=1, resolution=16, spp=8, max_depth=6)
    replace(capture("still", data, small, tell=lambda line: None), light="unknown").save(data)
    return data


@pytest.fixture
def times(cornell, tmp_path):
    """The data set with photographs times a factor."""

    def make(factor):
        data = shutil.copytree(cornell, tmp_path / "data", dirs_exist_ok=True)
        for name in ("train_000", "train_001"):
            pixels = read_exr(cornell / "images" / f"{name}.exr")
            pixels[..., :3] *= factor
            write_exr(data / "images" / f"{name}.exr", pixels)
        return data

    return make


def test_good_data_are_not_doubted(cornell):
    assert told(cornell) == []


@pytest.mark.parametrize(
    ("factor", "message"), [(1e6, "e+06 times brighter"), (1e-6, "times darker")]
)
def test_photographs_in_other_units_are_told(factor, message, times):
    (line,) = told(times(factor))
    assert line.startswith("the photographs are ") and message in line
    assert line.endswith("Are they in other units than the lights?")


@pytest.mark.parametrize("factor", [0.1, 10])
def test_dark_and_bright_surfaces_are_not_doubted(factor, times):
    assert told(times(factor)) == []


def test_where_lights_are_unknown_any_brightness_is_good(times):
    lighting = update(TINY_FIT, {"unknown": "emission"})
    assert told(times(1e6), lighting) == []


def test_a_placeholder_that_is_taken_for_the_light_is_told(sky):
    (line,) = told(sky, update(TINY_FIT, {"unknown": "materials"}))
    assert line.startswith("the data set says that its light is unknown, and what stands for it")
    assert told(sky) == told(sky, update(TINY_FIT, {"unknown": "lighting"})) == []


SKIES = {
    "constant": '<emitter type="constant"/>',
    "envmap": '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>',
}


@pytest.mark.parametrize(("kind", "doubted"), [("constant", False), ("envmap", True)])
def test_a_placeholder_whose_strength_is_fitted_is_not_doubted(kind, doubted, tmp_path):
    scene, lamp = tmp_path / "scene.xml", '<emitter type="point"/>'
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    scene.write_text(f'<scene version="3.0.0"><shape type="sphere"/>{lamp}{SKIES[kind]}</scene>')
    dataset = Dataset(tmp_path, scene, "visible", (), {}, None, light="unknown")
    problem = make_problem(scene, "visible", update(TINY_FIT, {"unknown": "emission"}), 0.5)
    assert (plausibility._placeholder(dataset, problem) is not None) == doubted


def test_lamps_with_pictures_are_told_where_their_strength_is_fitted(tmp_path):
    scene = tmp_path / "scene.xml"
    write_exr(tmp_path / "screen.exr", np.ones((8, 16, 3)))
    picture = '<texture type="bitmap" name="radiance"><string name="filename" value="screen.exr"/>'
    scene.write_text(
        f"""<scene version="3.0.0"><shape type="sphere"/><emitter type="point"/>
        <shape type="rectangle" id="screen"><emitter type="area">{picture}</texture></emitter>
        </shape></scene>"""
    )
    dataset = Dataset(tmp_path, scene, "visible", (), {}, None)
    for unknown, pictures, told in (
        ("emission", "known", False),
        ("emission", "ignored", True),
        ("materials", "ignored", False),
    ):
        settings = update(TINY_FIT, {"unknown": unknown, "lamp_pictures": pictures})
        line = plausibility._pictures(dataset, make_problem(scene, "visible", settings, 0.5))
        assert line is None if not told else line.startswith("screen will have one colour")


@pytest.mark.parametrize(("unknown", "open_"), [("emission", True), ("materials", False)])
def test_a_white_balance_that_unknown_light_leaves_open_is_told(unknown, open_, cornell):
    camera = {"white_balance": "common"}
    lines = told(cornell, update(TINY_FIT, {"unknown": unknown, "camera": camera}))
    assert [line.split(":")[0] for line in lines] == open_ * [
        "the white balance of all photographs and the colour of unknown light cannot be told apart"
    ]


def test_light_that_is_unknown_is_recovered_unless_the_user_says_otherwise(
    sky, cornell, tiny, unbake, tmp_path
):
    line = "the data set says that its light is unknown: it is recovered with the materials"
    for data, words, unknown in (
        (sky, (), "materials+lighting"),
        (sky, ("--unknown", "materials"), "materials"),
        (sky, ("--unknown", "lighting"), "lighting"),
        (cornell, (), "materials"),
    ):
        run = tmp_path / "-".join((data.parent.name, *words))
        outcome = unbake("fit", data, "--out", run, "--settings", tiny, "--steps", 0, *words)
        assert outcome.status == 0, outcome
        assert RunFolder(run).settings().unknown == unknown
        assert (line in outcome.out) == (data == sky and not words)
        convention = "the data set hides the background, and no mirror shows the light: brightness"
        assert (convention in outcome.out) == (unknown == "materials+lighting")


def test_what_direct_light_does_not_reach_is_lit_by_whole_paths(cornell, monkeypatch):
    monkeypatch.setattr(plausibility, "_direct_light", lambda *words: 0.0)
    assert told(cornell) == []
    monkeypatch.setattr(plausibility, "_all_light", lambda *words: 0.0)
    assert told(cornell) == ["no light of the scene reaches what the training views see"]


def test_a_pixel_that_is_far_too_bright_is_told(times):
    data = times(1)
    image = data / "images" / "train_001.exr"
    pixels = read_exr(image)
    pixels[3, 5, :3] = 1e8
    write_exr(image, pixels)
    (line,) = told(data)
    assert line.startswith("1 pixel is over 100,000 times as bright as the others: ")
    assert "train_001 at (5, 3): 1e+08, taken as " in line
    assert np.isfinite(float(line.rsplit(" ", 1)[1]))
