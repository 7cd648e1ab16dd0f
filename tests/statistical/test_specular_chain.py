"""Mirrors, glass and cut-outs: chains of them are followed to the first surface that scatters."""

import drjit as dr
import mitsuba as mi
import pytest
from support import (
    PathTracedRadiance,
    assert_same_expectation,
    pieces,
    pixel_rays,
    seeded,
    stock_path,
)

from unbake.dataset.camera import Camera
from unbake.transport.emitter_sampling import lets_pass
from unbake.transport.path_sample import lhs, rhs, trace
from unbake.transport.path_tracer import path_traced
from unbake.transport.vertex import SceneView, find_vertex

SPP = 1024
CAMERA = Camera.look_at((0, -2.6, 0.2), (0, 0, -0.1), (0, 0, 1), 50.0, 12, 12)


def grey(value: float) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def pane(bsdf: dict, origin, target, up=(0, 0, 1), size=1.0, **more) -> dict:
    to_world = mi.ScalarTransform4f().look_at(list(origin), list(target), list(up)).scale(size)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf, **more}


def box(thing: dict, **others) -> mi.Scene:
    """A thing in an open box with a lamp; dark walls, so that paths are short."""
    return mi.load_dict(
        {
            "type": "scene",
            "floor": pane(grey(0.4), (0, 0, -1), (0, 0, 0), (0, 1, 0), 1.5),
            "back": pane(
                {"type": "principled", "base_color": {"type": "rgb", "value": [0.5, 0.2, 0.2]}},
                (0, 1.2, 0),
                (0, 0, 0),
                size=1.5,
            ),
            "lamp": pane(
                grey(0.0),
                (0.2, -0.2, 1.4),
                (0, 0, 0),
                (0, 1, 0),
                0.5,
                emitter={"type": "area", "radiance": {"type": "rgb", "value": [6, 5, 4]}},
            ),
            "thing": thing,
            **others,
        }
    )


def box_of_instances(thing: dict) -> mi.Scene:
    """The same box, whose thing stands there as two instances of a group."""
    group = {"type": "shapegroup", "shape": thing}
    here, there = (
        {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": mi.ScalarTransform4f().translate([x, 0.2, 0]).scale(0.6),
        }
        for x in (-0.4, 0.5)
    )
    return box(here, group=group, there=there)


def ball(bsdf: dict) -> dict:
    return {"type": "sphere", "center": [0, 0, -0.3], "radius": 0.6, "bsdf": bsdf}


def cut_out(opacity) -> dict:
    return {"type": "mask", "opacity": opacity, "bsdf": {"type": "twosided", "bsdf": grey(0.6)}}


CHECKS = {
    "type": "checkerboard",
    "color0": {"type": "rgb", "value": 0.0},
    "color1": {"type": "rgb", "value": 1.0},
    "to_uv": mi.ScalarTransform4f().scale([3, 3, 1]),
}
FRONT = ((0.2, -0.5, 0), (0, -2.6, 0.2))
THINGS = {
    "mirror": ball({"type": "conductor", "material": "none"}),
    "coloured mirror": ball({"type": "conductor", "material": "Cu"}),
    "glass ball": ball({"type": "dielectric", "int_ior": 1.5}),
    "glass pane": pane({"type": "thindielectric", "int_ior": 1.5}, *FRONT, size=0.7),
    "cut-out": pane(cut_out(CHECKS), *FRONT, size=0.7),
    "half opaque": pane(cut_out(0.5), *FRONT, size=0.7),
    "half opaque gloss": pane(
        {
            "type": "mask",
            "opacity": 0.5,
            "bsdf": {"type": "twosided", "bsdf": {"type": "principled", "roughness": 0.3}},
        },
        *FRONT,
        size=0.7,
    ),
    "half opaque ball": ball(cut_out(0.5)),
}


def image_of_mitsuba(scene: mi.Scene, ray: mi.Ray3f) -> mi.Color3f:
    """Radiance by a path tracer of Mitsuba: `path`, or `volpath` where there are cut-outs.

    `path` of Mitsuba 3.9.1 is wrong where opacities are fractions: see `path_integrator`. Where
    light passes holes it has heavy tails: no emitter sample finds it.
    """
    name = "volpath" if lets_pass(scene) else "path"
    return stock_path(scene, ray, 2, max_depth=64, integrator=name)


@pytest.mark.parametrize("name", THINGS)
def test_series_is_the_image_of_path(name):
    scene = box(THINGS[name])
    scene_view = SceneView.of(scene, None, 40)
    assert scene_view.has_chains
    # Caustics have heavy tails: with few samples a pixel's own variance is no measure of them.
    spp = 4 * SPP if name == "glass ball" else SPP
    ray = pixel_rays([CAMERA], spp, seed=1)
    truth = image_of_mitsuba(scene, ray)
    series = path_traced(scene_view, ray, 3, max_depth=16, rr_depth=5, hide_emitters=False)
    assert_same_expectation(series, truth, spp)


