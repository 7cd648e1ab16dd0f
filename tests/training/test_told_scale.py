"""Whether photographs tell the scale between albedo and light, and what holds it otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from support import TINY_FIT, built_in_cameras, on_ranks, tiny_fields, with_more

from unbake.config import LightingConfig
from unbake.dataset.camera import Camera
from unbake.dataset.pixels import PixelSource
from unbake.dataset.views import Dataset, View
from unbake.imaging.pictures import write_exr, write_png
from unbake.ranks import Ranks
from unbake.scene import free_space
from unbake.training.problem import make_problem, pixels_of
from unbake.training.regularizers import is_anchored
from unbake.training.sharing import kept_whole
from unbake.training.step import TrainingStep
from unbake.training.told_scale import conventional_albedo, shows_light, weigh_convention

SIZE = 8
BOTH = replace(TINY_FIT, unknown="materials+lighting")
LAMP = '<emitter type="point"><rgb name="intensity" value="1"/></emitter>'
MIRROR = """<shape type="sphere"><point name="center" value="0,0,0.9"/>
    <float name="radius" value="0.3"/><bsdf type="conductor"/></shape>"""


@pytest.fixture
def still(built_in):
    return built_in("still")


def lighting(**settings):
    return LightingConfig(resolution=8, **settings)


def surfaces(problem, cameras):
    """Whether pixels show a surface, (n,) bool."""
    size = cameras[0].width * cameras[0].height
    row, column = np.divmod(np.arange(size), cameras[0].width)
    each = [camera.rays(column + 0.5, row + 0.5) for camera in cameras]
    rays = [np.concatenate(parts) for parts in zip(*each, strict=True)]
    return np.isfinite(free_space.trace(problem.scene_view.scene, *rays).distance)


def begun(scene, background, config, *, masked):
    """The problem of a fit to photographs that show whatever there is, or surfaces alone."""
    problem, cameras = make_problem(scene, background, config, 0.2), built_in_cameras("still", SIZE)
    counted = surfaces(problem, cameras) if masked else np.ones(SIZE * SIZE, bool)
    assert 0.2 < surfaces(problem, cameras).mean() < 1
    rgb = np.full((len(counted), 3), 0.2)
    pixels = PixelSource.of(cameras, rgb, counted.astype(float), foreground_only=masked)
    TrainingStep(problem, pixels, config)
    return problem


@pytest.mark.parametrize(
    ("background", "masked", "mirror", "told"),
    [
        ("visible", False, False, True),
        ("visible", True, False, False),
        ("visible", True, True, True),
        ("hidden", True, False, False),
        ("hidden", True, True, True),
        ("hidden", False, False, False),
    ],
)
def test_the_scale_is_told_where_counted_pixels_show_the_environment(
    background, masked, mirror, told, still
):
    scene = with_more(still, MIRROR) if mirror else still
    config = replace(BOTH, lighting=lighting())
    problem = begun(scene, background, config, masked=masked)
    assert problem.shows_light is told
    assert is_anchored(problem, config) is not told


@pytest.mark.parametrize(
    ("done", "weight"), [(0.0, 2.0), (0.1, 2.0), (0.3, 0.2), (0.5, 0.02), (0.7, 0.02), (1.0, 0.02)]
)
def test_the_convention_loses_its_weight_in_the_first_half_of_a_fit(done, weight, still):
    config = replace(BOTH, lighting=lighting(anchor=2.0, final_anchor=0.02))
    problem = make_problem(still, "hidden", config, 0.2)
    weigh_convention(problem, config, done)
    assert problem.anchor == pytest.approx(weight)
    known = make_problem(still, "hidden", replace(config, unknown="materials"), 0.2)
    weigh_convention(known, replace(config, unknown="materials"), done)
    assert known.anchor is None


@pytest.mark.parametrize(("background", "anchored"), [("visible", False), ("hidden", True)])
def test_earlier_fits_go_by_the_background(background, anchored, still):
    config = replace(BOTH, lighting=lighting(scale_told_by="background"))
    problem = begun(still, background, config, masked=True)
    assert problem.shows_light is None
    assert is_anchored(problem, config) is anchored


@pytest.mark.parametrize("unknown", ["materials", "lighting"])
def test_nobody_looks_where_no_scale_is_open(unknown, still):
    config = replace(BOTH, unknown=unknown, lighting=lighting())
    problem = begun(still, "visible", config, masked=False)
    assert problem.shows_light is None and not is_anchored(problem, config)


@pytest.mark.parametrize(
    ("background", "masked", "more", "change", "whole"),
    [
        ("visible", False, "", {}, False),
        ("visible", True, "", {}, True),
        ("visible", True, LAMP, {}, False),
        ("visible", True, "", {"anchor": 0.0}, False),
        ("visible", True, "", {"scale_told_by": "background"}, False),
        ("hidden", True, "", {}, True),
    ],
)
def test_processes_that_may_hold_the_mean_albedo_read_all_photographs(
    background, masked, more, change, whole, still, tmp_path
):
    scene = with_more(still, more)
    config = replace(tiny_fields(), unknown="materials+lighting", lighting=lighting(**change))
    cameras = built_in_cameras("still", SIZE, 2)
    seen = surfaces(make_problem(scene, background, config, 0.2), cameras)
    views = []
    for number, part in enumerate(seen.reshape(2, SIZE, SIZE)):
        mask = tmp_path / f"mask_{number}.png" if masked else None
        if mask is not None:
            write_png(mask, np.where(part, 255, 0).astype(np.uint8))
        image = tmp_path / f"{number}.exr"
        views.append(View(str(number), "train", cameras[number], image, {}, mask=mask))
    dataset = Dataset(scene.parent, scene, background, tuple(views), {}, None)
    several = Ranks()
    several.size = 2
    found = kept_whole(config, dataset, several)
    assert ("mean albedo" in found) if whole else found is None


def test_a_narrow_strip_of_sky_is_not_enough_for_processes_to_share_photographs(still, tmp_path):
    """Other pixels are looked at later, and may not show it."""
    config = replace(tiny_fields(), unknown="materials+lighting", lighting=lighting())
    (camera,) = built_in_cameras("still", 256)
    seen = surfaces(make_problem(still, "visible", config, 0.2), [camera])
    several = Ranks()
    several.size = 2
    assert 1e-4 * seen.sum() < 6 < 4e-4 * seen.sum() < 200
    found = []
    for count in (6, 200):
        shown = seen.copy()
        shown[np.flatnonzero(~seen)[:count]] = True
        write_png(tmp_path / f"{count}.png", 255 * shown.reshape(256, 256).astype(np.uint8))
        view = View("0", "train", camera, tmp_path / "0.exr", {}, mask=tmp_path / f"{count}.png")
        dataset = Dataset(still.parent, still, "visible", (view, view), {}, None)
        found.append(kept_whole(config, dataset, several))
    assert "mean albedo" in found[0] and found[1] is None


def test_processes_learn_what_the_views_of_others_show(still, tmp_path):
    config, cameras = replace(BOTH, lighting=lighting()), built_in_cameras("still", SIZE, 2)
    problem = make_problem(still, "visible", config, 0.2)
    seen = surfaces(problem, cameras).reshape(2, SIZE, SIZE)
    views = []
    for number, counted in enumerate((np.ones_like(seen[0]), seen[1])):
        image, mask = tmp_path / f"{number}.exr", tmp_path / f"{number}.png"
        write_exr(image, np.full((SIZE, SIZE, 3), 0.2, np.float32))
        write_png(mask, np.where(counted, 255, 0).astype(np.uint8))
        views.append(View(str(number), "train", cameras[number], image, {}, mask=mask))

    def told(chosen):
        dataset = Dataset(tmp_path, still, "visible", tuple(chosen), {}, None)

        def look(ranks):
            pixels = pixels_of(dataset, config, clip_negative=False, ranks=ranks)
            return shows_light(problem, config, pixels)

        return on_ranks(len(chosen), look)

    assert told(views) == [True, True]
    assert told(views[1:]) == [False]


def test_a_known_lamp_tells_the_scale(still):
    config = replace(BOTH, lighting=lighting())
    problem = begun(with_more(still, LAMP), "visible", config, masked=True)
    assert problem.shows_light is None and not is_anchored(problem, config)


PANEL = """<shape type="rectangle"><transform name="to_world"><scale value="0.5"/>
    <translate z="0.9"/></transform><emitter type="area"/></shape>"""


@pytest.mark.parametrize(
    ("unknown", "sky", "lamp", "told"),
    [
        ("materials+emission", "", PANEL, True),
        ("materials+emission", "", LAMP, False),
        ("materials+emission", "<emitter type='constant'/>", PANEL, True),
        ("materials+emission", "<emitter type='sunsky'/>", PANEL, None),
        ("materials+lighting", "<emitter type='constant'/>", PANEL, None),
        ("materials+lighting+emission", "<emitter type='constant'/>", PANEL, True),
        ("lighting+emission", "<emitter type='constant'/>", PANEL, None),
    ],
)
@pytest.mark.parametrize("clipped", [False, True])
def test_lamps_in_view_tell_the_scale_where_they_are_not_clipped(
    unknown, sky, lamp, told, clipped, tmp_path
):
    """Asked, that is, where they and albedo are unknown, and no light is known."""
    floor = '<shape type="rectangle"><transform name="to_world"><scale value="4"/></transform>'
    (tmp_path / "scene.xml").write_text(
        f"""<scene version="3.0.0">{floor}<bsdf type="principled"/></shape>{sky}{lamp}</scene>"""
    )
    camera = Camera.look_at([0, 0, 2.5], [0, 0, 0], [0, 1, 0], 60, SIZE, SIZE)
    config = replace(TINY_FIT, unknown=unknown, lighting=lighting())
    problem = make_problem(tmp_path / "scene.xml", "visible", config, 0.2)
    rgb = np.full((SIZE * SIZE, 3), 0.2)
    pixels = PixelSource.of([camera], rgb, np.ones(len(rgb)), foreground_only=False)
    pixels = replace(pixels, limits=np.array([0.05 if clipped else 0.3], np.float32))
    assert shows_light(problem, config, pixels) is (told and not clipped)


def test_the_mean_albedo_has_the_colour_of_the_photographs_without_highlights(still):
    """As if light were white: a coloured object keeps its colour, and cameras their balance."""
    cameras = built_in_cameras("still", SIZE)
    problem = make_problem(still, "hidden", BOTH, 0.2)
    rgb = np.tile([0.3, 0.2, 0.1], (SIZE * SIZE, 1))
    rgb[:4] = 100.0
    pixels = PixelSource.of(cameras, rgb, np.ones(len(rgb)), foreground_only=True)

    def albedo(rgb=rgb, unknown="materials+lighting", **settings):
        pixels = PixelSource.of(cameras, rgb, np.ones(len(rgb)), foreground_only=True)
        config = replace(BOTH, unknown=unknown, lighting=lighting(**settings))
        return conventional_albedo(problem, config, pixels)

    assert albedo(mean_albedo=0.4) == pytest.approx((0.6, 0.4, 0.2), rel=1e-5)
    assert albedo(mean_albedo=0.4, mean_colour="grey") == (0.4, 0.4, 0.4)
    assert albedo(mean_albedo=0.8) == pytest.approx((0.8, 0.8 / 1.5, 0.4 / 1.5), rel=1e-5)
    assert albedo(0 * rgb, mean_albedo=0.4) == pytest.approx((0.4, 0.4, 0.4))
    known = make_problem(with_more(still, LAMP), "hidden", BOTH, 0.2)
    assert conventional_albedo(known, BOTH, pixels) == (0.5, 0.5, 0.5)
