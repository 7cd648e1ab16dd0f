"""What must happen to images and gradients when a scene is changed in a way whose effect is known.

No reference is needed. With the same random numbers, light may only change as the scene does: what
remains is rounding, and the few paths that it sends elsewhere.
"""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    ConstantMaterials,
    ConstantRadiance,
    assert_same_expectation,
    pixel_rays,
    planned_sampler,
    seeded,
)

from unbake.dataset.camera import Camera
from unbake.dataset.pixels import CameraRays
from unbake.fields.texture import material_textures
from unbake.transport.path_tracer import path_traced
from unbake.transport.vertex import SceneView

SPP, DEPTH = 16, 4
METHODS = ["ours", "direct", "ad-pt", "prb"]
PAINT, LAMP, POINT = (0.6, 0.4, 0.2), (5.0, 4.0, 2.0), (1.0, 2.0, 3.0)
CAMERA = Camera.look_at((0, -3.0, 1.6), (0, 0, 0.5), (0, 0, 1), 60.0, 12, 10)


def in_order(colour, order):
    return [float(colour[i]) for i in order]


class Room:
    """A ball on a floor, under a lamp, a point light and a sky, and its materials.

    Args:
        motion: moves everything, cameras too.
        scale: of all lengths.
        light: factor of all light.
        order: of the colour channels.
    """

    def __init__(self, motion=None, *, scale=1.0, light=1.0, order=(0, 1, 2), sky=True) -> None:
        self.motion, self.scale, self.light = motion or mi.ScalarTransform4f(), scale, light
        place = self.motion @ mi.ScalarTransform4f().scale(scale)
        self.materials = ConstantMaterials(mi.Color3f(*in_order(PAINT, order)), 0.4, 0.3)
        paint = {"type": "principled", **material_textures(self.materials)}
        lamp = place.look_at([0.8, -0.5, 2.2], [0, 0, 0.5], [0, 1, 0]).scale(0.5)
        radiance = [light * x for x in in_order(LAMP, order)]
        intensity = [light * scale**2 * x for x in in_order(POINT, order)]
        lights = {
            "lamp": {
                "type": "rectangle",
                "to_world": lamp,
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
            },
            "point": {
                "type": "point",
                "position": list(place @ mi.ScalarPoint3f(-1.2, -1, 2)),
                "intensity": {"type": "rgb", "value": intensity},
            },
        }
        if sky:
            texels = np.random.default_rng(2).uniform(0, 0.6 * light, (8, 16, 3))
            lights["sky"] = {
                "type": "envmap",
                "bitmap": mi.Bitmap(texels.astype(np.float32)),
                "to_world": self.motion,
            }
        scene = mi.load_dict(
            {
                "type": "scene",
                "floor": {"type": "rectangle", "to_world": place.scale(2), "bsdf": paint},
                "ball": {
                    "type": "sphere",
                    "to_world": place.translate([0, 0, 0.6]).scale(0.5),
                    "bsdf": {"type": "twosided", "bsdf": paint},
                },
                **lights,
            }
        )
        self.view = SceneView.of(scene, self.materials, 8)
        self.camera = moved(CAMERA, self.motion, scale)

    def samples(self, method: str):
        """Radiance of camera samples, and the derivatives of its sum by the materials."""
        m = self.materials
        parameters = {name: getattr(m, name) for name in m}
        for value in parameters.values():
            dr.make_opaque(value)
            dr.disable_grad(value)
            dr.enable_grad(value)
        ray = pixel_rays([self.camera], SPP, 1)
        sampler = planned_sampler(
            method,
            self.view,
            ray,
            SPP,
            max_depth=DEPTH,
            radiance=ConstantRadiance(0.4 * self.light),
            read_by_scene=lambda: parameters,
        )
        with sampler.prepared():
            image = sampler.image(self.view.scene, ray, seeded(2, dr.width(ray)))
            dr.backward(dr.sum(dr.mean(image, axis=1)))
        albedo = np.array(dr.grad(m.albedo), np.float64).ravel()
        others = [float(dr.grad(x)[0]) for x in (m.roughness, m.metallic)]
        return np.array(dr.detach(image), np.float64), albedo, np.array(others)


def moved(camera: Camera, motion, scale: float) -> Camera:
    matrix = np.array(motion.matrix, np.float64)
    pose = matrix @ np.diag([scale, scale, scale, 1]) @ camera.to_world
    pose[:3, :3] = matrix[:3, :3] @ camera.to_world[:3, :3]
    c = camera
    return Camera(pose, c.fl_x, c.fl_y, c.cx, c.cy, c.width, c.height)


