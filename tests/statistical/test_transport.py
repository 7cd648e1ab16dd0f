"""The right-hand side with an exact cache, and the Neumann series, against Mitsuba's `path`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    ConstantMaterials,
    PathTracedRadiance,
    assert_same_expectation,
    built_in_cameras,
    pieces,
    pixel_rays,
    random_values,
    seeded,
    stock_path,
)

from unbake.dataset.camera import Camera
from unbake.fields.domain import Domain
from unbake.fields.guide import LightGuide
from unbake.fields.settings import GuideConfig
from unbake.fields.texture import material_textures
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.transport.path_sample import lhs, rhs, trace
from unbake.transport.path_tracer import path_traced
from unbake.transport.prior import residual
from unbake.transport.vertex import SceneView

# Deep enough that what is cut off is far below the noise; mirrors count for `path`, not for us.
DEPTH, STOCK_DEPTH, SPP = 24, 64, 1024


def compare(
    ours: SceneView,
    stock: mi.Scene,
    cameras: list[Camera],
    *,
    hide_emitters: bool = False,
    spp: int = SPP,
) -> None:
    """All three ways to an image: E + T(L) and E + L with an exact L, and the series.

    E + T(L) also with a guide that knows nothing, whose directions are as good as any.
    """
    ray = pixel_rays(cameras, spp, seed=1)
    truth = stock_path(stock, ray, 3, max_depth=STOCK_DEPTH, hide_emitters=hide_emitters)
    # The series brings its own random numbers, from another seed.
    cache = PathTracedRadiance(ours, 4, DEPTH)
    requirements = pieces(1, 1)
    sample = trace(
        ours, cache, ray, seeded(5, dr.width(ray)), requirements, hide_emitters=hide_emitters
    )
    assert_same_expectation(rhs(sample, sample.radiance[1]), truth, spp)
    assert_same_expectation(lhs(sample, sample.radiance[0]), truth, spp)
    guided = trace(
        ours,
        cache,
        ray,
        seeded(7, dr.width(ray)),
        requirements,
        hide_emitters=hide_emitters,
        guide=random_guide(ours.scene),
    )
    assert_same_expectation(rhs(guided, guided.radiance[1]), truth, spp)
    series = path_traced(ours, ray, 6, max_depth=DEPTH, rr_depth=5, hide_emitters=hide_emitters)
    assert_same_expectation(series, truth, spp)


def random_guide(scene: mi.Scene) -> LightGuide:
    """A guide with a random distribution and share in each cell."""
    guide = LightGuide(GuideConfig(cells=3, bands=4, sectors=4), Domain.of(scene.bbox()))
    guide.assign(random_values(guide, 11, 0.15))
    return guide


def load(path) -> mi.Scene:
    return mi.load_file(str(path))


def test_cornell_in_principled_paint(built_in):
    scene = load(built_in("cornell"))
    compare(SceneView.of(scene, None, 8), scene, built_in_cameras("cornell", 12))


def test_cube_with_a_light_that_reflects(built_in):
    scene = load(built_in("cube"))
    compare(SceneView.of(scene, None, 8), scene, built_in_cameras("cube", 12))


@pytest.mark.slow
def test_demo_with_textures_a_mirror_and_hidden_lamps(built_in):
    scene = load(built_in("demo"))
    compare(SceneView.of(scene, None, 8), scene, built_in_cameras("demo", 16), spp=2048)


def test_fields_in_the_place_of_materials(built_in):
    """The values carried to the BSDFs give what the same constants in the scene file give."""
    colour, roughness = (0.7, 0.4, 0.2), 0.3
    materials = ConstantMaterials(mi.Color3f(*colour), roughness)
    ours, stock = parse(built_in("cornell")), parse(built_in("cornell"))
    edit.set_textures(ours, material_textures(materials))
    paint = mi.load_dict({"type": "rgb", "value": list(colour)})
    edit.set_textures(stock, {"base_color": paint, "roughness": roughness})
    scene_view = SceneView.of(ours.instantiate(), materials, 8)
    compare(scene_view, stock.instantiate(), built_in_cameras("cornell", 12))


def test_the_residuals_of_the_exact_radiance_vanish(built_in):
    """Both of them, at the vertices that cameras see and one bounce further."""
    scene_view = SceneView.of(load(built_in("cornell")), None, 8)
    ray = pixel_rays(built_in_cameras("cornell", 8), 4 * SPP, seed=7)
    cache = PathTracedRadiance(scene_view, 8, DEPTH)
    sample = trace(
        scene_view,
        cache,
        ray,
        seeded(9, dr.width(ray)),
        pieces(1, 2),
        hide_emitters=False,
    )
    first = residual(sample, 1, sample.radiance[0], sample.radiance[1])
    assert_same_expectation(sample.radiance[0], sample.radiance[0] - first, 4 * SPP)
    second = residual(sample, 2, sample.radiance[1], sample.radiance[2])
    assert_same_expectation(sample.radiance[1], sample.radiance[1] - second, 4 * SPP)


# ---------------------------------------------------------------------------- other lights


def still_life(**lights) -> mi.Scene:
    """A glossy ball on a floor."""
    to_world = mi.ScalarTransform4f
    paint = {"type": "principled", "base_color": {"type": "rgb", "value": [0.6, 0.5, 0.3]}}
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": to_world().scale(2),
                "bsdf": {"type": "twosided", "bsdf": paint | {"roughness": 0.6}},
            },
            "ball": {
                "type": "sphere",
                "center": [0, 0, 0.6],
                "radius": 0.5,
                "bsdf": paint | {"roughness": 0.25},
            },
            **lights,
        }
    )


CAMERA = ((0.0, -3.0, 1.6), (0.0, 0.0, 0.5), (0.0, 0.0, 1.0), 60.0)


def sky() -> dict:
    """An environment map with a bright spot."""
    v, u = np.mgrid[0:16, 0:32] / 16
    texels = np.stack([0.3 + 0.2 * u, 0.4 + 0 * u, 0.8 - 0.3 * v], -1)
    texels[3:5, 4:6] = 30.0
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    return {"type": "envmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "to_world": to_world}


def lamp_in_view():
    """A lamp between the camera and all else, not in its way where it is hidden."""
    origin, target = (np.array(x) for x in CAMERA[:2])
    centre = origin + 0.5 * (target - origin)
    return {
        "type": "sphere",
        "center": [float(x) for x in centre],
        "radius": 0.1,
        "emitter": {"type": "area", "radiance": 5.0},
    }


@pytest.mark.parametrize(
    ("lights", "hide_emitters"),
    [
        ({"sky": sky}, False),
        ({"sky": sky}, True),
        ({"even": lambda: {"type": "constant", "radiance": 0.7}}, False),
        ({"even": lambda: {"type": "constant", "radiance": 0.7}}, True),
        ({"point": lambda: {"type": "point", "position": [1, -1, 2.5], "intensity": 8.0}}, False),
        (
            {
                "point": lambda: {"type": "point", "position": [1, -1, 2.5], "intensity": 8.0},
                "sky": sky,
            },
            False,
        ),
        ({"lamp": lamp_in_view, "sky": sky}, False),
        ({"lamp": lamp_in_view, "sky": sky}, True),
    ],
    ids=[
        "sky",
        "hidden sky",
        "even sky",
        "hidden even sky",
        "point",
        "point and sky",
        "lamp",
        "hidden lamp",
    ],
)
def test_lights_far_away_and_without_extent(lights, hide_emitters):
    scene = still_life(**{name: make() for name, make in lights.items()})
    camera = Camera.look_at(*CAMERA, 12, 12)
    compare(SceneView.of(scene, None, 8), scene, [camera], hide_emitters=hide_emitters)
