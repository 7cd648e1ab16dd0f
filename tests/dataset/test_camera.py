"""Cameras: the formula, Mitsuba's sensor and the files all mean the same view."""

import json
import math
import re

import mitsuba as mi
import numpy as np
import pytest

from unbake.dataset.camera import Camera, LookAt
from unbake.dataset.camera_files import read_cameras, read_named_cameras, write_camera_file
from unbake.errors import UserError

ORIGIN, TARGET, UP = (1.0, -2.0, 3.0), (-0.5, 0.25, 1.0), (0.0, 0.3, 1.0)


def off_centre(width=24, height=16):
    straight = Camera.look_at(ORIGIN, TARGET, UP, 62.0, width, height)
    return Camera(straight.to_world, 31.0, 31.0, 9.25, 10.5, width, height)


def pixel_centres(camera):
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return x.ravel(), y.ravel()


def sensor_directions(camera):
    sensor = mi.load_dict(camera.sensor(1))
    x, y = pixel_centres(camera)
    film = mi.Point2f(np.stack([x / camera.width, y / camera.height]).astype(np.float32))
    ray, _ = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
    return np.array(ray.o).T, np.array(ray.d).T


@pytest.mark.parametrize(
    "camera",
    [
        Camera.look_at(ORIGIN, TARGET, UP, 62.0, 24, 16),
        Camera.look_at(ORIGIN, TARGET, UP, 62.0, 16, 24),
        off_centre(),
    ],
    ids=["landscape", "portrait", "off-centre"],
)
def test_the_sensor_casts_the_rays_of_the_formula(camera):
    px, py = pixel_centres(camera)
    local = np.stack(
        [
            (px - camera.cx) / camera.fl_x,
            -(py - camera.cy) / camera.fl_y,
            -np.ones_like(px),
        ]
    )
    in_world = (camera.to_world[:3, :3] @ local).T
    in_world /= np.linalg.norm(in_world, axis=1, keepdims=True)
    origins, directions = sensor_directions(camera)
    assert np.abs(directions - in_world).max() < 1e-5
    # Mitsuba starts its rays on the near plane, which is 1e-4 away
    assert np.linalg.norm(origins - camera.origin, axis=1).max() < 2e-4
    own_origins, own_directions = camera.rays(px, py)
    assert np.allclose(own_directions, in_world, atol=1e-12)
    assert np.array_equal(own_origins[3], ORIGIN)


def test_an_image_shows_what_is_right_on_the_right_and_what_is_up_above():
    light = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    to_world = mi.ScalarTransform4f().translate([0.8, 0.8, -4]).scale(0.2)
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "ball": {"type": "sphere", "to_world": to_world, "light": light},
        }
    )
    camera = Camera.look_at((0, 0, 0), (0, 0, -1), (0, 1, 0), 60.0, 16, 16)
    image = np.array(mi.render(scene, sensor=mi.load_dict(camera.sensor(4)), spp=4))
    assert image.shape == (16, 16, 4)
    rows, columns = np.nonzero(image[..., 0])
    assert rows.size and rows.max() < 8 and columns.min() >= 8
    assert np.array_equal(image[..., 3] > 0, image[..., 0] > 0)


def test_a_sensor_turns_back_into_its_camera():
    camera = off_centre()
    again = Camera.from_mitsuba(mi.load_dict(camera.sensor(1)))
    assert np.allclose(again.to_world, camera.to_world, atol=1e-6)
    for name in ("fl_x", "fl_y", "cx", "cy"):
        assert getattr(again, name) == pytest.approx(getattr(camera, name), rel=1e-5)
    assert (again.width, again.height) == (24, 16)


def test_a_crop_window_is_a_camera_of_its_own():
    description = off_centre().sensor(1)
    description["film"] |= {
        "crop_width": 8,
        "crop_height": 6,
        "crop_offset_x": 3,
        "crop_offset_y": 5,
    }
    camera = Camera.from_mitsuba(mi.load_dict(description))
    assert (camera.width, camera.height) == (8, 6)
    assert (camera.cx, camera.cy) == pytest.approx((6.25, 5.5), abs=1e-4)
    _, whole = off_centre().rays(np.array([3.5]), np.array([5.5]))
    _, cropped = camera.rays(np.array([0.5]), np.array([0.5]))
    assert np.allclose(whole, cropped, atol=1e-5)


