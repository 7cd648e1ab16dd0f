"""The strength of lights: stock lights take it, and gradients arrive in the array assigned."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import losses_of_light, pixel_rays, seeded

from unbake.dataset.camera import Camera
from unbake.fields.emission import BOUND, Emission, emission_textures
from unbake.scene.emitters import Picture
from unbake.transport.operator import attach_material, bounce
from unbake.transport.vertex import SceneView, find_vertex

#: Strengths in the order of `lit_scene`; each light alone makes a picture that is not black.
TRUTH = [[1.0, 2.0, 3.0], [8.0, 4.0, 2.0], [10.0, 12.0, 14.0], [2.0, 3.0, 1.0], [0.2, 0.1, 0.3]]
CAMERA = [Camera.look_at([0, 1, 4], [0, 0, 0], [0, 1, 0], 45, 12, 12)]


def lit_scene(strengths):
    """A ball on the ground under a light of each kind: area, point, spot, directional, constant."""
    area, point, spot, directional, constant = strengths
    transform = mi.ScalarTransform4f()
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 45.0,
                "to_world": transform.look_at([0, 1, 4], [0, 0, 0], [0, 1, 0]),
                "film": {
                    "type": "hdrfilm",
                    "width": 8,
                    "height": 8,
                    "pixel_format": "rgb",
                    "rfilter": {"type": "box"},
                },
            },
            "ball": {"type": "sphere", "bsdf": {"type": "principled", "roughness": 0.4}},
            "ground": {
                "type": "rectangle",
                "to_world": transform.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4),
            },
            "lamp": {
                "type": "sphere",
                "center": [1.5, 1.5, 0],
                "radius": 0.2,
                "emitter": {"type": "area", "radiance": area},
            },
            "point": {"type": "point", "position": [-2, 2, 1], "intensity": point},
            "spot": {
                "type": "spot",
                "to_world": transform.look_at([0, 3, 2], [0, 0, 0], [0, 1, 0]),
                "intensity": spot,
            },
            "sun": {"type": "directional", "direction": [1, -1, -1], "irradiance": directional},
            "sky": {"type": "constant", "radiance": constant},
        }
    )


def fitted(strengths, scale=1.0):
    """Emission of these strengths, and the array that gradients arrive in."""
    emission = Emission(len(strengths), scale=scale)
    log = mi.Float(np.log(np.ravel(strengths) / scale).astype(np.float32))
    dr.enable_grad(log)
    emission.assign({"log": log})
    emission.prepare()
    return emission, log


def stock(integrator="path"):
    return mi.load_dict({"type": integrator, "max_depth": 3})


def test_every_kind_of_light_takes_it():
    emission, _ = fitted(TRUTH, scale=2.0)
    ours = lit_scene(emission_textures(emission))
    for i in range(5):
        # One light at a time, so that none can hide behind another
        alone = np.array(TRUTH) * 1e-6
        alone[i] = TRUTH[i]
        emission.assign({"log": mi.Float(np.log(np.ravel(alone) / 2).astype(np.float32))})
        emission.prepare()
        theirs = lit_scene([{"type": "rgb", "value": list(map(float, v))} for v in alone])
        a = np.array(mi.render(ours, integrator=stock(), spp=16, seed=1))
        b = np.array(mi.render(theirs, integrator=stock(), spp=16, seed=1))
        assert b.mean() > 0.01
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)


def test_the_untrained_strength_is_the_scale():
    emission = Emission(3, scale=0.7)
    np.testing.assert_allclose(emission.values, np.full((3, 3), 0.7), rtol=1e-6)
    assert list(emission.parameters()) == ["log"]


def test_lights_begin_with_strengths_of_their_own():
    emission = Emission(2, scale=0.5)
    emission.start([1, 1e8])
    np.testing.assert_allclose(emission.values, [[0.5, 5e7]] * 3, rtol=1e-5)


@pytest.mark.parametrize("sign", [1, -1])
def test_extreme_parameters_stay_finite_and_keep_a_gradient(sign):
    emission = Emission(2, scale=1.0)
    log = dr.full(mi.Float, sign * 1e4, 6)
    dr.enable_grad(log)
    emission.assign({"log": log})
    emission.prepare()
    np.testing.assert_allclose(emission.values, np.exp(sign * BOUND), rtol=1e-4)
    dr.backward(dr.sum(dr.sum(emission.values)))
    assert np.isfinite(dr.grad(log)).all()
    assert (np.array(dr.grad(log)) > 0).all()


@pytest.mark.parametrize("integrator", ["prb", "path"])
def test_gradients_through_stock_integrators_are_what_each_light_adds(integrator):
    """Pictures are linear in strengths, so that gradients of logs are each light's own picture."""
    emission, log = fitted(TRUTH)
    scene = lit_scene(emission_textures(emission))
    ones = dr.full(mi.TensorXf, 1, (8, 8, 3))
    renderer = stock(integrator)
    renderer.render_backward(scene, mi.traverse(scene), ones, 0, seed=1, spp=256)
    ours = np.array(dr.grad(log)).reshape(5, 3)
    for i in range(5):
        alone = [{"type": "rgb", "value": v if i == j else 0.0} for j, v in enumerate(TRUTH)]
        image = np.array(mi.render(lit_scene(alone), integrator=renderer, spp=256, seed=2))
        expected = image.sum((0, 1))
        np.testing.assert_allclose(ours[i], expected, rtol=0.1 if i == 0 else 0.05)


