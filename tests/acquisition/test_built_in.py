"""The built-in scenes load, are closed, have sane cameras; the furnace has its known radiance."""

from __future__ import annotations

import numpy as np
import pytest

drjit = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
if mi.variant() is None:
    mi.set_variant("llvm_ad_rgb")

from unbake.acquisition import built_in  # noqa: E402
from unbake.dataset.camera import Camera  # noqa: E402
from unbake.dataset.pixels import CameraRays  # noqa: E402
from unbake.errors import UserError  # noqa: E402

RAYS = 2000


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """Every built-in scene, written and loaded once."""
    root = tmp_path_factory.mktemp("scenes")
    paths = {name: built_in.write_scene(name, root / name) for name in built_in.SCENES}
    return {name: mi.load_file(str(path)) for name, path in paths.items()}


def all_round(scene, camera):
    """Hits of rays in all directions from the camera: (hit, distance, cosine) arrays."""
    directions = np.random.default_rng(1).normal(size=(3, RAYS))
    directions /= np.linalg.norm(directions, axis=0)
    d = mi.Vector3f(directions.astype(np.float32))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(camera["origin"]), d))
    return np.array(si.is_valid()), np.array(si.t), np.array(drjit.dot(si.n, d))


@pytest.mark.parametrize("name", built_in.SCENES)
def test_cameras_stand_in_free_space(scenes, name):
    for camera in built_in.default_cameras(name, 26, 8):
        hit, distance, cosine = all_round(scenes[name], camera)
        # Inside an object, or outside the room, the back of a face would be seen.
        assert not np.any(cosine[hit] > 0), camera
        assert distance[hit].min() > 0.05, camera


@pytest.mark.parametrize("name", ["demo", "annex", "cube", "furnace"])
def test_closed_scenes_have_no_slit(scenes, name):
    for camera in built_in.default_cameras(name, 8, 4):
        assert all_round(scenes[name], camera)[0].all()


@pytest.mark.parametrize("name", built_in.SCENES)
def test_cameras_are_distinct_and_prefixes_of_more(name):
    many = built_in.default_cameras(name, 30, 10)
    assert [c["split"] for c in many] == ["train"] * 30 + ["heldout"] * 10
    poses = {(*c["origin"], *c["target"]) for c in many}
    assert len(poses) == len(many)
    few = built_in.default_cameras(name, 4, 2)
    assert few == many[:4] + many[30:32]


@pytest.mark.parametrize("name", built_in.SCENES)
def test_no_camera_looks_straight_up_or_down(name):
    for c in built_in.default_cameras(name, 40, 12):
        across = np.linalg.norm(np.subtract(c["target"], c["origin"])[:2])
        assert across > 0.05


def radiance(scene, camera, max_depth, spp):
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": camera["fov"],
            "to_world": mi.ScalarTransform4f().look_at(
                camera["origin"], camera["target"], camera["up"]
            ),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": max_depth})
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp))[..., :3]


@pytest.mark.parametrize("albedo", [0.0, 0.5, 0.8])
def test_furnace_radiance(tmp_path, albedo):
    scene = mi.load_file(str(built_in.write_scene("furnace", tmp_path, albedo=albedo)))
    camera = built_in.default_cameras("furnace", 1, 0)[0]
    image = radiance(scene, camera, 60, 64)
    expected = 1 / (1 - albedo)
    # The light of 60 of infinitely many vertices is missing: albedo^60 of it. MIS leaves noise.
    error = image.mean() / expected - 1
    assert abs(error) < 0.01 + albedo**60


def test_demo_is_lit_indirectly(scenes):
    bright, dark = [], []
    for camera in built_in.default_cameras("demo", 6, 0):
        full = radiance(scenes["demo"], camera, 16, 64).mean(-1)
        direct = radiance(scenes["demo"], camera, 2, 16).mean(-1)
        bright.append(full.mean())
        dark.append(np.mean(direct < 0.02))
    assert 0.15 < np.mean(bright) < 0.6
    assert np.mean(dark) > 0.6


def test_the_annex_is_lit_and_hardly_seen_through_its_door(scenes):
    """Cameras to learn from stand in the first room, held-out ones in both by turns."""
    scene, cameras = scenes["annex"], built_in.default_cameras("annex", 16, 6)
    train, held_out = cameras[:16], cameras[16:]
    assert all(c["origin"][0] < 3.2 for c in (*train, *held_out[::2]))
    assert all(c["origin"][0] > 3.3 for c in held_out[1::2])
    beyond = [seen_at(scene, c)[0] > 3.3 for c in train]
    assert 0 < np.mean(beyond) < 0.05
    assert np.mean([seen_at(scene, c)[0] > 3.3 for c in held_out[1::2]]) > 0.7
    first, second = (
        np.mean([radiance(scene, c, 32, 64) for c in group], (0, 1, 2))
        for group in (held_out[::2], held_out[1::2])
    )
    assert (first > 0.03).all() and first.mean() < 0.2 * second.mean()
    direct = [radiance(scene, c, 2, 16).mean(-1) > 0.02 for c in train]
    assert np.mean(direct) < 0.2, "most of the first room sees no lamp"


def seen_at(scene, camera):
    """Points (3, n) that a camera sees, on a grid of pixels."""
    look = Camera.look_at(camera["origin"], camera["target"], camera["up"], camera["fov"], 32, 32)
    rays = CameraRays.of([look])
    ray = rays.through(drjit.arange(mi.UInt32, rays.pixels), mi.Point2f(0.5))
    return np.array(scene.ray_intersect(ray).p)


def test_the_scenes_are_named_in_the_help(unbake):
    for name in built_in.SCENES:
        assert name in unbake("capture", "--help").out


def test_scene_is_self_contained(tmp_path):
    text = built_in.write_scene("demo", tmp_path / "here").read_text(encoding="utf-8")
    assert str(tmp_path) not in text
    (tmp_path / "here").rename(tmp_path / "there")
    assert mi.load_file(str(tmp_path / "there" / "scene.xml")).bbox().valid()


def test_same_scene_twice(tmp_path):
    for side in ("a", "b"):
        built_in.write_scene("demo", tmp_path / side)
    files = [p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*.*")]
    assert len(files) > 40
    for file in files:
        if file.suffix == ".exr":
            a, b = (np.array(mi.Bitmap(str(tmp_path / side / file))) for side in ("a", "b"))
            assert np.array_equal(a, b), file
        else:
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize("name", ["demo", "annex"])
def test_textures_are_in_range(tmp_path, name):
    built_in.write_scene(name, tmp_path)
    paths = sorted((tmp_path / "textures").glob("*.exr"))
    assert paths
    for path in paths:
        values = np.array(mi.Bitmap(str(path))).astype(np.float32)
        low, high = (0.15, 0.95) if "roughness" in path.name else (0.02, 0.95)
        assert values.min() > low - 0.02 and values.max() < high, path.name


def test_bad_input_is_named():
    with pytest.raises(UserError, match="no built-in scene 'kitchen'"):
        built_in.default_cameras("kitchen", 1, 1)
    with pytest.raises(UserError, match="albedo 1 is out of range"):
        built_in.write_scene("cube", "unused", albedo=1.0)
