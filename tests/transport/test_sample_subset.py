"""L_θ may learn of some camera samples of each pixel: the terms are those of these samples."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_same_expectation,
    built_in_cameras,
    enable_gradients,
    pixel_rays,
    planned_sampler,
    seeded,
)

from unbake.transport import path_sample
from unbake.transport.loss import RelativeL2
from unbake.transport.methods import METHODS, PHOTOMETRIC
from unbake.transport.objective import objective, requirements
from unbake.transport.path_sample import SampleSubset, lhs, rhs, trace
from unbake.transport.prior import residual

SPP, FEW = 8, 2


@pytest.fixture(scope="module")
def rays():
    return pixel_rays(built_in_cameras("cornell", 12), SPP, seed=1)


def row_of(method):
    """Terms of a method, or of `ours` with the one bounce prior."""
    if method == "one-bounce":
        return METHODS["ours"].without_extra_bounce().terms
    return METHODS[method].terms


def first_samples(rays):
    """Numbers of the first samples of each pixel."""
    lane = dr.arange(mi.UInt32, dr.width(rays) // SPP * FEW)
    return lane // FEW * SPP + lane % FEW


def traced(problem, rays, wanted, *, subset, seed=2):
    chosen = first_samples(rays)
    second = SampleSubset(chosen, seeded(seed + 77, dr.width(chosen))) if subset else None
    sampler = seeded(seed, dr.width(rays))
    return trace(
        problem.scene_view,
        problem.radiance,
        rays,
        sampler,
        wanted,
        hide_emitters=False,
        subset=second,
    )


@pytest.mark.parametrize("method", ["ours", "one-bounce", "no-prior", "with-biased-prior"])
@pytest.mark.parametrize("bounces", [1, 2, 3])
def test_what_is_learned_of_is_what_all_samples_have_there(problem, rays, method, bounces):
    wanted = requirements(row_of(method), bounces)
    every = traced(problem, rays, wanted, subset=False)
    sample = traced(problem, rays, wanted, subset=True)
    chosen = first_samples(rays)
    for image in (rhs(s, s.radiance[bounces], bounces) for s in (every, sample)):
        assert dr.width(image) == dr.width(rays)
    np.testing.assert_allclose(
        rhs(every, every.radiance[bounces], bounces),
        rhs(sample, sample.radiance[bounces], bounces),
        rtol=1e-4,
        atol=1e-6,
    )
    few = sample.learned
    assert dr.width(few.x1.valid) == dr.width(chosen)
    pairs = [(lhs(every, every.radiance[0]), lhs(few, few.radiance[0]))]
    if wanted.residuals:
        at_x1 = (residual(s, 1, s.radiance[0], s.radiance[1]) for s in (every, few))
        pairs.append(tuple(at_x1))
    for all_of_them, some_of_them in pairs:
        expected = np.array(dr.gather(mi.Color3f, mi.Color3f(all_of_them), chosen))
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(expected, some_of_them, rtol=1e-4, atol=1e-6)


def test_the_second_residual_has_the_same_expectation(problem, rays):
    """It takes other random numbers, as many as there are samples."""
    wanted = requirements(METHODS["ours"].terms)
    values = [
        residual(s, 2, s.radiance[1], s.radiance[2])
        for k in range(24)
        for s in (traced(problem, rays, wanted, subset=True, seed=100 + k).learned,)
    ]
    reference = [
        dr.gather(mi.Color3f, residual(s, 2, s.radiance[1], s.radiance[2]), first_samples(rays))
        for k in range(24)
        for s in (traced(problem, rays, wanted, subset=False, seed=500 + k),)
    ]
    assert_same_expectation(*(as_samples(v) for v in (values, reference)), spp=24 * FEW)


def as_samples(batches):
    """Samples of several traces, all of a pixel behind each other; squared: all are positive."""
    stacked = np.stack([np.square(np.array(b)).reshape(3, -1, FEW) for b in batches], -1)
    flat = stacked.reshape(3, -1).astype(np.float32)
    return mi.Color3f(*[mi.Float(row) for row in flat])


@pytest.mark.parametrize("method", ["ours", "no-prior", "with-prior", "with-biased-prior"])
def test_terms_train_the_same_parameters(problem, rays, method):
    row = METHODS[method].terms
    target = mi.Color3f(0.1 + 0.3 * dr.arange(mi.Float, dr.width(rays) // SPP) / 36)
    trained = []
    for subset in (False, True):
        φ, θ = enable_gradients(problem)
        sample = traced(problem, rays, requirements(row), subset=subset)
        values = objective(row, sample, target, RelativeL2(0.01))
        assert list(values) == list(row)
        dr.backward(sum(v for k, v in values.items() if k != PHOTOMETRIC))
        gradients = [np.array(dr.grad(a)).ravel() for a in (*φ.values(), *θ.values())]
        assert all(np.isfinite(g).all() for g in gradients)
        trained.append([bool((g != 0).any()) for g in gradients])
    assert trained[0] == trained[1] and any(trained[0])


def test_all_samples_are_learned_of_where_as_many_are_asked_for_as_there_are():
    for radiance_spp, learned in ((0, SPP), (2, 2), (SPP, SPP), (2 * SPP, SPP)):
        config = replace(TINY_FIT, spp=SPP, radiance_spp=radiance_spp)
        assert config.radiance_samples == learned


@pytest.mark.parametrize(("method", "bounces"), [("ours", 1), ("ours", 2), ("no-prior", 1)])
def test_an_image_asks_for_no_more_than_it_shows(problem, rays, method, bounces, monkeypatch):
    """Residuals have bounces and look-ups of their own, which pictures and probes do without."""
    sampler = planned_sampler(
        method,
        problem.scene_view,
        rays,
        SPP,
        max_depth=4,
        bounces=bounces,
        radiance=problem.radiance,
    )
    looked_up, bounced = [], []
    plain, plain_bounce = path_sample.reflected_radiance, path_sample.bounce

    def counted(field, *vertices):
        looked_up.append(sum(dr.width(vertex.valid) for vertex in vertices))
        return plain(field, *vertices)

    def counted_bounce(*arguments):
        bounced.append(arguments)
        return plain_bounce(*arguments)

    monkeypatch.setattr(path_sample, "reflected_radiance", counted)
    monkeypatch.setattr(path_sample, "bounce", counted_bounce)
    image = sampler.image(problem.scene_view.scene, rays, seeded(2, dr.width(rays)))
    assert sum(looked_up) == dr.width(rays) and len(bounced) == bounces
    wanted = requirements(METHODS[method].terms, bounces)
    whole = traced(problem, rays, wanted, subset=False)
    np.testing.assert_allclose(
        image, rhs(whole, whole.radiance[bounces], bounces), rtol=1e-4, atol=1e-6
    )