def test_gradients_through_a_bounce_of_our_own_and_a_frozen_step():
    rays = pixel_rays(CAMERA, 16, 3)
    target = mi.Color3f(0.4, 0.5, 0.6)
    histories = []
    gc.collect()
    gc.disable()
    for frozen in (True, False):
        emission, log = fitted(TRUTH)
        scene_view = SceneView.of(lit_scene(emission_textures(emission)), None, 4)
        optimizer = mi.ad.Adam(0.05, {"log": log})
        losses = losses_of_light(emission, optimizer, scene_view, rays, target, frozen=frozen)
        histories.append((losses, np.array(optimizer["log"])))
    gc.enable()
    (a, learnt_a), (b, learnt_b) = histories
    assert a[-1] < 0.95 * a[0]
    np.testing.assert_allclose(a, b, rtol=1e-3)
    np.testing.assert_allclose(learnt_a, learnt_b, atol=1e-3)


def test_direct_light_is_linear_in_strengths():
    """Gradients of logs sum to the light itself, through the samples of `bounce`."""
    emission, log = fitted(TRUTH)
    scene_view = SceneView.of(lit_scene(emission_textures(emission)), None, 4)
    rays = pixel_rays(CAMERA, 16, 3)
    sampler = seeded(5, dr.width(rays))
    first = find_vertex(scene_view, rays, mi.Bool(True), sampler)
    step = bounce(scene_view, attach_material(scene_view, first), sampler)
    total = dr.sum(dr.sum(step.direct + step.weight * step.next.emitted + first.emitted))
    dr.backward(total)
    assert np.array(dr.grad(log)).min() > 0
    assert np.array(dr.grad(log)).sum() == pytest.approx(np.array(total)[0], rel=1e-4)


#: Lamps with texture coordinates: how they stand, and whether these tell where they are sampled.
SCREENS = {
    "rectangle": ({"type": "rectangle"}, True),
    "disk": ({"type": "disk"}, True),
    "sphere": ({"type": "sphere", "center": [0, 0, 0.3], "radius": 0.6}, True),
    "ply": ({"type": "ply"}, False),
}


def two_triangles(file):
    """A square with texture coordinates, as a file."""
    mesh = mi.Mesh("square", 4, 2, has_vertex_texcoords=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [-1.0, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]
    params["faces"] = [0, 1, 2, 0, 2, 3]
    params["vertex_texcoords"] = [0.0, 0, 1, 0, 1, 1, 0, 1]
    params.update()
    mesh.write_ply(str(file))
    return str(file)


@pytest.mark.parametrize("kind", SCREENS)
@pytest.mark.parametrize("mean", [(0.5, 1.0, 2.0), (0.5, 0.0, 2.0)])
def test_a_lamp_with_a_picture_is_its_strength_times_that(mean, kind, tmp_path):
    pixels = np.random.default_rng(3).uniform(0.2, 1.8, (4, 8, 3))
    pixels *= np.array(mean) / pixels.mean((0, 1))
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(pixels.astype(np.float32)), "raw": True}
    texture["filter_type"] = "nearest"
    strength, (shape, by_it) = np.array([3.0, 1.5, 0.5]), SCREENS[kind]
    if kind == "ply":
        shape = shape | {"filename": two_triangles(tmp_path / "square.ply")}

    def screen(radiance):
        room = {"type": "scene", "wall": {"type": "rectangle"}}
        place = mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.7)
        light = {"type": "area", "radiance": radiance}
        room["screen"] = shape | {"to_world": place, "emitter": light}
        film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
        to_world = mi.ScalarTransform4f().look_at([2.5, 0, 0.4], [0, 0, 0.4], [0, 0, 1])
        room["sensor"] = {"type": "perspective", "to_world": to_world, "fov": 50.0, "film": film}
        return mi.load_dict(room)

    pattern = Picture(mi.load_dict(texture), mean, by_it)
    emission = Emission(1, scale=1.0, patterns=[pattern])
    log = mi.Float(np.log(strength).astype(np.float32))
    dr.enable_grad(log)
    emission.assign({"log": log})
    emission.prepare()
    ours = mi.render(screen(emission_textures(emission)[0]), integrator=stock(), spp=4096, seed=1)
    shown = np.where(np.array(mean) > 0, pixels / np.maximum(mean, 1e-9), 1) * strength
    texture["bitmap"] = mi.Bitmap(shown.astype(np.float32))
    theirs = np.array(mi.render(screen(texture), integrator=stock(), spp=4096, seed=2))
    assert np.abs(np.array(ours) - theirs).mean() < 0.02 * theirs.mean()
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.uv = mi.Point2f([1.5 / 8, 6.5 / 8], [0.5 / 4, 2.5 / 4])
    (texture,) = emission_textures(emission)
    value = texture.eval(si)
    np.testing.assert_allclose(np.array(value), shown[[0, 2], [1, 6]].T, rtol=1e-5)
    dr.backward(value)  # it is linear in the strength
    np.testing.assert_allclose(np.array(dr.grad(log)), np.array(value).sum(1), rtol=1e-5)
