"""Data folders: what is written is read back, and every mistake is one clear error."""

import json
import os
from dataclasses import replace
from unittest.mock import patch

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unbake import memory
from unbake.dataset.camera import Camera
from unbake.dataset.fingerprint import fingerprint
from unbake.dataset.image_files import counted_by, counted_in, read_image
from unbake.dataset.poses import check_cameras
from unbake.dataset.views import (
    Dataset,
    View,
    fitted,
    fitted_pixels,
    may_ring,
    read_masked,
    read_photograph,
)
from unbake.errors import UserError

WIDTH, HEIGHT = 6, 4


def write_exr(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32)).write(str(path))


def picture(index, channels=4):
    pixels = np.arange(HEIGHT * WIDTH * channels, dtype=np.float32) + 100 * index
    pixels = pixels.reshape(HEIGHT, WIDTH, channels) / 64
    if channels == 4:
        pixels[..., 3] = (np.arange(WIDTH) > index)[None]
    return pixels


@pytest.fixture
def folder(tmp_path):
    """Two training views and a held-out one, the first with truth images."""
    data = tmp_path / "data"
    (data / "scene").mkdir(parents=True)
    (data / "scene" / "scene.xml").write_text("<scene version='3.0.0'/>")
    names = [("train_000", "train"), ("train_001", "train"), ("heldout_000", "heldout")]
    views = []
    for index, (name, split) in enumerate(names):
        image = data / "images" / f"{name}.exr"
        write_exr(image, picture(index))
        camera = Camera.look_at((index, 1, 2), (0, 0, 0), (0, 1, 0), 50.0, WIDTH, HEIGHT)
        views.append(View(name, split, camera, image, {}))
    for kind in ("albedo", "roughness"):
        write_exr(data / "truth" / kind / "train_000.exr", picture(0))
    scene, render = data / "scene" / "scene.xml", {"spp": 16, "integrator": "path"}
    Dataset(data, scene, "hidden", tuple(views), render, 0.75).save(data)
    return data


def change(folder, edit):
    file = folder / "transforms.json"
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def refused(folder, message):
    with pytest.raises(UserError, match=message) as caught:
        Dataset.load(folder)
    assert caught.value.where and caught.value.remedy
    return caught.value


def pixels_of(view, clip_negative=False):
    return read_image(view.image, view.camera.width, view.camera.height, clip_negative)


def refused_pixels(folder, message, clip_negative=False):
    """Headers are good, so that only reading the pixels tells."""
    views = Dataset.load(folder).views
    with pytest.raises(UserError, match=message) as caught:
        _ = [pixels_of(view, clip_negative) for view in views]
    assert caught.value.where and caught.value.remedy
    return caught.value


def test_a_saved_data_set_is_loaded_again(folder):
    data = Dataset.load(folder)
    assert (data.background, data.coverage) == ("hidden", 0.75)
    assert data.render == {"spp": 16, "integrator": "path"}
    assert data.scene == folder / "scene" / "scene.xml"
    assert [v.name for v in data.train] == ["train_000", "train_001"]
    assert [v.name for v in data.heldout] == ["heldout_000"]
    first, second = data.train
    assert first.truth["albedo"] == folder / "truth" / "albedo" / "train_000.exr"
    assert first.truth["roughness"].is_file() and second.truth == {}
    expected = Camera.look_at((1, 1, 2), (0, 0, 0), (0, 1, 0), 50.0, WIDTH, HEIGHT)
    assert np.array_equal(second.camera.to_world, expected.to_world)
    assert second.camera.fl_x == expected.fl_x


def test_saving_leaves_one_file_and_replaces_it_whole(folder):
    data = Dataset.load(folder)
    before = (folder / "transforms.json").read_bytes()
    data.save(folder)
    assert (folder / "transforms.json").read_bytes() == before
    broken = Dataset(folder, data.scene, "hidden", data.views, {"spp": float("nan")}, None)
    with pytest.raises(ValueError, match="JSON"):
        broken.save(folder)
    assert (folder / "transforms.json").read_bytes() == before
    assert sorted(p.name for p in folder.iterdir()) == [
        "images",
        "scene",
        "transforms.json",
        "truth",
    ]


