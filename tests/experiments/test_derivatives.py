"""Derivatives by an albedo in the furnace, where all of them are known."""

import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras

from unbake.dataset.pixels import CameraRays
from unbake.experiments.derivatives import estimate
from unbake.scene.parse import parse
from unbake.transport.path_tracer import path_lengths
from unbake.transport.vertex import SceneView

ALBEDO = 0.4
CUT, LIVE = (2, 3, 6), (1, 2, 4)


@pytest.fixture(scope="module")
def furnace(built_in):
    scene = parse(built_in("furnace", ALBEDO)).instantiate()
    parameters = mi.traverse(scene)
    keys = [key for key, _ in parameters if key.endswith("reflectance.value")]
    assert keys

    def assign(value):
        for key in keys:
            parameters[key] = mi.Color3f(value)
        parameters.update()

    return SceneView.of(scene, None, 0), assign


@pytest.fixture(scope="module")
def estimates(furnace):
    scene_view, assign = furnace
    rays = CameraRays.of(built_in_cameras("furnace", 8))
    return estimate(
        scene_view, assign, ALBEDO, rays.through, rays.pixels, 64,
        seed=1, max_depth=40, cut=CUT, attached=LIVE,
    )  # fmt: skip


def same(pixels, value, tolerance=0.02):
    assert np.isfinite(pixels).all()
    assert pixels.mean() == pytest.approx(value, rel=tolerance)


def test_the_image_and_its_derivative_are_those_of_the_geometric_series(estimates):
    same(estimates.image, 1 / (1 - ALBEDO))
    same(estimates.derivative, 1 / (1 - ALBEDO) ** 2)


@pytest.mark.parametrize("depth", CUT)
def test_short_paths_know_the_first_terms(estimates, depth):
    image, derivative = estimates.cut[depth]
    same(image, sum(ALBEDO**i for i in range(depth)))
    same(derivative, sum(i * ALBEDO ** (i - 1) for i in range(1, depth)))


@pytest.mark.parametrize("k", LIVE)
def test_differentiable_bounces_know_the_first_terms_and_all_light_after_them(estimates, k):
    first = sum(i * ALBEDO ** (i - 1) for i in range(1, k))
    same(estimates.attached[k], first + k * ALBEDO ** (k - 1) / (1 - ALBEDO))


@pytest.mark.parametrize("limit", [3, 500])
def test_paths_are_as_long_as_walls_let_them_be(furnace, limit):
    scene_view, _ = furnace
    rays = CameraRays.of(built_in_cameras("furnace", 8))
    sampler = mi.load_dict({"type": "independent"})
    lanes = rays.pixels * 256
    sampler.seed(0, lanes)
    pixel = mi.UInt32(sampler.next_1d() * 0.99999 * rays.pixels)
    ray = rays.through(pixel, sampler.next_2d())
    lengths = np.array(path_lengths(scene_view, ray, 3, max_depth=limit, rr_depth=1))
    assert lengths.min() == 1 and lengths.max() <= limit
    assert lengths.mean() == pytest.approx((1 - ALBEDO**limit) / (1 - ALBEDO), rel=0.01)
