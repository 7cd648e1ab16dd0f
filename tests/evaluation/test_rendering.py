"""New pictures of a recovered scene, under its own light and under another one."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import tiny_fields

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.backend import CUDA_VARIANT
from unbake.config.light import LightConfig
from unbake.dataset.camera import LookAt, up_of
from unbake.dataset.camera_files import read_cameras, write_camera_file
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation.rendering import relight, render
from unbake.evaluation.renderings import METRICS, render_camera, told_noise, told_unit
from unbake.evaluation.settings import RenderSettings
from unbake.evaluation.turntable import turntable
from unbake.imaging.metrics import psnr
from unbake.imaging.pictures import read_exr, tonemap, write_exr, write_png
from unbake.scene import relight as relighting
from unbake.scene.parse import parse
from unbake.training.loop import fit
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder

#: Its materials are those of untrained grids. It has a light of each kind: one that is a shape, one
#: that is none, and an environment.
SCENE = """<scene version="3.0.0">
  <bsdf type="principled" id="grey"><rgb name="base_color" value="0.5"/>
    <float name="roughness" value="{roughness}"/></bsdf>
  <shape type="rectangle"><bsdf type="twosided"><ref id="grey"/></bsdf></shape>
  <shape type="sphere"><ref id="grey"/><float name="radius" value="0.4"/>
    <point name="center" x="0" y="0" z="0.4"/></shape>
  <shape type="rectangle" id="lamp"><emitter type="area"><rgb name="radiance" value="9 3 3"/>
    </emitter><transform name="to_world"><scale value="0.2"/><rotate x="1" angle="180"/>
      <translate x="-0.6" y="-0.6" z="1.4"/></transform></shape>
  <emitter type="point"><rgb name="intensity" value="1 2 1"/>
    <point name="position" x="0.7" y="-0.7" z="1"/></emitter>
  <emitter type="constant"><rgb name="radiance" value="0.1 0.1 0.3"/></emitter>
</scene>
"""
LIGHTS = """<scene version="3.0.0">
  <bsdf type="diffuse" id="grey"/>
  <shape type="sphere" id="lamp"><ref id="grey"/><float name="radius" value="0.1"/>
    <point name="center" x="0.8" y="0.5" z="1.1"/>
    <emitter type="area"><rgb name="radiance" value="20 10 5"/></emitter></shape>
  <shape type="cube" id="box"><bsdf type="diffuse"/></shape>
  <emitter type="directional"><vector name="direction" x="0.3" y="0.3" z="-1"/>
    <rgb name="irradiance" value="0.2 0.4 0.9"/></emitter>
</scene>
"""
SIZE = 16
SILENT = {"tell": lambda line: None}


def sky(path, low=(0.1, 0.15, 0.3)):
    """An environment map with a warm sun halfway up, an eighth of a turn from its middle."""
    pixels = np.full((16, 32, 3), low, np.float32)
    pixels[4:6, 20:22] = (12.0, 9.0, 5.0)
    write_exr(path, pixels)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A data set `data`, and a run `run` of untrained grids, which have the true materials."""
    folder = tmp_path_factory.mktemp("relit")
    (folder / "scene.xml").write_text(SCENE.format(roughness=0.5))
    looks = [LookAt((2.4, -1.5, 1.8), (0, 0, 0.3), (0, 0, 1), 45.0)]
    looks += [LookAt((-1.9, -1.8, 2.2), (0, 0, 0.2), (0, 0, 1), 45.0)]
    views = [("train", looks[0]), ("heldout", looks[1]), ("train", looks[1])]
    write_camera_file(folder / "cameras.json", views)
    small = CaptureSettings(resolution=SIZE, spp=16, max_depth=8)
    scene, file = folder / "scene.xml", folder / "cameras.json"
    capture(scene, folder / "data", small, cameras=file, **SILENT)
    config = replace(tiny_fields("grid"), method="direct", unknown="materials+lighting", steps=0)
    config = replace(config, lighting=replace(config.lighting, resolution=8))
    fit(folder / "data", folder / "run", config)
    (folder / "lights.xml").write_text(LIGHTS)
    sky(folder / "sky.exr")
    return folder


def test_untrained_grids_have_the_materials_of_the_scene(folder):
    materials = load_run(folder / "run").problem.materials
    si = dr.zeros(mi.SurfaceInteraction3f, 4)
    found = materials.evaluate(si, dr.ones(mi.Bool, 4))
    np.testing.assert_allclose(np.array(found["albedo"]), 0.5, atol=1e-3)
    np.testing.assert_allclose(np.array(found["roughness"]), 0.5, atol=0.05)


