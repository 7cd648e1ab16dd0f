"""How near light is: low frequencies, relit balls, strengths; what scores and what does not."""

import dataclasses
import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT

from unbake.evaluation import lighting
from unbake.evaluation.lighting import (
    DEFINITIONS,
    compare_environments,
    environment_scale,
    recovered_emitters,
    relight_psnr,
    relit,
    sh_coefficients,
    sh_error,
)
from unbake.fields.envmap import latlong
from unbake.scene import emitters
from unbake.scene.parse import parse
from unbake.training.problem import make_problem

ROWS = 64


@pytest.fixture(scope="module")
def sky(built_in):
    """The environment of `still`."""
    return emitters.environment_latlong(parse(built_in("still")).instantiate(), ROWS)


def picture_of(function):
    """The picture of a function of x, y, z, grey."""
    return latlong(lambda d: mi.Color3f(function(d.x, d.y, d.z) + 0 * d.x), ROWS, 4)


# ------------------------------------------------------------------------- spherical harmonics


@pytest.mark.parametrize(
    ("function", "expected"),
    [
        (lambda x, y, z: 1, {0: np.sqrt(4 * np.pi)}),
        (lambda x, y, z: y, {2: np.sqrt(4 * np.pi / 3)}),
        # The picture's θ is counted from +y, its φ from -z towards +x.
        (lambda x, y, z: x, {1: np.sqrt(4 * np.pi / 3)}),
        (lambda x, y, z: z, {3: -np.sqrt(4 * np.pi / 3)}),
        (lambda x, y, z: 3 * y * y - 1, {6: 2 * np.sqrt(4 * np.pi / 5)}),
        (lambda x, y, z: x * z, {4: -np.sqrt(4 * np.pi / 15)}),
        (lambda x, y, z: z * z - x * x, {8: 2 * np.sqrt(4 * np.pi / 15)}),
        (lambda x, y, z: 5 * y * y * y - 3 * y, {12: 2 * np.sqrt(4 * np.pi / 7)}),
        (lambda x, y, z: (35 * y * y * y * y - 30 * y * y + 3) / 8, {}),
        (lambda x, y, z: x * z * (7 * y * y - 1), {}),
    ],
    ids=["1", "y", "x", "z", "3y²-1", "xz", "z²-x²", "5y³-3y", "order 4, m = 0", "order 4, m = 2"],
)
def test_coefficients_are_those_of_known_functions(function, expected):
    """Of orders 0 to 3, closed forms; order 4 does not count."""
    c = sh_coefficients(picture_of(function))
    analytic = np.zeros((16, 3))
    for number, value in expected.items():
        analytic[number] = value
    np.testing.assert_allclose(c, analytic, atol=4e-3)


def test_the_basis_is_orthonormal():
    """Order by order, m from -l to l: the image of a basis function has one coefficient, 1."""
    gram = np.array([sh_coefficients(np.dstack([f] * 3))[:, 0] for f in lighting._sh_basis(256)])
    np.testing.assert_allclose(gram, np.eye(16), atol=3e-4)


def test_coefficients_are_those_of_associated_legendre_polynomials():
    """Numbers of an implementation by the recurrence of P_l^m, without Condon–Shortley phase."""
    y, x = np.mgrid[0:16, 0:32]
    channels = [np.exp(-0.05 * ((x - 9) ** 2 + (y - 5) ** 2)), 0.3 + 0.01 * x * y]
    image = np.stack([*channels, np.sin(0.4 * x) ** 2 * y], axis=-1)
    first = [
        0.516730304, 0.594091113, 0.243139564, -0.181094211, -0.189894843, 0.289095598,
        -0.125114548, -0.088123754, -0.2855309, -0.080407027, -0.091729454, 0.014591554,
        -0.089659673, -0.00444788, -0.137926828, 0.097786253,
    ]  # fmt: skip
    np.testing.assert_allclose(sh_coefficients(image)[:, 0], first, rtol=1e-6)
    assert sh_error(image, image[::-1]) == pytest.approx(0.782707066366079, rel=1e-12)


