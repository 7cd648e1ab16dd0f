"""The gradient of the squared error is unbiased: from all pairs of samples, halves or two passes.

One that takes both of its factors from the same samples is not, which is why there are these.
"""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, ConstantMaterials, ConstantRadiance, built_in_cameras, pieces, seeded

from unbake.dataset.pixels import CameraRays, PixelSource
from unbake.fields.texture import material_textures
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.training.problem import make_problem
from unbake.training.state import State
from unbake.training.step import TrainingStep
from unbake.transport.loss import RelativeL2, pixel_means, squared_error
from unbake.transport.methods import PHOTOMETRIC, PRIOR, PRIOR_PAIR, Attached
from unbake.transport.objective import objective, requirements
from unbake.transport.path_sample import rhs, trace
from unbake.transport.prior import residual
from unbake.transport.vertex import SceneView


def z_of(values, expected, error=0.0):
    """How many standard errors the mean of independent values is away from what it should be."""
    values = np.asarray(values, np.float64)
    standard = np.sqrt(values.var(0, ddof=1) / len(values) + error**2)
    return (values.mean(0) - expected) / standard


def naive(samples, target, spp, weight, primal=None):
    """Both factors from the same samples."""
    return dr.mean(dr.mean(dr.square(pixel_means(samples, spp) - target) * weight))


# ---------------------------------------------------- made-up samples: each pixel is a seed

SEEDS, SPP = 20_000, 4
TRUE, TARGET, WEIGHT = 0.7, 0.5, 1.7