def test_mitsuba_renders_a_loaded_run_as_it_is(folder, tmp_path):
    loaded = load_run(folder / "run")
    scene, camera = loaded.problem.scene_view.scene, loaded.dataset.heldout[0].camera
    sensor, integrator = mi.load_dict(camera.sensor(256)), mi.load_dict({"type": "path"})
    stock = np.array(mi.render(scene, sensor=sensor, integrator=integrator, seed=3))[..., :3]
    settings = RenderSettings(spp=256)
    ours = render_camera(loaded.problem.scene_view, camera, settings, hide_emitters=False)
    assert ours.mean() > 0.05
    # Within noise, and far from what black materials would show
    np.testing.assert_allclose(stock.mean((0, 1)), ours.mean((0, 1)), rtol=0.02)
    assert psnr(np.minimum(stock, 1), np.minimum(ours, 1)) > 28
    # A fit beside it is recorded and replayed as ever, and leaves the loaded run as it is.
    config = replace(tiny_fields(), method="prb", steps=4, score_seconds=0.0)
    beside = fit(folder / "data", tmp_path / "beside", config)
    assert beside.step == 4 and not loaded.problem.materials.carried
    again = np.array(mi.render(scene, sensor=sensor, integrator=integrator, seed=3))[..., :3]
    np.testing.assert_allclose(again, stock, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "options",
    [
        {"envmap": "sky.exr", "envmap_up": "+z", "envmap_rotate": 70.0, "envmap_scale": 2.0},
        {"lights": "lights.xml"},
        pytest.param({"lights": "lights.xml", "keep_lights": True}, marks=pytest.mark.slow),
    ],
)
def test_true_materials_relit_are_a_capture_under_that_light(options, folder, tmp_path):
    files = {k: folder / v for k, v in options.items() if k in ("envmap", "lights")}
    light = LightConfig(**options | files)
    if light.keep_lights:  # the environment is unknown in `run`, and untrained
        config = replace(tiny_fields("grid"), method="direct", steps=0)
        fit(folder / "data", tmp_path / "run", config)
    run = tmp_path / "run" if light.keep_lights else folder / "run"
    truth, lines = tmp_path / "truth", []
    # Lamps that are added to others leave more noise.
    spp = 4096 if light.keep_lights else 1024
    more = CaptureSettings(resolution=SIZE, spp=spp, max_depth=8)
    scene, cameras = folder / "scene.xml", folder / "cameras.json"
    capture(scene, truth, more, cameras=cameras, light=light, **SILENT)
    settings = RenderSettings(spp=spp, max_depth=8, views="all")
    made = relight(run, tmp_path / "out", light, settings, truth=truth, tell=lines.append)
    print([frame["render_psnr"] for frame in made["frames"]])
    assert [frame["name"] for frame in made["frames"]] == ["train_000", "heldout_000", "train_001"]
    assert all(frame["render_psnr"] > 38 for frame in made["frames"])
    assert made["mean"]["views"] == 3 and made["mean"]["render_psnr"] > 38
    assert made["mean"]["render_ssim"] > 0.9 and made["mean"]["render_flip"] < 0.1
    assert any("turned off 3 lights" in line for line in lines) is not light.keep_lights
    assert not any("warning" in line for line in lines)
    before, after = (Dataset.load(folder / d).train[0].image for d in ("data", truth))
    assert np.abs(read_exr(before) - read_exr(after))[..., :3].mean() > 0.02
    if light.lights is not None:
        assert any("left out 1 shapes that emit no light" in line for line in lines)


def test_scores_do_not_depend_on_the_exposure_of_the_png_files(folder, tmp_path):
    light, found = LightConfig(envmap=folder / "sky.exr"), []
    for exposure in (0.0, 3.0):
        settings = RenderSettings(spp=4, max_depth=3, exposure=exposure)
        out = tmp_path / f"out-{exposure}"
        made = relight(folder / "run", out, light, settings, truth=folder / "data", **SILENT)
        found.append((made["mean"], made["display_exposure"]))
    assert found[0] == found[1]