def test_the_poles_are_the_first_and_the_last_row():
    """A picture of few rows, where half a texel matters."""
    y = np.cos(np.pi * np.arange(9) / 8)[:, None, None] * np.ones((9, 18, 3))
    even = sh_coefficients(y)
    np.testing.assert_allclose(even[2], np.sqrt(4 * np.pi / 3), rtol=0.02)
    np.testing.assert_allclose(np.delete(even, 2, 0), 0, atol=0.06)
    np.testing.assert_allclose(sh_coefficients(np.ones((9, 18, 3)))[0], np.sqrt(4 * np.pi))


def test_a_map_has_no_error_against_itself_and_a_scaled_one_its_scale(sky):
    assert sh_error(sky, sky) == 0
    assert sh_error(1.3 * sky, sky) == pytest.approx(0.3, rel=1e-4)
    assert sh_error(0 * sky, sky) == pytest.approx(1)
    assert np.isfinite(sh_error(sky, 0 * sky))


def test_alignment_takes_the_scale_of_each_channel_away(sky):
    tinted = sky * np.array([0.5, 1.5, 3])
    np.testing.assert_allclose(environment_scale(tinted, sky), [2, 1 / 1.5, 1 / 3], rtol=1e-5)
    found = compare_environments(tinted, sky)
    assert found["sh_error"] > 0.4 and found["relight_psnr"] < 20
    assert found["sh_error_aligned"] < 1e-5 and found["relight_psnr_aligned"] > 60


def test_alignment_never_makes_the_error_larger(sky):
    rng = np.random.default_rng(0)
    for _ in range(5):
        found = sky * rng.uniform(0.5, 2) + rng.uniform(0, 1, 3) * np.roll(sky, 20, 1)
        aligned = found * environment_scale(found, sky)
        assert sh_error(aligned, sky) < sh_error(found, sky)


def test_high_frequencies_do_not_count(sky):
    fine = picture_of(lambda x, y, z: dr.sin(20 * x) * dr.sin(20 * z))
    assert np.abs(fine).max() > 0.8
    low = picture_of(lambda x, y, z: x * z)
    assert sh_error(sky + 0.3 * fine, sky) < 0.01
    assert sh_error(sky + 0.3 * low, sky) > 0.05


# ------------------------------------------------------------------------------------ relighting


def test_equal_light_makes_equal_pictures_and_turned_light_others(sky):
    assert relight_psnr(sky, sky) == 120  # what stands for infinity
    turns = [relight_psnr(np.roll(sky, n, 1), sky) for n in (1, 8, 64)]
    assert turns == sorted(turns, reverse=True)
    assert turns[0] > 30 and turns[-1] < 15
    assert relight_psnr(sky[::-1], sky) < 17
    assert relight_psnr(np.full_like(sky, sky.mean()), sky) < 20


def test_noise_of_rendering_does_not_hide_small_errors(sky):
    rng = np.random.default_rng(0)
    assert relight_psnr(sky * rng.uniform(0.98, 1.02, sky.shape), sky) > 50


@pytest.mark.filterwarnings("error")
def test_darkness_is_no_division_by_zero(sky):
    found = compare_environments(sky, 0 * sky)
    assert all(np.isfinite(value) for value in found.values())
    assert all(np.isfinite(value) for value in compare_environments(0 * sky, sky).values())


def test_no_side_of_the_light_is_hidden(sky):
    """A small bright spot shows wherever it is."""
    base, seen = relit(np.full_like(sky, 0.1))
    assert 0.5 < seen.mean() < 0.7
    for row, column in [(0, 0), (16, 16), (32, 48), (32, 112), (48, 80), (60, 0)]:
        lit = np.full_like(sky, 0.1)
        lit[row : row + 4, column : column + 4] = 20
        assert (relit(lit)[0] - base)[seen].mean() > 0.001, (row, column)


# ---------------------------------------------------------------------------------- orientation


def test_latlong_is_the_layout_of_mitsubas_envmap(sky):
    """A picture that is loaded by `envmap` is read back as it was, pixel by pixel."""
    emitter = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(sky)})

    def radiance(d):
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
        si.wi = -d
        return emitter.eval(si)

    found = latlong(radiance, ROWS, 1)
    np.testing.assert_allclose(found[1:-1], sky[1:-1], rtol=1e-3, atol=1e-4)
    # The poles are one direction each, which has no longitude.
    np.testing.assert_allclose(found[[0, -1]], sky[[0, -1]], rtol=0.1)


