"""Derivatives by an albedo: in the furnace, where all are known, and in a box with an exact L."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras

from unbake.dataset.pixels import CameraRays
from unbake.experiments.derivatives import estimate
from unbake.scene.parse import parse
from unbake.transport.path_tracer import path_lengths, path_traced
from unbake.transport.vertex import SceneView, find_vertex

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


class ConstantRadiance:
    """The same reflected radiance everywhere: a stand-in for L_θ."""

    def __init__(self, value):
        self.value = value

    def evaluate(self, p, w, n, albedo, valid):
        return dr.select(valid, mi.Color3f(self.value), 0)


@pytest.mark.parametrize("L", [0.0, ALBEDO / (1 - ALBEDO)], ids=["black", "exact"])
def test_the_radiance_field_stands_for_all_light_after_k_bounces(furnace, L):
    scene_view, assign = furnace
    rays = CameraRays.of(built_in_cameras("furnace", 8))
    found = estimate(
        scene_view, assign, ALBEDO, rays.through, rays.pixels, 1024,
        seed=2, max_depth=40, cut=CUT, attached=LIVE, radiance=ConstantRadiance(L),
    )  # fmt: skip
    assert set(found.cached) == set(LIVE)
    for k, (image, derivative) in found.cached.items():
        same(image, sum(ALBEDO**i for i in range(k + 1)) + ALBEDO**k * L)
        short = sum(i * ALBEDO ** (i - 1) for i in range(1, k + 1))
        same(derivative, short + k * ALBEDO ** (k - 1) * L)


def test_there_are_no_estimates_of_a_radiance_field_that_is_not_there(estimates):
    assert estimates.cached == {}


class PathTracedRadiance:
    """The exact reflected radiance, from one path for each look-up: a stand-in for L_θ."""

    def __init__(self, scene_view):
        self.scene_view, self.seed = scene_view, 0

    def evaluate(self, p, w, n, albedo, valid):
        self.seed += 1
        back = mi.Ray3f(p + 0.01 * w, -w)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(self.seed, dr.width(p))
        first = find_vertex(self.scene_view, back, mi.Bool(True), sampler)
        assert dr.all(~valid | (dr.norm(first.si.p - p) < 0.01))  # it looks at the same point
        followed = path_traced(
            self.scene_view, back, self.seed, max_depth=40, rr_depth=5, hide_emitters=False
        )
        return dr.select(valid, followed - first.emitted, 0)


@pytest.fixture(scope="module")
def cornell(built_in):
    """A box with several materials; the albedo of one of them is the parameter."""
    scene = parse(built_in("cornell")).instantiate()
    parameters = mi.traverse(scene)
    (key, *_) = sorted(k for k, _ in parameters if k.endswith(("reflectance.value", "color.value")))

    def assign(value):
        parameters[key] = mi.Color3f(value)
        parameters.update()

    assign(mi.Float(0.7))
    return SceneView.of(scene, None, 8), assign


def test_with_an_exact_radiance_field_all_is_as_with_the_exact_light(cornell):
    scene_view, assign = cornell
    rays = CameraRays.of(built_in_cameras("cornell", 3))
    found = estimate(
        scene_view, assign, 0.7, rays.through, rays.pixels, 16384,
        seed=1, max_depth=40, cut=(2,), attached=LIVE, radiance=PathTracedRadiance(scene_view),
    )  # fmt: skip
    assert found.derivative.mean() > 0.01 and found.image.mean() > 0.1
    for k in LIVE:
        image, derivative = found.cached[k]
        assert image.mean(0) == pytest.approx(found.image.mean(0), rel=0.01)
        assert derivative.mean(0) == pytest.approx(found.attached[k].mean(0), rel=0.02)
        np.testing.assert_allclose(image, found.image, rtol=0.08, atol=0.02)


def test_paths_of_two_values_share_their_noise(cornell):
    """Whichever other paths end: random numbers stay with their camera sample."""
    scene_view, assign = cornell
    rays = CameraRays.of(built_in_cameras("cornell", 8))
    images = [
        estimate(
            scene_view, assign, value, rays.through, rays.pixels, 16,
            seed=seed, max_depth=40, cut=(2,), attached=(1,),
        ).image
        for value, seed in [(0.7, 1), (0.71, 1), (0.71, 2)]
    ]  # fmt: skip
    same_seed, other_seed = (np.abs(image - images[0]).mean() for image in images[1:])
    assert 0 < same_seed < 0.1 * other_seed, (same_seed, other_seed)


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
