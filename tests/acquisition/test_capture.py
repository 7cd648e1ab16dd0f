"""Capture from scene files: truth is what the scene says, and nothing is lost on the way."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest

from unbake.acquisition import capture as module
from unbake.acquisition.capture import capture
from unbake.acquisition.new_light import change_light
from unbake.acquisition.settings import CaptureSettings
from unbake.config.light import LightConfig
from unbake.dataset.camera import LookAt
from unbake.dataset.camera_files import write_camera_file
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.imaging.pictures import read_exr, write_exr
from unbake.io import locked
from unbake.scene.emitters import named_emitters
from unbake.scene.parse import parse, write

SMALL = CaptureSettings(views=2, held_out=1, resolution=24, spp=8, max_depth=6)
OBJECT = """<scene version="3.0.0">
  <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
  <shape type="sphere"><point name="center" x="-1.1" y="0" z="0"/>
    <bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.6 0.3 0.1"/>
      <float name="alpha" value="0.09"/><boolean name="nonlinear" value="true"/></bsdf></shape>
  <shape type="sphere"><point name="center" x="1.1" y="0" z="0"/>
    <bsdf type="dielectric"/></shape>
</scene>
"""
WALL = """<scene version="3.0.0">
  <emitter type="constant"/>
  <shape type="rectangle"><bsdf type="twosided"><bsdf type="principled">
    <texture type="bitmap" name="base_color"><string name="filename" value="paint.exr"/>
      <string name="filter_type" value="nearest"/><boolean name="raw" value="true"/></texture>
    <texture type="bitmap" name="roughness"><string name="filename" value="rough.exr"/>
      <string name="filter_type" value="nearest"/><boolean name="raw" value="true"/></texture>
  </bsdf></bsdf></shape>