def test_negative_pixels_of_the_truth_are_taken_as_zero_where_that_is_asked_for(folder, tmp_path):
    light, settings = LightConfig(envmap=folder / "sky.exr"), RenderSettings(spp=1, max_depth=2)
    truth = shutil.copytree(folder / "data", tmp_path / "truth", ignore=lambda *_: [".cache"])
    for image in (truth / "images").iterdir():
        write_exr(image, -1 - read_exr(image))
    words = (folder / "run", tmp_path / "out", light, settings)
    with pytest.raises(UserError, match="Pass --clip-negative"):
        relight(*words, truth=truth, **SILENT)
    assert relight(*words, truth=truth, clip_negative=True, **SILENT)["mean"]["views"]


@pytest.mark.parametrize("scale", [0.2, 6.0])
def test_pictures_are_aligned_where_the_fit_left_their_brightness_open(scale, folder, tmp_path):
    """Also where they are brighter than white, and the truth is not."""
    truth, light = tmp_path / "truth", LightConfig(envmap=folder / "sky.exr", envmap_scale=scale)
    more = CaptureSettings(resolution=SIZE, spp=128, max_depth=4)
    scene, cameras = folder / "scene.xml", folder / "cameras.json"
    capture(scene, truth, more, cameras=cameras, light=light, **SILENT)
    settings = RenderSettings(spp=128, max_depth=4)
    brighter = replace(light, envmap_scale=2 * scale)
    made = relight(folder / "run", tmp_path / "out", brighter, settings, truth=truth, **SILENT)
    (frame,) = made["frames"]
    np.testing.assert_allclose(made["render_scale"], 0.5, rtol=0.02)
    assert frame["render_psnr_aligned"] > frame["render_psnr"] + 6 > 12
    assert made["mean"]["render_psnr_aligned"] == pytest.approx(frame["render_psnr_aligned"])
    assert "render_psnr_aligned" in made["definitions"]
    known = replace(tiny_fields("grid"), method="direct", steps=0)
    fit(folder / "data", tmp_path / "known", known)
    made = relight(tmp_path / "known", tmp_path / "more", light, settings, truth=truth, **SILENT)
    assert not any("aligned" in key for key in (*made["frames"][0], *made["mean"], *made))