@cache
def plain(method: str):
    return Room().samples(method)


def assert_same_samples(image, expected, most=0.01) -> None:
    """All but a few paths carry the same light, and all together next to the same."""
    assert expected.mean() > 0.02
    apart = np.abs(image - expected) > 2e-3 * (np.abs(expected) + 0.01)
    print(f"{apart.mean():.3%} of samples differ; means {image.mean()} and {expected.mean()}")
    assert apart.mean() < most
    np.testing.assert_allclose(image.mean(1), expected.mean(1), rtol=5e-3)


@pytest.mark.parametrize("method", METHODS)
def test_light_times_a_factor_is_radiance_and_gradients_times_it(method):
    image, albedo, others = Room(light=3.0).samples(method)
    expected = plain(method)
    assert_same_samples(image, 3 * expected[0], 1e-3)
    np.testing.assert_allclose(albedo, 3 * expected[1], rtol=1e-3)
    np.testing.assert_allclose(others, 3 * expected[2], rtol=1e-3)


@pytest.mark.parametrize("method", METHODS)
def test_a_rigid_motion_of_all_leaves_images_and_gradients(method):
    motion = mi.ScalarTransform4f().translate([3, -2, 1]).rotate([0.6, 0, 0.8], 50)
    image, albedo, others = Room(motion).samples(method)
    expected = plain(method)
    assert_same_samples(image, expected[0])
    np.testing.assert_allclose(albedo, expected[1], rtol=1e-2)
    np.testing.assert_allclose(others, expected[2], rtol=2e-2)


@pytest.mark.parametrize("scale", [0.1, 100.0])
@pytest.mark.parametrize("method", METHODS)
def test_the_unit_of_length_does_not_matter(method, scale):
    """Surfaces shine as before; the intensity of a point light grows with the square.

    Mitsuba starts rays at a small distance from surfaces, which is not in proportion to the scene.
    """
    image, albedo, others = Room(scale=scale).samples(method)
    expected = plain(method)
    assert_same_samples(image, expected[0], 0.03)
    np.testing.assert_allclose(albedo, expected[1], rtol=1e-2)
    np.testing.assert_allclose(others, expected[2], rtol=2e-2)


@pytest.mark.parametrize("method", METHODS)
def test_exchanged_colour_channels_exchange_results(method):
    order = (2, 0, 1)
    # An environment map is sampled by luminance, which weighs the channels differently.
    image, albedo, others = Room(order=order, sky=False).samples(method)
    expected = Room(sky=False).samples(method)
    assert_same_samples(image, expected[0][list(order)], 1e-3)
    np.testing.assert_allclose(albedo, expected[1][list(order)], rtol=1e-3)
    np.testing.assert_allclose(others, expected[2], rtol=1e-3)


# ----------------------------------------------------------------------------------------- crops


def cropped(camera: Camera, left: int, top: int, width: int, height: int) -> Camera:
    c = camera
    return Camera(c.to_world, c.fl_x, c.fl_y, c.cx - left, c.cy - top, width, height)


def test_a_crop_is_a_slice_of_the_image():
    """Ray by ray, and pixel by pixel within the noise of other random numbers."""
    spp, room = 256, Room()
    window = (slice(3, 8), slice(2, 9))
    crop = cropped(CAMERA, left=2, top=3, width=7, height=5)
    numbers = np.arange(CAMERA.width * CAMERA.height).reshape(CAMERA.height, -1)[window].ravel()

    def rays(camera, numbers):
        pixel = mi.UInt32(np.repeat(numbers, spp).astype(np.uint32))
        offset = np.random.default_rng(4).uniform(size=(2, dr.width(pixel))).astype(np.float32)
        return CameraRays.of([camera]).through(pixel, mi.Point2f(offset))

    part, whole = rays(crop, np.arange(crop.width * crop.height)), rays(CAMERA, numbers)
    np.testing.assert_allclose(np.array(part.d), np.array(whole.d), atol=2e-7)
    images = [
        path_traced(room.view, ray, seed, max_depth=DEPTH, rr_depth=9, hide_emitters=False)
        for ray, seed in ((part, 5), (whole, 6))
    ]
    assert_same_expectation(*images, spp)
