"""Whole paths in a wavefront that becomes narrower: the same light in any width."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    ConstantMaterials,
    assert_same_expectation,
    built_in_cameras,
    pixel_rays,
    seeded,
    stock_path,
)

from unbake.fields.texture import material_textures
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.transport import wavefront
from unbake.transport.path_sample import Requirements, rhs, trace
from unbake.transport.vertex import SceneView
from unbake.transport.wavefront import PathLimits, path_light, plan_widths

DEPTH = 8
LIMITS = PathLimits(DEPTH, 2, hide_emitters=False)
#: Narrower than there are survivors, at the first bounces already.
TIGHT = (2, 4, 5, 6, 6, 8, 8)


def view(built_in, name, albedo=0.6):
    """A scene of one material, and that."""
    materials = ConstantMaterials(albedo, 0.4)
    parsed = parse(built_in(name))
    edit.to_principled(parsed)
    edit.set_textures(parsed, material_textures(materials))
    return SceneView.of(parsed.instantiate(), materials, 8), materials


# ------------------------------------------------------------------------------------ roulette


def outcomes(survival, width, repeats):
    """Weights (repeats, paths) of paths that go on, zero for the others; checks the bookkeeping."""
    lanes, weights = len(survival), []
    for seed in range(repeats):
        found = wavefront._roulette(mi.Float(survival), width, seeded(seed, lanes))
        kept, slot = np.array(found.kept), np.array(found.slot)
        taken, parent = np.array(found.taken), np.array(found.parent)
        gone_on = np.flatnonzero(kept)
        assert taken.sum() == len(gone_on) == len(set(slot[kept])) and taken[slot[kept]].all()
        assert (parent[slot[kept]] == gone_on).all()
        # No half takes lanes of the other.
        assert ((gone_on >= lanes // 2) == (slot[kept] >= width // 2)).all()
        weights.append(np.where(kept, np.array(found.weight), 0))
    return np.array(weights, np.float64)


@pytest.mark.parametrize("factor", [0.1, 1.0], ids=["room for all", "too many"])
def test_roulette_is_unbiased_whether_or_not_there_is_room(factor):
    rng = np.random.default_rng(0)
    survival = (factor * rng.uniform(0, 1, 96) ** 2).astype(np.float32)
    survival[rng.uniform(size=96) < 0.3] = 0
    repeats, width = 3000, 16
    weights = outcomes(survival, width, repeats)
    assert (weights[:, survival == 0] == 0).all()
    found = (weights > 0).reshape(repeats, 2, -1).sum(-1)
    expected = np.minimum(survival.reshape(2, -1).sum(-1), width // 2)
    assert (found <= np.ceil(expected + 1e-3)).all() and (found >= np.floor(expected - 1e-3)).all()
    # A linear functional of the paths, such as the light of a pixel.
    value = rng.uniform(0.5, 1.5, 96) * (survival > 0)
    for half in (slice(48), slice(48, None)):
        totals = (weights * value)[:, half].sum(1)
        z = (totals.mean() - value[half].sum()) / (totals.std(ddof=1) / np.sqrt(repeats))
        print(f"{totals.mean():.3f}, {value[half].sum():.3f}, z {z:.2f}")
        assert abs(z) < 3.5
    # The estimator of split halves, the only one of one pass that these paths can have, multiplies
    # them.
    first, second = ((weights * value)[:, half].sum(1) for half in (slice(48), slice(48, None)))
    z = np.corrcoef(first, second)[0, 1] * np.sqrt(repeats)
    print(f"correlation z {z:.2f}")
    assert abs(z) < 3.5


def test_halves_of_pixels_lie_apart():
    order, back = (np.array(x) for x in wavefront._by_halves(24, 8))
    assert sorted(order) == list(range(24))
    assert (order[:12] % 8 < 4).all() and (order[12:] % 8 >= 4).all()
    assert (order[back] == np.arange(24)).all()


# ---------------------------------------------------------------------------------------- plans


def test_a_plan_follows_the_light(built_in):
    sums = {}
    for name in ("furnace", "still"):
        for albedo in (0.2, 0.9):
            scene_view, _ = view(built_in, name, albedo)
            ray = pixel_rays(built_in_cameras(name, 32), 8, 1)
            plan = plan_widths(scene_view, ray, seeded(2, dr.width(ray)), 8, LIMITS, 1)
            assert len(plan) == DEPTH - 1 and list(plan) == sorted(plan)
            widths = [wavefront._width(level, dr.width(ray)) for level in plan]
            sums[name, albedo] = sum(widths) / dr.width(ray)
    print(sums)
    # Two bounces before roulette; hardly any path of the object meets another surface.
    assert 2 < sums["furnace", 0.2] < 3 < sums["furnace", 0.9] <= DEPTH - 1
    assert sums["still", 0.2] <= sums["still", 0.9] < 1.5


def test_a_plan_for_brighter_surfaces_is_that_of_brighter_surfaces(built_in):
    ray = pixel_rays(built_in_cameras("furnace", 32), 8, 1)

    def plan(albedo, gain):
        scene_view, _ = view(built_in, "furnace", albedo)
        return np.array(
            plan_widths(scene_view, ray, seeded(2, dr.width(ray)), 8, LIMITS, gain), int
        )

    untrained, planned, bright = plan(0.5, 1), plan(0.5, 1.6), plan(0.8, 1)
    print(untrained, planned, bright)
    # Specular light is no brighter with albedo, so that they differ by some widths.
    assert np.abs(planned - bright).max() <= 2 < (untrained - bright).max()


def test_without_roulette_all_paths_of_a_closed_room_are_those_of_bounces(built_in):
    """Nothing is gained there: so nothing is moved, and random numbers are the same."""
    scene_view, _ = view(built_in, "furnace")
    ray = pixel_rays(built_in_cameras("furnace", 8), 8, 1)
    limits = PathLimits(4, 4, hide_emitters=False)
    plan = plan_widths(scene_view, ray, seeded(2, dr.width(ray)), 8, limits, 1)
    assert plan == (0, 0, 0)
    found = path_light(scene_view, ray, seeded(2, dr.width(ray)), 8, limits, plan)
    sample = trace(scene_view, None, ray, seeded(2, dr.width(ray)), Requirements(3))
    np.testing.assert_allclose(found, rhs(sample, mi.Color3f(0), 3), rtol=1e-5)


# ----------------------------------------------------------------------------- light and gradients


@pytest.mark.parametrize("tight", [False, True])
@pytest.mark.parametrize("name", ["cornell", "still"])
def test_the_image_is_that_of_mitsubas_path(built_in, name, tight):
    scene_view, spp = SceneView.of(mi.load_file(str(built_in(name))), None, 8), 256
    ray = pixel_rays(built_in_cameras(name, 12), spp, 1)
    lanes = dr.width(ray)
    plan = TIGHT if tight else plan_widths(scene_view, ray, seeded(5, lanes), spp, LIMITS, 1)
    assert any(plan)
    found = path_light(scene_view, ray, seeded(2, lanes), spp, LIMITS, plan)
    theirs = stock_path(scene_view.scene, ray, 3, max_depth=DEPTH)
    assert_same_expectation(found, theirs, spp)


@pytest.mark.parametrize("tight", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_gradient_is_that_of_all_bounces(built_in, tight):
    """Of the albedo in each pixel's colour, channel by channel, and of the roughness."""
    scene_view, materials = view(built_in, "cornell")
    spp, repeats = 64, 12
    ray = pixel_rays(built_in_cameras("cornell", 12), spp, 1)
    lanes = dr.width(ray)
    plan = TIGHT if tight else plan_widths(scene_view, ray, seeded(5, lanes), spp, LIMITS, 1)

    def gradients(follow, seed):
        materials.albedo, materials.roughness = mi.Color3f(0.6), mi.Float(0.4)
        dr.enable_grad(materials.albedo, materials.roughness)
        dr.backward(dr.mean(dr.mean(follow(seeded(seed, lanes)))))
        values = (*dr.grad(materials.albedo), dr.grad(materials.roughness))
        return [float(value[0]) for value in values]

    def narrower(sampler):
        return path_light(scene_view, ray, sampler, spp, LIMITS, plan)

    def unrolled(sampler):
        sample = trace(scene_view, None, ray, sampler, Requirements(DEPTH - 1))
        return rhs(sample, mi.Color3f(0), DEPTH - 1)

    a, b = (
        np.array([gradients(follow, first + i) for i in range(repeats)])
        for first, follow in ((100, narrower), (200, unrolled))
    )
    z = (a.mean(0) - b.mean(0)) / np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / repeats)
    print(f"{a.mean(0)}, {b.mean(0)}, z {z}")
    assert np.abs(z).max() < 3.5
    # A gradient that stopped at the first narrowing would be seen.
    np.testing.assert_allclose(a.mean(0)[:3], b.mean(0)[:3], rtol=0.03)