</scene>
"""


def front(folder, distance=4.0, split="train"):
    """A camera file with one view along -z."""
    look = LookAt((0, 0, distance), (0, 0, 0), (0, 1, 0), 2 * np.degrees(np.arctan(1 / distance)))
    write_camera_file(folder / "cameras.json", [(split, look)])
    return folder / "cameras.json"


@pytest.fixture
def told():
    return []


def test_the_axis_that_is_up_may_be_given(tmp_path, told, unbake):
    """A ball on a ground with z up, and no sensor that tells so."""
    file = tmp_path / "scene.xml"
    file.write_text(
        """<scene version="3.0.0"><emitter type="constant"/>
        <shape type="sphere"><point name="center" x="0" y="0" z="1"/>
          <bsdf type="principled"/></shape>
        <shape type="rectangle"><transform name="to_world"><scale value="5"/></transform>
          <bsdf type="twosided"><bsdf type="principled"/></bsdf></shape></scene>"""
    )
    lying = capture(file, tmp_path / "lying", TINY, tell=told.append)
    assert lying.views[0].camera.to_world[1, 1] > 0.1
    (line,) = [line for line in told if "--up" in line]
    assert line.startswith("cameras are placed with +y up") and line.endswith("--up +z sets")
    told.clear()
    upright = capture(file, tmp_path / "upright", replace(TINY, up="+z"), tell=told.append)
    assert upright.views[0].camera.to_world[2, 1] > 0.1
    assert upright.views[0].camera.origin[2] > 0
    assert not any("--up" in line for line in told)
    with pytest.raises(UserError, match="--up: cannot be given with a built-in scene"):
        capture("cube", tmp_path / "cube", replace(TINY, up="+z"), tell=told.append)
    with pytest.raises(UserError, match="up: cannot be given with a camera file"):
        capture(file, tmp_path / "both", replace(TINY, up="+z"), cameras=front(tmp_path))
    words = ("--cameras", front(tmp_path), "--up", "+z", "--out", tmp_path / "both")
    outcome = unbake("capture", file, *words)
    assert outcome.status == 2 and "--up" in outcome.err


def test_photographs_of_an_object_show_the_sky_if_asked_to(tmp_path, told):
    file = tmp_path / "scene.xml"
    file.write_text(
        """<scene version="3.0.0">
        <emitter type="constant"><rgb name="radiance" value="0.2, 0.3, 0.5"/></emitter>
        <shape type="sphere"><bsdf type="principled"/></shape></scene>"""
    )
    seen = {}
    for background in ("auto", "visible", "hidden"):
        settings = replace(TINY, background=background, resolution=16)
        data = capture(file, tmp_path / background, settings, tell=told.append)
        picture = read_exr(data.views[0].image)
        corner = picture[0, 0]
        assert data.background == ("visible" if background == "visible" else "hidden")
        assert corner[3] == (1 if background == "visible" else 0)
        seen[background] = corner[:3]
    assert not seen["auto"].any() and not seen["hidden"].any()
    np.testing.assert_allclose(seen["visible"], [0.2, 0.3, 0.5], rtol=1e-3)


@pytest.fixture
def objects(tmp_path, told):
    """An opaque and a glass ball before a sky, captured."""
    sky = 0.2 + np.random.default_rng(0).random((8, 16, 3))
    write_exr(tmp_path / "sky.exr", sky)
    (tmp_path / "scene.xml").write_text(OBJECT)
    look = LookAt((0, 0, 6), (0, 0, 0), (0, 1, 0), 50.0)
    write_camera_file(tmp_path / "cameras.json", [("train", look), ("heldout", look)])
    return capture(
        str(tmp_path / "scene.xml"),
        tmp_path / "data",
        SMALL,
        cameras=tmp_path / "cameras.json",
        tell=told.append,
    )


def test_an_object_stands_before_a_hidden_background(objects, told):
    assert objects.background == "hidden" and "1 BSDF made principled" in told
    assert "left out, as principled has no such property: 'nonlinear' of 1 BSDF" in told
    photograph = read_exr(objects.train[0].image)
    assert np.isfinite(photograph).all()
    assert (photograph[0] == 0).all() and (photograph[:, :2] == 0).all()
    opaque, glass = photograph[12, 6], photograph[12, 17]
    assert opaque[3] == glass[3] == 1
    # Glass shows the sky behind it although the sky itself is hidden
    assert glass[:3].min() > 0.05 and opaque[:3].min() > 0.01


def test_only_what_is_sought_has_truth(objects):
    albedo, roughness = (
        read_exr(p) for p in (objects.train[0].truth["albedo"], objects.train[0].truth["roughness"])
    )
    assert np.allclose(albedo[12, 6], [0.6, 0.3, 0.1, 1], atol=1e-3)
    assert np.allclose(roughness[12, 6], [0.3, 0.3, 0.3, 1], atol=1e-3)
    assert (albedo[12, 17] == 0).all() and (roughness[12, 17] == 0).all()
    assert (albedo[0] == 0).all()


def test_glass_is_kept(objects):
    plugins = [node.props.plugin_name() for node in parse(objects.scene).state.nodes]
    assert plugins.count("dielectric") == 1 and plugins.count("principled") == 1
    assert plugins.count("envmap") == 1 and "roughplastic" not in plugins


def test_bitmap_textures_are_the_truth_pixel_by_pixel(tmp_path):
    rng = np.random.default_rng(2)
    paint, rough = rng.uniform(0.1, 0.9, (8, 8, 3)), rng.uniform(0.2, 0.9, (8, 8))
    write_exr(tmp_path / "paint.exr", paint)
    write_exr(tmp_path / "rough.exr", rough)
    (tmp_path / "scene.xml").write_text(WALL)
    data = capture(
        str(tmp_path / "scene.xml"),
        tmp_path / "data",
        SMALL,
        cameras=front(tmp_path),
        tell=lambda line: None,
    )
    # The wall fills the image, so that each texel covers 3 x 3 pixels; the middle one is pure.
    # v runs upwards, rows run downwards.
    paint, rough = paint[::-1], rough[::-1]
    albedo, roughness = (
        read_exr(p) for p in (data.train[0].truth["albedo"], data.train[0].truth["roughness"])
    )
    assert (albedo[..., 3] == 1).all() and (roughness[..., 3] == 1).all()
    assert np.allclose(albedo[1::3, 1::3, :3], paint, atol=1e-3)
    assert np.allclose(roughness[1::3, 1::3, 0], rough, atol=1e-3)
    names = {p.name for p in (data.scene.parent).rglob("*") if p.is_file()}
    assert names == {"scene.xml", "paint.exr", "rough.exr"}


def test_cameras_that_are_not_square_are_told(objects, tmp_path, told):
    told.clear()
    content = json.loads((objects.folder / "transforms.json").read_text())
    content["frames"][0] |= {"w": 24, "h": 12, "cy": 6}
    (tmp_path / "oblong.json").write_text(json.dumps(content))
    words = {"cameras": tmp_path / "oblong.json", "tell": told.append}
    again = capture(tmp_path / "scene.xml", tmp_path / "again", TINY, **words)
    assert {(view.camera.width, view.camera.height) for view in again.views} == {
        (TINY.resolution,) * 2
    }
    (line,) = (line for line in told if "are square" in line)
    assert "1 cameras of" in line and "fields of view stay" in line


def test_a_sky_that_lies_on_its_side_is_told(tmp_path, told):
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    (tmp_path / "scene.xml").write_text(OBJECT)
    words = {"cameras": front(tmp_path, 6.0), "tell": told.append}
    for axis in ("+y", "+z"):
        light = LightConfig(envmap=tmp_path / "sky.exr", envmap_up=axis)
        capture(tmp_path / "scene.xml", tmp_path / axis, SMALL, light=light, **words)
    (line,) = [line for line in told if "the map's first row" in line]
    assert "lies at +z, while the cameras' up is +y: --envmap-up +y turns it" in line


def test_a_capture_is_the_same_twice_and_another_with_another_seed(tmp_path):
    images = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        settings = CaptureSettings(views=1, held_out=0, resolution=8, spp=4, max_depth=4, seed=seed)
        data = capture("cube", tmp_path / name, settings, tell=lambda line: None)
        images.append(read_exr(data.train[0].image))
    assert np.array_equal(images[0], images[1]) and not np.array_equal(images[0], images[2])


def test_what_is_captured_can_be_loaded_from_anywhere(cornell, tmp_path):
    data = Dataset.load(cornell)
    assert [v.name for v in data.views] == ["train_000", "train_001", "heldout_000"]
    assert all(v.truth["albedo"] and v.truth["roughness"] for v in data.views)
    text = (cornell / "transforms.json").read_text() + data.scene.read_text()
    assert str(cornell.parent) not in text


@pytest.mark.parametrize("failure", [UserError("no"), KeyboardInterrupt(), OSError(28, "full")])
def test_a_capture_that_fails_leaves_nothing(failure, tmp_path, monkeypatch):
    def fail(*words):
        raise failure

    monkeypatch.setattr("unbake.acquisition.capture._truth", fail)
    settings = CaptureSettings(views=1, held_out=0, resolution=4, spp=1)
    with pytest.raises((UserError, KeyboardInterrupt)):
        capture("cube", tmp_path / "new" / "data", settings, tell=lambda line: None)
    assert not list(tmp_path.iterdir())


TINY = CaptureSettings(views=1, held_out=0, resolution=4, spp=1, max_depth=2)


def test_photographs_without_light_are_refused(tmp_path):
    """Of a lamp that looks away, with all that is wrong with values told before."""
    away = """<scene version="3.0.0">
      <shape type="sphere"><bsdf type="diffuse"/></shape>
      <emitter type="spot"><transform name="to_world">
        <lookat origin="0, 4, 0" target="0, 9, 0" up="0, 0, 1"/></transform></emitter>
    </scene>"""
    (tmp_path / "away.xml").write_text(away)
    with pytest.raises(UserError, match=r"away.xml: all photographs are black: no light"):
        capture(str(tmp_path / "away.xml"), tmp_path / "data", TINY, tell=lambda line: None)
    bad = away.replace('"diffuse"/>', '"diffuse"><float name="reflectance" value="2"/></bsdf>')
    bad = bad.replace("</emitter>", '<rgb name="intensity" value="-1"/></emitter>')
    (tmp_path / "bad.xml").write_text(bad)
    with pytest.raises(UserError, match=r"'intensity' of the light.*'base_color' is 2, not"):
        capture(str(tmp_path / "bad.xml"), tmp_path / "data", TINY, tell=lambda line: None)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["away.xml", "bad.xml"]


def test_lamps_of_another_light_have_their_own_names(tmp_path):
    (tmp_path / "scene.xml").write_text(OBJECT)
    (tmp_path / "lamps.xml").write_text(
        """<scene version="3.0.0">
        <shape type="rectangle" id="bulb"><emitter type="area"/></shape>
        <shape type="sphere"><bsdf type="diffuse"/><emitter type="area"/></shape></scene>"""
    )
    (tmp_path / "sky.exr").write_bytes(b"")  # of the light that is replaced
    parsed = parse(tmp_path / "scene.xml")
    change_light(parsed, LightConfig(lights=tmp_path / "lamps.xml"), False, lambda line: None)
    (tmp_path / "copy").mkdir()
    again = parse(write(parsed, tmp_path / "copy"))
    assert [light.name for light in named_emitters(again)] == ["bulb", "area light"]
    assert not [node.props.id() for node in again.state.nodes if "new light" in node.props.id()]


def test_all_that_is_wrong_with_a_scene_is_told_at_once(tmp_path):
    """What its surfaces reflect, what its textures read, and that it is dark."""
    texture = (
        '<texture type="mesh_attribute" name="base_color"><string name="name" '
        'value="vertex_tint"/></texture>'
    )
    (tmp_path / "scene.xml").write_text(
        f"""<scene version="3.0.0"><shape type="cube" id="thing"><bsdf type="principled">{texture}
        <float name="roughness" value="2"/></bsdf></shape></scene>"""
    )
    with pytest.raises(UserError) as caught:
        capture(str(tmp_path / "scene.xml"), tmp_path / "data", SMALL, tell=lambda line: None)
    told = str(caught.value)
    assert "'roughness' is 2, not from 0 to 1" in told
    assert "the shape 'thing' has no 'vertex_tint'" in told
    assert "the scene has no light" in told
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("scene", ["cube", "cbue", "none.xml"])
def test_a_folder_of_the_user_is_left_alone(scene, tmp_path):
    """`data.partial` was deleted, even if the scene's name was misspelt."""
    mine = tmp_path / "data.partial"
    mine.mkdir()
    (mine / "work").write_text("years")
    if scene == "cube":
        capture(scene, tmp_path / "data", TINY, tell=lambda line: None)
    else:
        with pytest.raises(UserError, match="no such scene"):
            capture(scene, tmp_path / "new" / "data", TINY, tell=lambda line: None)
    assert (mine / "work").read_text() == "years"
    left = {"data.partial", "data"} if scene == "cube" else {"data.partial"}
    assert {p.name for p in tmp_path.iterdir()} == left