def noisy(parameter, seed):
    """Samples of I(φ) = φ whose noise is in the value and in the derivative."""
    lane = dr.arange(mi.UInt32, SEEDS * SPP)
    sampler = seeded(seed, SEEDS * SPP)
    noise = mi.Color3f([4 * sampler.next_1d() - 1 for _ in range(3)])
    return dr.gather(mi.Float, parameter, lane // SPP) * noise


def made_up(estimator):
    """The loss's value, and the derivative of each pixel's part of it."""
    parameter = dr.full(mi.Float, TRUE, SEEDS)
    dr.enable_grad(parameter)
    samples = noisy(parameter, 1)
    target, weight = dr.full(mi.Color3f, TARGET, SEEDS), mi.Color3f(WEIGHT)
    loss = estimator(samples, target, weight, dr.detach(pixel_means(noisy(parameter, 2), SPP)))
    dr.backward(loss)
    return float(loss[0]), SEEDS * np.array(dr.grad(parameter))


ESTIMATORS = {
    "all pairs": lambda samples, g, w, primal: squared_error(samples, g, SPP, w),
    "split halves": lambda samples, g, w, primal: squared_error(samples, g, SPP, w, pairs=False),
    "two passes": lambda samples, g, w, primal: squared_error(samples, g, SPP, w, primal),
    "naive": lambda samples, g, w, primal: naive(samples, g, SPP, w),
}


@pytest.mark.parametrize("name", ["all pairs", "split halves", "two passes"])
def test_the_gradient_is_unbiased(name):
    _, gradients = made_up(ESTIMATORS[name])
    z = z_of(gradients, 2 * WEIGHT * (TRUE - TARGET))
    print(f"{name}: z {z:.2f}, mean {gradients.mean():.4f}, σ {gradients.std():.3f}")
    assert abs(z) < 3


def test_the_naive_gradient_is_biased():
    _, gradients = made_up(ESTIMATORS["naive"])
    z = z_of(gradients, 2 * WEIGHT * (TRUE - TARGET))
    print(f"naive: z {z:.1f}, mean {gradients.mean():.4f}")
    assert z > 5
    # By twice the covariance of value and derivative, Var(noise) φ / spp; the noise is uniform.
    bias = 2 * WEIGHT * TRUE * (4**2 / 12) / SPP
    assert abs(z_of(gradients, 2 * WEIGHT * (TRUE - TARGET) + bias)) < 3


def test_all_pairs_have_less_noise_than_halves():
    """The gradient's variance: of all n (n - 1) products it is less than of n² / 2 of them."""
    pairs, halves = (made_up(ESTIMATORS[name])[1].var() for name in ("all pairs", "split halves"))
    print(f"σ² {pairs:.3f} of all pairs, {halves:.3f} of halves")
    assert pairs < 0.9 * halves


@pytest.mark.parametrize("name", ["all pairs", "split halves", "two passes"])
def test_the_value_is_the_squared_error_of_the_expected_image(name):
    value, _ = made_up(ESTIMATORS[name])
    naive_value, _ = made_up(ESTIMATORS["naive"])
    expected = WEIGHT * (TRUE - TARGET) ** 2
    assert abs(value - expected) < 0.02
    assert naive_value - expected > 0.1


# ------------------------------------------------------------------- one pixel of a real image


@pytest.fixture(scope="module")
def room(built_in):
    """The Cornell box with one principled material whose albedo each lane can have its own of."""
    materials = ConstantMaterials(0.5, 0.4)
    parsed = parse(built_in("cornell"))
    edit.set_textures(parsed, material_textures(materials))
    return SceneView.of(parsed.instantiate(), materials, 8)


def one_pixel(room, lanes, seed):
    """Samples of one pixel, and the albedo of each."""
    rays = CameraRays.of(built_in_cameras("cornell", 4))
    sampler = seeded(seed, lanes)
    ray = rays.through(dr.full(mi.UInt32, 9, lanes), sampler.next_2d())
    albedo = room.materials.albedo = dr.full(mi.Color3f, 0.5, lanes)
    dr.enable_grad(albedo)
    return albedo, trace(
        room, ConstantRadiance(0.3), ray, sampler, pieces(1, 1), hide_emitters=False
    )


def reference_gradient(room, target, weight, batches=12, lanes=1 << 17):
    """2 w (I − G) ∂I with both factors from so many samples that there is hardly any noise."""
    means = []
    for k in range(batches):
        _, sample = one_pixel(room, lanes, 1000 + k)
        means.append(np.array(dr.detach(rhs(sample, sample.radiance[1])), np.float64).mean(1))
    image = np.mean(means, 0)
    factor = mi.Color3f((2 / 3 * weight * (image - target)).tolist())
    gradients = []
    for k in range(batches):
        albedo, sample = one_pixel(room, lanes, 2000 + k)
        dr.backward(dr.sum(dr.mean(factor * rhs(sample, sample.radiance[1]), axis=1)))
        gradients.append(np.array(dr.grad(albedo), np.float64).sum(1))
    # The error of `image` is common to all and scales the gradient.
    relative = np.std(means, 0, ddof=1) / np.sqrt(batches) / np.abs(image - target)
    mean = np.mean(gradients, 0)
    return mean, np.hypot(np.std(gradients, 0, ddof=1) / np.sqrt(batches), mean * relative)


def test_the_gradient_of_a_real_pixel_is_unbiased(room):
    repeats, spp, epsilon = 8192, 2, 0.01
    target = np.array([0.25, 0.2, 0.1])
    exact, error = reference_gradient(room, target, 1 / (target**2 + epsilon))
    print(f"exact {exact} ± {error}")

    def gradients(two_pass, estimator=None):
        primal = None
        if two_pass:
            _, again = one_pixel(room, repeats * spp, 77)
            primal = dr.detach(pixel_means(rhs(again, again.radiance[1]), spp))
        albedo, sample = one_pixel(room, repeats * spp, 78)
        photographs = dr.repeat(mi.Color3f(target.tolist()), repeats)
        loss = RelativeL2(epsilon)
        if estimator is None:
            row = {PHOTOMETRIC: Attached(scene=True)}
            value = objective(row, sample, photographs, loss, primal)[PHOTOMETRIC]
        else:
            weight = loss.weight(photographs)
            value = estimator(rhs(sample, sample.radiance[1]), photographs, spp, weight)
        dr.backward(value)
        lanes = np.array(dr.grad(albedo), np.float64).reshape(3, repeats, spp)
        return repeats * lanes.sum(2).T

    for two_pass in (False, True):
        z = z_of(gradients(two_pass), exact, error)
        print(f"two passes: {two_pass}: z {z}")
        assert np.abs(z).max() < 3
    z = z_of(gradients(False, naive), exact, error)
    print(f"naive: z {z}")
    assert z.max() > 5


# ------------------------------------------------------- a prior that trains the materials too

CACHE = 0.3
ONE_PRIOR = RelativeL2(0.01)


def one_point_a_pixel(room, repeats, albedo, seed, wanted):
    """Path samples through the centres of 16 pixels, `repeats` lanes each."""
    rays = CameraRays.of(built_in_cameras("cornell", 4))
    pixel = dr.arange(mi.UInt32, 16 * repeats) // repeats
    ray = rays.through(pixel, mi.Point2f(0.5) + dr.zeros(mi.Point2f, 16 * repeats))
    room.materials.albedo = albedo
    sampler = seeded(seed, 16 * repeats)
    return trace(room, ConstantRadiance(CACHE), ray, sampler, wanted, hide_emitters=False)


def squared_residual(room, albedo, seed, repeats=1 << 13):
    """Of the mean of many samples of T at each point, by channel: mean over the points."""
    row = {PRIOR: Attached(lhs=True)}
    with dr.suspend_grad():
        sample = one_point_a_pixel(room, repeats, mi.Color3f(albedo), seed, requirements(row))
        r = residual(sample, 1, sample.radiance[0], sample.radiance[1])
    mean = np.array(r, np.float64).reshape(3, 16, repeats).mean(2)
    return (np.square(mean) / (CACHE**2 + ONE_PRIOR.epsilon)).mean(1)


def test_the_product_of_two_residuals_has_an_unbiased_gradient_and_the_square_of_one_has_not(room):
    """By the albedo, against central differences: the squared residual is quadratic in it."""
    ends = [[squared_residual(room, 0.5 + h, 300 + k) for h in (0.1, -0.1)] for k in range(24)]
    differences = np.array([(a - b) / 0.2 for a, b in ends])
    exact, error = differences.mean(0), differences.std(0, ddof=1) / np.sqrt(len(ends))
    print(f"exact {exact} ± {error}")

    repeats = 1 << 13
    found = {}
    for term in (PRIOR_PAIR, PRIOR):
        row = {term: Attached(scene=True)}
        albedo = dr.full(mi.Color3f, 0.5, 16 * repeats)
        dr.enable_grad(albedo)
        sample = one_point_a_pixel(room, repeats, albedo, 900, requirements(row))
        value = objective(row, sample, mi.Color3f(0), ONE_PRIOR)[term]
        dr.backward(value)
        lanes = np.array(dr.grad(albedo), np.float64).reshape(3, 16, repeats)
        # The objective is a mean over lanes and channels, the reference one over points.
        found[term] = z_of((3 * repeats * lanes.sum(1)).T, exact, error)
        print(f"{term}: z {found[term]}")
    assert np.abs(found[PRIOR_PAIR]).max() < 3
    assert found[PRIOR].min() > 5


# -------------------------------------------------------------------------- the training step


def step_gradients(built_in, config, steps, first=0):
    """Gradients of φ that training steps on a single pixel take, (steps, parameters).

    Gradient descent at rate 1 gives them away; all steps start at the same place.
    """
    problem = make_problem(built_in("cornell"), "visible", config, 0.2)
    camera = dataclasses.replace(built_in_cameras("cornell", 4)[0], width=1, height=1)
    photograph = np.array([[0.25, 0.2, 0.1]])
    pixels = PixelSource.of([camera], photograph, np.ones(1), foreground_only=False)
    φ = problem.materials.parameters()
    state = State(mi.ad.SGD(1.0, φ), mi.ad.SGD(1.0, problem.learned_parameters()))
    step = TrainingStep(problem, pixels, config)
    start = {k: np.array(v) for k, v in φ.items()}
    rows = []
    for i in range(first, first + steps):
        step(state, i, {"albedo": 1.0, "roughness": 1.0, "radiance": 0.0})
        rows.append([np.ravel(start[k] - np.array(state.phi[k])) for k in start])
        state.phi.update(φ)
    return np.array([np.concatenate(row) for row in rows], np.float64)


@pytest.mark.parametrize("reference", ["photograph", "smoothed"])
def test_the_gradient_of_a_training_step_is_unbiased(built_in, reference):
    few = dataclasses.replace(TINY_FIT, seed=1, pixels=128, spp=2, loss_reference=reference)
    many = dataclasses.replace(few, pixels=4, spp=4096)
    # With so many samples a pixel no estimator has a bias to speak of.
    exact = step_gradients(built_in, many, 60, first=10_000)
    direction = exact.mean(0) / np.linalg.norm(exact.mean(0))
    along = exact @ direction
    error = along.std(ddof=1) / np.sqrt(len(along))
    for estimator in ("all-pairs", "split-halves", "two-pass"):
        config = dataclasses.replace(few, estimator=estimator)
        gradients = step_gradients(built_in, config, 200) @ direction
        z = z_of(gradients, along.mean(), error)
        print(f"{reference}, {estimator}: {gradients.mean():.5f}, {along.mean():.5f}, z {z:.2f}")
        assert abs(z) < 3
