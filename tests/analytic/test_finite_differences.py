"""Gradients of the right-hand side image against finite differences of the same estimator.

Sampling is detached: the estimator is f(φ)/p(φ₀), where only the value moves with φ. So the
finite differences need a BSDF that samples with φ₀ and evaluates with φ, which `Held` is. With
common random numbers and a linear objective nothing else separates the two.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from held import Held
from support import ConstantMaterials, built_in_cameras, pieces, pixel_rays, seeded

from unbake.fields.texture import material_textures
from unbake.transport.path_sample import rhs, trace
from unbake.transport.vertex import SceneView

ALBEDO, ROUGHNESS, METALLIC = (0.6, 0.3, 0.45), 0.35, 0.4
SPP = 64


@pytest.fixture(scope="module")
def held_plugin():
    """Register the BSDF that samples as one material and evaluates as another."""

    class HeldSampling(Held):
        def eval_diffuse_reflectance(self, si, active=True):
            return mi.Color3f(0)

    mi.register_bsdf("held_sampling", lambda props: HeldSampling(props))


def principled(colour, roughness, metallic=None):
    if not isinstance(colour, mi.Texture):
        colour = {"type": "rgb", "value": [float(c) for c in colour]}
    bsdf = {"type": "principled", "base_color": colour, "roughness": roughness}
    return bsdf if metallic is None else bsdf | {"metallic": metallic}


def room(bsdf):
    """A floor, a wall and a lamp: light comes directly and off the other surface."""
    to_world = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {
                "type": "rectangle",
                "to_world": to_world().translate([0, 0, -1]),
                "bsdf": bsdf,
            },
            "wall": {
                "type": "rectangle",
                "to_world": to_world().look_at([0, 1, 0], [0, 0, 0], [0, 0, 1]),
                "bsdf": bsdf,
            },
            "lamp": {
                "type": "rectangle",
                "to_world": to_world().look_at([0.3, 0, 0.9], [0, 0, -1], [0, 1, 0]).scale(0.4),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [5, 4, 3]}},
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
            },
        }
    )


class VaryingRadiance:
    """Some smooth radiance field that does not depend on the materials."""

    def evaluate(self, p, w, n, albedo, valid, engine=None):
        value = mi.Color3f(1 + dr.sin(3 * p.x), 1 + 0.5 * w.y, 0.5 + dr.square(p.z))
        return dr.select(valid, value, 0)


def objective(scene_view):
    """A weighted sum of the pixels of the right-hand side, always with the same random numbers."""
    cameras = built_in_cameras("cornell", 12)
    ray = pixel_rays(cameras, SPP, seed=1)
    field = VaryingRadiance()
    sample = trace(
        scene_view,
        field,
        ray,
        seeded(2, dr.width(ray)),
        pieces(1, 1),
        hide_emitters=False,
    )
    weights = np.random.default_rng(3).uniform(0.5, 1.5, (3, dr.width(ray) // SPP))
    weights = mi.Color3f(np.repeat(weights, SPP, axis=1).astype(np.float32))
    return weights * rhs(sample, sample.radiance[1])


def total(values):
    return np.array(dr.detach(values)).astype(np.float64).mean()


def solid(bsdf):
    return bsdf


def cut_out(bsdf):
    return {"type": "mask", "opacity": 0.6, "bsdf": bsdf}


PARAMETERS = ["red", "green", "blue", "roughness", "metallic"]
#: What is differentiated, and the metallic of the material, if that is a parameter.
CASES = [*((name, None) for name in PARAMETERS[:4]), *((name, METALLIC) for name in PARAMETERS)]


@pytest.mark.parametrize("wrap", [solid, cut_out])
@pytest.mark.parametrize(("parameter", "metallic"), CASES)
def test_gradient_is_the_derivative_of_the_estimator(held_plugin, wrap, parameter, metallic):
    materials = ConstantMaterials(mi.Color3f(*ALBEDO), ROUGHNESS, metallic)
    textures = material_textures(materials)
    bsdf = principled(textures["base_color"], textures["roughness"], textures.get("metallic"))
    live = SceneView.of(room(wrap(bsdf)), materials, 8)
    optimized = [getattr(materials, name) for name in materials]
    dr.enable_grad(optimized)
    image = objective(live)
    dr.backward(dr.mean(dr.mean(image)))
    albedo, *others = dr.grad(optimized)
    index = PARAMETERS.index(parameter)
    gradient = float([*albedo, *others][index][0])

    def moved(offset):
        values = [*ALBEDO, ROUGHNESS, metallic]
        values[index] += offset
        bsdf = {
            "type": "held_sampling",
            "sampled": principled(ALBEDO, ROUGHNESS, metallic),
            "evaluated": principled(values[:3], *values[3:]),
        }
        return total(objective(SceneView.of(room(wrap(bsdf)), None, 8)))

    # Fourth-order differences: the step may be large enough for single precision.
    h = 0.02
    difference = (8 * (moved(h) - moved(-h)) - (moved(2 * h) - moved(-2 * h))) / (12 * h)
    print(f"{parameter}: gradient {gradient:.6f}, finite difference {difference:.6f}")
    np.testing.assert_allclose(moved(0), total(image), rtol=1e-5)
    assert abs(difference) > 1e-3, "a gradient of zero proves nothing"
    np.testing.assert_allclose(gradient, difference, rtol=1e-3)