def test_light_that_is_unknown_is_kept(folder):
    assert Dataset.load(folder).light == "known"
    assert "light" not in json.loads((folder / "transforms.json").read_text())
    change(folder, set_top("light", "unknown"))
    Dataset.load(folder).save(folder)
    assert Dataset.load(folder).light == "unknown"


def test_files_outside_the_folder_are_not_saved(folder, tmp_path):
    with pytest.raises(UserError, match="lies outside the data folder"):
        Dataset.load(folder).save(tmp_path / "elsewhere")


def test_pixels_come_row_by_row(folder):
    for i, view in enumerate(Dataset.load(folder).views):
        pixels = pixels_of(view)
        assert pixels.dtype == np.float32
        assert np.array_equal(pixels, picture(i).reshape(-1, 4))


@pytest.mark.parametrize("channels", [1, 3])
def test_images_without_alpha_are_opaque(tmp_path, channels):
    pixels = picture(1, channels)
    write_exr(tmp_path / "a.exr", pixels)
    read = read_image(tmp_path / "a.exr", WIDTH, HEIGHT)
    assert np.array_equal(read[:, :3], np.broadcast_to(pixels, (HEIGHT, WIDTH, 3)).reshape(-1, 3))
    assert (read[:, 3] == 1).all()


def test_nerfstudio_data_need_no_keys_of_ours(folder):
    def strip(content):
        frames = content["frames"]
        for frame in frames:
            for key in ("split", "fl_x", "fl_y", "cx", "cy", "w", "h"):
                frame.pop(key)
        extra = {"fl_x": 7.5, "w": WIDTH, "h": HEIGHT, "k1": 0.0, "camera_model": "OPENCV"}
        content.clear()
        content |= {"frames": frames, "scene": "scene/scene.xml", **extra}

    change(folder, strip)
    data = Dataset.load(folder)
    assert len(data.train) == 3 and not data.heldout
    assert (data.background, data.render, data.coverage) == ("visible", {}, None)
    assert data.train[0].camera.fl_y == 7.5 and data.train[0].camera.cx == WIDTH / 2


def set_frame(key, value):
    return lambda content: content["frames"][1].__setitem__(key, value)


def set_top(key, value):
    return lambda content: content.__setitem__(key, value)


def all_heldout(content):
    for frame in content["frames"]:
        frame["split"] = "heldout"


MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()
FAR_POSE = [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def nested(depth):
    return {"a": nested(depth - 1)} if depth else {}


NAN_POSE = [[float("nan")] * 4] * 4


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (set_top("frames", []), "'frames' is not a list of frames"),
        (set_top("frames", {}), "'frames' is not a list of frames"),
        (set_top("frames", [1]), "frame 0: the frame is not an object"),
        (lambda c: c.pop("frames"), "'frames' is not a list of frames"),
        (lambda c: c.pop("scene"), "the key 'scene' is missing"),
        (set_top("scene", 3), "'scene' is not a text"),
        (set_top("scene", "scene/other.xml"), "other.xml: the scene file does not exist"),
        (set_top("scene", "../scene.xml"), "lies outside the data folder"),
        (set_top("scene", "/etc/passwd"), "lies outside the data folder"),
        (set_top("background", "black"), "unknown background 'black'"),
        (set_top("background", ["hidden"]), "unknown background"),
        (set_top("light", "guessed"), "unknown light 'guessed'"),
        (set_top("light", None), "unknown light None"),
        (set_top("render", []), "'render' is not an object"),
        (set_top("coverage", "most"), "'coverage' is not a number"),
        (set_top("coverage", 1.5), "'coverage' is not a number from 0 to 1"),
        (all_heldout, "no view has the split 'train'"),
        (lambda c: c["frames"][1].pop("file_path"), "frame 1: the key 'file_path' is missing"),
        (set_frame("file_path", "images/none.exr"), "none.exr: the image does not exist"),
        (set_frame("file_path", "images/train_000.exr"), "two frames are named 'train_000'"),
        (set_frame("file_path", "other/train_000.exr"), "two frames are named 'train_000'"),
        (set_frame("file_path", "../../a.exr"), "'../../a.exr' lies outside"),
        (set_frame("file_path", "a\0.exr"), "is not a path"),
        (set_frame("file_path", "images/\ud800.exr"), "is not a path"),
        (set_frame("file_path", "file:///a.exr"), "the image does not exist"),
        (set_frame("file_path", "C:\\a.exr"), "the image does not exist"),
        (set_frame("file_path", "images"), "images: the image cannot be read .Is a directory"),
        (set_frame("split", "val"), r"frame 1 \(train_001.exr\): unknown split 'val'"),
        (set_frame("transform_matrix", MIRRORED), r"\(train_001.exr\): the pose is left-handed"),
        (set_frame("transform_matrix", NAN_POSE), "the pose has NaN"),
        (set_frame("transform_matrix", [[0] * 4] * 4), "the pose is singular"),
        (set_frame("transform_matrix", (2 * np.eye(4)).tolist()), "not a rigid motion"),
        (set_frame("transform_matrix", [1, 2]), "not an array of 4 x 4 numbers"),
        (set_frame("transform_matrix", [[1], [1, 2]]), "not an array of 4 x 4 numbers"),
        (set_frame("fl_x", -3), "the focal length"),
        (set_frame("fl_x", None), "'fl_x' is not a number"),
        (set_frame("w", "6"), "'w' is not a number"),
        (set_frame("w", WIDTH + 1), "train_001.exr: the image has 6 x 4 pixels"),
        (set_frame("h", 10**9), r"\(train_001.exr\): the image size 6 x 1e\+09 is too large"),
        (set_frame("w", 1e300), r"\(train_001.exr\): the image size 1e\+300 x 4 is too large"),
        (set_frame("w", 2.5), "'w' is 2.5, not a whole number"),
        (set_frame("w", float("nan")), "'w' is nan, not a finite number"),
        (set_frame("h", 10**400), "'h' is too large"),
        (set_frame("fl_y", 0), r"the focal length \(\S+, 0\) is out of range"),
        (set_frame("fl_x", 1e-30), "the focal length .* is out of range"),
        (set_frame("fl_x", 1e30), "the focal length .* is out of range"),
        (set_frame("cx", 1e300), "the principal point .* is far outside of the image"),
        (set_frame("cy", float("inf")), "'cy' is inf, not a finite number"),
        (set_frame("transform_matrix", FAR_POSE), r"the pose has entries over 1e\+15"),
        (set_frame("transform_matrix", [[10**400] * 4] * 4), "not an array of 4 x 4 numbers"),
        (set_frame("file_path", f"images/{'x' * 201}.exr"), "the name of the image has over 200"),
        (
            set_frame("file_path", "images/a\x1b[31m.exr"),
            "name of the image has control characters",
        ),
        (set_top("coverage", 10**400), "'coverage' is not a number from 0 to 1"),
        (set_top("coverage", float("nan")), "'coverage' is not a number from 0 to 1"),
        (set_top("coverage", True), "'coverage' is not a number from 0 to 1"),
        (set_top("light_by_depth", [0.5, 10**400]), "'light_by_depth' is not a list of shares"),
        (set_top("render", nested(100)), "nested deeper than 64 levels"),
        (set_top("format", 10**400), "was written by a newer unbake"),
    ],
)
def test_a_wrong_entry_is_one_clear_error(folder, edit, message):
    change(folder, edit)
    refused(folder, message)


def test_all_wrong_entries_at_the_top_are_told_at_once(folder):
    wrong = {"background": "x", "light": 3, "light_by_depth": "x", "coverage": "x", "render": 5}
    change(folder, lambda content: content.update(wrong))
    faults = []
    Dataset.load(folder, faults=faults)
    assert len(faults) == 5
    assert all(any(key in fault.what for fault in faults) for key in wrong)


def test_training_views_that_cannot_be_used_are_not_said_to_be_missing(folder):
    change(folder, lambda c: [frame.update(fl_x=-1) for frame in c["frames"]])
    faults = []
    with pytest.raises(UserError, match="none of the training views can be used"):
        Dataset.load(folder, faults=faults)
    assert faults