def test_only_perspective_sensors_are_cameras():
    with pytest.raises(UserError, match="not a perspective camera"):
        Camera.from_mitsuba(mi.load_dict({"type": "orthographic"}))


def test_look_at_points_to_the_target_with_the_horizontal_field_of_view():
    camera = Camera.look_at(ORIGIN, TARGET, UP, 62.0, 24, 16)
    _, middle = camera.rays(np.array([12.0]), np.array([8.0]))
    way = np.subtract(TARGET, ORIGIN)
    assert np.allclose(middle[0], way / np.linalg.norm(way))
    _, edges = camera.rays(np.array([0.0, 24.0]), np.array([8.0, 8.0]))
    assert math.degrees(math.acos(edges[0] @ edges[1])) == pytest.approx(62.0)
    assert camera.to_world[:3, 1] @ np.array(UP) > 0


@pytest.mark.parametrize(
    ("origin", "target", "up", "fov", "message"),
    [
        (ORIGIN, ORIGIN, UP, 60.0, "do not define a view"),
        ((0, 0, 0), (0, 0, 1), (0, 0, 2), 60.0, "do not define a view"),
        (ORIGIN, TARGET, (0, 0, 0), 60.0, "do not define a view"),
        ((math.nan, 0, 0), TARGET, UP, 60.0, "do not define a view"),
        (ORIGIN, TARGET, UP, 0.0, "field of view 0 "),
        (ORIGIN, TARGET, UP, 180.0, "field of view 180 "),
        (ORIGIN, TARGET, UP, math.nan, "field of view nan"),
    ],
)
def test_look_at_refuses_what_is_no_view(origin, target, up, fov, message):
    with pytest.raises(UserError, match=message):
        Camera.look_at(origin, target, up, fov, 8, 8)


def poses():
    nan, singular, mirrored, scaled, row = (np.eye(4) for _ in range(5))
    nan[0, 0] = np.nan
    singular[2, 2] = 0
    mirrored[0, 0] = -1
    scaled[:3, :3] *= 2
    row[3, 0] = 1
    return {
        "NaN": nan,
        "singular": singular,
        "left-handed": mirrored,
        "not a rigid motion": scaled,
        "last row": row,
        "shape": np.eye(3),
    }


@pytest.mark.parametrize("message", poses())
def test_a_camera_refuses_a_pose_that_is_none(message):
    with pytest.raises(UserError, match=message):
        Camera(poses()[message], 10.0, 10.0, 4.0, 4.0, 8, 8)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((0.0, 10.0, 4.0, 4.0, 8, 8), "focal length"),
        ((10.0, math.nan, 4.0, 4.0, 8, 8), "focal length"),
        ((10.0, 10.0, math.inf, 4.0, 8, 8), "principal point"),
        ((10.0, 10.0, 4.0, 4.0, 0, 8), "empty"),
    ],
)
def test_a_camera_refuses_impossible_intrinsics(values, message):
    with pytest.raises(UserError, match=message):
        Camera(np.eye(4), *values)