@pytest.mark.parametrize(
    "name",
    [pytest.param("mirror", marks=pytest.mark.slow), "cut-out", "half opaque", "half opaque gloss"],
)
def test_series_is_the_image_of_path_inside_instances(name):
    scene = box_of_instances(THINGS[name])
    scene_view = SceneView.of(scene, None, 40)
    assert scene_view.has_chains
    ray = pixel_rays([CAMERA], SPP, seed=1)
    truth = image_of_mitsuba(scene, ray)
    series = path_traced(scene_view, ray, 3, max_depth=16, rr_depth=5, hide_emitters=False)
    assert_same_expectation(series, truth, SPP)


@pytest.mark.parametrize(
    "name", ["coloured mirror", "glass ball", pytest.param("glass pane", marks=pytest.mark.slow)]
)
def test_both_sides_with_an_exact_cache_are_the_image_of_path(name):
    """The cache is asked at the first surface that scatters, seen along the chain's last ray."""
    scene = box(THINGS[name])
    scene_view = SceneView.of(scene, None, 40)
    ray = pixel_rays([CAMERA], SPP, seed=4)
    truth = stock_path(scene, ray, 5, max_depth=64)
    cache, requirements = (
        PathTracedRadiance(scene_view, 6, 16),
        pieces(1, 1),
    )
    sample = trace(
        scene_view, cache, ray, seeded(7, dr.width(ray)), requirements, hide_emitters=False
    )
    flags = sample.x1.bsdf.flags()
    assert dr.all(mi.has_flag(flags, mi.BSDFFlags.Smooth) | ~sample.x1.valid)
    assert_same_expectation(rhs(sample, sample.radiance[1]), truth, SPP)
    assert_same_expectation(lhs(sample, sample.radiance[0]), truth, SPP)


# ---------------------------------------------------------------------------- the chain's limit


def along(scene: mi.Scene, max_specular: int, ray: mi.Ray3f):
    """The first vertex along a single ray."""
    scene_view = SceneView.of(scene, None, max_specular)
    return find_vertex(scene_view, ray, mi.Bool(True), seeded(0, 1))


def corridor(panes: int, bsdf: dict) -> mi.Scene:
    """So many panes one behind the other, and a glowing wall at the end."""
    walls = {f"pane{i}": pane(bsdf, (0, i, 0), (0, -1, 0)) for i in range(panes)}
    wall = pane(grey(0.5), (0, panes, 0), (0, -1, 0), emitter={"type": "area", "radiance": 2.0})
    return mi.load_dict({"type": "scene", **walls, "wall": wall})


@pytest.mark.parametrize(
    "bsdf",
    [
        pytest.param({"type": "mask", "opacity": 0.0, "bsdf": grey(0.5)}, id="cut-outs"),
        pytest.param({"type": "null"}, id="null surfaces"),
    ],
)
def test_a_chain_longer_than_the_limit_ends_in_black(bsdf):
    scene = corridor(3, bsdf)
    ray = mi.Ray3f(mi.Point3f(0, -1, 0), mi.Vector3f(0, 1, 0))
    for limit in (3, 4):
        seen = along(scene, limit, ray)
        assert seen.valid[0] and seen.emitted.x[0] == 2 and seen.throughput.x[0] == 1
        assert abs(seen.si.p.y[0] - 3) < 1e-3
    for limit in (0, 2):
        seen = along(scene, limit, ray)
        assert not seen.valid[0] and dr.max(seen.emitted)[0] == 0


def mirrors() -> mi.Scene:
    """Two facing mirrors, between which a ray at 45° climbs, and a glowing lid at height 10."""
    mirror = {"type": "conductor", "material": "none"}
    return mi.load_dict(
        {
            "type": "scene",
            "left": pane(mirror, (-0.5, 0, 0), (1, 0, 0), size=9.7),
            "right": pane(mirror, (0.5, 0, 0), (-1, 0, 0), size=9.7),
            "lid": pane(grey(0.0), (0, 0, 10), (0, 0, 0), (0, 1, 0), 5, emitter={"type": "area"}),
        }
    )


def test_reflections_are_counted():
    # From the middle at height 0 there is a reflection at 0.5, 1.5, …, 8.5, 9.5: ten.
    ray = mi.Ray3f(mi.Point3f(0, 0, 0), dr.normalize(mi.Vector3f(1, 0, 1)))
    at_limit, beyond = along(mirrors(), 10, ray), along(mirrors(), 9, ray)
    assert at_limit.valid[0] and not at_limit.direct_view[0] and at_limit.emitted.x[0] == 1
    assert not beyond.valid[0] and beyond.emitted.x[0] == 0


def test_a_lane_in_black_stays_black_in_both_images():
    """Between mirrors that nothing lights, neither side of the equation holds any light."""
    scene = mirrors()
    ray = mi.Ray3f(mi.Point3f(dr.zeros(mi.Float, 8), 0, 0), dr.normalize(mi.Vector3f(1, 0, 1)))
    scene_view = SceneView.of(scene, None, 4)
    cache = PathTracedRadiance(scene_view, 1, 4)
    sample = trace(scene_view, cache, ray, seeded(2, 8), pieces(1, 2), hide_emitters=False)
    assert dr.all(lhs(sample, sample.radiance[0]) == 0, axis=None)
    assert dr.all(rhs(sample, sample.radiance[1]) == 0, axis=None)