def test_the_file_of_a_data_set_in_its_place_is_told(folder):
    with pytest.raises(UserError, match="not a data folder") as caught:
        Dataset.load(folder / "transforms.json")
    assert caught.value.remedy == f"Give its folder: {folder}"


@pytest.mark.parametrize("content", ["", "{", "[1]", "\x80", "[" * 100000])
def test_a_file_that_is_no_json_object_is_refused(folder, content):
    (folder / "transforms.json").write_text(content, encoding="latin-1")
    refused(folder, "transforms.json: the file (is not|does not hold)")


def test_a_missing_folder_or_file_is_named(folder, tmp_path):
    refused(tmp_path / "none", "the data folder does not exist")
    (folder / "transforms.json").unlink()
    refused(folder, "no transforms.json in the folder")


def test_a_link_out_of_the_folder_is_refused(folder, tmp_path):
    write_exr(tmp_path / "secret.exr", picture(0))
    (folder / "images" / "train_001.exr").unlink()
    (folder / "images" / "train_001.exr").symlink_to(tmp_path / "secret.exr")
    assert "--allow-outside" in refused(folder, "lies outside the data folder").remedy
    assert len(Dataset.load(folder, allow_outside=True).views) == 3


@pytest.mark.parametrize("place", ["truth", "truth/albedo", "truth/albedo/train_000.exr"])
def test_no_truth_is_read_through_a_link_out_of_the_folder(folder, tmp_path, place):
    moved = (folder / place).rename(tmp_path / "elsewhere")
    (folder / place).symlink_to(moved)
    message = "'truth/(albedo|roughness)/train_000.exr' lies outside the data folder"
    assert "--allow-outside" in refused(folder, message).remedy
    loaded = Dataset.load(folder, allow_outside=True)
    assert loaded.allow_outside and loaded.views[0].truth["albedo"].is_file()


def test_links_within_the_folder_are_followed(folder):
    (folder / "truth").rename(folder / "materials")
    (folder / "truth").symlink_to("materials")
    assert Dataset.load(folder).views[0].truth["albedo"].is_file()


def test_transforms_that_are_a_link_out_of_the_folder_are_refused(folder, tmp_path):
    moved = (folder / "transforms.json").rename(tmp_path / "poses.json")
    (folder / "transforms.json").symlink_to(moved)
    refused(folder, "'transforms.json' lies outside the data folder")