def test_rounding_in_a_pose_is_repaired_and_an_exact_pose_is_kept():
    exact = Camera.look_at(ORIGIN, TARGET, UP, 62.0, 8, 8)
    assert np.array_equal(Camera(exact.to_world, 8, 8, 4, 4, 8, 8).to_world, exact.to_world)
    repaired = Camera(exact.to_world.round(4), 8, 8, 4, 4, 8, 8).to_world[:3, :3]
    assert np.allclose(repaired @ repaired.T, np.eye(3), atol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        exact.to_world[0, 0] = 2.0


def test_rescaling_keeps_the_field_of_view():
    camera = off_centre()
    large = camera.rescaled(48, 32)
    px, py = pixel_centres(camera)
    assert np.allclose(large.rays(2 * px, 2 * py)[1], camera.rays(px, py)[1])
    square = camera.rescaled(24, 24)
    assert np.allclose(square.rays(px, py + 4)[1], camera.rays(px, py)[1])


def test_projection_is_the_inverse_of_rays_and_numbers_pixels_by_rows():
    camera = off_centre()
    px, py = pixel_centres(camera)
    origins, directions = camera.rays(px, py)
    points = origins + directions * np.linspace(0.1, 50, len(px))[:, None]
    assert np.allclose(camera.project(points), np.stack([px, py], axis=1), atol=1e-9)
    assert np.array_equal(camera.pixel_of(points), np.arange(24 * 16))
    behind, beside = 2 * origins - points, sum(camera.rays(np.array([-0.5]), np.array([3.5])))
    assert np.isnan(camera.project(np.vstack([behind, camera.origin]))).all()
    assert (camera.pixel_of(np.vstack([behind, beside])) == -1).all()
    assert np.allclose(camera.project(beside), [[-0.5, 3.5]])


def test_pixels_that_are_not_square_have_no_sensor():
    with pytest.raises(UserError, match="not square"):
        Camera(np.eye(4), 10.0, 11.0, 4.0, 4.0, 8, 8).sensor(1)


def test_a_camera_file_gives_back_what_was_written(tmp_path):
    placed = [
        ("train", LookAt(ORIGIN, TARGET, UP, 62.0)),
        ("train", LookAt(TARGET, ORIGIN, UP, 40.0)),
        ("heldout", LookAt(ORIGIN, (0.0, 0.0, 0.0), UP, 75.0)),
    ]
    file = tmp_path / "new" / "cameras.json"
    write_camera_file(file, placed)
    entries = json.loads(file.read_text())["cameras"]
    assert [e["name"] for e in entries] == ["train_000", "train_001", "heldout_000"]
    cameras = read_cameras(file, 12, 10)
    assert [split for split, _ in cameras] == ["train", "train", "heldout"]
    for (_, camera), (_, look_at) in zip(cameras, placed, strict=True):
        assert np.allclose(camera.to_world, look_at.camera(12, 10).to_world, atol=1e-4)
        assert camera.fl_x == pytest.approx(look_at.camera(12, 10).fl_x)


def test_transforms_are_a_camera_file_too(tmp_path):
    camera = off_centre()
    frame = {"transform_matrix": camera.to_world.tolist(), "file_path": "any.exr"}
    top = {"fl_x": 31.0, "cx": 9.25, "cy": 10.5, "w": 24.0, "h": 16, "frames": [frame]}
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(top))
    [(split, read)] = read_cameras(file, 48, 32)
    assert split == "train" and read.fl_y == 62.0
    x, y = np.array([1.5, 7.5]), np.array([3.5, 2.5])
    assert np.allclose(read.rays(2 * x, 2 * y)[1], camera.rays(x, y)[1])
    file.write_text(json.dumps({"camera_angle_x": math.radians(90), "frames": [frame]}))
    [(_, read)] = read_cameras(file, 48, 32)
    assert read.fl_x == pytest.approx(24.0) and (read.cx, read.cy) == (24.0, 16.0)


ENTRY = {"origin": [0, 0, 0], "target": [0, 0, 1], "up": [0, 1, 0], "fov": 60}
FRAME = {"transform_matrix": np.eye(4).tolist(), "fl_x": 10}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not readable JSON"),
        ("\x00", "not readable JSON"),
        ("{}", "no cameras in the file"),
        ('{"cameras": []}', "no cameras in the file"),
        ("3", "no cameras in the file"),
        ([3], "camera 0: the entry is not an object"),
        ([ENTRY, {**ENTRY, "fov": "wide"}], "camera 1: 'fov' is not a number"),
        ([{**ENTRY, "fov": True}], "'fov' is not a number"),
        ([{**ENTRY, "fov": 10**400}], "'fov' is too large"),
        ([{**ENTRY, "fov": -5}], "camera 0: the field of view -5"),
        ([{**ENTRY, "up": [0, 1]}], "'up' is not an array of 3 numbers"),
        ([{**ENTRY, "up": ["0", "1", "0"]}], "'up' is not an array of 3 numbers"),
        ([{k: v for k, v in ENTRY.items() if k != "target"}], "the key 'target' is missing"),
        ([{**ENTRY, "split": "test"}], "unknown split 'test'"),
        ([{**ENTRY, "split": ["train"]}], "unknown split"),
        ({"frames": [{**FRAME, "k1": 0.1}]}, "lens distortion in k1"),
        ({"frames": [FRAME], "camera_model": "OPENCV_FISHEYE"}, "unknown camera_model"),
        ({"frames": [{"transform_matrix": np.eye(4).tolist()}]}, "the key 'fl_x' is missing"),
        ({"frames": [FRAME | {"w": 8.5, "h": 8}]}, "'w' is 8.5"),
        ({"frames": [{**FRAME, "fl_x": 0}]}, "camera 0: the focal length"),
    ],
)
def test_a_broken_camera_file_is_one_clear_error(tmp_path, content, message):
    file = tmp_path / "cameras.json"
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(UserError, match=message) as caught:
        read_cameras(file, 8, 8)
    assert str(file) in str(caught.value) and caught.value.remedy