def test_samples_become_as_many_as_fill_a_grid(tmp_path, told, capfd):
    found = capture("cube", tmp_path / "data", replace(TINY, spp=7), tell=told.append)
    assert found.render["spp"] == 8
    assert "8 samples per pixel instead of 7: they fill a grid" in told
    assert "WARN" not in "".join(capfd.readouterr())  # of Mitsuba, with codes of colours


def test_the_noise_that_is_told_is_that_between_captures(tmp_path, told):
    def image(seed, tell):
        settings = replace(SMALL, views=1, held_out=0, resolution=16, seed=seed)
        data = capture("cornell", tmp_path / str(seed), settings, tell=tell)
        return read_exr(data.views[0].image)[..., :3] @ [0.2126, 0.7152, 0.0722]

    images = np.array([image(seed, told.append if seed == 0 else str) for seed in range(10)])
    found = np.median(images.std(0, ddof=1) / images.mean(0))
    (line,) = [line for line in told if "noise" in line]
    said = float(line.split("pixel is ")[1].split(" %")[0]) / 100
    print(line, found)
    # What independent samples would have; grids have less.
    assert found < said < 1.6 * found


def test_noise_that_hides_materials_is_warned_of(told):
    module._tell_noise(float("nan"), 1, told.append)
    module._tell_noise(0.5, 64, told.append)
    module._tell_noise(2.1, 64, told.append)
    assert told == [
        "the noise of a pixel is 50 % of its light (median)",
        "warning: the noise of a pixel is 210 % of its light (median). "
        "--spp 1200 would bring it to 50 %",
    ]