@pytest.mark.parametrize("name", ["transforms.json", "images/train_001.exr", "scene/scene.xml"])
def test_a_pipe_in_the_place_of_a_file_is_refused_at_once(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    refused(folder, f"{name}: the .*cannot be read .it is a pipe or a device")


def test_a_folder_whose_path_is_not_utf8_is_refused(folder):
    odd = folder.rename(folder.with_name("d\udcffta"))
    error = refused(odd, "the path of the data folder is not UTF-8")
    assert f"d\\xffta: {error.what}" in str(error)


@pytest.mark.parametrize("name", ["photo.png", "photo.JPG", "photo.tiff"])
def test_low_dynamic_range_is_refused(folder, name):
    (folder / "images" / name).write_bytes(b"anything")
    change(folder, set_frame("file_path", f"images/{name}"))
    assert "OpenEXR" in refused(folder, "low dynamic range").remedy


def coded(folder, name, codes, **keys):
    """Put a photograph of code values into the place of the second view's."""
    mi.Bitmap(np.ascontiguousarray(codes)).write(str(folder / "images" / name))
    for key, value in {"file_path": f"images/{name}", "encoding": "srgb", **keys}.items():
        change(folder, set_frame(key, value))
    return Dataset.load(folder).views[1]


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_code_values_are_decoded_by_the_srgb_curve(folder, kind):
    most = np.iinfo(kind).max
    codes = np.linspace(0, most, HEIGHT * WIDTH * 3).astype(kind).reshape(HEIGHT, WIDTH, 3)
    view = coded(folder, "photo.png", codes)
    pixels = read_photograph(view)
    value = codes.astype(np.float64) / most
    wanted = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    assert np.abs(pixels[..., :3] - wanted).max() < 1e-6 and (pixels[..., 3] == 1).all()
    assert np.array_equal(
        pixels_of(Dataset.load(folder).views[0])[:, 0], picture(0)[..., 0].ravel()
    )


def test_alpha_of_code_values_is_premultiplied(folder):
    codes = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    codes[:2, :, 3] = 51
    pixels = read_photograph(coded(folder, "photo.png", codes))
    assert np.allclose(pixels[:2], 0.2) and np.allclose(pixels[2:], 1)


def test_a_data_set_of_code_values_and_masks_is_saved_and_loaded(folder):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[1:3, 2] = 0
    mi.Bitmap(mask).write(str(folder / "mask.png"))
    view = coded(folder, "photo.png", np.full((HEIGHT, WIDTH, 3), 128, np.uint8))
    change(folder, set_frame("mask_path", "mask.png"))
    data = Dataset.load(folder)
    data.save(folder)
    again = Dataset.load(folder).views[1]
    assert (again.encoding, again.mask) == ("srgb", folder / "mask.png") and view.mask is None
    assert np.array_equal(read_photograph(again)[..., 3], mask / 255)
    assert Dataset.load(folder).views[0].mask is None


def test_photographs_are_read_for_fitted_pixels_only_where_their_alpha_counts(folder, monkeypatch):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[1:3, 2] = 0
    mi.Bitmap(mask).write(str(folder / "mask.png"))
    write_exr(folder / "images" / "opaque.exr", picture(0, channels=3))
    view = Dataset.load(folder).views[0]
    masked = replace(view, mask=folder / "mask.png")
    covered = picture(0)[..., 3] > 0
    assert 0 < covered.mean() < 1
    assert np.array_equal(fitted_pixels(view, "hidden"), covered)
    assert np.array_equal(fitted_pixels(masked, "hidden"), covered & (mask > 0))

    def read(*words):
        raise AssertionError("the photograph is read")

    monkeypatch.setattr("unbake.dataset.views.read_image", read)
    assert np.array_equal(fitted_pixels(masked, "visible"), mask > 0)
    assert fitted_pixels(view, "visible") is None
    opaque = replace(view, image=folder / "images" / "opaque.exr")
    assert fitted_pixels(opaque, "hidden") is None


@pytest.mark.parametrize(
    ("colours", "alpha", "counted"),
    [
        ([0, 255], None, [False, True]),
        ([0, 255], [255, 255], [False, True]),
        ([255, 255], [0, 255], [False, True]),
        ([0, 255], [255, 0], [False, False]),
        ([0, 0], [0, 255], [False, True]),
        ([0, 0], [255, 255], [False, False]),
    ],
)
@pytest.mark.parametrize("channels", [1, 3])
def test_black_and_transparent_pixels_of_a_mask_do_not_count(colours, alpha, counted, channels):
    codes = np.repeat(np.array([[colours]], np.uint8).transpose(0, 2, 1), channels, axis=2)
    if alpha is not None:
        codes = np.dstack([codes, np.array([alpha], np.uint8)])
    assert counted_by(codes).tolist() == [counted]


def test_noise_of_jpeg_counts_no_pixel_of_a_mask(tmp_path):
    """Beside edges of a disk, JPEG leaves small codes in black and lowers white."""
    y, x = np.mgrid[:64, :64]
    disk = np.hypot(x - 30, y - 33) < 20
    codes = np.where(disk, 255, 0).astype(np.uint8)
    for name in ("mask.png", "mask.jpg"):
        Image.fromarray(codes).save(tmp_path / name)
    stored = np.asarray(Image.open(tmp_path / "mask.jpg"))
    assert (stored[~disk] > 0).any()
    assert np.array_equal(counted_in(tmp_path / "mask.png"), disk)
    assert np.array_equal(counted_in(tmp_path / "mask.jpg"), disk)
    dark = np.where(disk, 3, 0).astype(np.uint8)
    Image.fromarray(dark).save(tmp_path / "dark.png")
    assert np.array_equal(counted_in(tmp_path / "dark.png"), disk), "of PNG, all but black counts"


def test_the_fingerprint_knows_masks(folder):
    def of_photographs():
        dataset = Dataset.load(folder)
        files = [view.image for view in dataset.views]
        with patch("unbake.dataset.fingerprint.geometry_fingerprint", return_value={}):
            return files and fingerprint(dataset)["photographs"]

    before = of_photographs()
    mi.Bitmap(np.full((HEIGHT, WIDTH), 255, np.uint8)).write(str(folder / "mask.png"))
    change(folder, set_frame("mask_path", "mask.png"))
    masked = of_photographs()
    mi.Bitmap(np.zeros((HEIGHT, WIDTH), np.uint8)).write(str(folder / "mask.png"))
    assert len({before, masked, of_photographs()}) == 3


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"encoding": "gamma"}, "unknown encoding 'gamma'"),
        ({"encoding": 3}, "unknown encoding 3"),
        ({"file_path": "images/train_001.exr"}, "the image holds no code values: it is .exr"),
        ({"mask_path": "none.png"}, "none.png: the mask does not exist"),
        ({"mask_path": "images/train_001.exr"}, "holds no code values"),
        ({"mask_path": "../a.png"}, "'../a.png' lies outside"),
        ({"mask_path": 1}, "'mask_path' is not a text"),
        ({"w": WIDTH + 1}, "photo.png: the image has 6 x 4 pixels"),
    ],
)
def test_a_wrong_key_of_a_coded_photograph_is_refused(folder, keys, message):
    codes = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with pytest.raises(UserError, match=message) as caught:
        coded(folder, "photo.png", codes, **keys)
    assert caught.value.where and caught.value.remedy