def test_pixels_that_are_not_finite_are_left_out_and_told(folder, tmp_path, monkeypatch):
    """Also where they are the brightest ones, which says nothing of a black picture."""

    def broken(*words):
        picture = render_camera(*words)
        picture[SIZE // 2, SIZE // 2] = np.nan
        return picture

    monkeypatch.setattr("unbake.evaluation.rendering.render_camera", broken)
    light, settings = LightConfig(envmap=folder / "sky.exr"), RenderSettings(spp=4, max_depth=3)
    lines: list[str] = []
    words = (folder / "run", tmp_path / "out", light, settings)
    made = relight(*words, truth=folder / "data", tell=lines.append)
    (frame,) = made["frames"]
    assert frame["not_finite"] == 1 and frame["render_psnr"] > 0
    assert np.isfinite(made["render_scale"]).all() and frame["render_psnr_aligned"] > 0
    assert any(line.endswith("1 pixel is not finite and left out") for line in lines)
    assert not any("all pictures are black" in line for line in lines)


def test_scores_need_more_memory_than_pictures(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("unbake.evaluation.rendering._SCORED_BYTES", 1e15)
    light, settings = LightConfig(envmap=folder / "sky.exr"), RenderSettings(spp=1, max_depth=2)
    words = (folder / "run", tmp_path / "out", light, settings)
    with pytest.raises(UserError, match=r"a picture and its scores need about .* of memory"):
        relight(*words, truth=folder / "data", **SILENT)
    relight(*words, **SILENT)


def test_another_light_than_that_of_the_truth_scores_less(folder, tmp_path):
    settings = RenderSettings(spp=64, max_depth=8)
    light = LightConfig(envmap=folder / "sky.exr")
    lines = []
    made = relight(
        folder / "run", tmp_path / "out", light, settings, truth=folder / "data", tell=lines.append
    )
    assert made["mean"]["render_psnr"] < 25 and made["mean"]["render_flip"] > 0.1
    assert any("--envmap-up +z turns it" in line for line in lines)
    assert any("data was captured under the scene's own light" in line for line in lines)


def test_a_truth_of_other_settings_or_of_another_scene_is_told(folder, cornell, tmp_path):
    truth, lines = tmp_path / "truth", []
    more = CaptureSettings(resolution=8, spp=4, max_depth=2)
    light = LightConfig(envmap=folder / "sky.exr", envmap_rotate=40.0)
    scene, cameras = folder / "scene.xml", folder / "cameras.json"
    capture(scene, truth, more, cameras=cameras, light=light, **SILENT)
    other, settings = replace(light, envmap_rotate=90.0), RenderSettings(spp=4, max_depth=2)
    relight(folder / "run", tmp_path / "out", other, settings, truth=truth, tell=lines.append)
    assert any("truth was captured under another light: envmap_rotate 40.0" in x for x in lines)
    words = (folder / "run", tmp_path / "second", light, settings)
    with pytest.raises(UserError, match=r"is of another scene than the run: they span .* around"):
        relight(*words, truth=cornell, **SILENT)
    assert not (tmp_path / "second").exists()


def test_recovered_lights_are_kept_where_that_is_asked(folder, tmp_path):
    """An untrained environment is no longer there, and recovered strengths stay."""
    config = replace(tiny_fields("grid"), method="direct", unknown="emission", steps=0)
    fit(folder / "data", tmp_path / "run", config)
    black = np.full((4, 8, 3), 1e-8, np.float32)
    write_exr(tmp_path / "night.exr", black)
    means = {}
    for keep in (False, True):
        light = LightConfig(envmap=tmp_path / "night.exr", keep_lights=keep)
        settings = RenderSettings(spp=16, max_depth=4)
        relight(tmp_path / "run", tmp_path / f"out-{keep}", light, settings, **SILENT)
        means[keep] = read_exr(tmp_path / f"out-{keep}" / "heldout_000.exr").mean()
    assert means[False] < 1e-6 and means[True] > 1e-3
    # Others are put into the scene beside the recovered ones, which are as many as they were.
    light = LightConfig(lights=folder / "lights.xml", keep_lights=True)
    relight(tmp_path / "run", tmp_path / "out-more", light, settings, **SILENT)
    assert read_exr(tmp_path / "out-more" / "heldout_000.exr").mean() > means[True]


# ------------------------------------------------------------------------------------------- output


def test_views_are_rendered_and_their_cameras_can_be_read_again(folder, tmp_path, unbake):
    run, out = folder / "run", tmp_path / "out"
    words = ("--spp", 4, "--max-depth", 4, "--exposure", 1)
    outcome = unbake("render", run, "--out", out, *words)
    assert outcome.status == 0 and outcome.err == ""
    assert f"wrote {out}: 1 pictures" in outcome.out
    assert sorted(p.name for p in out.iterdir()) == [
        "heldout_000.exr", "heldout_000.png", "render.json"
    ]  # fmt: skip
    linear = read_exr(out / "heldout_000.exr")
    shown = np.array(mi.Bitmap(str(out / "heldout_000.png")))
    assert np.array_equal(shown, tonemap(linear, 1.0)) and linear.shape == (SIZE, SIZE, 3)
    ((split, camera),) = read_cameras(out / "render.json", SIZE, SIZE)
    (view,) = Dataset.load(folder / "data").heldout
    np.testing.assert_allclose(camera.to_world, view.camera.to_world, atol=1e-9)
    assert split == "heldout" and camera.fl_x == pytest.approx(view.camera.fl_x)

    again = tmp_path / "again"
    cameras = ("--cameras", out / "render.json", "--width", 8)
    assert unbake("render", run, "--out", again, *words, *cameras).status == 0
    assert read_exr(again / "heldout_000.exr").shape == (8, 8, 3)


def test_a_camera_file_keeps_its_sizes(folder, tmp_path):
    settings = RenderSettings(spp=1, max_depth=2, height=4)
    file = folder / "data" / "transforms.json"
    made = render(folder / "run", tmp_path / "out", settings, cameras=file, **SILENT)
    assert [(f["name"], f["w"], f["h"]) for f in made["frames"]] == [
        ("train_000", 4, 4), ("heldout_000", 4, 4), ("train_001", 4, 4)
    ]  # fmt: skip


def test_pictures_have_the_names_of_a_camera_file(folder, tmp_path):
    """Whatever the order in the file."""
    content = json.loads((folder / "data" / "transforms.json").read_text())
    first, second, third = content["frames"]
    content["frames"] = [third | {"name": "window"}, second, first]
    file, out = tmp_path / "cameras.json", tmp_path / "out"
    file.write_text(json.dumps(content))
    settings = RenderSettings(spp=1, max_depth=2, height=4)
    made = render(folder / "run", out, settings, cameras=file, **SILENT)
    poses = {frame["name"]: frame["transform_matrix"] for frame in made["frames"]}
    assert list(poses) == ["window", "heldout_000", "train_000"]
    for name, frame in (("window", third), ("heldout_000", second), ("train_000", first)):
        np.testing.assert_allclose(poses[name], frame["transform_matrix"], atol=1e-9)
        assert (out / f"{name}.exr").is_file()
    content["frames"][1]["name"] = "window"
    file.write_text(json.dumps(content))
    with pytest.raises(UserError, match="several cameras have the same name: 'window'"):
        render(folder / "run", tmp_path / "again", settings, cameras=file, **SILENT)
    assert not (tmp_path / "again").exists()


def test_a_turntable_is_a_numbered_sequence(folder, tmp_path, unbake):
    words = ("--turntable", 3, "--spp", 2, "--max-depth", 2, "--width", 6, "--height", 4)
    light = ("--lights", folder / "lights.xml")
    outcome = unbake("relight", folder / "run", "--out", tmp_path / "out", *words, *light)
    assert outcome.status == 0, outcome.err
    assert "turntable: a circle of radius" in outcome.out
    names = sorted(p.name for p in (tmp_path / "out").glob("*.png"))
    assert names == [f"turntable_00{i}.png" for i in range(3)]
    made = json.loads((tmp_path / "out" / "render.json").read_text())
    assert made["cameras"]["kind"] == "turntable, circle" and made["mean"] is None
    assert made["light"]["lights"] == str(folder / "lights.xml")
    np.testing.assert_allclose(made["cameras"]["up"], [0, 0, 1], atol=0.2)


def test_black_pictures_are_told(folder, tmp_path):
    """A sun below the slab, and no light above it."""
    dark = '<scene version="3.0.0"><emitter type="directional"><vector name="direction" z="1"/>'
    dark = dark.replace('z="1"', 'x="0" y="0" z="0.001"')
    (tmp_path / "dark.xml").write_text(
        dark + '<rgb name="irradiance" value="0"/></emitter></scene>'
    )
    lines = []
    light = LightConfig(lights=tmp_path / "dark.xml")
    settings = RenderSettings(spp=2, max_depth=2)
    made = relight(folder / "run", tmp_path / "out", light, settings, tell=lines.append)
    assert made["notes"] and any(line.startswith("note: all pictures are black") for line in lines)


# ---------------------------------------------------------------------------------------- bad input


def broken(folder, kind):
    """A file that is no environment map."""
    pixels = np.ones((4, 8, 3), np.float32)
    if kind == "png":
        path = folder / "sky.png"
        mi.Bitmap((255 * pixels).astype(np.uint8)).write(str(path))
        return path
    pixels[1, 2] = {"nan": np.nan, "negative": -1.0}.get(kind, 1.0)
    if kind == "black":
        pixels[:] = 0
    write_exr(folder / "sky.exr", pixels)
    if kind == "cut":
        data = (folder / "sky.exr").read_bytes()
        (folder / "sky.exr").write_bytes(data[: len(data) // 2])
    return folder / ("none.exr" if kind == "missing" else "sky.exr")


@pytest.mark.parametrize(
    ("kind", "told"),
    [
        ("missing", "does not exist"),
        ("png", "no environment map can be read from '.png'"),
        ("nan", "1 pixels of the environment map are NaN or infinite"),
        ("negative", "1 pixels of the environment map are negative"),
        ("black", "the environment map is black"),
        ("cut", "cannot be read"),
    ],
)
def test_what_is_no_environment_map_is_refused(kind, told, tmp_path):
    with pytest.raises(UserError, match=told):
        relighting.check_environment(broken(tmp_path, kind))


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((), "no light given. Give --envmap FILE or --lights FILE"),
        (("--envmap", "a.exr", "--lights", "b.xml"), "--lights: cannot be given together"),
        (("--envmap", "none.exr"), "--envmap: there is no file none.exr. Check the path"),
        (("--lights", "none.xml"), "--lights: there is no file none.xml. Check the path"),
        (("--lights", "dark.xml"), "dark.xml: no light in the file"),
        (("--lights", "dark.xml", "--envmap-scale", 2), "--envmap-scale: needs --envmap"),
        (
            ("--lights", "dark.xml", "--views", "all", "--turntable", 3),
            "--views: cannot be given together with --turntable",
        ),
        (("--envmap", "a.exr", "--envmap-scale", 0), "--envmap-scale: must be"),
        (("--envmap", "a.exr", "--turntable", 0), "--turntable: must be from 1"),
        (("--envmap", "a.exr", "--turntable", 2, "--cameras", "c"), "--cameras: cannot be given"),
        (
            ("--envmap", "a.exr", "--truth", "none"),
            "a.exr. Check the path; --truth: there is no folder none. Check the path",
        ),
        (("--envmap", "a.exr", "--spp", 0), "--spp: must be 1 or more"),
        (("--envmap", "a.exr", "--height", 0), "--height: must be 1 or more"),
        (
            ("--envmap", "a.exr", "--spp", 0, "--width", 0, "--height", -1),
            "--spp: must be 1 or more, not 0; --width: must be 1 or more, not 0; --height: must be",
        ),
        (
            ("--lights", "none.xml", "--turntable", -1, "--cameras", "c", "--out", "full"),
            "Give another --out, or empty it; --cameras: cannot be given together with --turntable",
        ),
        (("--envmap", "a.exr", "--out", "full"), "full: the folder is not empty"),
    ],
)
def test_a_wrong_option_is_named(words, told, folder, unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "kept").write_text("")
    (tmp_path / "dark.xml").write_text('<scene version="3.0.0"><shape type="cube"/></scene>')
    given = () if "--out" in words else ("--out", "out")
    outcome = unbake("relight", folder / "run", *given, *words)
    assert outcome.status == 2 and outcome.err.startswith("error: "), outcome
    assert told in outcome.err.replace("\n", " ") and outcome.err.count("\n") == 1
    assert not (tmp_path / "out").exists() and not list(tmp_path.glob(".*"))


def test_no_denoiser_is_told(folder, tmp_path):
    if mi.variant() == CUDA_VARIANT:
        pytest.skip("it is there")
    with pytest.raises(UserError, match="denoiser needs an NVIDIA GPU"):
        render(folder / "run", tmp_path / "out", RenderSettings(denoise=True))


@pytest.mark.gpu
def test_denoised_pictures_are_nearer_to_clean_ones(folder, tmp_path):
    pictures = {}
    for name, spp, denoise in (("noisy", 4, False), ("denoised", 4, True), ("clean", 1024, False)):
        settings = RenderSettings(spp=spp, denoise=denoise, width=64)
        render(folder / "run", tmp_path / name, settings, **SILENT)
        pictures[name] = read_exr(tmp_path / name / "heldout_000.exr")
    error = {k: np.square(v - pictures["clean"]).mean() for k, v in pictures.items()}
    assert error["denoised"] < 0.5 * error["noisy"]


# ------------------------------------------------------------------------------------- their parts


@pytest.mark.parametrize("axis", ["+x", "-x", "+y", "-y", "+z", "-z"])
def test_the_first_row_of_a_map_lies_at_the_axis_that_is_up(axis, folder, tmp_path):
    pixels = np.zeros((17, 32, 3), np.float32)
    pixels[0] = 1.0
    write_exr(tmp_path / "up.exr", pixels)
    scene = parse(folder / "scene.xml")
    relighting.turn_off(scene)
    up = LightConfig(envmap=tmp_path / "up.exr", envmap_up=axis).up
    relighting.put_environment(scene, tmp_path / "up.exr", 3.0, up, 0.7)
    emitter = scene.instantiate().environment()
    for sign in (1, -1):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -sign * mi.Vector3f(*up)
        assert np.ravel(emitter.eval(si))[0] == pytest.approx(3.0 if sign > 0 else 0, abs=1e-3)


def test_maps_turn_counterclockwise_as_seen_from_above():
    turned = relighting._rotation((0, 0, 1), np.pi / 2) @ relighting._rotation((0, 0, 1), 0).T
    np.testing.assert_allclose(turned[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    for up in ((0, 1, 0), (0, -1, 0), (-1, 0, 0)):
        matrix = relighting._rotation(up, 0.3)[:3, :3]
        np.testing.assert_allclose(matrix @ [0, 1, 0], up, atol=1e-12)
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1)


def test_turned_off_shapes_stay_and_emit_nothing(folder):
    scene = parse(folder / "scene.xml")
    assert relighting.turn_off(scene) == 3
    relighting.put_lights(scene, folder / "lights.xml")
    made = scene.instantiate(merge=False)
    lamps = [shape for shape in made.shapes() if shape.is_emitter()]
    assert len(lamps) == 2 and len(made.emitters()) == 3 and made.environment() is None
    radiance = {mi.traverse(lamp.emitter())["radiance.value"].numpy().max() for lamp in lamps}
    assert radiance == {0.0, 20.0}


def ring(count, height, radius, pitch_to=0.0, turn=0.0):
    """Cameras on a circle that look at a point of its axis."""
    angles = turn + 2 * np.pi * np.arange(count) / count
    places = [(radius * np.cos(a), radius * np.sin(a), height) for a in angles]
    return [LookAt(p, (0, 0, pitch_to), (0, 0, 1), 50.0).camera(8, 8) for p in places]


@pytest.mark.parametrize("cameras", [ring(7, 2.0, 3.0), ring(9, 0.5, 2.0)[:3], ring(1, 0.2, 3.0)])
def test_the_upward_direction_is_that_of_the_cameras(cameras):
    assert up_of(cameras) @ [0, 0, 1] > 0.99


def test_a_circle_is_where_the_cameras_were(folder):
    scene = parse(folder / "scene.xml").instantiate()
    table = turntable(scene, ring(8, 1.5, 2.5, 0.3), 6, 12, 8, room=False)
    assert table.kind == "circle" and len(table.cameras) == 6
    np.testing.assert_allclose(table.centre, [0, 0, 0.3], atol=1e-6)
    assert table.radius == pytest.approx(2.5)
    origins = np.array([camera.origin for camera in table.cameras])
    np.testing.assert_allclose(origins[:, 2], 1.5, atol=1e-6)
    np.testing.assert_allclose(origins[0], [2.5, 0, 1.5], atol=1e-6)
    assert (table.cameras[0].width, table.cameras[0].height) == (12, 8)
    for camera in table.cameras:
        to_centre = table.centre - camera.origin
        assert -camera.to_world[:3, 2] @ to_centre == pytest.approx(np.linalg.norm(to_centre))


def boxed(size, pillar):
    """A closed box from -1 to 1, with a pillar in the middle."""
    scene = {
        "type": "scene",
        "box": {"type": "cube", "flip_normals": True},
        "pillar": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().scale([pillar, pillar, 1]),
        },
        "light": {"type": "point", "position": [0.9, 0.9, 0.9]},
    }
    return mi.load_dict(scene), ring(5, 0.0, size)


def test_a_circle_in_a_room_shrinks_until_it_is_free():
    scene, cameras = boxed(1.1, 0.1)  # cameras in the walls; one that stands inside sees the circle
    cameras += ring(4, 0.0, 0.6)
    table = turntable(scene, cameras, 4, 8, 8, room=True)
    radii = [np.linalg.norm(camera.origin[:2]) for camera in table.cameras]
    assert table.kind == "circle" and 0.2 < max(radii) < 0.9


def test_a_room_without_a_free_circle_is_seen_from_one_place():
    scene, cameras = boxed(0.8, 0.6)
    table = turntable(scene, cameras, 8, 8, 8, room=True)
    assert table.kind == "pan" and table.radius == 0
    origins = {tuple(camera.origin) for camera in table.cameras}
    assert len(origins) == 1 and origins <= {tuple(camera.origin) for camera in cameras}
    ahead = np.array([-camera.to_world[:3, 2] for camera in table.cameras])
    np.testing.assert_allclose(ahead.sum(0), 0, atol=1e-9)
    with pytest.raises(UserError, match="no circle around the scene is free"):
        turntable(scene, cameras, 8, 8, 8, room=False)


def test_a_light_file_must_not_leave_its_folder(folder, tmp_path):
    light = '<scene version="3.0.0"><emitter type="envmap"><string name="filename" value="{}"/>'
    (tmp_path / "lights").mkdir()
    shutil.copy(folder / "sky.exr", tmp_path)
    file = tmp_path / "lights" / "lights.xml"
    file.write_text(light.format("../sky.exr") + "</emitter></scene>")
    with pytest.raises(UserError, match="outside"):
        relighting.put_lights(parse(folder / "scene.xml"), file)
    scene = parse(folder / "scene.xml")
    relighting.put_lights(scene, file, tmp_path)
    # The environment of the file has taken the place of the scene's own.
    assert len(scene.instantiate().emitters()) == 3


def test_renderings_of_few_samples_are_told_to_be_noise():
    assert "of 4 samples a pixel: raise --spp" in (told_noise(4) or "")
    assert told_noise(16) is told_noise(64) is None


@pytest.mark.parametrize(
    ("exposure", "told"), [(None, None), (2.9, None), (9.6, "darker"), (-10.0, "brighter")]
)
def test_photographs_far_from_white_are_told(exposure, told):
    line = told_unit(exposure)
    assert line is None if told is None else f"are far {told} than white" in line


def test_evaluate_tells_that_photographs_are_far_from_white(unbake, folder, tmp_path):
    data = shutil.copytree(folder / "data", tmp_path / "data")
    for image in (data / "images").glob("*.exr"):
        write_exr(image, 1e4 * read_exr(image))
    config = replace(tiny_fields("grid"), method="direct", steps=0)
    fit(data, tmp_path / "run", config)
    outcome = unbake("evaluate", tmp_path / "run", "--spp", 2, "--train-views", 0)
    assert outcome.status == 0 and outcome.err == ""
    assert "note: photographs are far brighter than white, 1: render_psnr says" in outcome.out


def test_relit_pictures_that_are_far_from_white_are_told(folder, tmp_path):
    light = LightConfig(envmap=folder / "sky.exr", envmap_scale=1e5)
    more = CaptureSettings(resolution=SIZE, spp=4, max_depth=3)
    scene, cameras = folder / "scene.xml", folder / "cameras.json"
    capture(scene, tmp_path / "truth", more, cameras=cameras, light=light, **SILENT)
    settings = RenderSettings(spp=4, max_depth=3)
    out, truth = tmp_path / "out", tmp_path / "truth"
    made = relight(folder / "run", out, light, settings, truth=truth, **SILENT)
    (note,) = (note for note in made["notes"] if "render_psnr says little" in note)
    assert note.startswith("photographs are far brighter than white")


def test_evaluate_tells_the_factors_that_albedo_is_aligned_by(unbake, folder):
    outcome = unbake("evaluate", folder / "run", "--spp", 2, "--max-depth", 3, "--train-views", 0)
    (line,) = [line for line in outcome.out.splitlines() if "is aligned by the factors" in line]
    scale = RunFolder(folder / "run").metrics()["albedo_scale"]
    # Grids have the materials of the scene, which are grey.
    assert scale == pytest.approx([1, 1, 1], abs=0.01)
    told = "albedo is aligned by the factors 1.00 1.00 1.00 (red, green, blue)"
    assert line.strip() == told, line


def mask_all(data, name):
    """Mask all of a view, so that no pixel of it is scored."""
    write_png(data / "black.png", np.zeros((SIZE, SIZE, 3), np.uint8))
    file = data / "transforms.json"
    transforms = json.loads(file.read_text())
    for frame in transforms["frames"]:
        if Path(frame["file_path"]).stem == name:
            frame["mask_path"] = "black.png"
    file.write_text(json.dumps(transforms))


def test_evaluate_tells_of_how_many_views_means_are(unbake, folder, tmp_path):
    data = shutil.copytree(folder / "data", tmp_path / "data")
    run = tmp_path / "run"
    fit(data, run, replace(tiny_fields("grid"), method="direct", steps=0))
    words = ("--spp", 2, "--max-depth", 3)
    outcome = unbake("evaluate", run, *words)
    assert outcome.status == 0 and " of 2 views)" not in outcome.out
    assert "scored" not in RunFolder(run).metrics()
    mask_all(data, "train_001")
    outcome = unbake("evaluate", run, *words)
    assert outcome.status == 0, outcome.err
    (line,) = [line for line in outcome.out.splitlines() if line.startswith("train (2 views): ")]
    assert re.search(r" render_psnr \S+ dB \(1 of 2 views\), .* albedo_psnr \S+ dB \(1 of", line)
    metrics = RunFolder(run).metrics()
    assert metrics["train"]["views"] == 2 and "scored" in metrics["definitions"]
    keys = (*METRICS, "albedo_psnr", "roughness_psnr")
    assert metrics["scored"] == {"train": dict.fromkeys(keys, 1)}


def test_relight_tells_of_how_many_views_means_are(unbake, folder, tmp_path):
    truth = shutil.copytree(folder / "data", tmp_path / "truth")
    mask_all(truth, "train_001")
    words = ("--envmap", folder / "sky.exr", "--truth", truth, "--views", "all")
    out = tmp_path / "out"
    outcome = unbake("relight", folder / "run", "--out", out, *words, "--spp", 2)
    assert outcome.status == 0, outcome.err
    assert re.search(r"mean over 3 views: render_psnr \S+ dB \(2 of 3 views\), ", outcome.out)
    made = json.loads((out / "render.json").read_text())
    scored = dict.fromkeys((*METRICS, "render_psnr_aligned"), 2)
    assert made["mean"]["views"] == 3 and made["scored"] == scored
