"""Noise that was clipped at black is found by its zeros, and nothing else is taken for it."""

from dataclasses import replace

import numpy as np
import pytest

from unbake.dataset.camera import Camera
from unbake.dataset.clipped_noise import without_clipped_noise
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.findings import noise_at_black
from unbake.dataset.noise_at_black import COLUMNS, blocks, found_noise, told_noise
from unbake.dataset.photographs import Photographs
from unbake.dataset.views import Dataset, SensorNoise, View
from unbake.imaging.pictures import write_exr

SIDE = 240


def scene(darkest=0.002, brightest=0.5):
    """Light that rises from left to right, with a little texture; (SIDE, SIDE, 3)."""
    rise = np.geomspace(darkest, brightest, SIDE)[None, :, None]
    texture = 1 + 0.1 * np.sin(np.arange(SIDE) / 3)[:, None, None]
    return np.broadcast_to(rise * texture, (SIDE, SIDE, 3))


def photograph(light, noise, seed=0):
    """By a sensor that counts electrons, clipped at black."""
    rng = np.random.default_rng(seed)
    counted = noise.shot * rng.poisson(light / noise.shot) if noise.shot else light
    return np.maximum(counted + rng.normal(0, noise.read, light.shape), 0).astype(np.float32)


def found(*pictures, counted=None):
    every = np.ones(pictures[0].shape[:2], bool) if counted is None else counted
    return told_noise(np.concatenate([blocks(picture, every) for picture in pictures]))


@pytest.mark.parametrize("noise", [SensorNoise(0.005, 0.02), SensorNoise(0.0005, 0.01)])
@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_the_noise_of_a_sensor_is_found(noise, unit):
    pictures = [unit * photograph(scene(), noise, seed) for seed in range(4)]
    told = found(*pictures)
    assert told.read == pytest.approx(unit * noise.read, rel=0.1)
    assert 0 <= told.shot < unit * 5 * noise.shot
    finding = noise_at_black(told)
    assert finding.level == "warning" and f'"read": {told.read:.2g}' in finding.what


@pytest.mark.parametrize("edge", [100, 120, 150])
@pytest.mark.parametrize("seed", range(3))
def test_a_dark_surface_beside_a_bright_one_tells_its_noise(edge, seed):
    """Blocks on the edge, with some of both, tell nothing of it."""
    light = np.where(np.arange(SIDE) < edge, 0.02, 0.5)[None, :, None]
    light = np.broadcast_to(light, (SIDE, SIDE, 3))
    told = found(*(photograph(light, SensorNoise(0.0, 0.02), 10 * seed + i) for i in range(4)))
    assert told.read == pytest.approx(0.02, rel=0.25)


@pytest.mark.parametrize("light", [0.005, 0.01, 0.02])
def test_light_that_is_the_same_everywhere_tells_its_noise(light):
    even = np.full((SIDE, SIDE, 3), light)
    told = found(*(photograph(even, SensorNoise(0.0, 0.02), i) for i in range(4)))
    deviation = np.sqrt(told.shot * light + told.read**2)
    assert deviation == pytest.approx(0.02, rel=0.05)


@pytest.mark.filterwarnings("error")
def test_enormous_pixels_are_no_trouble():
    noisy = photograph(scene(), SensorNoise(0.005, 0.02))
    noisy[::50, ::50] = np.finfo(np.float32).max
    assert found(noisy, noisy, noisy, noisy).read == pytest.approx(0.02, rel=0.15)


def test_photographs_without_noise_at_black_are_not_doubted():
    assert noise_at_black(None) is None
    bright = [photograph(scene(0.2), SensorNoise(0.0, 0.01), seed) for seed in range(4)]
    assert found(*bright) is None
    assert found(scene().astype(np.float32)) is None
    assert found(np.zeros((SIDE, SIDE, 3), np.float32)) is None


def test_shadows_and_black_texture_are_no_noise():
    y, x = np.mgrid[:SIDE, :SIDE]
    for black in ((x // 7 + y // 11) % 2 == 0, (x - y) % 17 < 4, (x % 12 < 4) & (y % 9 < 4)):
        assert found(np.where(black[..., None], 0, scene()).astype(np.float32)) is None


@pytest.mark.parametrize("hits", [0.3, 1.0, 3.0])
def test_paths_that_find_no_light_are_no_noise_of_a_sensor(hits):
    """A pixel's mean over samples of which few find light: there are zeros, and no bias."""
    rng = np.random.default_rng(1)
    light = scene(0.02, 1.0)
    counts = rng.poisson(hits * light / light.mean())
    pictures = rng.gamma(np.maximum(counts, 1e-9)) * (counts > 0)
    assert found(pictures.astype(np.float32)) is None


def test_pixels_that_do_not_count_and_small_pictures_tell_nothing():
    noisy = photograph(scene(), SensorNoise(0.005, 0.02))
    assert found(noisy, counted=np.zeros((SIDE, SIDE), bool)) is None
    for shape in ((4, 40), (40, 14), (1, 1)):
        small = noisy[: shape[0], : shape[1]]
        assert blocks(small, np.ones(shape, bool)).shape == (0, COLUMNS)
        assert found(small) is None
    # Only blocks that count as a whole.
    counted = np.arange(SIDE)[None].repeat(SIDE, 0) < SIDE // 2
    spoiled = np.where(counted[..., None], noisy, 0)
    half = blocks(spoiled, counted)
    np.testing.assert_array_equal(half, blocks(noisy[:, : SIDE // 2], counted[:, : SIDE // 2]))


def test_of_a_large_picture_some_rows_are_looked_at():
    light = np.tile(scene(), (8, 8, 1))
    rows = blocks(photograph(light, SensorNoise(0.0, 0.02)), np.ones(light.shape[:2], bool))
    assert 10_000 < len(rows) / 3 < 17_000
    assert told_noise(rows).read == pytest.approx(0.02, rel=0.1)


def test_a_fit_corrects_what_it_finds_and_leaves_what_is_told_or_rendered(tmp_path):
    noise, camera = (
        SensorNoise(0.005, 0.02),
        Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, SIDE, SIDE),
    )
    views = []
    for i in range(4):
        picture = photograph(scene(), noise, i)
        write_exr(tmp_path / f"{i}.exr", np.dstack([picture, np.ones((SIDE, SIDE))]))
        views.append(View(f"{i}", "train", camera, tmp_path / f"{i}.exr", {}))
    data = Dataset(tmp_path, tmp_path / "s.xml", "visible", views, {}, None)
    found = Photographs.load(data, False)
    assert found.noise == found_noise(data) and found.noise.read == pytest.approx(0.02, rel=0.1)
    corrected = without_clipped_noise(
        photograph(scene(), noise, 0).reshape(-1, 3), np.ones(SIDE**2, bool), camera, found.noise
    )
    np.testing.assert_array_equal(found.table[: SIDE**2, :3], corrected)
    dark = found.table[:, 0].reshape(4, SIDE, SIDE)[..., :40]
    assert dark.mean() == pytest.approx(scene()[:, :40].mean(), rel=0.25)
    told = replace(data, views=tuple(replace(view, noise=noise) for view in views))
    assert Photographs.load(told, False).noise is None
    rendered = replace(data, render={"spp": 16})
    plain = Photographs.load(rendered, False)
    assert plain.noise is None and plain.table[:, :3].min() == 0
    DataFolder(tmp_path).degraded_file.write_text("{}")
    assert Photographs.load(rendered, False).noise == found.noise
