"""A guide gives what lies near each other with albedo of equal brightness one value."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import randomised, seeded

from unbake.errors import UserError
from unbake.fields.domain import SurfacePoint
from unbake.fields.field import FieldSpec
from unbake.fields.guide import Guide
from unbake.fields.materials import make_materials
from unbake.fields.network import Network
from unbake.fields.perceptron import can_record_layout
from unbake.fields.settings import GridConfig, GuideConfig, NetworkConfig
from unbake.quantities import QUANTITIES

LANES = 300
SMALL = GuideConfig(levels=2, brightnesses=4, gain=3.0)
NETWORK = NetworkConfig(GridConfig(2, 2, 8), width=8, hidden=1, guide=SMALL)
ENGINES = ("tensor", "coopvec", *(["fused"] if can_record_layout() else []))


def points(albedo=None, seed=1):
    sampler = seeded(seed, LANES)
    p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    grey = mi.Color3f(sampler.next_1d()) if albedo is None else mi.Color3f(albedo)
    dr.eval(p, grey)
    return SurfacePoint(p, albedo=grey)


@pytest.mark.parametrize("outputs", [1, 3])
def test_engines_agree_with_a_guide(outputs):
    results = []
    for engine in ENGINES:
        network = Network(NETWORK, FieldSpec(outputs, bounded=True, initial=0.3, seed=2))
        parameters = randomised(network)
        values = network.evaluate(points(), (), engine)
        dr.backward(dr.sum(sum(values)))
        gradients = {k: np.array(dr.grad(v).array) for k, v in parameters.items()}
        results.append((np.array([np.array(v) for v in values]), gradients))
    for values, gradients in results[1:]:
        np.testing.assert_allclose(values, results[0][0], atol=2e-5)
        for key, gradient in gradients.items():
            np.testing.assert_allclose(gradient, results[0][1][key], atol=2e-3, err_msg=key)
    assert all(np.abs(g).max() > 0 for g in results[0][1].values())


def test_an_untrained_guide_changes_nothing():
    network = Network(NETWORK, FieldSpec(1, bounded=True, initial=0.3, seed=2))
    (value,) = network.evaluate(points())
    np.testing.assert_allclose(np.array(value), 0.3, atol=5e-3)


def test_brightness_decides_which_numbers_are_read():
    guide = Guide(SMALL, 1)
    values = randomised(guide)
    (dark,) = guide.evaluate(points(0.0))
    dr.backward(dr.sum(dark))
    rows = np.array(dr.grad(values["guide.0"])).reshape(-1, SMALL.brightnesses)
    assert (rows[:, 0] > 0).any()
    assert not rows[:, 1:].any()  # a step that sees black surfaces leaves all others as they are
    (white,) = guide.evaluate(points(1.0))
    assert np.abs(np.array(white) - np.array(dark)).mean() > 0.1


def test_values_between_brightnesses_are_between_theirs():
    guide = Guide(SMALL, 1)
    randomised(guide)
    low, middle, high = (
        np.array(guide.evaluate(points(level**2))[0]) for level in (1 / 3, 0.5, 2 / 3)
    )
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-5)


@pytest.mark.parametrize("albedo", [-1.0, 2.0, float("nan")])
def test_an_albedo_out_of_bounds_reads_no_other_memory(albedo):
    guide = Guide(SMALL, 1)
    randomised(guide)
    bound = points(1.0 if albedo == 2.0 else 0.0)
    found, wanted = (np.array(guide.evaluate(p)[0]) for p in (points(albedo), bound))
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_roughness_does_not_pull_albedo():
    settings = {name: NETWORK for name in ("albedo", "roughness")}
    materials = make_materials("neural", settings, [], seed=1)
    values = randomised(materials)
    material = materials.evaluate(surface(), mi.Bool(True))
    dr.backward(dr.sum(material["roughness"]))
    reached = {k for k, v in values.items() if np.abs(np.array(dr.grad(v).array)).max() > 0}
    assert reached == {k for k in values if k.startswith("roughness.")}


def test_roughness_alone_has_a_guide_over_positions():
    materials = make_materials("neural", {"roughness": NETWORK}, [], seed=1)
    randomised(materials)
    values = np.array(materials.evaluate(surface(), mi.Bool(True))["roughness"])
    bounds = QUANTITIES["roughness"]
    assert np.ptp(values) > 0.05
    assert (values >= bounds.lower).all()
    assert (values <= bounds.upper).all()


def test_sizes_tell_the_memory():
    for outputs in (1, 3):
        counted = sum(dr.width(v) for v in Guide(SMALL, outputs).parameters().values())
        assert counted <= SMALL.numbers(outputs) <= 2 * counted


@pytest.mark.parametrize(
    "wrong",
    [{"levels": 9}, {"brightnesses": 5}, {"levels": 6, "base_resolution": 16}, {"network": 0.0}],
)
def test_sizes_out_of_range_are_refused(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        GuideConfig(**wrong)


def surface():
    p = points().position
    si = dr.zeros(mi.SurfaceInteraction3f, LANES)
    si.p = p
    return si
