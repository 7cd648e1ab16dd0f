"""How much light paths carry by their depth, where it is known, and as Mitsuba counts."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras, pixel_rays, seeded, stock_path

from unbake.dataset.camera import Camera
from unbake.scene.parse import parse
from unbake.transport.light_by_depth import light_by_depth
from unbake.transport.prb import light_through_holes, path_radiance, path_replay


@pytest.mark.parametrize("albedo", [0.3, 0.8])
@pytest.mark.parametrize("rr_depth", [1, 5, 100])
def test_light_of_a_furnace_is_a_geometric_series(built_in, albedo, rr_depth):
    scene = parse(built_in("furnace", albedo)).instantiate()
    ray = pixel_rays(built_in_cameras("furnace", 16), 64, seed=1)
    depth = 20
    shares = light_by_depth(scene, ray, 2, max_depth=depth, rr_depth=rr_depth, hide_emitters=False)
    # Depth d adds ρ^(d-1); depth 1, the emission that cameras see, does not count.
    expected = (1 - albedo ** np.arange(depth)) / (1 - albedo ** (depth - 1))
    assert shares[0] == 0 and shares[-1] == 1 and (np.diff(shares) >= 0).all()
    assert np.abs(shares - expected).max() < 0.01


def objects() -> mi.Scene:
    """A mirror, glass and a half opaque pane in a bright box with a lamp."""
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}
    to = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "box": {"type": "cube", "flip_normals": True, "bsdf": white},
            "lamp": {
                "type": "rectangle",
                "to_world": to().look_at([0, 0, 0.9], [0, 0, 0], [0, 1, 0]).scale(0.4),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [3, 2, 1]}},
            },
            "mirror": {
                "type": "sphere", "center": [0.4, 0.3, -0.5], "radius": 0.4,
                "bsdf": {"type": "conductor", "material": "none"},
            },
            "glass": {
                "type": "sphere", "center": [-0.4, 0.3, -0.5], "radius": 0.4,
                "bsdf": {"type": "dielectric"},
            },
            "pane": {
                "type": "rectangle",
                "to_world": to().look_at([0, -0.4, 0], [0, -1, 0], [0, 0, 1]).scale(0.5),
                "bsdf": {
                    "type": "mask", "opacity": 0.5,
                    "bsdf": {"type": "twosided", "bsdf": white},
                },
            },
        }
    )  # fmt: skip


def image(scene, ray, depth, hide_emitters):
    """By a path tracer of Mitsuba, without hidden emitters behind cut-outs."""
    if not hide_emitters:
        return np.array(stock_path(scene, ray, 3, max_depth=depth))
    replay = path_replay(depth, 9, True)
    light = path_radiance(replay, scene, seeded(3, dr.width(ray)), ray, {})
    return np.array(light - light_through_holes(scene, ray, depth))


@pytest.mark.parametrize("hide_emitters", [False, True])
def test_depth_has_the_meaning_of_mitsubas_integrators(hide_emitters):
    scene, depth = objects(), 6
    camera = Camera.look_at((0, -0.95, 0.2), (0, 0, 0), (0, 0, 1), 80.0, 24, 24)
    ray = pixel_rays([camera], 512, seed=1)
    seen = {"hide_emitters": hide_emitters}
    shares = light_by_depth(scene, ray, 2, max_depth=depth, rr_depth=9, **seen)
    light = [image(scene, ray, d, hide_emitters).mean() for d in range(1, depth + 1)]
    expected = (np.array(light) - light[0]) / (light[-1] - light[0])
    assert np.abs(shares - expected).max() < 0.01
    # The pane fills the view: direct illumination of what lies behind it has depth 3. The light
    # behind it, of depth 2, may be hidden.
    assert (expected[1] < 0.02) if hide_emitters else (0.05 < expected[1] < 0.1)
    assert expected[2] > 0.4


def test_a_few_extreme_samples_do_not_decide(built_in):
    scene = parse(built_in("furnace", 0.8)).instantiate()
    ray = pixel_rays(built_in_cameras("furnace", 16), 64, seed=1)
    seen = {"max_depth": 8, "rr_depth": 9, "hide_emitters": False}
    expected = light_by_depth(scene, ray, 2, **seen)
    # From outside of the box, seven of sixteen groups see nothing or the emission alone.
    outside = dr.arange(mi.UInt32, dr.width(ray)) % 16 < 7
    ray.o = dr.select(outside, mi.Point3f(0, 0, 5), ray.o)
    assert light_by_depth(scene, ray, 2, **seen) == pytest.approx(expected, abs=0.01)


def test_there_may_be_no_light():
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "e": {"type": "point",
                          "intensity": {"type": "rgb", "value": 0.0}}})  # fmt: skip
    ray = pixel_rays([Camera.look_at((0, -3, 0), (0, 0, 0), (0, 0, 1), 50.0, 4, 4)], 16, seed=1)
    shares = light_by_depth(scene, ray, 0, max_depth=3, rr_depth=5, hide_emitters=False)
    assert (shares == 0).all() and shares.shape == (3,)
