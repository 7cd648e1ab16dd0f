"""A closed box whose walls emit E = 1 and reflect ρ: the radiance is 1/(1 − ρ) everywhere.

The field is trained by the residual alone: it sees no photograph, and starts far from the answer.
"""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    ConstantMaterials,
    ConstantRadiance,
    built_in_cameras,
    pieces,
    pixel_rays,
    seeded,
)

from unbake.config import GridConfig, NetworkConfig
from unbake.dataset.pixels import CameraRays
from unbake.fields.domain import Domain
from unbake.fields.field import FieldSpec
from unbake.fields.network import Network
from unbake.fields.radiance import RadianceField
from unbake.fields.texture import material_textures
from unbake.scene.parse import parse
from unbake.transport.loss import RelativeL2
from unbake.transport.methods import EXTRA, METHODS, PHOTOMETRIC, PRIOR, PRIOR_PAIR, Attached
from unbake.transport.objective import objective, requirements
from unbake.transport.path_sample import lhs, rhs, trace
from unbake.transport.prior import residual
from unbake.transport.vertex import SceneView

SMALL = NetworkConfig(
    grid=GridConfig(levels=2, features=2, table_log2=10, base_resolution=2), width=16, hidden=1
)
ONE_BOUNCE = {PRIOR: Attached(lhs=True)}
EXTRA_BOUNCE = {PRIOR: Attached(lhs=True), EXTRA: Attached(lhs=True)}
LANES = 2048


