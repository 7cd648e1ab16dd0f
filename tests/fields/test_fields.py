"""Networks are the same on all engines; fields are positive, alive and never poisoned."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY, randomised, seeded

from unbake.config import preset
from unbake.fields.domain import Domain, SurfacePoint
from unbake.fields.field import FieldSpec
from unbake.fields.materials import Materials, with_joint_gradients
from unbake.fields.network import Network
from unbake.fields.perceptron import can_record_layout
from unbake.fields.radiance import RadianceField
from unbake.fields.settings import LEAK, GridConfig, NetworkConfig
from unbake.quantities import QUANTITIES

LANES = 200
#: The fused engine is for LLVM.
ENGINES = ("tensor", "coopvec", *(["fused"] if can_record_layout() else []))
WIDE = NetworkConfig(
    grid=GridConfig(levels=3, features=4, table_log2=6, base_resolution=3, growth=1.6),
    width=24,
    hidden=3,
    leak=0.1,
)


def points(lanes=LANES, seed=1):
    sampler = seeded(seed, lanes)
    p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    dr.eval(p)
    return p


# ---------------------------------------------------------------------------------- the engines


@pytest.mark.parametrize("config", [TINY, WIDE], ids=["tiny", "wide"])
@pytest.mark.parametrize(("extra", "outputs"), [(0, 1), (0, 4), (12, 3)])
def test_engines_agree_on_values_and_gradients(config, extra, outputs):
    results = {}
    for engine in ENGINES:
        network = Network(config, FieldSpec(outputs=outputs, extra=extra, seed=3))
        parameters = randomised(network)
        more = [mi.Float(0.1 * i) + points().x for i in range(extra)]
        dr.enable_grad(more)
        values = network.evaluate(SurfacePoint(points()), more, engine)
        assert len(values) == outputs
        dr.backward(sum((i + 1) * dr.sum(v * v) for i, v in enumerate(values)))
        gradients = {k: np.array(dr.grad(v)).ravel() for k, v in parameters.items()}
        gradients["inputs"] = np.array([np.array(dr.grad(m)) for m in more]).ravel()
        results[engine] = np.array([np.array(v) for v in values]), gradients
    a, grad_a = results["tensor"]
    assert np.abs(a).max() > 0.1
    for engine in ENGINES:
        b, grad_b = results[engine]
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4 * np.abs(a).max())
        assert grad_a.keys() == grad_b.keys() >= {"grid", "0.weights", "0.bias"}
        for name, gradient in grad_a.items():
            if gradient.size:
                scale = np.abs(gradient).max()
                assert scale > 0, name
                np.testing.assert_allclose(gradient, grad_b[name], atol=1e-4 * scale, err_msg=name)


@pytest.mark.parametrize("engine", ["tensor", "coopvec"])
def test_half_precision_is_near_single(engine):
    found = []
    for half in (False, True):
        network = Network(WIDE, FieldSpec(outputs=3, seed=3, half=half))
        parameters = randomised(network)
        values = network.evaluate(SurfacePoint(points()), [], engine)
        assert all(type(v) is mi.Float for v in values)
        dr.backward(sum((i + 1) * dr.mean(v * v) for i, v in enumerate(values)))
        gradients = {k: np.array(dr.grad(v)).ravel() for k, v in parameters.items()}
        found.append((np.array(values), gradients))
    (exact, of_exact), (near, of_near) = found
    assert np.abs(near - exact).max() < 2e-2 * np.abs(exact).max()
    assert (near != exact).any(), "the products were not in half precision"
    for name, gradient in of_exact.items():
        difference = np.linalg.norm(of_near[name] - gradient)
        assert difference < 3e-2 * np.linalg.norm(gradient), name


@pytest.mark.parametrize("engine", ENGINES)
def test_the_gradient_of_one_output_of_several(engine):
    """The other outputs, which are not used, have none."""
    network = Network(WIDE, FieldSpec(outputs=3, seed=3))
    parameters = randomised(network)
    weight = points(seed=8).x
    dr.backward(dr.sum(weight * network.evaluate(SurfacePoint(points()), [], engine)[1]))
    last = f"{WIDE.hidden}.bias"
    gradient = np.array(dr.grad(parameters[last])).ravel()
    np.testing.assert_allclose(gradient, [0, np.sum(weight), 0], rtol=1e-5)


@pytest.mark.parametrize("engine", ENGINES)
def test_without_gradients_values_are_the_same(engine):
    network = Network(WIDE, FieldSpec(outputs=3, seed=3))
    randomised(network)
    live = network.evaluate(SurfacePoint(points()), [], engine)
    with dr.suspend_grad():
        still = network.evaluate(SurfacePoint(points()), [], engine)
    assert dr.grad_enabled(live) and not dr.grad_enabled(still)
    np.testing.assert_allclose(np.array(live), np.array(still), rtol=1e-5)


@pytest.mark.parametrize("leak", [0.0, 0.1])
def test_network_is_a_matrix_product_with_rectified_layers(leak):
    """Against NumPy, the features taken as they are."""
    network = Network(replace(WIDE, leak=leak), FieldSpec(outputs=3, extra=2, seed=5))
    randomised(network)
    more = [points(seed=2).x, points(seed=3).y]
    x = np.array([np.array(f) for f in [*network.grid(list(points())), *more]], np.float64)
    for i, (weights, bias) in enumerate(network.perceptron.layers):
        x = np.array(weights, np.float64) @ x + np.array(bias, np.float64)
        x = np.maximum(x, leak * x) if i < WIDE.hidden else x
    values = np.array([np.array(v) for v in network.evaluate(SurfacePoint(points()), more)])
    np.testing.assert_allclose(values, x, rtol=1e-3, atol=1e-4 * np.abs(x).max())


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("leak", [0.0, LEAK])
def test_a_layer_below_zero_learns_with_a_leak_alone(leak, engine):
    """No neuron of the last layer is above zero: its output is a constant, unless it leaks."""
    network = Network(replace(TINY, leak=leak), FieldSpec(outputs=1, seed=3))
    parameters = randomised(network)
    last = TINY.hidden - 1
    shape = parameters[f"{last}.bias"].shape
    parameters[f"{last}.bias"] = dr.full(mi.TensorXf, -100, shape)
    dr.enable_grad(parameters)
    network.assign(parameters)
    (value,) = network.evaluate(SurfacePoint(points()), [], engine)
    dr.backward(dr.sum(value * points(seed=4).x))
    assert (np.ptp(np.array(value)) > 0) == (leak > 0)
    for name in ("grid", f"{last}.weights"):
        assert np.any(np.array(dr.grad(parameters[name])) != 0) == (leak > 0), name


def test_radiance_leaks_and_materials_do_not():
    config = preset("cpu")
    for form in ("neural", "triplane"):
        assert config.radiance[form].leak == LEAK
        assert config.materials["albedo"][form].leak == 0
    assert preset("paper").radiance["neural"].leak == 0


def test_grid_interpolates_between_the_corners_of_a_cell():
    """One dense level of 2³ corners: its features are trilinear in the position."""
    grid = GridConfig(levels=1, features=2, table_log2=10, base_resolution=2)
    network = Network(NetworkConfig(grid=grid, width=4, hidden=1), FieldSpec(outputs=1))
    randomised(network)
    a = np.array([0.1, 0.2, 0.15])
    b = np.array([0.35, 0.2, 0.15])
    t = np.linspace(0, 1, 5)
    line = a[:, None] * (1 - t) + b[:, None] * t
    position = mi.Point3f(*[mi.Float(row.astype(np.float32)) for row in line])
    for feature in network.grid(list(position)):
        values = np.array(feature)
        assert np.ptp(values) > 1e-3
        np.testing.assert_allclose(np.diff(values, 2), 0, atol=1e-5)


def test_equal_seeds_give_equal_networks_and_others_do_not():
    def flat(seed):
        network = Network(TINY, FieldSpec(outputs=3, seed=seed))
        return np.concatenate([np.array(v).ravel() for v in network.parameters().values()])

    np.testing.assert_array_equal(flat(1), flat(1))
    assert (flat(1) != flat(2)).any()


def test_gradients_arrive_in_the_arrays_that_were_assigned():
    network = Network(TINY, FieldSpec(outputs=1, seed=1))
    given = {k: type(v)(v) for k, v in network.parameters().items()}
    dr.enable_grad(given)
    network.assign(given)
    for engine in ENGINES:
        (value,) = network.evaluate(SurfacePoint(points()), [], engine)
        dr.backward(dr.sum(value))
    assert all(np.any(np.array(dr.grad(v)) != 0) for v in given.values())


# ------------------------------------------------------------------------------------ radiance


def radiance(scale=2.0):
    network = Network(TINY, FieldSpec(outputs=6, extra=12, seed=1))
    return RadianceField(network, Domain((1.0, 2.0, 3.0), 4.0), scale=scale)


def look(field, p, valid=True, engine="tensor"):
    lanes = dr.width(p)
    up = dr.zeros(mi.Vector3f, lanes)
    up.z = 1
    albedo = dr.full(mi.Color3f, 0.5, lanes)
    valid = dr.full(mi.Bool, True, lanes) & valid
    return field.evaluate(p, up, mi.Normal3f(up), albedo, valid, engine)


def world_points(lanes=LANES):
    return 4 * points(lanes) + mi.Point3f(-1, 0, 1)


def test_untrained_radiance_is_its_scale():
    value = np.array(look(radiance(2.5), world_points()))
    np.testing.assert_allclose(value, 2.5, rtol=0.2)


def test_radiance_engines_agree():
    field = radiance()
    randomised(field.function)
    tensor = np.array(look(field, world_points(), engine="tensor"))
    coopvec = np.array(look(field, world_points(), engine="coopvec"))
    assert np.ptp(tensor) > 0.1
    np.testing.assert_allclose(tensor, coopvec, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("raw", [-1000.0, -30.0, 0.0, 30.0])
def test_radiance_is_positive_and_its_gradient_is_alive(raw):
    """Whatever the network's output is: no sample can drive the field into a dead end."""
    field = radiance(scale=1.0)
    parameters = {k: dr.zeros(type(v), v.shape) for k, v in field.parameters().items()}
    last = list(parameters)[-1]
    shape = parameters[last].shape
    assert shape == (field.function.perceptron.outputs, 1)
    parameters[last] = mi.TensorXf([raw] * shape[0], shape)
    dr.enable_grad(parameters[last])
    field.assign(parameters)
    value = look(field, world_points(1))
    dr.backward(dr.sum(dr.sum(value)))
    slope = np.array(dr.grad(parameters[last]))
    assert np.isfinite(np.array(value)).all() and np.isfinite(slope).all()
    assert np.all(np.array(value) > 0) and np.all(slope > 0)
    # Linear where it is large, so that no step explodes.
    assert np.all(slope < 3)


