"""Materials as networks, dense grids and bitmaps: one interface, each with a meaning of its own."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import randomised, seeded, tiny_fields

from unbake.config import BitmapConfig, DenseGridConfig
from unbake.errors import UserError
from unbake.fields.bitmap import Bitmaps
from unbake.fields.domain import Domain, SurfacePoint
from unbake.fields.field import FieldSpec
from unbake.fields.grid import DenseGrid
from unbake.fields.materials import make_materials
from unbake.fields.network import Network
from unbake.fields.radiance import RadianceField, make_radiance
from unbake.fields.registry import representations
from unbake.fields.settings import TriPlaneConfig
from unbake.fields.triplane import TriPlane

LANES = 300
REPRESENTATIONS = representations()


def uniform(dimensions, lanes=LANES, seed=1):
    sampler = seeded(seed, lanes)
    values = [sampler.next_1d() for _ in range(dimensions)]
    dr.eval(values)
    return values


def interactions(lanes=LANES):
    """Points in the cube [-1,1]³ with texture coordinates in [-2,2]²."""
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    x, y, z, u, v = uniform(5, lanes)
    si.p = 2 * mi.Point3f(x, y, z) - 1
    si.uv = 4 * mi.Point2f(u, v) - 2
    si.sh_frame = mi.Frame3f(dr.normalize(mi.Vector3f(1, 2, 3)))
    return si


def made(representation):
    fields = make_materials(
        representation, tiny_fields(representation).material_settings, ["one"], seed=3
    )
    fields.domain = Domain((0.0, 0.0, 0.0), 2.0)
    return fields


# --------------------------------------------------------------------------- all representations


@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_untrained_materials_are_grey(representation):
    found = made(representation).evaluate(interactions(), mi.Bool(True))
    np.testing.assert_allclose(np.array(found["albedo"]), 0.5, atol=0.05)
    np.testing.assert_allclose(np.array(found["roughness"]), 0.51, atol=0.05)


@pytest.mark.parametrize("representation", REPRESENTATIONS)
@pytest.mark.parametrize("engine", ["tensor", "coopvec"])
def test_gradients_are_those_of_finite_differences(representation, engine):
    fields, si = made(representation), interactions()
    parameters = randomised(fields)

    def value():
        found = fields.evaluate(si, mi.Bool(True), engine)
        total = dr.sum(found["albedo"] * mi.Color3f(1, 2, 3)) + 2 * found["roughness"]
        return dr.sum(total * (1 + mi.Float(si.p.x)))

    dr.backward(value())
    rng = np.random.default_rng(5)
    for name, array in parameters.items():
        gradient = np.array(dr.grad(array)).ravel()
        # Along a random direction the kinks of a few ReLUs do not matter.
        direction = rng.normal(size=gradient.shape).astype(np.float32)
        h = 1e-3

        def moved(by, name=name, array=array, direction=direction):
            step = type(array)((np.array(array).ravel() + by * direction).reshape(array.shape))
            fields.assign({**parameters, name: step})
            return float(value()[0])

        slope = (moved(h) - moved(-h)) / (2 * h)
        fields.assign(parameters)
        expected = float(gradient @ direction)
        scale = float(np.linalg.norm(gradient))
        assert scale > 0, name
        assert slope == pytest.approx(expected, abs=0.03 * scale), name


@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_engines_agree(representation):
    fields, si = made(representation), interactions()
    randomised(fields)
    a, b = (fields.evaluate(si, mi.Bool(True), engine) for engine in ("tensor", "coopvec"))
    assert np.ptp(np.array(a["albedo"])) > 0.1 and np.ptp(np.array(a["roughness"])) > 0.1
    np.testing.assert_allclose(np.array(a["albedo"]), np.array(b["albedo"]), atol=1e-5)
    np.testing.assert_allclose(np.array(a["roughness"]), np.array(b["roughness"]), atol=1e-5)
    alone = fields.evaluate_one("albedo", si, mi.Bool(True))
    np.testing.assert_allclose(np.array(alone), np.array(a["albedo"]), atol=1e-6)


@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_parameters_go_out_and_come_back(representation):
    one, other = made(representation), made(representation)
    randomised(one, seed=1)
    randomised(other, seed=2)
    si = interactions()
    before = np.array(other.evaluate(si, mi.Bool(True))["albedo"])
    other.assign(one.parameters())
    a, b = one.evaluate(si, mi.Bool(True)), other.evaluate(si, mi.Bool(True))
    np.testing.assert_array_equal(np.array(a["albedo"]), np.array(b["albedo"]))
    np.testing.assert_array_equal(np.array(a["roughness"]), np.array(b["roughness"]))
    assert (before != np.array(b["albedo"])).any()


@pytest.mark.parametrize("bad", [np.inf, np.nan, 3e38])
@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_a_lane_that_hit_nothing_poisons_nothing(representation, bad):
    def gradients(si, valid):
        fields = made(representation)
        parameters = randomised(fields)
        found = fields.evaluate(si, valid)
        near = fields.evaluate_near(si, valid, mi.Point2f(0.3, 0.6), 0.1)
        total = found["roughness"] + near["roughness"] + dr.sum(found["albedo"] + near["albedo"])
        dr.backward(dr.sum(dr.select(valid, dr.square(total), 0)))
        return np.array(total), {k: np.array(dr.grad(v)).ravel() for k, v in parameters.items()}

    valid = dr.arange(mi.UInt32, LANES) % 4 != 1
    clean, broken = interactions(), interactions()
    broken.p = dr.select(valid, broken.p, mi.Point3f(bad))
    broken.uv = dr.select(valid, broken.uv, mi.Point2f(bad))
    broken.sh_frame.s = dr.select(valid, broken.sh_frame.s, mi.Vector3f(bad))
    value, found = gradients(broken, valid)
    _, expected = gradients(clean, valid)
    assert np.isfinite(value).all()
    for name, gradient in found.items():
        np.testing.assert_allclose(gradient, expected[name], atol=1e-3, err_msg=name)


@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_near_points_are_near_in_the_tangent_plane(representation, monkeypatch):
    fields, si = made(representation), interactions()
    seen = {}

    def evaluate(near, valid):
        seen["offset"] = np.array(near.p - si.p)
        seen["uv"] = np.array(near.uv - si.uv)

    monkeypatch.setattr(fields, "evaluate", evaluate)
    fields.evaluate_near(si, mi.Bool(True), mi.Point2f(*uniform(2)), 0.1)
    # The domain's edge is 2 units long.
    length = np.linalg.norm(seen["offset"], axis=0)
    assert 0.19 < length.max() <= 0.2 + 1e-6 and np.median(length) > 0.1
    assert np.abs(np.array(si.sh_frame.n).ravel() @ seen["offset"]).max() < 1e-6
    length = np.linalg.norm(seen["uv"], axis=0)
    assert 0.095 < length.max() <= 0.1 + 1e-6


@pytest.mark.parametrize("name", ["albedo", "roughness"])
@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_points_and_those_near_them_are_asked_together(representation, name):
    """Values and gradients are those of two questions."""
    fields, si = made(representation), interactions()
    parameters, numbers = randomised(fields), mi.Point2f(*uniform(2))
    valid, found = dr.arange(mi.UInt32, LANES) % 4 != 1, []
    for together in (False, True):
        if together:
            pair = fields.evaluate_one_and_near(name, si, valid, numbers, 0.1)
        else:
            near = fields.evaluate_near(si, valid, numbers, 0.1)
            pair = fields.evaluate(si, valid)[name], near[name]
        difference = dr.square(mi.Color3f(pair[0]) - 2 * mi.Color3f(pair[1]))
        dr.backward(dr.sum(dr.select(valid, dr.mean(difference), 0)))
        found.append(
            (list(map(np.array, pair)), [np.array(dr.grad(v)) for v in parameters.values()])
        )
        dr.clear_grad(list(parameters.values()))
    (values, gradients), (values_together, gradients_together) = found
    np.testing.assert_allclose(values_together, values, atol=1e-5)
    assert any(gradient.any() for gradient in gradients)
    for one, other in zip(gradients_together, gradients, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_near_points_show_a_slope(representation):
    """Differences at near points are small with the radius, and not zero."""
    fields, si = made(representation), interactions()
    randomised(fields)
    here = np.array(fields.evaluate(si, mi.Bool(True))["roughness"])
    mean = []
    for radius in (0.001, 0.1):
        near = fields.evaluate_near(si, mi.Bool(True), mi.Point2f(*uniform(2)), radius)
        mean.append(np.abs(np.array(near["roughness"]) - here).mean())
    assert 0 < mean[0] < 0.05 * mean[1]


# ------------------------------------------------------------------------------------------ grid


def radiance_field(representation, domain, *, scale, seed):
    config = tiny_fields(radiance=representation)
    return make_radiance(representation, config.radiance_settings, domain, scale=scale, seed=seed)


def test_a_grid_is_exact_on_a_linear_function():
    """Up to the faces of the cube: corners of cells lie on them."""
    grid, cells = DenseGrid(DenseGridConfig(4), FieldSpec(outputs=3)), 4
    k, j, i = np.meshgrid(*3 * [np.arange(cells + 1) / cells], indexing="ij")  # x varies fastest
    linear = np.stack([1 + 2 * i - j, j + 3 * k, i - k, 0 * i], -1)
    (name,) = grid.parameters()
    # Nothing beyond the last corner is read.
    values = np.append(linear.ravel(), np.full(256, np.nan)).astype(np.float32)
    grid.assign({name: mi.Float(values)})
    x, y, z = np.array(uniform(3)).reshape(3, -1)
    x[:3], y[:3], z[:3] = [0, 1, 1], [0, 1, 0], [0, 1, 1]
    p = mi.Point3f(*(mi.Float(c) for c in (x, y, z)))
    found = np.array([np.array(v) for v in grid.evaluate(SurfacePoint(p))])
    np.testing.assert_allclose(found, [1 + 2 * x - y, y + 3 * z, x - z], atol=1e-5)


@pytest.mark.parametrize(("outputs", "features"), [(1, 2), (3, 4), (6, 8)])
def test_a_grid_has_a_value_of_its_own_at_every_corner(outputs, features):
    grid = DenseGrid(DenseGridConfig(9), FieldSpec(outputs=outputs))
    (values,) = grid.parameters().values()
    assert dr.width(values) >= features * 10**3
    # Distinct values at all corners come back from all corners: nothing is hashed.
    count = dr.width(values)
    grid.assign({"corners": mi.Float(dr.arange(mi.UInt32, count))})
    lane = dr.arange(mi.UInt32, 10**3)
    p = mi.Point3f(mi.Float(lane % 10), mi.Float(lane // 10 % 10), mi.Float(lane // 100)) / 9
    found = np.array(grid.evaluate(SurfacePoint(p))[0])
    assert len(np.unique(np.round(found))) == 10**3


def test_a_radiance_grid_takes_the_calls_of_a_network():
    field = radiance_field("grid", Domain.unit(), scale=2.0, seed=1)
    p, n = mi.Point3f(*uniform(3)), dr.zeros(mi.Normal3f, LANES)
    w = mi.Vector3f(0, 0, 1)
    untrained = field.evaluate(p, w, n, mi.Color3f(0.5), mi.Bool(True))
    np.testing.assert_allclose(np.array(untrained), 2.0, rtol=1e-5)
    parameters = randomised(field)
    (width,) = (dr.width(v) for v in parameters.values())
    assert 8 * 5**3 <= width < 8 * 6**3
    a = field.evaluate(p, w, n, mi.Color3f(0.5), mi.Bool(True))
    b = field.evaluate(p, -w, n, mi.Color3f(0.5), mi.Bool(True), "coopvec")
    assert np.ptp(np.array(a)) > 0.1 and np.array(a).min() > 0
    np.testing.assert_allclose(np.array(a), np.array(b), rtol=1e-5)  # Fig. 5: no direction
    dr.backward(dr.sum(dr.sum(a)))
    assert all(np.any(np.array(dr.grad(v)) != 0) for v in parameters.values())


def test_both_representations_of_radiance_are_made():
    kinds = {
        "neural": radiance_field("neural", Domain.unit(), scale=1.0, seed=1).function,
        "grid": radiance_field("grid", Domain.unit(), scale=1.0, seed=1).function,
        "triplane": radiance_field("triplane", Domain.unit(), scale=1.0, seed=1).function,
    }
    assert isinstance(kinds["neural"], Network) and isinstance(kinds["grid"], DenseGrid)
    assert isinstance(kinds["triplane"], TriPlane)
    assert isinstance(RadianceField(kinds["grid"], Domain.unit(), scale=1.0), RadianceField)


# ----------------------------------------------------------------------------------- feature planes


def test_features_are_sums_of_bilinear_planes():
    """Linear functions of two coordinates each come back exactly, from edge to edge."""
    corners = 5
    settings = TriPlaneConfig(levels=1, features=2, base_resolution=corners, width=4)
    field, seen = TriPlane(settings, FieldSpec(outputs=1)), []
    field.perceptron.evaluate = lambda features, engine: seen.extend(features)
    second, first = np.meshgrid(*2 * [np.linspace(0, 1, corners)], indexing="ij")
    planes = {"xy": (2, -1), "yz": (3, 0.5), "zx": (-1, 4)}
    filled = {
        name: np.stack([a * first + b * second, first * 0 + a], -1).ravel()
        for name, (a, b) in planes.items()
    }
    given = field.parameters()
    for name, values in filled.items():
        room = np.zeros(given[name].shape, np.float32)
        room[: values.size] = values
        given[name] = mi.Float(room)
    field.assign(given)
    x, y, z = np.array(uniform(3)).reshape(3, -1)
    x[:3], y[:3], z[:3] = [0, 1, 1], [0, 1, 0], [0, 1, 1]
    field.evaluate(SurfacePoint(mi.Point3f(*(mi.Float(c) for c in (x, y, z)))))
    expected = [2 * x - y + 3 * y + 0.5 * z - z + 4 * x, np.full(LANES, 4)]
    np.testing.assert_allclose(np.array(seen), expected, atol=1e-5)


@pytest.mark.parametrize("settings", [TriPlaneConfig(), TriPlaneConfig(4, 2, 7)])
def test_planes_have_a_value_of_their_own_at_every_corner(settings):
    field = TriPlane(settings, FieldSpec(outputs=1))
    corners = sum((settings.base_resolution * 2**level) ** 2 for level in range(settings.levels))
    for plane in field.planes.values():
        assert (
            corners * settings.features <= dr.width(plane.data) < 1.01 * corners * settings.features
        )


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"levels": 0}, "levels: must be 1 or more, not 0"),
        ({"features": 3}, "features: must be 2, 4 or 8, not 3"),
        ({"base_resolution": 1}, "base_resolution: must be 2 or more, not 1"),
        ({"levels": 10}, r"levels: must be such that base_resolution \* 2\^\(levels - 1\) is 81"),
        ({"levels": 13}, "levels: must be such that"),
        ({"width": 0}, "width: must be 1 or more"),
        ({"learning_rate": 0.0}, "learning_rate: must be positive"),
    ],
)
def test_settings_of_planes_are_checked(bad, message):
    with pytest.raises(UserError, match=message):
        TriPlaneConfig(**bad)


# --------------------------------------------------------------------------------------- bitmaps


def bitmaps_of(resolution, names, channels):
    spec = FieldSpec(outputs=channels, bounded=True, materials=tuple(names))
    return Bitmaps(BitmapConfig(resolution), spec)


def logit(values):
    return np.log(values / (1 - values))


def assign_values(bitmaps, values):
    """Give bitmaps these values, (materials, size, size, channels)."""
    bitmaps.assign({"texels": mi.Float(logit(values).astype(np.float32).ravel())})


def look_up(bitmaps, u, v, material=0):
    u, v = (mi.Float(np.asarray(c, np.float32)) for c in (u, v))
    point = SurfacePoint(mi.Point3f(0), mi.Point2f(u, v), mi.UInt32(material))
    return np.array([np.array(c) for c in bitmaps.evaluate(point)])


def test_a_bitmap_is_exact_on_a_linear_function():
    bitmaps, size = bitmaps_of(8, ["one"], 3), 8
    row, column = np.meshgrid(*2 * [(np.arange(size) + 0.5) / size], indexing="ij")
    linear = [0.1 + 0.8 * column, 0.9 - 0.8 * row, 0.2 + 0.3 * row + 0.3 * column]
    assign_values(bitmaps, np.stack(linear, -1)[None])
    u, v = np.array(uniform(2)).reshape(2, -1) * (1 - 1 / size) + 0.5 / size
    expected = [0.1 + 0.8 * u, 0.9 - 0.8 * v, 0.2 + 0.3 * v + 0.3 * u]
    np.testing.assert_allclose(look_up(bitmaps, u, v), expected, atol=1e-5)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_bitmaps_repeat(size):
    bitmaps = bitmaps_of(size, ["one"], 3)
    randomised(bitmaps)
    u, v = np.array(uniform(2)).reshape(2, -1)
    first = look_up(bitmaps, u, v)
    for du, dv in ((1, 0), (0, -1), (-3, 7)):
        np.testing.assert_allclose(look_up(bitmaps, u + du, v + dv), first, atol=1e-4)
    # Without a seam; just below zero rounds to one.
    below, above = (look_up(bitmaps, [x, 0.3], [0.3, x]) for x in (-1e-9, 1e-9))
    np.testing.assert_allclose(below, above, atol=1e-4)


@pytest.mark.parametrize("channels", [1, 3])
def test_bitmaps_equal_mitsubas_own(channels):
    bitmaps = bitmaps_of(5, ["other", "this"], channels)
    randomised(bitmaps)
    values = bitmaps.to_arrays()["this"]
    assert values.shape == (5, 5, channels) and values.dtype == np.float32
    stock = mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True})
    si = interactions()
    point = SurfacePoint(mi.Point3f(0), si.uv, mi.UInt32(1))
    expected = np.array(stock.eval_1(si) if channels == 1 else stock.eval(si))
    expected = expected.reshape(channels, -1)
    found = np.array([np.array(c) for c in bitmaps.evaluate(point)])
    assert np.ptp(found) > 0.1
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_a_texel_that_is_not_touched_stays(tmp_path):
    bitmaps = bitmaps_of(8, ["one", "two"], 1)
    optimizer = mi.ad.Adam(0.1, bitmaps.parameters(), mask_updates=True)
    for _ in range(3):
        bitmaps.assign(dict(optimizer.items()))
        point = SurfacePoint(mi.Point3f(0), mi.Point2f(3.5 / 8, 6.5 / 8), mi.UInt32(1))
        dr.backward(dr.sum(bitmaps.evaluate(point)[0]))
        optimizer.step()
    moved = np.array(optimizer["texels"]).reshape(2, 8, 8)
    assert moved[1, 6, 3] < -0.2
    moved[1, 6, 3] = 0
    assert (moved == 0).all()


def test_bitmaps_beyond_an_array_are_an_error():
    with pytest.raises(UserError, match="30 bitmaps of 8192 x 8192 pixels"):
        bitmaps_of(8192, ["x"] * 30, 3)


@pytest.mark.parametrize("outputs", [1, 3])
def test_a_dense_grid_tells_differences_of_neighbouring_corners(outputs):
    grid = DenseGrid(DenseGridConfig(3), FieldSpec(outputs))
    values = np.random.default_rng(0).random(len(grid.grid.data)).astype(np.float32)
    grid.assign({"corners": mi.Float(values)})
    corners = values.reshape(4, 4, 4, -1)  # z, y, x
    expected = [
        np.diff(corners[..., output], axis=axis).ravel()
        for axis in (2, 1, 0)
        for output in range(outputs)
    ]
    for found, wanted in zip(grid.differences(), expected, strict=True):
        np.testing.assert_allclose(np.array(found), wanted, atol=1e-6)
