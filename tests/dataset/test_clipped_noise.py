"""Noise that was clipped at black: what it adds on average is taken away, and nothing else is."""

import numpy as np
import pytest

from unbake.dataset.camera import Camera
from unbake.dataset.clipped_noise import without_clipped_noise
from unbake.dataset.views import SensorNoise

SENSOR = SensorNoise(shot=0.005, read=0.02)
SIDE = 96
CAMERA = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, SIDE, SIDE)
ALL = np.ones(SIDE * SIDE, bool)


def photograph(light, sensor=SENSOR, seed=0):
    """Of light, (SIDE, SIDE) or a number, by a sensor whose noise is normal; not clipped."""
    light = np.broadcast_to(light, (SIDE, SIDE)).reshape(-1, 1).repeat(3, 1)
    deviation = np.sqrt(sensor.shot * light + sensor.read**2)
    noise = np.random.default_rng(seed).normal(0, 1, light.shape)
    return (light + deviation * noise).astype(np.float32)


@pytest.mark.parametrize("light", [0.005, 0.01, 0.02, 0.05, 0.2])
def test_the_mean_is_that_of_the_light(light):
    clipped = np.maximum(photograph(light), 0)
    found = without_clipped_noise(clipped, ALL, CAMERA, SENSOR)
    assert abs(found.mean() - light) < 0.08 * SENSOR.read
    if light <= 0.01:
        assert clipped.mean() - light > 0.2 * SENSOR.read
    else:
        assert abs(found.mean() - light) < 0.02 * light


def test_where_there_is_no_light_most_of_what_noise_adds_is_gone():
    clipped = np.maximum(photograph(0.0), 0)
    found = without_clipped_noise(clipped, ALL, CAMERA, SENSOR)
    assert found.mean() < 0.3 * clipped.mean()
    assert found.min() < 0, "values are as they were in the sensor"


def test_dark_and_bright_surfaces_keep_their_edge():
    light = np.where(np.arange(SIDE) < SIDE // 2, 0.01, 0.5)[None]
    found = without_clipped_noise(np.maximum(photograph(light), 0), ALL, CAMERA, SENSOR)
    columns = found.reshape(SIDE, SIDE, 3).mean((0, 2))
    np.testing.assert_allclose(columns[SIDE // 2 :], 0.5, rtol=0.05)
    np.testing.assert_allclose(columns[: SIDE // 2 - 2].mean(), 0.01, atol=0.08 * SENSOR.read)


def test_photographs_that_are_not_clipped_stay_as_they_are():
    rgb = photograph(0.01)
    for sensor in (SENSOR, None, SensorNoise(shot=0.005)):
        assert without_clipped_noise(rgb, ALL, CAMERA, sensor) is rgb
    bright = photograph(1.0)
    np.testing.assert_array_equal(without_clipped_noise(bright, ALL, CAMERA, SENSOR), bright)
    clipped = np.maximum(rgb, 0)
    for sensor in (None, SensorNoise(shot=0.005)):
        assert without_clipped_noise(clipped, ALL, CAMERA, sensor) is clipped


def test_pixels_that_do_not_count_tell_nothing():
    """A background of zeros beside a surface, or of negative numbers."""
    counted = (np.arange(SIDE) < SIDE // 2)[None].repeat(SIDE, 0).ravel()
    clipped = np.maximum(photograph(0.02), 0)
    alone = without_clipped_noise(clipped, ALL, CAMERA, SENSOR)
    for value in (0.0, -1.0, 7.0):
        rgb = np.where(counted[:, None], clipped, np.float32(value))
        found = without_clipped_noise(rgb, counted, CAMERA, SENSOR)
        assert abs(found[counted].mean() - alone[counted].mean()) < 0.02 * SENSOR.read
    nothing = np.zeros(SIDE * SIDE, bool)
    assert without_clipped_noise(clipped, nothing, CAMERA, SENSOR) is clipped


def test_what_is_clipped_at_white_stays_a_bound():
    """A small light in a dark room, whose window is dark in the mean."""
    clipped = np.maximum(photograph(0.005), 0)
    lights = np.arange(7, SIDE * SIDE, 997)
    clipped[lights] = 0.3
    found = without_clipped_noise(clipped, ALL, CAMERA, SENSOR, limit=0.3)
    assert (found[lights] == np.float32(0.3)).all()
    bounds = np.isin(np.arange(SIDE * SIDE), lights)
    assert (found[~bounds] < clipped[~bounds]).mean() > 0.9


@pytest.mark.filterwarnings("error")
def test_enormous_pixels_are_no_trouble():
    rgb = np.maximum(photograph(0.01), 0)
    rgb[1000:1010] = np.finfo(np.float32).max
    found = without_clipped_noise(rgb, ALL, CAMERA, SENSOR)
    assert np.isfinite(found).all() and (found[1000:1010] == rgb[1000:1010]).all()


def test_units_do_not_matter():
    clipped = np.maximum(photograph(0.01), 0)
    found = without_clipped_noise(clipped, ALL, CAMERA, SENSOR)
    divided = without_clipped_noise(clipped / 8, ALL, CAMERA, SENSOR.divided(8))
    np.testing.assert_allclose(8 * divided, found, atol=1e-6)
