"""Gradients of PRB and AD path tracing against finite differences, and against a closed form.

Both detach sampling: the estimator is f(φ)/p(φ₀), where only the value moves with φ. So the finite
differences need a BSDF that samples with φ₀ and evaluates with φ, which `Held` is.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from held import Held
from support import ConstantMaterials, built_in_cameras, pixel_rays, seeded

from unbake.fields.texture import material_textures
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.transport.prb import materials_along_paths, path_radiance, path_replay
from unbake.transport.vertex import SceneView
from unbake.transport.wavefront import PathLimits, path_light, plan_widths

ALBEDO, ROUGHNESS = (0.6, 0.3, 0.45), 0.35
SPP, DEPTH = 16, 4


@pytest.fixture(scope="module")
def held_plugin():
    """Register the BSDF that samples as one material and evaluates as another."""

    class HeldAlongPaths(Held):
        """The weight of a sample is the value with φ over the density with φ₀."""

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs, weight = super().sample(ctx, si, sample1, sample2, active)
            value = self.evaluated.eval(ctx, si, bs.wo, active)
            alive = (bs.pdf > 0) & (dr.max(weight) > 0)
            return bs, dr.select(alive, value / dr.select(alive, bs.pdf, 1), 0)

    mi.register_bsdf("held_along_paths", lambda props: HeldAlongPaths(props))


def principled(albedo, roughness):
    colour = {"type": "rgb", "value": [float(c) for c in albedo]}
    return mi.load_dict({"type": "principled", "base_color": colour, "roughness": roughness})


def with_bsdf(path, plugin, **properties):
    """A scene all of whose materials are this one."""
    parsed = parse(path)
    edit.to_principled(parsed)
    for node in parsed.principled_nodes():
        for key in list(node.props.keys()):
            del node.props[key]
        node.props.set_plugin_name(plugin)
        for key, value in properties.items():
            node.props[key] = value
    return parsed.instantiate()


def path_traced(method, scene, materials, sampler, ray, rr_depth=DEPTH, depth=DEPTH, spp=SPP):
    """Radiance by a method, differentiable in the materials (None: the scene's own)."""
    if method == "ad-pt":
        scene_view, limits = SceneView.of(scene, materials, 8), PathLimits(depth, rr_depth, False)
        # Without roulette what survives does not depend on φ, so that any widths will do.
        plan = tuple(range(depth - 1))
        if rr_depth < depth:
            plan = plan_widths(scene_view, ray, sampler.clone(), spp, limits, 1)
            assert plan[0] < plan[-1], "the wavefront becomes narrower"
        return path_light(scene_view, ray, sampler, spp, limits, plan)
    integrator = path_replay(depth, rr_depth, False)
    arrays = {}
    if materials is not None:
        arrays = {"albedo": materials.albedo, "roughness": materials.roughness}
    return path_radiance(integrator, scene, sampler, ray, arrays)


def weighted(radiance):
    """Samples times fixed weights: a linear objective, which has no noise squared."""
    weights = np.random.default_rng(3).uniform(0.5, 1.5, (3, dr.width(radiance) // SPP))
    return mi.Color3f(np.repeat(weights, SPP, axis=1).astype(np.float32)) * radiance


def total(values):
    return np.array(dr.detach(values)).astype(np.float64).mean()


@pytest.mark.parametrize("name", ["cornell", "furnace"])
@pytest.mark.parametrize("method", ["prb", "ad-pt"])
def test_gradient_is_the_derivative_of_the_estimator(held_plugin, built_in, method, name):
    ray = pixel_rays(built_in_cameras(name, 12), SPP, seed=1)
    sampler = seeded(2, dr.width(ray))

    materials = ConstantMaterials(mi.Color3f(*ALBEDO), ROUGHNESS)
    parameters = {"albedo": materials.albedo, "roughness": materials.roughness}
    textures = material_textures(materials)
    scene = with_bsdf(built_in(name), "principled", **textures)
    dr.enable_grad(parameters)
    with materials_along_paths(materials):
        # No Russian roulette: which paths it ends depends on φ as well.
        image = path_traced(method, scene, materials, sampler.clone(), ray)
        dr.backward(dr.mean(dr.mean(weighted(image))))
    gradients = [float(g[0]) for g in (*dr.grad(materials.albedo), dr.grad(materials.roughness))]

    def moved(index, offset):
        values = [*ALBEDO, ROUGHNESS]
        values[index] += offset
        held = with_bsdf(
            built_in(name),
            "held_along_paths",
            sampled=principled(ALBEDO, ROUGHNESS),
            evaluated=principled(values[:3], values[3]),
        )
        return total(weighted(path_traced(method, held, None, sampler.clone(), ray)))

    np.testing.assert_allclose(moved(0, 0), total(weighted(image)), rtol=1e-5)
    for index, gradient in enumerate(gradients):
        # Fourth-order differences: the step may be large enough for single precision.
        h = 0.02
        near, far = (moved(index, k * h) - moved(index, -k * h) for k in (1, 2))
        difference = (8 * near - far) / (12 * h)
        print(f"{method}, {name}, {index}: {gradient:.6f}, finite difference {difference:.6f}")
        assert abs(difference) > 1e-3, "a gradient of zero proves nothing"
        np.testing.assert_allclose(gradient, difference, rtol=1e-3)


@pytest.mark.parametrize("albedo", [0.3, 0.8])
@pytest.mark.parametrize("method", ["prb", "ad-pt"])
def test_the_whole_gradient_of_the_furnace(built_in, method, albedo):
    """With paths of up to d vertices, I = Σ ρⁱ for i < d, and ∂I/∂ρ = Σ i ρⁱ⁻¹."""
    materials = ConstantMaterials(albedo)
    parsed = parse(built_in("furnace"))
    texture = material_textures(materials)["base_color"]
    for node in parsed.state.nodes:
        if node.props.plugin_name() == "diffuse":
            node.props["reflectance"] = texture
    scene = parsed.instantiate()
    ray = pixel_rays(built_in_cameras("furnace", 12, views=4), 64, seed=5)
    dr.enable_grad(materials.albedo)
    with materials_along_paths(materials):
        # With Russian roulette
        image = path_traced(method, scene, materials, seeded(6, dr.width(ray)), ray, 3, 12, 64)
        dr.backward(dr.sum(dr.mean(image, axis=1)))
    value = np.array(dr.mean(dr.detach(image), axis=1)).ravel()
    gradient = np.array(dr.grad(materials.albedo)).ravel()

    powers = np.arange(12)
    print(f"{method}, {albedo}: image {value}, gradient {gradient}")
    np.testing.assert_allclose(value, (albedo**powers).sum(), rtol=1e-2)
    np.testing.assert_allclose(gradient, (powers[1:] * albedo ** powers[:-1]).sum(), rtol=2e-2)
