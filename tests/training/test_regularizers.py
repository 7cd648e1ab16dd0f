"""Terms that photographs have no part in: what they measure, whom they train, where they count."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, built_in_cameras, grey_photographs, pixel_rays, seeded

from unbake.config import LightingConfig, RegularizationConfig, preset
from unbake.training.problem import make_problem
from unbake.training.regularizers import is_anchored, regularization_terms
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.regularizers import (
    albedo_smoothness,
    albedo_ties_roughness,
    mean_albedo_deviation,
    roughness_smoothness,
)

SPP = TINY_FIT.spp
#: The photometric loss of a batch.
PHOTOMETRIC = 0.1
SMOOTH = RegularizationConfig()
NONE = {"albedo_smoothness": 0.0}


def floats(values):
    return mi.Float(np.asarray(values, np.float32))


def material(albedo, roughness):
    """A lane for each number; grey albedo."""
    result = {"albedo": mi.Color3f(floats(albedo)), "roughness": floats(roughness)}
    dr.enable_grad(result)
    return result


def everywhere(lanes):
    return dr.full(mi.Bool, True, lanes)


# ---------------------------------------------------------------------------------- smoothness


def test_equal_neighbours_are_smooth():
    here, near = material([0.1, 0.9], [0.5, 0.5]), material([0.3, 0.2], [0.5, 0.5])
    assert roughness_smoothness(here, near, everywhere(2))[0] == 0


def test_smoothness_is_the_mean_difference_of_the_lanes_that_count():
    here = material([0.5] * 4, [0.1, 0.5, 0.3, 0.9])
    near = material([0.5] * 4, [0.2, 0.1, 0.3, 0.1])
    valid = mi.Bool([True, True, True, False])
    value = roughness_smoothness(here, near, valid)
    assert value[0] == pytest.approx((0.1 + 0.4 + 0) / 3)
    dr.backward(value)
    np.testing.assert_allclose(dr.grad(here["roughness"]), [-1 / 3, 1 / 3, 0, 0], atol=1e-6)
    np.testing.assert_allclose(dr.grad(near["roughness"]), [1 / 3, -1 / 3, 0, 0], atol=1e-6)
    assert not np.array(dr.grad(here["albedo"])).any()


def test_smoothness_of_albedo_is_the_mean_over_channels_and_lanes_that_count():
    here, near = (
        mi.Color3f(*map(floats, channels))
        for channels in (([0.1, 0.5], [0.2, 0.5], [0.3, 0.5]), ([0.4, 0], [0.2, 0], [0.0, 0]))
    )
    dr.enable_grad(here, near)
    value = albedo_smoothness(here, near, mi.Bool([True, False]))
    assert value[0] == pytest.approx((0.3 + 0 + 0.3) / 3)
    dr.backward(value)
    np.testing.assert_allclose(dr.grad(near), [[1 / 3, 0], [0, 0], [-1 / 3, 0]], atol=1e-6)


@pytest.mark.parametrize("term", ["albedo", "roughness", "ties", "mean"])
def test_no_lane_that_counts_is_no_division_by_zero(term):
    here, none = material([0.1, 0.9], [0.2, 0.5]), mi.Bool([False, False])
    if term == "ties":
        value = albedo_ties_roughness(here, none, 0.1, 1)
    elif term == "mean":
        value = mean_albedo_deviation(here, none, (0.0, 0.0, 0.0))
    elif term == "albedo":
        value = albedo_smoothness(here["albedo"], mi.Color3f(floats([0, 0])), none)
    else:
        value = roughness_smoothness(here, material([0, 0], [1, 1]), none)
    dr.backward(value)
    assert value[0] == 0
    assert (
        np.isfinite(dr.grad(here["roughness"])).all() and np.isfinite(dr.grad(here["albedo"])).all()
    )


# ---------------------------------------------------------------------------------------- ties


def test_ties_are_weighted_by_the_likeness_of_albedo():
    # Pairs of lanes 0 and 2, 1 and 3; then 2 and 0, 3 and 1.
    here = material([0.2, 0.4, 0.2, 0.5], [0.1, 0.3, 0.5, 0.9])
    value = albedo_ties_roughness(here, everywhere(4), similarity=0.1, shift=2)
    alike, apart = 0.4**2, np.exp(-3 * 0.1**2 / (2 * 0.1**2)) * 0.6**2
    assert value[0] == pytest.approx((2 * alike + 2 * apart) / 4, rel=1e-5)
    dr.backward(value)
    roughness = np.array(dr.grad(here["roughness"]))
    assert roughness[0] == pytest.approx(-roughness[2]) and roughness[0] < 0
    assert not np.array(dr.grad(here["albedo"])).any()


def test_other_albedo_and_lanes_that_do_not_count_tie_nothing():
    different = material([0.1, 0.9], [0.1, 0.9])
    assert albedo_ties_roughness(different, everywhere(2), 0.05, 1)[0] < 1e-6
    alike = material([0.5, 0.5, 0.5], [0.1, 0.9, 0.1])
    assert albedo_ties_roughness(alike, everywhere(3), 0.1, 1)[0] > 0.3
    assert albedo_ties_roughness(alike, mi.Bool([True, False, True]), 0.1, 1)[0] == 0


# ---------------------------------------------------------------------------------------- mean


def test_the_deviation_of_the_mean_is_exact():
    colours = mi.Color3f(floats([0.1, 0.3, 9]), floats([0.2, 0.6, 9]), floats([0.5, 0.5, 9]))
    here = {"albedo": colours, "roughness": floats([0, 0, 0])}
    dr.enable_grad(here["albedo"])
    value = mean_albedo_deviation(here, mi.Bool([True, True, False]), (0.5, 0.5, 0.4))
    assert value[0] == pytest.approx(0.3**2 + 0.1**2 + 0.1**2, rel=1e-5)
    dr.backward(value)
    np.testing.assert_allclose(
        dr.grad(here["albedo"]), [[-0.3, -0.3, 0], [-0.1, -0.1, 0], [0.1, 0.1, 0]], atol=1e-6
    )


# --------------------------------------------------------------------------------- regularizers


def settings(**changes):
    return dataclasses.replace(TINY_FIT, **changes)


@pytest.fixture(scope="module")
def cornell_problem(built_in):
    return make_problem(built_in("cornell"), "visible", TINY_FIT, 0.2)


def terms_of(problem, config, cameras, photometric=PHOTOMETRIC):
    """The terms, and for each the parameters that its gradient reaches."""
    names, values = zip(*problem.parameters().items(), strict=True)
    found = {}
    rays = pixel_rays(cameras, SPP, seed=1)
    dr.enable_grad(*values)
    problem.assign(dict(zip(names, values, strict=True)))
    scene = problem.scene_view.scene
    lanes, error = dr.width(rays), mi.Float(photometric)
    for term in regularization_terms(problem, config, scene, rays, seeded(2, lanes), error):
        terms = regularization_terms(problem, config, scene, rays, seeded(2, lanes), error)
        dr.clear_grad(list(values))
        dr.backward(terms[term])
        reached = {n.partition(".")[0] for n, v in zip(names, values, strict=True)
                   if np.array(dr.grad(v)).any()}  # fmt: skip
        found[term] = float(terms[term][0]), reached
    dr.disable_grad(*values)
    return found


def test_the_smoothness_of_albedo_is_on_by_default_and_nothing_in_the_papers_settings(
    cornell_problem,
):
    cameras = built_in_cameras("cornell", 8)
    found = terms_of(cornell_problem, settings(regularization=RegularizationConfig()), cameras)
    ((term, (value, reached)),) = found.items()
    assert term == "albedo_smoothness" and value > 0 and reached == {"albedo"}
    for name in ("paper", "release"):
        config = settings(regularization=preset(name).regularization)
        assert terms_of(cornell_problem, config, cameras) == {}


@pytest.mark.parametrize(("error", "counted"), [(0.2, 0.2), (3.0, 1.0), (-0.1, 0.0)])
def test_albedo_is_as_smooth_as_photographs_are_left_unexplained(cornell_problem, error, counted):
    rays = pixel_rays(built_in_cameras("cornell", 8), SPP, seed=1)
    config, scene = settings(regularization=SMOOTH), cornell_problem.scene_view.scene

    def value(error):
        sampler = seeded(2, dr.width(rays))
        terms = regularization_terms(cornell_problem, config, scene, rays, sampler, mi.Float(error))
        return terms["albedo_smoothness"][0]

    assert value(error) == pytest.approx(counted * value(1.0), rel=1e-5) and value(1.0) > 0


def test_terms_have_their_weights_and_train_the_roughness_alone(cornell_problem):
    cameras = built_in_cameras("cornell", 8)
    names = ("roughness_smoothness", "albedo_ties_roughness")
    single, double = (
        terms_of(
            cornell_problem,
            settings(regularization=RegularizationConfig(**dict.fromkeys(names, weight), **NONE)),
            cameras,
        )
        for weight in (1.0, 2.0)
    )
    assert set(single) == set(names)
    for name, (value, reached) in single.items():
        assert value > 0 and reached == {"roughness"}
        assert double[name][0] == pytest.approx(2 * value, rel=1e-5)


def test_lighting_alone_has_no_terms(built_in):
    config = settings(unknown="lighting", regularization=RegularizationConfig(1.0, 0.02, 1.0))
    problem = make_problem(built_in("still"), "hidden", config, 0.2)
    assert not is_anchored(problem, config)
    assert terms_of(problem, config, built_in_cameras("still", 4)) == {}


# -------------------------------------------------------------------------------------- anchor

LAMP = '<emitter type="point"><rgb name="intensity" value="1"/></emitter></scene>'


@pytest.mark.parametrize(
    ("background", "known_light", "anchor", "anchored"),
    [
        ("hidden", False, 1.0, True),
        ("visible", False, 1.0, False),
        ("hidden", True, 1.0, False),
        ("hidden", False, 0.0, False),
    ],
    ids=["hidden background", "visible background", "a known lamp", "no weight"],
)
def test_the_scale_is_a_convention_where_photographs_do_not_tell_it(
    background, known_light, anchor, anchored, built_in
):
    path = built_in("still")
    if known_light:
        text = path.read_text().replace("</scene>", LAMP)
        path = path.with_name("with_lamp.xml")
        path.write_text(text)
    lighting = LightingConfig(resolution=8, anchor=anchor)
    config = settings(unknown="materials+lighting", lighting=lighting)
    problem = make_problem(path, background, config, 0.2)
    assert is_anchored(problem, config) is anchored
    found = terms_of(problem, config, built_in_cameras("still", 8))
    if anchored:
        value, reached = found["mean_albedo"]
        assert list(found) == ["mean_albedo"] and reached == {"albedo"}
        assert value >= 0
    else:
        assert found == {}


def test_known_materials_do_not_count(tmp_path):
    """What is seen of them says nothing about the albedo that is optimized."""
    path = tmp_path / "scene.xml"
    wrapped = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
    metal = '<bsdf type="roughconductor"/>'
    balls = "".join(
        f'<shape type="sphere"><point name="center" value="{3 * i},0,0"/>{bsdf}</shape>'
        for i, bsdf in enumerate((wrapped, metal))
    )
    path.write_text(f'<scene version="3.0.0">{balls}<emitter type="constant"/></scene>')
    config = settings(regularization=RegularizationConfig(roughness_smoothness=1.0))
    problem = make_problem(path, "visible", config, 0.2)

    def smoothness(x):
        rays = mi.Ray3f(mi.Point3f(mi.Float(x), 0, 5), mi.Vector3f(0, 0, -1))
        sampler = seeded(2, len(x))
        scene = problem.scene_view.scene
        terms = regularization_terms(problem, config, scene, rays, sampler, mi.Float(0.1))
        return terms["roughness_smoothness"]

    assert smoothness([0, 0.5])[0] > 0
    assert smoothness([3, 3.5])[0] == 0


# --------------------------------------------------------------------------------- in the step


@pytest.mark.parametrize(
    ("method", "term", "weight"),
    [("ours", "roughness_smoothness", 1.0), ("prb", "albedo_ties_roughness", 40.0)],
)
def test_a_fit_with_a_term_logs_it_and_is_smoother(built_in, method, term, weight):
    rates = {"albedo": 1e-2, "roughness": 1e-2, "radiance": 1e-2}
    cameras = built_in_cameras("cornell", 16, views=2)

    def fitted(weight):
        chosen = RegularizationConfig(**NONE | {"radius": 0.1, term: weight})
        config = settings(method=method, regularization=chosen)
        problem = make_problem(built_in("cornell"), "visible", config, 0.2)
        step = TrainingStep(problem, grey_photographs(cameras), config)
        state = initial_state(problem)
        logged = [step(state, i, rates) for i in range(60)]
        state.publish(problem)
        si = problem.scene_view.scene.ray_intersect(pixel_rays(cameras, 1, 0))
        with dr.suspend_grad():
            roughness = np.array(problem.materials.evaluate(si, si.is_valid())["roughness"])
        return roughness[np.array(si.is_valid())].std(), logged

    rough, without = fitted(0.0)
    smooth, logged = fitted(weight)
    print(rough, smooth)
    assert smooth < 0.5 * rough
    assert term not in without[0]
    assert all(float(terms[term][0]) > 0 for terms in logged)
    assert not any(float(terms["skipped"][0]) for terms in logged)
