"""L_θ of held materials: in the furnace it is known everywhere."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, built_in_cameras, pixel_rays, seeded

from unbake.dataset.pixels import CameraRays
from unbake.experiments.radiance_cache import (
    CacheTraining,
    fresh_radiance,
    load_radiance,
    save_radiance,
    train,
)
from unbake.scene.parse import parse
from unbake.transport.operator import attach_albedo
from unbake.transport.path_sample import reflected_radiance
from unbake.transport.vertex import SceneView, find_vertex

ALBEDO = 0.6
EXACT = ALBEDO / (1 - ALBEDO)
TRAINING = CacheTraining(steps=150, lanes=512, rate=0.01)


@pytest.fixture(scope="module")
def scene_view(built_in):
    return SceneView.of(parse(built_in("furnace", ALBEDO)).instantiate(), None, 0)


@pytest.fixture(scope="module")
def rays():
    return CameraRays.of(built_in_cameras("furnace", 8, 2))


def seen(radiance, scene_view) -> np.ndarray:
    """L_θ where rays meet a surface."""
    ray = pixel_rays(built_in_cameras("furnace", 8, 2), 16, 5)
    lanes = dr.width(ray)
    x1 = find_vertex(scene_view, ray, mi.Bool(True), seeded(6, lanes))
    (L,) = reflected_radiance(radiance, attach_albedo(scene_view, x1))
    return np.array(L)


def test_training_finds_the_light_of_all_bounces(scene_view, rays, tmp_path):
    radiance = fresh_radiance(scene_view, rays, TINY_FIT, 0)
    assert radiance.scale == pytest.approx(1 / (1 - ALBEDO), rel=0.05)
    before = seen(radiance, scene_view)
    first = train(scene_view, radiance, rays, CacheTraining(10, 512, 1e-6), seed=1)
    residual = train(scene_view, radiance, rays, TRAINING, seed=2)
    after = seen(radiance, scene_view)
    assert np.abs(after.mean() - EXACT) < 0.1 * np.abs(before.mean() - EXACT)
    assert after.mean() == pytest.approx(EXACT, rel=0.03)
    assert np.abs(after - EXACT).mean() < 0.06 * EXACT
    assert residual < 0.5 * first

    save_radiance(tmp_path / "radiance.npz", radiance)
    loaded = load_radiance(tmp_path / "radiance.npz", scene_view, TINY_FIT)
    np.testing.assert_array_equal(seen(loaded, scene_view), after)


def test_training_goes_on_where_it_was(scene_view, rays):
    """A field that is trained already stays so: it is not started afresh."""
    radiance = fresh_radiance(scene_view, rays, TINY_FIT, 0)
    train(scene_view, radiance, rays, TRAINING, seed=2)
    train(scene_view, radiance, rays, CacheTraining(5, 512, 1e-4), seed=3)
    assert seen(radiance, scene_view).mean() == pytest.approx(EXACT, rel=0.04)