def test_what_a_killed_capture_has_left_is_told(tmp_path, told):
    left, other = tmp_path / f".data.{'a' * 16}.partial", tmp_path / ".data.mine.partial"
    for folder in (left, other):
        folder.mkdir()
    capture("cube", tmp_path / "data", TINY, tell=told.append)
    assert [line for line in told if "did not finish" in line] == [
        f"an earlier capture did not finish and has left {left}"
    ]
    assert left.is_dir() and other.is_dir()


def test_two_captures_to_one_folder_do_not_both_render(tmp_path, told):
    """What the second one had rendered was lost."""
    live = tmp_path / f".data.{'b' * 16}.partial"
    live.mkdir()
    with locked(live), pytest.raises(UserError, match="another capture to this folder is at work"):
        capture("cube", tmp_path / "data", TINY, tell=told.append)
    assert not told and [p.name for p in tmp_path.iterdir()] == [live.name]


@pytest.mark.parametrize("kind", ["folder", "link"])
def test_a_folder_that_appears_meanwhile_is_not_replaced(kind, tmp_path, monkeypatch):
    out = tmp_path / "data"

    def appear(*words):
        if kind == "folder":
            out.mkdir()
            (out / "mine").write_text("mine")
        else:
            out.symlink_to(tmp_path / "elsewhere")
        return real(*words)

    real = module._truth
    monkeypatch.setattr(module, "_truth", appear)
    with pytest.raises(UserError, match="data: cannot be written"):
        capture("cube", out, TINY, tell=lambda line: None)
    assert [p.name for p in tmp_path.iterdir()] == ["data"]
    assert out.is_symlink() or [p.name for p in out.iterdir()] == ["mine"]


