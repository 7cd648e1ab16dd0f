"""The learned environment: no seam, sampled as its density says, equal to Mitsuba's `envmap`."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    assert_same_expectation,
    losses_of_light,
    pixel_rays,
    randomised,
    seeded,
    stock_path,
)

from unbake.dataset.camera import Camera
from unbake.fields.envmap import BOUND, EnvironmentMap, environment_emitter, from_square, to_square
from unbake.transport.operator import attach_material, bounce
from unbake.transport.vertex import SceneView, find_vertex

CAMERA = [Camera.look_at([0, 1, 4], [0, 0, 0], [0, 1, 0], 45, 12, 12)]
CAMERA_PLUGIN = {
    "type": "perspective",
    "fov": 45.0,
    "to_world": mi.ScalarTransform4f().look_at([0, 1, 4], [0, 0, 0], [0, 1, 0]),
}


def filled(resolution=8, spread=0.7, scale=2.0, seed=0):
    """A map with random levels, and the arrays that gradients arrive in."""
    environment = EnvironmentMap(resolution, scale=scale)
    values = randomised(environment, seed, spread)
    environment.prepare()
    return environment, values


def squares(lanes, seed=1):
    sampler = seeded(seed, lanes)
    p = mi.Point2f(sampler.next_2d())
    dr.eval(p)
    return p


def spheres(lanes, seed=1):
    return mi.warp.square_to_uniform_sphere(squares(lanes, seed))


def vectors(columns):
    return mi.Vector3f(*[mi.Float(np.asarray(c, np.float32)) for c in columns])


def test_coarse_levels_count_as_often_as_their_gain():
    once, fourfold = EnvironmentMap(16, scale=1.5), EnvironmentMap(16, scale=1.5, coarse_gain=4.0)
    values = randomised(once, 3, 0.7)
    once.prepare()
    fourfold.assign({k: v / (4 if k in ("level.4", "level.8") else 1) for k, v in values.items()})
    fourfold.prepare()
    assert set(values) == {"level.4", "level.8", "level.16"}
    np.testing.assert_allclose(np.array(fourfold.texels), np.array(once.texels), rtol=1e-5)


def lit_scene(emitter):
    """A ball on the ground, half metal, a small lamp, and the environment."""
    transform = mi.ScalarTransform4f()
    metal = {"type": "principled", "base_color": {"type": "rgb", "value": [0.9, 0.6, 0.3]},
             "metallic": 0.7, "roughness": 0.3}  # fmt: skip
    return mi.load_dict(
        {
            "type": "scene",
            "environment": emitter,
            "ball": {"type": "sphere", "bsdf": metal},
            "ground": {
                "type": "rectangle",
                "to_world": transform.translate([0, -1, 0]).rotate([1, 0, 0], -90).scale(4),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
            },
            "lamp": {
                "type": "sphere",
                "center": [1.5, 1.5, 0],
                "radius": 0.2,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}},
            },
        }
    )


# --------------------------------------------------------------------------------- the square


def test_the_square_is_mapped_forth_and_back():
    p = squares(20_000)
    d = from_square(p)
    np.testing.assert_allclose(dr.norm(d), 1, atol=1e-6)
    np.testing.assert_allclose(to_square(d), p, atol=1e-6)


def test_the_poles_and_axes_are_where_they_should_be():
    axes = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    d = vectors(np.array(axes).T)
    p = np.array(to_square(d)).T
    np.testing.assert_allclose(p[0], 0.5)
    assert set(np.abs(p[1] - 0.5)) == {0.5}  # a corner
    np.testing.assert_allclose(p[2:6], [[1, 0.5], [0.5, 1], [0, 0.5], [0.5, 0]], atol=1e-6)
    np.testing.assert_allclose(from_square(to_square(d)), d, atol=1e-6)


def test_equal_areas_have_equal_solid_angles():
    p = squares(20_000)
    # Away from the creases, where a step would cross them
    q = np.array(p)
    smooth = np.abs(np.abs(q - 0.5).sum(0) - 0.5) > 0.02
    smooth &= (np.abs(q - 0.5) > 0.02).all(0) & (np.abs(q - 0.5) < 0.48).all(0)
    h = 4e-3
    along_u = (from_square(p + mi.Point2f(h, 0)) - from_square(p - mi.Point2f(h, 0))) / (2 * h)
    along_v = (from_square(p + mi.Point2f(0, h)) - from_square(p - mi.Point2f(0, h))) / (2 * h)
    area = np.array(dr.norm(dr.cross(along_u, along_v)))[smooth]
    assert smooth.mean() > 0.7
    np.testing.assert_allclose(area, 4 * np.pi, rtol=0.01)


# ----------------------------------------------------------------------------------- the lookup


def test_an_untrained_map_is_the_same_everywhere():
    environment = EnvironmentMap(16, scale=1.5)
    np.testing.assert_allclose(environment.radiance(spheres(500)), 1.5, rtol=1e-6)
    np.testing.assert_allclose(environment.pdf(spheres(500)), 1 / (4 * np.pi), rtol=1e-4)


def test_a_texel_is_the_exponential_of_its_levels():
    environment, values = filled(8)
    coarse = np.array(values["level.4"]).reshape(4, 4, 3)
    fine = np.array(values["level.8"]).reshape(8, 8, 3)
    # A texel of level 8 at the centre of the square: 9/16, 3/16, 3/16 and 1/16 of level 4.
    for (row, column), near in {(3, 3): (1, 1), (4, 3): (2, 1), (4, 4): (2, 2)}.items():
        far = tuple(3 - n for n in near)
        mixed = 9 * coarse[near] + 3 * coarse[near[0], far[1]] + 3 * coarse[far[0], near[1]]
        latent = (mixed + coarse[far]) / 16 + fine[row, column]
        p = mi.Point2f((column + 0.5) / 8, (row + 0.5) / 8)
        expected = 2 * np.exp(latent)
        np.testing.assert_allclose(np.ravel(environment.radiance(from_square(p))), expected, 1e-4)


def test_texels_are_interpolated_linearly():
    environment, _ = filled(8)
    t = np.linspace(0, 1, 9, dtype=np.float32)
    p = mi.Point2f((3.5 + mi.Float(t)) / 8, 5.2 / 8)
    values = np.array(environment.radiance(from_square(p)))
    assert np.ptp(values, axis=1).min() > 1e-2
    np.testing.assert_allclose(np.diff(values, 2), 0, atol=1e-4)


@pytest.mark.parametrize("edge", ["left", "right", "bottom", "top"])
@pytest.mark.parametrize("resolution", [4, 16])
def test_the_edges_of_the_square_are_no_seam(edge, resolution):
    environment, _ = filled(resolution)
    t = mi.Float(np.linspace(0, 1, 201, dtype=np.float32))
    inside = 1e-5

    def beside(t):
        near, far = mi.Float(inside), mi.Float(1 - inside)
        return {
            "left": mi.Point2f(near, t),
            "right": mi.Point2f(far, t),
            "bottom": mi.Point2f(t, near),
            "top": mi.Point2f(t, far),
        }[edge]

    a, b = from_square(beside(t)), from_square(beside(1 - t))
    np.testing.assert_allclose(a, b, atol=1e-3)  # the same directions, from two sides
    a, b = np.array(environment.radiance(a)), np.array(environment.radiance(b))
    assert np.ptp(a) > 0.5
    np.testing.assert_allclose(a, b, atol=1e-2)


@pytest.mark.parametrize("resolution", [4, 16])
def test_no_jump_on_circles_through_the_poles_and_around_them(resolution):
    environment, _ = filled(resolution)
    lanes = 40_000
    t = np.linspace(0, 2 * np.pi, lanes)
    circles = [(np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)) for a in (0, 0.6, 2.2)]
    circles += [
        (s * np.cos(t), s * np.sin(t), np.full(lanes, c)) for s, c in [(1e-3, -1), (0.6, -0.8)]
    ]
    for circle in circles:
        values = np.array(environment.radiance(vectors(circle)))
        # In one step less than one texel is crossed, and no more than all contrast there is.
        steepest = np.array(environment.radiance(spheres(20_000))).max() * resolution / lanes * 6.3
        assert np.abs(np.diff(values)).max() < steepest


def test_the_four_corners_of_the_square_are_one_direction():
    environment, _ = filled(8)
    e = 1e-6
    corners = [(e, e), (1 - e, e), (e, 1 - e), (1 - e, 1 - e)]
    at = [np.ravel(environment.radiance(from_square(mi.Point2f(*c)))) for c in corners]
    np.testing.assert_allclose(at, np.broadcast_to(at[0], (4, 3)), rtol=1e-3)


def test_lanes_that_are_not_active_are_zero_and_poison_nothing():
    environment, values = filled(8)
    d = vectors([[0, np.nan], [0, np.inf], [1, np.nan]])
    radiance = environment.radiance(d, mi.Bool([True, False]))
    dr.backward(dr.sum(dr.sum(radiance)))
    assert np.array(radiance)[:, 0].min() > 0
    assert (np.array(radiance)[:, 1] == 0).all()
    assert all(np.isfinite(dr.grad(v)).all() for v in values.values())


def test_directions_that_are_no_numbers_read_and_poison_no_table():
    """Mitsuba asks for the environment along any ray that leaves the scene, whatever it is."""
    bad = [np.nan, np.inf, -np.inf, 3e38]
    good = np.array([[0, 0, 1], [0.6, 0, 0.8]], np.float32).T
    environment, values = filled(8)
    broken = np.array([(a, b, c) for a in (0, *bad) for b in (0, *bad) for c in bad], np.float32).T
    d = vectors(np.concatenate([good, broken], axis=1))
    radiance, pdf = environment.radiance(d), environment.pdf(d)
    dr.backward(dr.sum(dr.sum(radiance)))
    texels = np.array(environment.texels).reshape(-1, 4)[:, :3]
    found = np.array(radiance)
    assert np.isfinite(found).all() and np.isfinite(pdf).all()
    assert (found.min(1) >= texels.min(0)).all() and (found.max(1) <= 1.0001 * texels.max(0)).all()
    assert all(np.isfinite(dr.grad(v)).all() for v in values.values())

    alone, _ = filled(8)
    expected = np.array(alone.radiance(vectors(good)))
    np.testing.assert_array_equal(found[:, :2], expected)


def test_random_numbers_that_are_none_choose_directions():
    environment, _ = filled(8)
    u = np.array([np.nan, 0.5, 0.3, np.inf], np.float32)
    direction, pdf = environment.sample(mi.Point2f(mi.Float(u), mi.Float(u[::-1].copy())))
    assert np.isfinite(direction).all() and np.isfinite(pdf).all()


def test_extreme_parameters_stay_finite_and_keep_a_gradient():
    environment, values = filled(8)
    for sign in (1, -1):
        wild = {k: dr.full(mi.Float, sign * 1e4, dr.width(v)) for k, v in values.items()}
        dr.enable_grad(wild)
        environment.assign(wild)
        environment.prepare()
        radiance = environment.radiance(spheres(1000))
        np.testing.assert_allclose(radiance, 2 * np.exp(sign * BOUND), rtol=1e-4)
        d, pdf = environment.sample(squares(1000))
        assert np.isfinite(d).all()
        np.testing.assert_allclose(pdf, 1 / (4 * np.pi), rtol=1e-3)
        dr.backward(dr.sum(dr.sum(radiance)))
        for gradient in dr.grad(list(wild.values())):
            assert np.isfinite(gradient).all()
            assert np.abs(gradient).max() > 0


def test_gradients_arrive_in_the_arrays_that_were_assigned():
    """Scaling every texel scales the radiance: gradients of a level sum to the radiance."""
    environment, values = filled(16)
    radiance = environment.radiance(spheres(2000))
    total = np.array(radiance).sum()
    dr.backward(dr.sum(dr.sum(radiance)))
    for name in ("level.4", "level.8", "level.16"):
        np.testing.assert_allclose(np.array(dr.grad(values[name])).sum(), total, rtol=1e-4)


# ------------------------------------------------------------------------------------- sampling


@pytest.mark.parametrize(("resolution", "spread"), [(4, 1.0), (8, 0.7), (16, 2.0)])
def test_directions_are_sampled_as_their_density_says(resolution, spread):
    environment, _ = filled(resolution, spread)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=lambda sample: environment.sample(sample)[0],
        pdf_func=environment.pdf,
        sample_dim=2,
        sample_count=200_000,
        res=33,
        ires=32,
    )
    assert test.run(), test.messages


@pytest.mark.parametrize("spread", [0.0, 1.0, 4.0])
def test_the_density_integrates_to_one_and_is_never_zero(spread):
    environment, _ = filled(16, spread)
    # A regular grid of the square: equal solid angles, and every texel counted alike.
    t = (np.arange(64) + 0.5) / 64
    u, v = np.meshgrid(t, t)
    p = mi.Point2f(*[mi.Float(x.ravel().astype(np.float32)) for x in (u, v)])
    density = np.array(environment.pdf(from_square(p)))
    assert density.min() > 0
    assert density.mean() * 4 * np.pi == pytest.approx(1, rel=1e-4)


def test_a_sample_comes_with_its_density_and_costs_less_than_a_uniform_one():
    environment, _ = filled(16, 1.5)
    d, pdf = environment.sample(squares(50_000))
    agree = np.isclose(np.array(pdf), np.array(environment.pdf(d)), rtol=1e-4)
    assert agree.mean() > 0.999  # on the edge of two texels, rounding decides
    # Both estimate the same integral.
    bright = np.array(mi.luminance(environment.radiance(d))) / np.array(pdf)
    uniform = np.array(mi.luminance(environment.radiance(spheres(50_000, 5)))) * 4 * np.pi
    error = np.hypot(bright.std(), uniform.std()) / np.sqrt(50_000)
    assert abs(bright.mean() - uniform.mean()) < 4 * error
    assert bright.std() < 0.5 * uniform.std()


def test_one_texel_that_outshines_all_is_found_and_the_rest_too():
    environment, values = filled(16, 0.0)
    sun = np.zeros((16, 16, 3), np.float32)
    sun[5, 11] = 14
    environment.assign({**values, "level.16": mi.Float(sun.ravel())})
    environment.prepare()
    d, _ = environment.sample(squares(20_000))
    p = np.floor(np.array(to_square(d)) * 16)
    share = ((p[0] == 11) & (p[1] == 5)).mean()
    near = (np.abs(p[0] - 11) <= 1) & (np.abs(p[1] - 5) <= 1)
    assert 0.5 < share < 0.65  # 9/16 of what is interpolated from a texel lies in it
    assert near.mean() == pytest.approx(0.95, abs=0.01)


# ------------------------------------------------------------------------------- against Mitsuba


def test_mitsuba_loads_the_exported_picture_as_the_same_environment():
    environment, _ = filled(8)
    picture = environment.to_latlong(96)
    assert picture.shape == (96, 192, 3)
    assert picture.dtype == np.float32
    stock = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(picture)})
    si = dr.zeros(mi.SurfaceInteraction3f, 5000)
    d = spheres(5000)
    si.wi = -d
    ours, theirs = np.array(environment.radiance(d)), np.array(stock.eval(si))
    # Both interpolate linearly, from different places: errors at creases.
    assert np.abs(ours - theirs).max() < 0.05 * ours.max()
    assert np.abs(ours - theirs).mean() < 0.005 * ours.mean()


def test_pictures_are_those_of_mitsubas_own_envmap():
    environment, _ = filled(8)
    picture = environment.to_latlong(256)
    stock = {"type": "envmap", "bitmap": mi.Bitmap(picture)}
    spp = 256
    rays = pixel_rays(CAMERA, spp, 3)
    # Without the background, which has no noise that would hide the error of interpolation.
    seen = {"max_depth": 4, "hide_emitters": True}
    ours = stock_path(lit_scene(environment_emitter(environment)), rays, 1, **seen)
    theirs = stock_path(lit_scene(stock), rays, 2, **seen)
    assert_same_expectation(ours, theirs, spp)


def test_scenes_sample_and_evaluate_the_emitter_alike():
    environment, _ = filled(8)
    scene = lit_scene(environment_emitter(environment))
    assert scene.environment() is not None
    assert np.isfinite(np.ravel([scene.bbox().min, scene.bbox().max])).all()
    si = scene.ray_intersect(pixel_rays(CAMERA, 16, 4))
    active = si.is_valid()
    ds, weight = scene.sample_emitter_direction(si, squares(12 * 12 * 16), False, active)
    far = active & (ds.dist > 1e6)
    assert 0.3 < np.array(far).mean() < 0.7
    pdf = scene.pdf_emitter_direction(si, ds, far)
    value = scene.eval_emitter_direction(si, ds, far)
    far = np.array(far)
    np.testing.assert_allclose(np.array(pdf)[far], np.array(ds.pdf)[far], rtol=1e-3)
    np.testing.assert_allclose(np.array(value / pdf)[:, far], np.array(weight)[:, far], rtol=2e-3)


# ------------------------------------------------------------------------------------- gradients


def difference(environment, values, name, direction, h, picture):
    """Central difference of a mean of a picture, along a direction of one level."""
    results = []
    for sign in (1, -1):
        moved = mi.Float(dr.detach(values[name])) + sign * h * direction
        environment.assign({**values, name: moved})
        environment.prepare()
        results.append(picture())
    environment.assign(values)
    environment.prepare()
    return (results[0] - results[1]) / (2 * h)


@pytest.mark.parametrize("integrator", ["prb", "path"])
@pytest.mark.parametrize("name", ["level.4", "level.8"])
def test_gradients_through_stock_integrators(integrator, name):
    environment, values = filled(8)
    scene = lit_scene(environment_emitter(environment))
    stock = mi.load_dict({"type": integrator, "max_depth": 3})
    sensor = CAMERA_PLUGIN | {"film": {"type": "hdrfilm", "width": 8, "height": 8,
                                       "rfilter": {"type": "box"}}}  # fmt: skip
    sensor = mi.load_dict(sensor)

    def picture():
        with dr.suspend_grad():
            image = stock.render(scene, sensor, seed=1, spp=512)
            return np.array(image).astype(np.float64).mean()

    rng = np.random.default_rng(2)
    direction = mi.Float(rng.normal(0, 1, dr.width(values[name])).astype(np.float32))
    ones = dr.full(mi.TensorXf, 1 / (8 * 8 * 3), (8, 8, 3))
    stock.render_backward(scene, mi.traverse(scene), ones, sensor, seed=2, spp=512)
    ours = np.dot(np.array(dr.grad(values[name]), np.float64), np.array(direction))
    # Sampling follows the map, so that the difference is as noisy as two pictures.
    h = 0.1
    expected = difference(environment, values, name, direction, h, picture)
    assert ours == pytest.approx(expected, rel=0.05, abs=0.02 * picture())


def directly_lit(scene_view, rays, seed):
    """Direct light at the vertices that a camera sees: by emitter and by BSDF sampling."""
    sampler = seeded(seed, dr.width(rays))
    first = find_vertex(scene_view, rays, mi.Bool(True), sampler)
    step = bounce(scene_view, attach_material(scene_view, first), sampler)
    light = dr.select(first.valid, step.direct + step.weight * step.next.emitted, 0)
    return light + first.emitted


def test_gradients_through_a_bounce_of_our_own():
    environment, values = filled(8)
    scene = lit_scene(environment_emitter(environment))
    scene_view = SceneView.of(scene, None, 4)
    rays = pixel_rays(CAMERA, 256, 3)

    def mean(light):
        return dr.mean(dr.mean(light))

    dr.backward(mean(directly_lit(scene_view, rays, 5)))
    rng = np.random.default_rng(2)
    for name in values:
        direction = mi.Float(rng.normal(0, 1, dr.width(values[name])).astype(np.float32))
        ours = np.dot(np.array(dr.grad(values[name]), np.float64), np.array(direction))

        def picture():
            with dr.suspend_grad():
                return float(np.array(mean(directly_lit(scene_view, rays, 6)))[0])

        expected = difference(environment, values, name, direction, 0.1, picture)
        assert ours == pytest.approx(expected, rel=0.05, abs=0.02 * picture())


# -------------------------------------------------------------------------------- frozen steps


@pytest.fixture
def no_collection():
    """Garbage that is collected during a recording ends the process."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def test_a_frozen_step_is_the_same_as_one_that_is_not(no_collection):
    rays, target = pixel_rays(CAMERA, 16, 3), mi.Color3f(0.1, 0.2, 0.3)
    histories = []
    for frozen in (True, False):
        environment, values = filled(16)
        scene_view = SceneView.of(lit_scene(environment_emitter(environment)), None, 4)
        optimizer = mi.ad.Adam(0.05, values)
        losses = losses_of_light(environment, optimizer, scene_view, rays, target, frozen=frozen)
        learnt = np.concatenate([np.array(v) for v in optimizer.values()])
        histories.append((losses, learnt))
        # After the frozen calls the map holds old texels until it is told anew.
        environment.assign(dict(optimizer.items()))
        environment.prepare()
        assert np.isfinite(environment.radiance(spheres(100))).all()
    (a, learnt_a), (b, learnt_b) = histories
    assert len(set(a)) == 6
    assert a[-1] < 0.95 * a[0]
    np.testing.assert_allclose(a, b, rtol=1e-3)
    # Adam's first steps are of one size, whatever the gradient: tiny ones may go either way.
    assert np.quantile(np.abs(learnt_a - learnt_b), 0.98) < 1e-3