def test_a_scenes_environment_is_its_picture(sky):
    scene = {"type": "scene", "ball": {"type": "sphere"}}
    scene["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    found = emitters.environment_latlong(mi.load_dict(scene), ROWS)
    # Means over pixels, so that only what is curved inside one differs.
    assert np.abs(found - sky).max() < 0.05 * sky.max()
    assert np.abs(found - sky).mean() < 0.005 * sky.mean()
    assert np.abs(found - np.roll(sky, 1, 1)).mean() > 0.02 * sky.mean()
    assert np.abs(found - np.roll(sky, 1, 0)).mean() > 0.02 * sky.mean()


def test_nothing_of_a_small_sun_is_lost():
    """Of fine maps every other row was missed, and of Mitsuba's sun a tenth."""
    rows = 1024
    fine = np.zeros((rows, 2 * rows, 3), np.float32)
    fine[301, 777] = 5000.0
    scene = {"type": "scene", "sky": {"type": "envmap", "bitmap": mi.Bitmap(fine)}}
    found = emitters.environment_latlong(mi.load_dict(scene), 32)
    whole = 5000 * np.pi**2 / (rows - 1) / rows * np.sin(np.pi * 301 / (rows - 1))
    solid = np.pi**2 / 31 / 32 * np.sin(np.pi * np.arange(32) / 31)
    assert (found * solid[:, None, None]).sum((0, 1)) == pytest.approx([whole] * 3, rel=0.05)

    sun = {"type": "sunsky", "sky_scale": 0.0, "sun_direction": [0.3, 0.2, 0.5]}
    images = [emitters.environment_latlong(mi.load_dict({"type": "scene", "sky": sun}), h)
              for h in (64, 128)]  # fmt: skip
    energies = []
    for image in images:
        h = len(image)
        solid = np.pi**2 / (h - 1) / h * np.sin(np.pi * np.arange(h) / (h - 1))
        energies.append((image * solid[:, None, None]).sum())
    assert energies[0] == pytest.approx(energies[1], rel=0.03)


# --------------------------------------------------------------------------------------- lights


def test_strengths_stand_beside_the_true_ones(built_in, tmp_path):
    config = dataclasses.replace(TINY_FIT, unknown="emission")
    problem = make_problem(built_in("cornell"), "visible", config, 4.0)
    (light,) = recovered_emitters(problem, tmp_path)
    assert light.name == "light_shape"
    np.testing.assert_allclose(light.strength, 4, rtol=1e-5)
    assert light.truth is None and light.emission_error is None

    (tmp_path / "truth").mkdir()
    known = [{"name": "light_shape", "strength": [4, 4, 2]}, {"name": "other", "strength": None}]
    (tmp_path / "truth" / "emission.json").write_text(json.dumps(known))
    (light,) = recovered_emitters(problem, tmp_path)
    assert light.truth == [4, 4, 2]
    assert light.emission_error == pytest.approx(2 / 6, rel=1e-5)

    known[0]["strength"] = [0, 0, 0]  # nothing that an error could be relative to
    (tmp_path / "truth" / "emission.json").write_text(json.dumps(known))
    (light,) = recovered_emitters(problem, tmp_path)
    assert light.truth == [0, 0, 0] and light.emission_error is None

    materials = make_problem(built_in("cornell"), "visible", TINY_FIT, 4.0)
    assert recovered_emitters(materials, tmp_path) == []


def test_every_number_has_a_definition():
    told = " ".join(lighting.DEFINITIONS)
    for name in ("sh_error", "relight_psnr", "aligned", "emission_error"):
        assert name in told


def test_directions_that_are_not_seen_have_no_part_in_the_scores_of_seen_ones(sky):
    seen = np.zeros(sky.shape[:2], bool)
    seen[: len(sky) // 2] = True
    wrong = np.where(seen[..., None], sky, 5 * sky + 1)
    found = compare_environments(wrong, sky, seen)
    assert found["sh_error"] > 0.3 and found["sh_error_seen"] == pytest.approx(0, abs=1e-6)
    assert found["relight_psnr_seen"] > 60 > found["relight_psnr"]
    assert "sh_error_seen" not in compare_environments(wrong, sky)
    assert set(found) < set(DEFINITIONS) | {"sh_error_aligned", "relight_psnr_aligned"}