def test_radiance_takes_albedo_as_a_constant():
    field = radiance()
    albedo = dr.full(mi.Color3f, 0.5, LANES)
    dr.enable_grad(albedo)
    randomised(field.function)
    up = mi.Vector3f(0, 0, 1)
    value = field.evaluate(world_points(), up, mi.Normal3f(up), albedo, mi.Bool(True))
    dr.backward(dr.sum(dr.sum(value)))
    assert np.all(np.array(dr.grad(albedo)) == 0)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan, 3e38])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_lane_that_hit_nothing_poisons_nothing(bad, engine):
    """Its position and direction are whatever they are; the parameters must not learn from it."""

    def gradients(p, w, valid):
        field, n = radiance(), dr.zeros(mi.Normal3f, dr.width(p))
        parameters = randomised(field.function)
        value = field.evaluate(p, w, n, mi.Color3f(0.5), valid, engine)
        dr.backward(dr.sum(dr.sum(dr.square(value))))
        return np.array(value), {k: np.array(dr.grad(v)).ravel() for k, v in parameters.items()}

    good = world_points(32)
    hit = dr.arange(mi.UInt32, 32) % 4 != 1
    p = dr.select(hit, good, mi.Point3f(bad))
    w = dr.select(hit, mi.Vector3f(0, 0, 1), mi.Vector3f(bad))
    value, found = gradients(p, w, hit)
    assert np.isfinite(value).all()
    assert np.all(value[:, ~np.array(hit)] == 0)
    _, clean = gradients(good, dr.select(hit, mi.Vector3f(0, 0, 1), 0), hit)
    for name in found:
        np.testing.assert_allclose(found[name], clean[name], rtol=1e-4, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan, 3e38])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_surface_at_no_position_poisons_nothing(bad, engine):
    """A degenerate triangle may say that it was hit, and not where."""
    field, up = radiance(), mi.Vector3f(0, 0, 1)
    parameters = randomised(field.function)
    p = dr.select(dr.arange(mi.UInt32, 32) % 4 != 1, world_points(32), mi.Point3f(bad))
    unit = np.array(field.domain.to_unit(p, mi.Bool(True)))
    assert unit.min() >= 0 and unit.max() <= 1
    value = field.evaluate(p, up, mi.Normal3f(up), mi.Color3f(0.5), mi.Bool(True), engine)
    dr.backward(dr.sum(dr.sum(dr.square(value))))
    assert np.isfinite(value).all()
    assert all(np.isfinite(dr.grad(v)).all() for v in parameters.values())


