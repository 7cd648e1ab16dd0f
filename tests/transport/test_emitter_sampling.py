"""Light of emitters: what cut-outs and panes let pass is that of Mitsuba's `volpath`."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import assert_same_expectation, pixel_rays, stock_path

from unbake.dataset.camera import Camera
from unbake.transport.emitter_sampling import has_cut_outs, lets_pass, lights_pierce
from unbake.transport.light_by_depth import light_by_depth
from unbake.transport.path_tracer import path_traced
from unbake.transport.render import path_integrator
from unbake.transport.vertex import SceneView, mis_weight

LIGHTS = {
    "point": {
        "type": "point",
        "position": [0.2, 0.1, 2],
        "intensity": {"type": "rgb", "value": [4, 3, 2]},
    },
    "spot": {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at([0, 0.2, 2], [0, 0, 0], [0, 1, 0]),
        "intensity": 6.0,
        "cutoff_angle": 50.0,
    },
    "directional": {"type": "directional", "direction": [0.2, 0.1, -1], "irradiance": 2.0},
    "sky": {"type": "constant", "radiance": 0.5},
    "lamp": {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]).scale(0.4),
        "emitter": {"type": "area", "radiance": 5.0},
    },
}


def scene_of(*lights, opacity=0.3, count=2, leaf=None):
    """A floor under some leaves (cut-outs) and lights, and rays of a camera beside them."""
    material = {"type": "twosided", "bsdf": {"type": "principled", "roughness": 0.5}}
    if leaf is None:
        leaf = material
        if opacity < 1:
            leaf = {"type": "mask", "opacity": opacity, "bsdf": material}
    content = {"type": "scene", "floor": {"type": "rectangle", "bsdf": material}}
    for number in range(count):
        place = mi.ScalarTransform4f().translate([0.1, 0, 0.5 + 0.3 * number]).scale(0.5)
        content[f"leaf {number}"] = {"type": "rectangle", "to_world": place, "bsdf": leaf}
    scene = mi.load_dict(content | {name: LIGHTS[name] for name in lights})
    camera = Camera.look_at((2.5, 0, 0.4), (0, 0, 0), (0, 0, 1), 40.0, 8, 8)
    return scene, pixel_rays([camera], 1024, seed=1)


@pytest.mark.parametrize("opacity", [0.0, 0.3])
@pytest.mark.parametrize(
    "lights", [["point"], ["spot"], ["directional"], ["point", "sky", "lamp"]], ids=" ".join
)
def test_lights_shine_through_cut_outs(lights, opacity):
    scene, ray = scene_of(*lights, opacity=opacity)
    assert lights_pierce(scene) and path_integrator(scene) == "volpath"
    theirs = stock_path(scene, ray, 3, max_depth=8, integrator="volpath")
    view = SceneView.of(scene, None, 8)
    ours = path_traced(view, ray, 2, max_depth=8, rr_depth=5, hide_emitters=False)
    assert_same_expectation(ours, theirs, 1024)


def test_what_is_opaque_hides_them():
    """And where nothing is cut out, Mitsuba decides what is in sight."""
    scene, ray = scene_of("point", opacity=1.0)
    assert not has_cut_outs(scene) and not lights_pierce(scene)
    theirs = stock_path(scene, ray, 3, max_depth=4)
    view = SceneView.of(scene, None, 8)
    ours = path_traced(view, ray, 2, max_depth=4, rr_depth=5, hide_emitters=False)
    assert_same_expectation(ours, theirs, 1024)
    assert has_cut_outs(scene_of("lamp")[0]) and not lights_pierce(scene_of("lamp")[0])


@pytest.mark.parametrize("pane", ["thindielectric", "null"])
@pytest.mark.parametrize("lights", [["point"], ["directional"], ["spot", "sky"]], ids=" ".join)
def test_lights_shine_through_panes(lights, pane):
    """They left rooms behind windows dark, in photographs and fits."""
    scene, ray = scene_of(*lights, leaf={"type": pane})
    assert lights_pierce(scene) and path_integrator(scene) == "volpath"
    assert lets_pass(scene) and not has_cut_outs(scene)
    theirs = stock_path(scene, ray, 3, max_depth=16, integrator="volpath")
    view = SceneView.of(scene, None, 16)
    ours = path_traced(view, ray, 2, max_depth=16, rr_depth=5, hide_emitters=False)
    assert_same_expectation(ours, theirs, 1024)


@pytest.mark.parametrize("pane", ["thindielectric", "null"])
def test_a_sun_behind_a_window_lights_what_is_before_it(pane):
    """By the share that passes the pane, which does not scatter; both of its sides are alike."""
    window = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 1]).scale(9)}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse"}}
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    ray = mi.Ray3f(mi.Point3f(0.1, 0.2, 0.5), mi.Vector3f(0, 0, -1))
    light = {}
    for name in (None, pane, "turned"):
        shapes = {"floor": floor, "sun": sun}
        if name is not None:
            turned = {"flip_normals": name == "turned"}
            shapes["window"] = window | turned | {"bsdf": {"type": pane}}
        scene = mi.load_dict({"type": "scene", **shapes})
        view = SceneView.of(scene, None, 8)
        found = path_traced(view, ray, 2, max_depth=2, rr_depth=5, hide_emitters=False)
        light[name] = np.array(found).mean()
        volumetric = np.array(stock_path(scene, ray, 3, max_depth=2, integrator="volpath")).mean()
        assert light[name] == pytest.approx(volumetric, rel=1e-4) and light[name] > 0.1
    once = ((1.5046 - 1.000277) / (1.5046 + 1.000277)) ** 2
    share = 1 - 2 * once / (1 + once) if pane == "thindielectric" else 1
    assert light[pane] == pytest.approx(share * light[None], rel=1e-3)
    assert light["turned"] == pytest.approx(light[pane], rel=1e-4)


@pytest.mark.parametrize("leaf", [None, {"type": "thindielectric"}, {"type": "null"}], ids=str)
@pytest.mark.parametrize("lights", [["lamp"], ["sky"], ["lamp", "sky", "spot"]], ids=" ".join)
def test_light_of_lamps_and_skies_passes_holes_once(lights, leaf):
    """Emitter sampling finds it, and rays that pass do: with weights that add up to one."""
    scene, ray = scene_of(*lights, leaf=leaf)
    theirs = stock_path(scene, ray, 3, max_depth=16, integrator="volpath")
    view = SceneView.of(scene, None, 16)
    ours = path_traced(view, ray, 2, max_depth=16, rr_depth=5, hide_emitters=False)
    assert_same_expectation(ours, theirs, 1024)


@pytest.mark.parametrize(
    "pane",
    [
        {"type": "thindielectric"},
        {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse"}},
    ],
    ids=["pane", "leaf"],
)
def test_a_small_lamp_behind_a_hole_is_found_as_if_there_was_none(pane):
    """Left to rays that happen to meet it, its light has ten thousand times the variance."""
    shapes = {
        "floor": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "lamp": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]).scale(0.2),
            "emitter": {"type": "area", "radiance": 40.0},
        },
    }
    up = mi.ScalarTransform4f().translate([0, 0, 1])
    over = {"pane": {"type": "rectangle", "to_world": up, "bsdf": pane}}
    lanes = 1 << 14
    ray = mi.Ray3f(dr.full(mi.Point3f, 0.5, lanes), mi.Vector3f(0, 0, -1))
    spread = []
    for content in (shapes, shapes | over):
        view = SceneView.of(mi.load_dict({"type": "scene", **content}), None, 8)
        found = np.array(path_traced(view, ray, 2, max_depth=2, rr_depth=5, hide_emitters=False))[0]
        spread.append(found.std() / found.mean())
    assert spread[1] < 1.5 * spread[0] + 0.02


def test_rays_meet_skies_and_lamps_behind_panes():
    scene, _ = scene_of("sky", "lamp", leaf={"type": "thindielectric"})
    assert lets_pass(scene) and not lights_pierce(scene) and path_integrator(scene) == "path"


def test_the_depth_of_light_counts_what_passes():
    """The floor has next to no other light than what passes the leaves."""
    scene, ray = scene_of("point", opacity=0.1, count=1)
    shares = light_by_depth(scene, ray, 2, max_depth=4, rr_depth=5, hide_emitters=False)
    direct, all_ = (
        np.array(stock_path(scene, ray, 3, max_depth=d, integrator="volpath")).mean()
        for d in (2, 4)
    )
    assert shares[1] == pytest.approx(direct / all_, abs=0.02)


def test_weights_of_any_densities_are_numbers():
    """Of an emitter that is seen edge on by a point on itself, they are beyond 10^19."""
    pairs = [(1, 1), (3, 1), (1e20, 1e-17), (1e-30, 1e20), (1e-30, 0), (1e38, 1e38), (0, 1), (0, 0)]
    a, b = (mi.Float(column) for column in zip(*pairs, strict=True))
    found = np.array(mis_weight(a, b))
    np.testing.assert_allclose(found, [0.5, 0.9, 1, 0, 1, 0.5, 0, 0], rtol=1e-5)
    assert np.array(mis_weight(mi.Float(np.inf), mi.Float(np.inf))) == 0