def test_all_broken_cameras_of_a_file_are_told_at_once(tmp_path):
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([{**ENTRY, "fov": -5}, ENTRY, 3, {**ENTRY, "split": "test"}, 4, 5]))
    with pytest.raises(UserError) as caught:
        read_cameras(file, 8, 8)
    told = str(caught.value)
    for number, what in ((0, "field of view"), (2, "not an object"), (3, "unknown split")):
        assert re.search(f"camera {number}: [^;]*{what}", told)
    assert told.endswith("; and 2 more") and "camera 1:" not in told


def test_cameras_have_the_names_of_their_file(tmp_path):
    file = tmp_path / "cameras.json"
    entries = [
        {**ENTRY, "split": "heldout", "name": "left"},
        {**FRAME, "file_path": ".\\images\\IMG_7.JPG"},
        ENTRY,
        {**ENTRY, "split": "heldout"},
        {**ENTRY, "name": "b.1", "file_path": "images/other.png"},
    ]
    file.write_text(json.dumps({"cameras": entries}))
    found = read_named_cameras(file, 8, 8)
    assert [(name, split) for name, split, _ in found] == [
        ("left", "heldout"),
        ("IMG_7", "train"),
        ("train_001", "train"),
        ("heldout_001", "heldout"),
        ("b.1", "train"),
    ]
    for (_, split, camera), (other, same) in zip(found, read_cameras(file, 8, 8), strict=True):
        assert split == other and np.array_equal(camera.to_world, same.to_world)


def test_names_that_pictures_cannot_have_are_told_at_once(tmp_path):
    file = tmp_path / "cameras.json"
    names = ["a/b", "c", "c\\d", "e\n", "c", "f", "f", "f"]
    file.write_text(json.dumps([{**ENTRY, "name": name} for name in names]))
    assert len(read_cameras(file, 8, 8)) == len(names)
    with pytest.raises(UserError) as caught:
        read_named_cameras(file, 8, 8)
    told = str(caught.value)
    assert all(repr(name) in told for name in ("a/b", "c\\d", "e\n"))
    assert "have the same name: 'c', 'f'" in told and str(file) in told
    file.write_text(json.dumps([{**ENTRY, "name": 3}, ENTRY, {**ENTRY, "name": ""}]))
    with pytest.raises(UserError, match=r"camera 0: 'name' is not a text.*camera 2: 'name' is not"):
        read_named_cameras(file, 8, 8)


def test_files_of_one_name_in_several_folders_are_numbered(tmp_path):
    file = tmp_path / "cameras.json"
    files = ["left/1.png", "right\\1.png", "right/2.png"]
    file.write_text(json.dumps([{**ENTRY, "file_path": name} for name in files]))
    found = [name for name, _, _ in read_named_cameras(file, 8, 8)]
    assert found == ["train_000", "train_001", "train_002"]


def test_a_missing_camera_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none\.json: the file does not exist"):
        read_cameras(tmp_path / "none.json", 8, 8)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [1e16, 1e300, float("inf")])
@pytest.mark.parametrize("key", [0, 1, 2])
def test_a_view_beyond_single_precision_is_refused(value, key):
    points = [[0, 0, 3], [0, 0, 0], [0, 1, 0]]
    points[key] = [value, 1, 1]
    with pytest.raises(UserError, match=r"origin, target or up have entries over 1e\+15"):
        Camera.look_at(*points, 40, 4, 4)


@pytest.mark.parametrize(
    "key",
    [{"applied_scale": 2.0}, {"applied_transform": np.eye(4)[[1, 0, 2]].tolist()}],
)
def test_poses_in_the_frame_of_another_program_are_refused(key, tmp_path):
    frame = {"transform_matrix": np.eye(4).tolist(), "fl_x": 20.0, "w": 8, "h": 8}
    same = {"applied_scale": 1.0, "applied_transform": np.eye(4)[:3].tolist()}
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"frames": [frame]} | same))
    assert len(read_cameras(file, 8, 8)) == 1
    file.write_text(json.dumps({"frames": [frame]} | key))
    with pytest.raises(UserError, match="in the frame after 'applied_transform'"):
        read_cameras(file, 8, 8)