# ----------------------------------------------------------------------------------- materials


def materials(seed=1):
    albedo = Network(TINY, FieldSpec(outputs=3, seed=seed, bounded=True))
    roughness = Network(TINY, FieldSpec(outputs=1, seed=seed + 1, bounded=True))
    fields = Materials({"albedo": albedo, "roughness": roughness})
    fields.domain = Domain((0.0, 0.0, 0.0), 2.0)
    return fields


def surface(p):
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
    si.p = 2 * p - 1
    return si


def test_materials_stay_in_their_ranges():
    fields = materials()
    for field in fields.values():
        values = randomised(field)
        values = {k: 20 * v for k, v in values.items()}
        field.assign(values)
    found = fields.evaluate(surface(points(2000)), mi.Bool(True))
    albedo, roughness = np.array(found["albedo"]), np.array(found["roughness"])
    assert np.isfinite(albedo).all() and albedo.min() >= 0 and albedo.max() <= 1
    assert roughness.min() >= QUANTITIES["roughness"].lower - 1e-6 and roughness.max() <= 1
    # Both ends are reached, or the test would show nothing.
    assert albedo.min() < 0.01 and albedo.max() > 0.99
    assert roughness.min() < 0.03 and roughness.max() > 0.99


def test_untrained_materials_are_grey():
    found = materials().evaluate(surface(points()), mi.Bool(True))
    np.testing.assert_allclose(np.array(found["albedo"]), 0.5, atol=0.05)


