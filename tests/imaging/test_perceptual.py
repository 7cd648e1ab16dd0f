"""SSIM and FLIP are those of their papers."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from unbake.errors import UserError
from unbake.imaging import perceptual, pictures
from unbake.imaging.perceptual import PIXELS_PER_DEGREE, flip, ssim


@pytest.fixture
def pair() -> tuple[np.ndarray, np.ndarray]:
    """A picture with edges, and the same with noise and a patch of another colour; sRGB values."""
    y, x = np.mgrid[0:24, 0:32] / 32
    reference = np.stack([x, y, 0.5 + 0.4 * np.sin(40 * x * y)], -1)
    reference = (reference + 0.3 * (np.sin(60 * x) > 0.2)[..., None]).clip(0, 1)
    image = reference + 0.1 * np.sin(np.arange(reference.size) ** 2).reshape(reference.shape)
    image[5:9, 6:12] = (1, 0, 0.2)
    return image.clip(0, 1), reference


@pytest.mark.parametrize(
    ("degree", "mean", "largest"),
    [(PIXELS_PER_DEGREE, 0.174667, 0.71888), (20.0, 0.360798, 0.97197)],
)
def test_flip_is_that_of_its_authors(pair, degree, mean, largest):
    """The numbers are those of flip-evaluator 1.7."""
    found = flip(*pair, degree)
    assert found.shape == (24, 32)
    assert found.mean() == pytest.approx(mean, abs=1e-5)
    assert found.max() == pytest.approx(largest, abs=1e-4)


def test_ssim_is_its_formula_within_a_window(pair):
    a, b = (x[7 - 5 : 7 + 6, 15 - 5 : 15 + 6] for x in pair)  # around row 7, column 15
    d = np.arange(-5, 6)
    window = np.exp(-(d[:, None] ** 2 + d**2) / (2 * 1.5**2))[..., None]
    window /= window.sum()
    mean_a, mean_b = ((window * x).sum((0, 1)) for x in (a, b))
    variance = [(window * (x - m) ** 2).sum((0, 1)) for x, m in ((a, mean_a), (b, mean_b))]
    both = (window * (a - mean_a) * (b - mean_b)).sum((0, 1))
    expected = (2 * mean_a * mean_b + 1e-4) * (2 * both + 9e-4)
    expected /= (mean_a**2 + mean_b**2 + 1e-4) * (sum(variance) + 9e-4)
    assert ssim(*pair)[7, 15] == pytest.approx(expected.mean(), abs=1e-9)


@pytest.mark.parametrize("compare", [ssim, flip])
def test_bands_of_rows_are_the_whole_picture_and_need_less_memory(compare, monkeypatch):
    rng = np.random.default_rng(0)
    a, b = (rng.random((300, 40, 3)) for _ in range(2))
    tracemalloc.start()
    found = compare(a, b)
    _, in_bands = tracemalloc.get_traced_memory()
    monkeypatch.setattr(perceptual, "bands", lambda height, _: [(slice(0, height),) * 3])
    tracemalloc.reset_peak()
    whole = compare(a, b)
    _, at_once = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(found, whole, rtol=0, atol=1e-12)
    assert in_bands < 0.5 * at_once


def test_equal_pictures_look_equal(pair):
    np.testing.assert_allclose(ssim(pair[0], pair[0]), 1, atol=1e-9)
    assert flip(pair[0], pair[0]).max() == 0


def test_more_noise_looks_worse(pair):
    _, reference = pair
    noise = np.random.default_rng(0).standard_normal(reference.shape)
    noisy = [(reference + s * noise).clip(0, 1) for s in (0.02, 0.1, 0.3)]
    assert np.all(np.diff([ssim(x, reference).mean() for x in noisy]) < -0.05)
    assert np.all(np.diff([flip(x, reference).mean() for x in noisy]) > 0.05)


def test_pictures_smaller_than_the_windows_are_compared():
    white, black = np.ones((2, 3, 3)), np.zeros((2, 3, 3))
    assert ssim(white, black).max() < 0.01 and flip(white, black).min() > 0.9


@pytest.mark.parametrize("compare", [ssim, flip])
def test_pictures_of_other_sizes_are_refused(compare):
    with pytest.raises(ValueError, match="cannot be compared"):
        compare(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))


def test_an_exposure_takes_bright_pixels_to_four_fifths():
    bright = np.linspace(0, 4, 1000)
    exposure = pictures.fitting_exposure([pictures.sample(bright), np.array([np.nan])[:0]])
    assert exposure == -2.0  # 0.8 / 3.8, in half stops
    assert pictures.fitting_exposure([]) == 0.0 == pictures.fitting_exposure([np.zeros(3)])
    encoded = pictures.encoded(np.array([0.2140411 * 4, 40.0, np.nan]), exposure)
    np.testing.assert_allclose(encoded, [0.5, 1, 0], atol=1e-4)


def test_png_comes_back(tmp_path):
    for shape in ((3, 5), (3, 5, 3)):
        picture = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
        pictures.write_png(tmp_path / "a.png", picture)
        np.testing.assert_array_equal(pictures.read_png(tmp_path / "a.png"), picture)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:30])
    with pytest.raises(UserError, match=r"b\.png: the picture cannot be read as PNG"):
        pictures.read_png(tmp_path / "b.png")