def test_a_link_that_leads_nowhere_is_not_written_through(tmp_path):
    (tmp_path / "data").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="data: exists already"):
        capture("cube", tmp_path / "data", TINY, tell=lambda line: None)
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("place", ["out", "scene"])
def test_a_path_that_is_not_utf8_is_refused(place, tmp_path):
    odd = tmp_path / "d\udcff"
    words = ("cube", odd) if place == "out" else (odd / "scene.xml", tmp_path / "data")
    with pytest.raises(UserError, match=r"the path of the (data folder|scene) is not UTF-8"):
        capture(*words, TINY, tell=lambda line: None)


def test_a_pipe_is_no_scene(tmp_path):
    os.mkfifo(tmp_path / "scene.xml")
    with pytest.raises(UserError, match="it is a pipe or a device"):
        capture(tmp_path / "scene.xml", tmp_path / "data", TINY, tell=lambda line: None)


HALF_OPAQUE = """<scene version="3.0.0">
  <emitter type="point"><point name="position" x="0" y="0" z="2"/>
    <float name="intensity" value="4"/></emitter>
  <shape type="shapegroup" id="leaf"><shape type="rectangle">
    <bsdf type="mask"><float name="opacity" value="{}"/><bsdf type="principled"/></bsdf>
  </shape></shape>
  <shape type="instance"><ref id="leaf"/></shape>
</scene>
"""