def test_material_engines_agree():
    fields = materials()
    for i, field in enumerate(fields.values()):
        randomised(field, i)
    si = surface(points())
    a, b = (fields.evaluate(si, mi.Bool(True), e) for e in ("tensor", "coopvec"))
    np.testing.assert_allclose(np.array(a["albedo"]), np.array(b["albedo"]), atol=1e-5)
    np.testing.assert_allclose(np.array(a["roughness"]), np.array(b["roughness"]), atol=1e-5)
    np.testing.assert_allclose(
        np.array(fields.evaluate_one("albedo", si, mi.Bool(True))), np.array(a["albedo"]), atol=1e-6
    )


@pytest.mark.parametrize("used", ["both", "albedo", "roughness"])
def test_gradients_computed_together_are_those_computed_one_by_one(used):
    def gradients(through):
        fields = materials()
        parameters = {}
        for i, (name, field) in enumerate(fields.items()):
            for key, value in randomised(field, i).items():
                parameters[f"{name}.{key}"] = value
        fields.assign(parameters)
        found = through(fields.evaluate(surface(points()), mi.Bool(True)))
        loss = 0
        if used != "roughness":
            loss += dr.sum(dr.square(found["albedo"]).x * found["albedo"].z)
        if used != "albedo":
            loss += dr.sum(found["roughness"] * dr.detach(found["albedo"].y))
        dr.backward(dr.sum(loss))
        return {k: np.array(dr.grad(v)).ravel() for k, v in parameters.items()}

    apart, together = gradients(lambda material: material), gradients(with_joint_gradients)
    assert max(abs(g).max() for g in apart.values()) > 1e-3
    for name, gradient in apart.items():
        np.testing.assert_allclose(together[name], gradient, rtol=1e-5, atol=1e-6, err_msg=name)


def test_parameters_go_out_and_come_back():
    one, other = materials(), materials(seed=9)
    other.assign(one.parameters())
    si = surface(points())
    a, b = one.evaluate(si, mi.Bool(True)), other.evaluate(si, mi.Bool(True))
    np.testing.assert_array_equal(np.array(a["albedo"]), np.array(b["albedo"]))
    np.testing.assert_array_equal(np.array(a["roughness"]), np.array(b["roughness"]))


# -------------------------------------------------------------------------------------- domain


def test_domain_is_one_uniform_scale_about_the_centre():
    box = mi.BoundingBox3f(mi.ScalarPoint3f(-1, 2, 0), mi.ScalarPoint3f(7, 4, 1))
    domain = Domain.of(box)
    assert domain.centre == (3.0, 3.0, 0.5)
    np.testing.assert_allclose(domain.extent, 8 * 1.01)

    def unit(*p):
        return np.array(domain.to_unit(mi.Point3f(*p), mi.Bool(True))).ravel()

    np.testing.assert_allclose(unit(3, 3, 0.5), 0.5)
    # The longest side spans the cube; the same distance along any axis is the same step.
    np.testing.assert_allclose(unit(-1, 3, 0.5)[0], 0.5 - 0.5 / 1.01, atol=1e-6)
    steps = [unit(3 + (i == 0), 3 + (i == 1), 0.5 + (i == 2))[i] - 0.5 for i in range(3)]
    np.testing.assert_allclose(steps, 1 / domain.extent, rtol=1e-5)
    corners = [unit(*c) for c in ((-1, 2, 0), (7, 4, 1))]
    assert np.min(corners) > 0 and np.max(corners) < 1


def test_positions_outside_and_masked_lanes_stay_in_the_cube():
    x = mi.Float([9.0, -9.0, np.inf, np.nan, 0.0])
    p = mi.Point3f(x, x, x)
    valid = mi.Bool([True, True, False, False, True])
    unit = np.array(Domain((0.0, 0.0, 0.0), 2.0).to_unit(p, valid))
    np.testing.assert_allclose(unit, [[1, 0, 0.5, 0.5, 0.5]] * 3)