def train(scene_view, field, terms, steps, rate, final_rate):
    """Minimise the residual, and nothing else, over what the training cameras see."""
    rays = CameraRays.of(built_in_cameras("furnace", 16, views=8))
    adam = mi.ad.Adam(rate, field.parameters(), mask_updates=True)
    black, loss = dr.zeros(mi.Color3f, LANES // 2), RelativeL2(0.01)

    def step(scene, sampler, rays, adam, black, seed):
        field.assign(dict(adam.items()))
        sampler.seed(seed, LANES)
        pixel = mi.UInt32(sampler.next_1d() * 0.99999 * rays.pixels)
        ray = rays.through(pixel, sampler.next_2d())
        sample = trace(
            scene_view.with_scene(scene),
            field,
            ray,
            sampler,
            pieces(1, 2),
            hide_emitters=False,
        )
        value = sum(objective(terms, sample, black, loss).values())
        dr.backward(value)
        adam.step(eval=False)
        dr.eval(adam, value)
        return value

    # A scene that is freed while a frozen function is recorded would end it.
    gc.collect()
    frozen, sampler = dr.freeze(step), mi.load_dict({"type": "independent"})
    for i in range(steps):
        now = rate * (final_rate / rate) ** (i / steps)
        adam.set_learning_rate({k: dr.opaque(mi.Float, now) for k in adam})
        frozen(scene_view.scene, sampler, rays, adam, black, dr.opaque(mi.UInt32, 7919 * i))
    field.assign(dict(adam.items()))


def pictures(scene_view, field, spp):
    """LHS and RHS of views between the training views, (pixels, 3) each."""
    cameras = built_in_cameras("furnace", 8, views=12)[8:]
    ray = pixel_rays(cameras, spp, seed=99)
    sample = trace(
        scene_view,
        field,
        ray,
        seeded(5, dr.width(ray)),
        pieces(1, 1),
        hide_emitters=False,
    )
    both = lhs(sample, sample.radiance[0]), rhs(sample, sample.radiance[1])
    return [np.array(x).reshape(3, -1, spp).mean(-1).T for x in both]


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


# The untrained field's radiance, `scale`, is far from ρ/(1 − ρ) in each row. The closer ρ is to 1,
# the slower the residual contracts: by a factor ρ in each of Picard's iterations.
@pytest.mark.parametrize(
    ("albedo", "terms", "scale", "steps", "rate", "final_rate"),
    [
        (0.0, EXTRA_BOUNCE, 1.0, 600, 0.1, 5e-4),
        (0.3, EXTRA_BOUNCE, 2.0, 500, 0.03, 5e-4),
        (0.5, EXTRA_BOUNCE, 3.0, 500, 0.03, 5e-4),
        (0.8, EXTRA_BOUNCE, 1.0, 500, 0.03, 5e-4),
        (0.8, ONE_BOUNCE, 1.0, 500, 0.03, 5e-4),
        pytest.param(0.97, EXTRA_BOUNCE, 4.0, 1400, 0.02, 2e-3, marks=pytest.mark.slow),
    ],
)
def test_the_residual_alone_finds_the_radiance(
    built_in, albedo, terms, scale, steps, rate, final_rate
):
    scene = mi.load_file(str(built_in("furnace", albedo)))
    scene_view = SceneView.of(scene, None, 8)
    network = Network(SMALL, FieldSpec(outputs=6, extra=12, seed=1))
    field = RadianceField(network, Domain.of(scene.bbox()), scale=scale)
    truth = 1 / (1 - albedo)

    untrained, _ = pictures(scene_view, field, 4)
    assert np.abs(untrained / truth - 1).min() > 0.2, "it must not know the answer beforehand"
    train(scene_view, field, terms, steps, rate, final_rate)

    seen, computed = pictures(scene_view, field, 256)
    for name, image in (("LHS", seen), ("RHS", computed)):
        error = image / truth - 1
        print(f"{albedo} {name}: mean {error.mean():+.4f}, rms {rms(error):.4f}")
        assert abs(error.mean()) < 0.01
        assert rms(error) < 0.01


def exact_sample(scene, albedo, factor=1.0, lanes_spp=64):
    """Path samples with the true reflected radiance ρ/(1 − ρ), times `factor`, everywhere."""
    scene_view = SceneView.of(scene, None, 8)
    field = ConstantRadiance(factor * albedo / (1 - albedo))
    ray = pixel_rays(built_in_cameras("furnace", 16, views=8), lanes_spp, seed=3)
    return trace(
        scene_view,
        field,
        ray,
        seeded(4, dr.width(ray)),
        pieces(1, 2),
        hide_emitters=False,
    )


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_the_residual_of_the_exact_radiance_is_zero_and_of_no_other(built_in, albedo):
    scene = mi.load_file(str(built_in("furnace", albedo)))

    def residuals(factor):
        s = exact_sample(scene, albedo, factor)
        both = [residual(s, i, s.radiance[i - 1], s.radiance[i]) for i in (1, 2)]
        return [np.array(r)[0].astype(np.float64) for r in both]

    for r in residuals(1.0):
        assert abs(r.mean()) < 3.5 * r.std() / np.sqrt(len(r))
    # (1 + δ) L leaves δ (1 − ρ) L = δ ρ: linear in δ, its norm quadratic. The same random numbers
    # serve for all δ, so that the difference has no noise but rounding.
    for exact, off in zip(residuals(1.0), residuals(1.1), strict=True):
        np.testing.assert_allclose((off - exact).mean(), 0.1 * albedo, rtol=2e-3)


# ------------------------------------------------------------ the gradient with k live bounces


@pytest.fixture(scope="module")
def learnable(built_in):
    """The furnace with Lambertian walls whose albedo is read from a stand-in for the fields."""
    materials = ConstantMaterials(0.5)
    parsed = parse(built_in("furnace"))
    albedo = material_textures(materials)["base_color"]
    for node in parsed.state.nodes:
        if node.props.plugin_name() == "diffuse":
            node.props["reflectance"] = albedo
    return SceneView.of(parsed.instantiate(), materials, 8)


@pytest.mark.parametrize("bounces", [1, 2, 4, 8])
@pytest.mark.parametrize("albedo", [0.3, 0.5, 0.8, 0.97])
def test_the_gradient_with_k_live_bounces_is_the_closed_form(learnable, albedo, bounces):
    """Σ_{i<k} i ρⁱ⁻¹ E + k ρᵏ⁻¹ L; for k = 1 that is (1 − ρ) times the true gradient (Sec. 6.3)."""
    materials = learnable.materials
    materials.albedo = mi.Color3f(albedo)
    dr.enable_grad(materials.albedo)
    ray = pixel_rays(built_in_cameras("furnace", 16, views=8), 64, seed=5)
    cache, wanted = ConstantRadiance(albedo / (1 - albedo)), pieces(bounces, 1)
    sample = trace(learnable, cache, ray, seeded(6, dr.width(ray)), wanted, hide_emitters=False)
    image = rhs(sample, sample.radiance[bounces], bounces)
    value = np.array(dr.mean(dr.detach(image), axis=1)).ravel()
    dr.backward(dr.sum(dr.mean(image, axis=1)))
    gradient = np.array(dr.grad(materials.albedo)).ravel()

    L = 1 / (1 - albedo)
    series = sum(i * albedo ** (i - 1) for i in range(1, bounces))
    expected = series + bounces * albedo ** (bounces - 1) * L
    print(f"{albedo}, {bounces}: gradient {gradient / expected}, of the true {expected / L**2:.3f}")
    np.testing.assert_allclose(value, L, rtol=5e-3)
    np.testing.assert_allclose(gradient, expected, rtol=5e-3)


def test_more_live_bounces_come_nearer_to_the_true_gradient(learnable):
    """The photometric term of `ours` is what k changes: the objective passes it on."""
    materials, albedo = learnable.materials, 0.8
    ray = pixel_rays(built_in_cameras("furnace", 8, views=2), 16, seed=5)
    found = []
    for bounces in (1, 4):
        materials.albedo = mi.Color3f(albedo)
        dr.enable_grad(materials.albedo)
        row = METHODS["ours"].terms
        field = ConstantRadiance(albedo / (1 - albedo))
        sampler = seeded(6, dr.width(ray))
        sample = trace(
            learnable, field, ray, sampler, requirements(row, bounces), hide_emitters=False
        )
        target = dr.full(mi.Color3f, 4.0, dr.width(ray) // 16)
        loss = RelativeL2(0.01)
        terms = objective(row, sample, target, loss, bounces=bounces)
        dr.backward(terms[PHOTOMETRIC])
        found.append(float(dr.sum(dr.grad(materials.albedo))[0]))
    closed = [sum(i * 0.8 ** (i - 1) for i in range(1, k)) + 5 * k * 0.8 ** (k - 1) for k in (1, 4)]
    np.testing.assert_allclose(found[1] / found[0], closed[1] / closed[0], rtol=0.02)


# ---------------------------------------------- the prior without its stop gradient, for exact L


def prior_gradients(learnable, albedo, term, batches=16):
    """Of the prior by the albedo of the walls, which it trains too: mean, its error, the value.

    L_θ is the exact radiance, which has no residual: neither it nor the albedo need to change.
    """
    materials, cache = learnable.materials, ConstantRadiance(albedo / (1 - albedo))
    row, cameras = {term: Attached(scene=True, lhs=True)}, built_in_cameras("furnace", 16, views=8)
    gradients, values = [], []
    for k in range(batches):
        materials.albedo = mi.Color3f(albedo)
        dr.enable_grad(materials.albedo)
        ray = pixel_rays(cameras, 16, seed=100 + k)
        sampler = seeded(200 + k, dr.width(ray))
        sample = trace(learnable, cache, ray, sampler, requirements(row), hide_emitters=False)
        value = objective(row, sample, mi.Color3f(0), RelativeL2(0.01))[term]
        dr.backward(value)
        gradients.append(float(dr.sum(dr.grad(materials.albedo))[0]))
        values.append(float(value[0]))
    return np.mean(gradients), np.std(gradients, ddof=1) / np.sqrt(batches), np.mean(values)


@pytest.mark.parametrize("albedo", [0.3, 0.5, 0.8])
def test_the_prior_of_the_exact_radiance_pulls_at_the_albedo_unless_it_is_a_pair(learnable, albedo):
    """One squared sample has the variance of T in it: here that is ∝ ρ², its derivative 2 Var/ρ."""
    biased, error, variance = prior_gradients(learnable, albedo, PRIOR)
    print(f"{albedo}: one sample {biased:.5f} ± {error:.5f}, 2 Var/ρ = {2 * variance / albedo:.5f}")
    assert biased > 20 * error
    np.testing.assert_allclose(biased, 2 * variance / albedo, rtol=0.03)

    unbiased, error, value = prior_gradients(learnable, albedo, PRIOR_PAIR)
    print(f"{albedo}: a pair {unbiased:.5f} ± {error:.5f}, value {value:.5f}")
    # The walls overlap by a millimetre, where shadow rays end too early: T is 0.04 % ρ too bright.
    assert abs(unbiased) < 3 * error + 0.01 * biased
    assert abs(value) < 0.02 * variance