def test_a_half_opaque_leaf_is_half_as_bright_as_an_opaque_one(tmp_path):
    """It was a quarter: `path` of Mitsuba 3.9.1 counts opacities twice."""
    settings = CaptureSettings(views=1, held_out=0, resolution=8, spp=1024, max_depth=3)
    images = []
    for opacity in (1.0, 0.5):
        (tmp_path / "scene.xml").write_text(HALF_OPAQUE.format(opacity))
        out, cameras = tmp_path / f"{opacity}", front(tmp_path)
        found = capture(
            str(tmp_path / "scene.xml"), out, settings, cameras=cameras, tell=lambda line: None
        )
        assert found.render["integrator"] == "volpath"
        images.append(read_exr(found.views[0].image))
    opaque, half = images
    assert opaque[..., :3].min() > 0.05
    np.testing.assert_allclose(half.mean((0, 1)), opaque.mean((0, 1)) / 2, rtol=0.02)


def test_the_truth_of_a_blend_is_that_of_the_part_to_fit(tmp_path):
    """It was the mean with what Mitsuba tells of the other: white metal, black glass."""
    blend = '<bsdf type="blendbsdf"><float name="weight" value="0.2"/>{}</bsdf>'
    rough = '<bsdf type="principled"><rgb name="base_color" value="0.6 0.3 0.1"/>'
    rough += '<float name="roughness" value="0.7"/></bsdf>'
    for number, known in enumerate(("roughconductor", "dielectric")):
        for order in (1, -1):
            sides = "".join([rough, f'<bsdf type="{known}"/>'][::order])
            wall = f'<shape type="rectangle">{blend.format(sides)}</shape>'
            text = f'<scene version="3.0.0"><emitter type="constant"/>{wall}</scene>'
            (tmp_path / "scene.xml").write_text(text)
            out, cameras = tmp_path / f"{number} {order}", front(tmp_path)
            found = capture(
                str(tmp_path / "scene.xml"), out, TINY, cameras=cameras, tell=lambda line: None
            )
            albedo, roughness = (read_exr(found.views[0].truth[q]) for q in ("albedo", "roughness"))
            np.testing.assert_allclose(albedo, np.full((4, 4, 4), [0.6, 0.3, 0.1, 1]), atol=1e-3)
            np.testing.assert_allclose(roughness[..., :3], 0.7, atol=1e-3)


ON_A_GROUND = """<scene version="3.0.0">
  <emitter type="constant"/>
  <sensor type="perspective"><transform name="to_world">
    <lookat origin="0, 3, 8" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
  <bsdf type="diffuse" id="grey"/>
  <shape type="cube">{0}</shape>
  <shape type="cube">{0}<transform name="to_world">
    <scale x="20" y="0.005" z="20"/><translate y="-1.005"/></transform></shape>
</scene>
"""


@pytest.mark.parametrize("bsdf", ['<ref id="grey"/>', ""], ids=["one", "none"])
def test_a_ground_of_the_object_s_own_material_does_not_move_its_cameras(bsdf, tmp_path):
    """Mitsuba merges meshes of one BSDF, and the object was a few pixels wide."""
    (tmp_path / "scene.xml").write_text(ON_A_GROUND.format(bsdf))
    found = capture(tmp_path / "scene.xml", tmp_path / "data", TINY, tell=lambda line: None)
    assert found.background == "hidden" and found.coverage > 0.3
    assert max(np.linalg.norm(view.camera.origin) for view in found.views) < 10