def test_an_unknown_format_is_refused(folder):
    (folder / "images" / "a.raw").write_bytes(b"anything")
    change(folder, set_frame("file_path", "images/a.raw"))
    refused(folder, "unknown image format '.raw'")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channel", [1, 3])
def test_pixels_that_are_not_finite_are_counted_and_never_accepted(folder, value, channel):
    pixels = picture(1)
    pixels[1, 2, channel] = pixels[3, 4, channel] = value
    write_exr(folder / "images" / "train_001.exr", pixels)
    for clip in (False, True):
        message = "train_001.exr: 2 of 24 pixels are NaN or infinite"
        refused_pixels(folder, message, clip)


def test_negative_pixels_are_refused_or_clipped(folder):
    pixels = picture(1)
    pixels[1, 2, 0] = -0.5
    write_exr(folder / "images" / "train_001.exr", pixels)
    error = refused_pixels(folder, "train_001.exr: 1 of 24 pixels are negative")
    assert "--clip-negative" in error.remedy
    clipped = pixels_of(Dataset.load(folder).train[1], clip_negative=True)
    assert clipped.min() == 0 and np.array_equal(clipped[:, 1], picture(1)[..., 1].ravel())


def test_a_damaged_truth_image_is_named(folder):
    (folder / "truth" / "albedo" / "train_000.exr").write_bytes(b"v/1\x01")
    refused(folder, "albedo/train_000.exr: the image cannot be read")


