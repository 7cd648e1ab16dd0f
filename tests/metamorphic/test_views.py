"""What must happen to training pixels, losses and fits when the data are told in another way."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scene_texts import PRINCIPLED
from support import TINY_FIT, grey_photographs, seeded

from unbake.dataset.camera import Camera
from unbake.dataset.pixels import PixelSource
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.loss import RelativeL2
from unbake.transport.methods import LHS, Attached
from unbake.transport.objective import objective, requirements
from unbake.transport.path_sample import trace

SCENE = f"""<scene version="3.0.0">
  <shape type="rectangle"><transform name="to_world"><scale value="{{s2}}"/></transform>
    {PRINCIPLED}</shape>
  <shape type="sphere"><point name="center" x="0" y="0" z="{{s}}"/>
    <float name="radius" value="{{s_half}}"/>{PRINCIPLED}</shape>
  <emitter type="point"><point name="position" x="{{s}}" y="-{{s}}" z="{{s4}}"/>
    <rgb name="intensity" value="{{light}}"/></emitter>
  <emitter type="constant"><rgb name="radiance" value="{{sky}}"/></emitter>
</scene>"""


def write_scene(path, scale=1.0, light=1.0):
    numbers = {"s": scale, "s2": 2 * scale, "s_half": scale / 2, "s4": 4 * scale}
    sky = " ".join(str(light * x) for x in (0.3, 0.2, 0.1))
    path.write_text(SCENE.format(**numbers, light=12 * light * scale**2, sky=sky))
    return path


def cameras(scale=1.0):
    """Three views of several sizes."""
    places = [((0, -4, 3), 9, 7), ((3, -2, 2.5), 6, 8), ((-3, 1, 4), 5, 5)]
    return [
        Camera.look_at(np.multiply(scale, p), (0, 0, scale / 2), (0, 0, 1), 50, w, h)
        for p, w, h in places
    ]


def source(order):
    """The training pixels of the views in an order."""
    views = cameras()
    pictures = [
        np.random.default_rng(i).uniform(0.1, 0.6, (view.width * view.height, 3))
        for i, view in enumerate(views)
    ]
    rgb = np.concatenate([pictures[i] for i in order])
    chosen = [views[i] for i in order]
    return PixelSource.of(chosen, rgb, np.ones(len(rgb)), foreground_only=False)


def rows(pixels):
    """All pixels: origins and directions of the rays through their centres, and their colours."""
    numbers = mi.UInt32(np.arange(pixels.rays.pixels, dtype=np.uint32))
    ray = pixels.rays.through(numbers, mi.Point2f(0.5))
    return ray, np.concatenate([np.array(ray.o), np.array(ray.d), pixels.photographs.table.T]).T


def in_sorted_rows(table):
    return table[np.lexsort(table.T)]


@pytest.mark.parametrize("order", [(2, 0, 1), (1, 0, 2)])
def test_permuted_views_are_the_same_pixels(order):
    pixels, expected = source(order), source((0, 1, 2))
    found = in_sorted_rows(rows(pixels)[1])
    np.testing.assert_allclose(found, in_sorted_rows(rows(expected)[1]), atol=1e-6)
    assert pixels.photographs.mean == pytest.approx(expected.photographs.mean, rel=1e-6)


def test_permuted_views_have_the_same_loss_and_gradient(tmp_path):
    """Over all pixels: the loss of L_θ as it is seen directly, which has no random numbers."""
    problem = make_problem(write_scene(tmp_path / "scene.xml"), "visible", TINY_FIT, 0.3)
    row = {LHS: Attached(lhs=True)}

    def loss_and_gradient(order):
        pixels = source(order)
        ray, _ = rows(pixels)
        θ = problem.radiance.parameters()
        dr.disable_grad(θ)
        dr.enable_grad(θ)
        problem.radiance.assign(θ)
        # Squared errors take different samples of a pixel: of two or more, which here are equal.
        twice = dr.gather(mi.Ray3f, ray, dr.arange(mi.UInt32, 2 * dr.width(ray)) // 2)
        sampler = seeded(0, dr.width(twice))
        sample = trace(problem.scene_view, problem.radiance, twice, sampler, requirements(row))
        target = mi.Color3f(pixels.photographs.table[:, :3].T.copy())
        (value,) = objective(row, sample, target, RelativeL2(0.01)).values()
        dr.backward(value)
        gradient = [np.array(dr.grad(x), np.float64).ravel() for x in θ.values()]
        return float(value[0]), np.concatenate(gradient)

    expected, gradient = loss_and_gradient((0, 1, 2))
    found, other = loss_and_gradient((2, 0, 1))
    assert expected > 0.01 and np.abs(gradient).max() > 1e-4
    assert found == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(other, gradient, atol=1e-4 * np.abs(gradient).max())


def test_a_crop_of_training_pixels_is_a_slice_of_a_photograph():
    pixels = source((0, 1, 2))
    table = pixels.photographs.table[: 9 * 7].reshape(7, 9, -1)
    _, all_rows = rows(pixels)
    origin = all_rows[0, :3]
    for seed in range(20):
        batch = pixels.draw_crop(seed, 16)
        drawn = batch.batch(pixels.rays, seeded(seed, 16), 1)
        if not np.allclose(np.array(drawn.ray.o)[:, 0], origin):
            continue
        colours = np.array(drawn.target).T.reshape(4, 4, 3)
        places = [
            (y, x)
            for y, x in np.ndindex(4, 6)
            if np.array_equal(table[y : y + 4, x : x + 4, :3], colours)
        ]
        assert len(places) == 1
        return
    pytest.fail("no crop of the first view in 20 draws")


def losses(method, path, scale=1.0, light=1.0):
    """Those of four steps."""
    depths = dataclasses.replace(TINY_FIT.path, max_depth=3)
    config = dataclasses.replace(TINY_FIT, method=method, path=depths, representation="grid")
    file = write_scene(path / f"{scale}-{light}.xml", scale, light)
    problem = make_problem(file, "visible", config, 0.3 * light)
    pixels = grey_photographs(cameras(scale), 0.3 * light)
    step = TrainingStep(problem, pixels, config)
    state = initial_state(problem)
    rates = dict.fromkeys((*config.quantities, "radiance"), 0.01)
    terms = [step(state, i, rates) for i in range(4)]
    return [[float(value[0]) for value in t.values()] for t in terms]


@pytest.mark.parametrize("method", ["ours", "prb", "ad-pt"])
def test_a_fit_does_not_depend_on_the_unit_of_length(method, tmp_path):
    """Fields are functions in the scene's box: twice as large, everything is the same."""
    found = [losses(method, tmp_path, scale=scale) for scale in (1.0, 2.0)]
    print(found)
    np.testing.assert_allclose(found[1], found[0], rtol=5e-3)


@pytest.mark.parametrize("method", ["ours", "prb", "ad-pt"])
def test_a_dim_fit_does_not_depend_on_the_unit_of_light(method, tmp_path):
    """A power of two, so that roundings are the same as well."""
    found = [losses(method, tmp_path, light=light) for light in (2**-4, 2**-14)]
    print(found)
    np.testing.assert_allclose(found[1], found[0], rtol=5e-3)
