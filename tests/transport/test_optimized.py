"""Which surfaces are optimized has one answer: in masks, in coverage, in regularizers."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras, pixel_rays, seeded

from unbake.acquisition.coverage import coverage
from unbake.dataset.camera import Camera
from unbake.dataset.pixels import CameraRays
from unbake.scene.free_space import sample_surface
from unbake.transport.optimized import has_optimized_material, optimized_shapes
from unbake.transport.render import render_materials
from unbake.transport.vertex import SceneView, find_vertex

PRINCIPLED = {"type": "principled"}
LIGHT = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}


def flat(channels):
    """A tiny picture."""
    return {
        "type": "bitmap",
        "raw": True,
        "bitmap": mi.Bitmap(np.full((4, 4, channels), 0.5, np.float32)),
    }


def twosided(bsdf):
    return {"type": "twosided", "bsdf": bsdf}


def mask(bsdf):
    return {"type": "mask", "opacity": 0.5, "bsdf": bsdf}


def blend(first, second):
    return {"type": "blendbsdf", "weight": 0.3, "first": first, "second": second}


CONDUCTOR = {"type": "roughconductor", "alpha": 0.3}
CASES = {
    "principled": (PRINCIPLED, True),
    "twosided": (twosided(PRINCIPLED), True),
    "mask": (mask(twosided(PRINCIPLED)), True),
    "bump": (lambda: {"type": "bumpmap", "texture": flat(1), "bsdf": PRINCIPLED}, True),
    "normal": (lambda: {"type": "normalmap", "normalmap": flat(3), "bsdf": PRINCIPLED}, True),
    "blend": (blend(CONDUCTOR, PRINCIPLED), True),
    "rough conductor": (CONDUCTOR, False),
    "rough conductors": (mask(twosided(blend(CONDUCTOR, CONDUCTOR))), False),
    "diffuse": ({"type": "diffuse"}, False),
    "rough dielectric": ({"type": "roughdielectric"}, False),
    "thin": ({"type": "principledthin"}, False),
    # A name is no BSDF: the printed form of this one holds the words "Principled BSDF".
    "named": ({"type": "diffuse", "id": "Principled BSDF"}, False),
}


def wall(bsdf, **others):
    """A square at z = 0 that faces +z."""
    return {"type": "rectangle", "bsdf": bsdf, **others}


def scene(**shapes):
    sky = {"type": "constant"}
    return mi.load_dict({"type": "scene", "sky": sky, **shapes}, optimize=False)


def share_of_samples(loaded):
    """What the mask of a picture says of a view that shows nothing but the wall."""
    camera = Camera.look_at((0, 0, 1), (0, 0, 0), (0, 1, 0), 60.0, 8, 8)
    rays = CameraRays.of([camera])
    *_, seen = render_materials(SceneView.of(loaded, None, 8), rays.through, 64, 16, seed=1)
    return seen.mean()


@pytest.mark.parametrize("name", CASES)
def test_a_shape_is_optimized_if_its_bsdf_is_or_holds_a_principled_one(name):
    bsdf, optimized = CASES[name]
    bsdf = bsdf() if callable(bsdf) else bsdf
    loaded = scene(wall=wall(bsdf))
    (shape,) = loaded.shapes()
    assert has_optimized_material(shape) is optimized
    assert len(SceneView.of(loaded, None, 8).optimized) == optimized
    assert len(sample_surface(loaded, 64, 0).position) == 64 * optimized
    seen = share_of_samples(loaded)
    if name == "mask":
        assert 0.3 < seen < 0.7  # half of the rays pass
    elif name != "rough conductors":
        assert seen == optimized


def test_an_emitter_is_not_optimized_whatever_its_bsdf():
    loaded = scene(wall=wall(PRINCIPLED, light=LIGHT))
    assert not optimized_shapes(loaded)
    assert share_of_samples(loaded) == 0
    assert len(sample_surface(loaded, 64, 0).position) == 0


def test_a_shape_that_is_only_seen_through_instances_is_optimized():
    for bsdf, optimized in ((PRINCIPLED, True), (CONDUCTOR, False)):
        group = {"type": "shapegroup", "wall": wall(bsdf)}
        instance = {"type": "instance", "group": {"type": "ref", "id": "group"}}
        loaded = scene(group=group, instance=instance)
        assert len(optimized_shapes(loaded)) == optimized
        assert share_of_samples(loaded) == optimized


def test_coverage_ignores_a_rough_conductor():
    """Half of the surfaces, seen by no camera, are metal that is known."""
    metal = wall(CONDUCTOR, to_world=mi.ScalarTransform4f().translate([0, 0, -5]))
    loaded = scene(wall=wall(PRINCIPLED), metal=metal)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 60.0, 8, 8)
    assert coverage(loaded, [camera], 2000) == pytest.approx(1.0, abs=2e-3)
    position = sample_surface(loaded, 500, 0).position
    assert (position[:, 2] > -1).all()


def test_the_mask_can_be_asked_in_a_frozen_function(built_in):
    """Of the shapes that rays meet, and of no shape where they meet none."""
    loaded = mi.load_file(str(built_in("cornell")))
    view = SceneView.of(loaded, None, 8)
    rays = pixel_rays(built_in_cameras("cornell", 8), 1, seed=1)

    def counted(scene, ray, sampler):
        here = view.with_scene(scene)
        vertex = find_vertex(here, ray, mi.Bool(True), sampler)
        return here.is_optimized(vertex.si.shape), vertex.valid

    frozen = dr.freeze(counted)
    for _ in range(3):
        found, valid = frozen(loaded, rays, seeded(1, dr.width(rays)))
    expected, _ = counted(loaded, rays, seeded(1, dr.width(rays)))
    np.testing.assert_array_equal(found, expected)
    assert np.array(found).any() and not np.array(found & ~valid).any()