def test_damaged_images_are_refused_before_memory_is_taken(folder):
    image = folder / "images" / "train_001.exr"
    whole = image.read_bytes()
    for length in (0, 3, 200):
        image.write_bytes(whole[:length])
        refused(folder, "train_001.exr: the image cannot be read")
    for length in (len(whole) // 2, len(whole) - 1):
        image.write_bytes(whole[:length])
        refused_pixels(folder, "train_001.exr: the image cannot be read")
    huge = bytearray(whole)
    at = whole.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4 + 8
    huge[at : at + 8] = b"\xff\xff\xff\x3f" * 2
    image.write_bytes(huge)
    refused(folder, r"\d+ bytes cannot hold 1073741824 x 1073741824 pixels")


def test_an_image_that_does_not_fit_the_memory_is_not_decoded(folder, monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: 1000)
    error = refused_pixels(folder, "the image needs about 0 MB of memory, 0 MB are free")
    assert error.remedy == "Use a smaller image"


def test_other_channels_are_refused(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", np.zeros((HEIGHT, WIDTH, 7)))
    monkeypatch.setattr(mi, "Bitmap", None)  # it is not decoded
    with pytest.raises(UserError, match="other channels"):
        read_image(tmp_path / "a.exr", WIDTH, HEIGHT)


def room(flipped):
    """The cube [-1, 1]^3 of six twosided walls, a box in one corner; normals in or outwards."""
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse"}}
    turns = [([0, 1, 0], angle) for angle in (0, 90, 180, 270)]
    turns += [([1, 0, 0], angle) for angle in (90, 270)]
    shapes = {}
    for index, (axis, angle) in enumerate(turns):
        to_world = mi.ScalarTransform4f().rotate(axis, angle).translate([0, 0, -1])
        shape = {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}
        shapes[f"wall{index}"] = shape | {"flip_normals": flipped}
    box = mi.ScalarTransform4f().translate([0.5, -0.6, 0.5]).scale(0.4)
    shapes["box"] = {"type": "cube", "to_world": box, "bsdf": bsdf}
    # Mitsuba cannot merge rectangles with cubes
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


@pytest.mark.parametrize("flipped", [False, True], ids=["inward", "outward"])
def test_cameras_in_or_on_geometry_are_named(flipped):
    def camera(*origin, target=(0.0, 0.0, -1.0)):
        return Camera.look_at(origin, target, (0, 1, 0), 60.0, 16, 16)

    cameras = {
        "free": camera(-0.5, 0.0, 0.5),
        "corner": camera(-0.9, 0.9, 0.9),
        "near the box": camera(0.5, 0.0, 0.4),
        "in the box": camera(0.5, -0.6, 0.5),
        "nose on the wall": camera(0.1, 0.0, -0.999, target=(0.1, 0.0, -2.0)),
    }
    assert check_cameras(room(flipped), cameras) == ["in the box", "nose on the wall"]


def test_cameras_outside_an_object_are_fine_and_inside_are_named():
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    outside = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 8, 8)
    inside = Camera.look_at((0, 0, 0.3), (0, 0, 0), (0, 1, 0), 40.0, 8, 8)
    assert check_cameras(scene, {"outside": outside, "inside": inside}) == ["inside"]
    assert check_cameras(scene, {}) == []


def test_values_beside_clipped_ones_of_jpeg_files_are_not_fitted(tmp_path):
    """A lamp on a dark wall, in whose photograph some pixels of the lamp read as no lamp would."""
    light = np.full((24, 24, 3), 0.02)
    light[9:15, 9:15] = 1.0
    light[4, 4] = (1.0, 0.3, 0.1)  # clipped in red alone
    codes = np.round(255 * (1.055 * light ** (1 / 2.4) - 0.055)).astype(np.uint8)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, 24, 24)
    for suffix in ("jpg", "png"):
        file = tmp_path / f"lamp.{suffix}"
        Image.fromarray(codes).save(file, **({"quality": 80} if suffix == "jpg" else {}))
        view = View("lamp", "train", camera, file, {}, encoding="srgb", clipped=0.95)
        pixels, mask = read_masked(view)
        counted = fitted(pixels, mask, "visible", view)
        assert may_ring(view) == (suffix == "jpg")
        if suffix == "png":
            assert counted.all() and fitted_pixels(view, "visible") is None
            continue
        clipped = pixels[..., :3] >= np.float32(0.95)
        whole = clipped.all(-1)
        assert whole.any() and counted[:3].all() and counted[whole].all()
        for row, column in zip(*np.nonzero(whole), strict=True):
            near = np.s_[row - 1 : row + 2, column - 1 : column + 2]
            assert not counted[near][~whole[near]].any()
        np.testing.assert_array_equal(fitted_pixels(view, "visible"), counted)
        for other in (replace(view, clipped=None), None):
            assert fitted(pixels, mask, "visible", other).all()
        assert fitted_pixels(replace(view, clipped=None), "visible") is None
