"""The true lighting of a data set: written beside photographs, read back, and checked."""

import json

import mitsuba as mi
import numpy as np
import pytest

from unbake.dataset.lighting import ROWS, true_emission, true_environment, write_true_lighting
from unbake.errors import UserError
from unbake.imaging.pictures import write_exr
from unbake.scene import emitters
from unbake.scene.parse import parse


@pytest.fixture
def truth(tmp_path):
    """The folder `truth` of a data set in `tmp_path`."""
    folder = tmp_path / "truth"
    folder.mkdir()
    return folder


def files(folder):
    return sorted(file.name for file in folder.iterdir())


def test_an_environment_is_what_directions_see(built_in, truth):
    write_true_lighting(built_in("still"), truth.parent)
    assert files(truth) == ["environment.exr"]
    picture = true_environment(truth.parent)
    assert picture.shape == (ROWS, 2 * ROWS, 3) and picture.dtype == np.float32
    expected = emitters.environment_latlong(parse(built_in("still")).instantiate(), ROWS)
    assert expected.std() > 0.1
    np.testing.assert_array_equal(picture, expected)
    assert true_emission(truth.parent) == {}


@pytest.mark.parametrize(
    ("name", "light", "strength"),
    [
        ("demo", "lamp_shape", [17.0, 15.8, 13.8]),
        ("cornell", "light_shape", [13.0, 10.0, 6.5]),
        ("furnace", "walls_shape", [1.0, 1.0, 1.0]),
    ],
)
def test_the_strength_of_lights_is_that_of_the_scene(name, light, strength, built_in, truth):
    write_true_lighting(built_in(name), truth.parent)
    assert files(truth) == ["emission.json"]
    known = true_emission(truth.parent)
    assert list(known) == [light]
    np.testing.assert_allclose(known[light], strength, rtol=1e-6)
    assert true_environment(truth.parent) is None


def test_a_constant_environment_is_both(truth, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="sphere"/><emitter type="constant" id="sky">'
        '<rgb name="radiance" value="0.5 1 2"/></emitter></scene>'
    )
    write_true_lighting(path, truth.parent)
    assert files(truth) == ["emission.json", "environment.exr"]
    np.testing.assert_allclose(true_environment(tmp_path), np.full((128, 256, 3), [0.5, 1, 2]))
    np.testing.assert_allclose(true_emission(tmp_path)["sky"], [0.5, 1, 2])


def test_a_light_with_a_picture_is_named_and_has_no_strength(truth):
    (truth / "emission.json").write_text('[{"name": "screen", "strength": null}]')
    assert true_emission(truth.parent) == {}


def test_nothing_is_known_where_there_is_no_file(tmp_path):
    assert true_environment(tmp_path) is None
    assert true_emission(tmp_path) == {}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[{", "emission.json: the file is not readable JSON"),
        ("7", "emission.json: not a list of lights"),
        ('{"name": "lamp"}', "emission.json: not a list of lights"),
        ("[3]", "emission.json: not a list of lights"),
        ('[{"strength": [1, 2, 3]}]', "emission.json, light 0: the key 'name' is missing"),
        ('[{"name": 7}]', "emission.json, light 0: 'name' is not a text"),
        ('[{"name": "a"}, {"name": "b", "strength": [1, 2]}]', "light 1: 'strength' is not an arr"),
        ('[{"name": "a", "strength": "bright"}]', "light 0: 'strength' is not an array of 3"),
        ('[{"name": "a", "strength": 1}]', "light 0: 'strength' is not an array of 3 numbers"),
        ('[{"name": "a", "strength": [1, NaN, 1]}]', "the strength of 'a' is not finite"),
    ],
)
def test_damaged_strengths_are_told_in_one_line(content, message, truth):
    (truth / "emission.json").write_text(content)
    with pytest.raises(UserError, match=message) as error:
        true_emission(truth.parent)
    assert "\n" not in str(error.value)


def test_strengths_that_are_no_text_are_told_in_one_line(truth):
    (truth / "emission.json").write_bytes(b"\xff\xfe\x00[")
    with pytest.raises(UserError, match=r"emission.json: the file is not UTF-8 text"):
        true_emission(truth.parent)


def broken(file):
    file.write_bytes(b"no picture at all")


def short(file):
    write_exr(file, np.ones((ROWS, 2 * ROWS, 3)))
    file.write_bytes(file.read_bytes()[:-1000])


def small(file):
    write_exr(file, np.ones((8, 16, 3)))


def not_finite(file):
    picture = np.ones((ROWS, 2 * ROWS, 3))
    picture[3, 4] = np.inf
    write_exr(file, picture)


@pytest.mark.parametrize("damage", [broken, short, small, not_finite])
def test_a_damaged_environment_is_told_in_one_line(damage, truth):
    damage(truth / "environment.exr")
    with pytest.raises(UserError, match=r"environment.exr: .*Capture the data set again") as error:
        true_environment(truth.parent)
    assert "\n" not in str(error.value)


def test_pixels_below_zero_are_taken_as_zero(truth):
    picture = np.ones((ROWS, 2 * ROWS, 3))
    picture[3, 4] = -0.25
    write_exr(truth / "environment.exr", picture)
    assert true_environment(truth.parent).min() == 0


def test_what_is_written_is_plain_json(truth, tmp_path):
    path = tmp_path / "scene.xml"
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "screen.exr"))
    path.write_text(
        '<scene version="3.0.0"><shape type="sphere"><emitter type="area">'
        '<texture type="bitmap" name="radiance">'
        '<string name="filename" value="screen.exr"/></texture></emitter></shape></scene>'
    )
    write_true_lighting(path, truth.parent)
    assert json.loads((truth / "emission.json").read_text()) == [
        {"name": "area light", "strength": [1.0, 1.0, 1.0], "varies": True}
    ]


def test_the_picture_is_what_mitsuba_would_load(truth, tmp_path):
    """An `envmap` from the truth, without a transform, is the scene's environment."""
    rng = np.random.default_rng(1)
    picture = np.repeat(np.repeat(rng.uniform(0, 2, (8, 16, 3)), 16, 0), 16, 1)
    write_exr(tmp_path / "sky.exr", picture)
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="sphere"/><emitter type="envmap">'
        '<string name="filename" value="sky.exr"/><float name="scale" value="2"/>'
        '<transform name="to_world"><rotate x="1" angle="90"/><rotate z="1" angle="40"/>'
        "</transform></emitter></scene>"
    )
    write_true_lighting(path, truth.parent)
    again = {"type": "envmap", "filename": str(truth / "environment.exr")}
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 4000)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    found = np.array(mi.load_dict(again).eval(si))
    true = np.array(parse(path).instantiate().environment().eval(si))
    assert true.std() > 0.5
    # The picture has sharp edges, which two grids that do not coincide blur.
    assert np.median(np.abs(found - true)) < 0.01
    assert np.abs(found - true).mean() < 0.05


@pytest.mark.parametrize("name", ["environment.exr", "emission.json"])
def test_true_lighting_is_not_read_through_a_link_out_of_the_folder(name, built_in, tmp_path):
    data = tmp_path / "data"
    (data / "truth").mkdir(parents=True)
    write_true_lighting(built_in("still" if name == "environment.exr" else "cornell"), data)
    moved = (data / "truth" / name).rename(tmp_path / name)
    (data / "truth" / name).symlink_to(moved)
    read = true_environment if name == "environment.exr" else true_emission
    with pytest.raises(UserError, match=f"'truth/{name}' lies outside the data folder"):
        read(data)
    assert len(read(data, allow_outside=True))
