"""Photographs as people have them: scaled, missing, with masks and colour profiles of their own."""

import json
import shutil
from pathlib import PurePath
from unittest.mock import patch

import numpy as np
import pytest
import tifffile
import trimesh
from layouts import codes, quiet, save, write_blender, write_colmap, write_nerfstudio
from PIL import Image

from unbake.dataset.views import Dataset, read_masked, read_photograph
from unbake.errors import UserError
from unbake.imaging.coded import decode, read_codes
from unbake.imaging.pictures import write_exr
from unbake.imaging.profiles import linear_srgb, profile_name, read_profile
from unbake.imaging.srgb import from_srgb, to_srgb
from unbake.importing import import_data as importing
from unbake.importing import views
from unbake.importing.faults import ImportFaults
from unbake.importing.frames import _lens
from unbake.importing.import_data import import_data
from unbake.importing.lens import Lens, opencv
from unbake.importing.photographs import CLIPPED_CODE
from unbake.importing.settings import ImportSettings
from unbake.importing.source import Shot, same_shape
from unbake.importing.views import _straightened, block_for

imagecodecs = pytest.importorskip("imagecodecs", reason="colour profiles need imagecodecs")

WHITE = (0.3127, 0.3290, 1.0)
#: CIE xy of the primaries of Display P3, with Y = 1.
P3 = (0.680, 0.320, 1.0, 0.265, 0.690, 1.0, 0.150, 0.060, 1.0)
#: Linear Display P3 to linear sRGB (CSS Color 4).
TO_SRGB = np.array(
    [[1.2249, -0.2247, 0.0], [-0.0420, 1.0419, 0.0], [-0.0197, -0.0786, 1.0979]], np.float64
)
#: The orientation in EXIF, a quarter turn and half a turn.
ORIENTATION, QUARTER, HALF = 0x0112, 6, 3


@pytest.fixture
def project(captured, tmp_path):
    write_colmap(captured, tmp_path / "project")
    return tmp_path / "project"


def profile_of(primaries, gamma):
    return imagecodecs.cms_profile("rgb", whitepoint=WHITE, primaries=primaries, gamma=gamma)


def imported(source, out, meshes, **more):
    """The data set, and what was told."""
    told = []
    settings = ImportSettings(holdout=0, **{k: more.pop(k) for k in list(more) if k in SETTINGS})
    import_data(source, out, meshes, settings, tell=told.append, **more)
    return Dataset.load(out), told


SETTINGS = ("leave_out_missing", "mesh_y_up", "keep_applied_transform", "longest", "background")


# -------------------------------------------------------------------------------------------- sizes


def test_cameras_are_scaled_to_photographs_that_were_made_smaller(
    captured, project, meshes, tmp_path
):
    for file in sorted((project / "images").iterdir()):
        small = Image.open(file).resize((8, 8), Image.Resampling.BOX)
        save(np.asarray(small), project / "images_2" / file.name)
    data, told = imported(project, tmp_path / "data", meshes, images=project / "images_2")
    assert "cameras are scaled by 0.5, to the size of their photographs: 3 of 3" in told
    known = {view.name: view.camera for view in captured.views}
    assert len(data.views) == len(known)
    for view in data.views:
        small, large = view.camera, known[view.name]
        assert (small.width, small.height) == (8, 8)
        assert (small.fl_x, small.cx, small.cy) == (large.fl_x / 2, large.cx / 2, large.cy / 2)
        assert np.allclose(small.to_world, large.to_world)


def test_sizes_that_were_rounded_keep_square_pixels():
    """4946 x 3286 pixels at a quarter are 1237 x 822, of which 1236.5 x 821.5 are exact."""
    lens = Lens(4946, 3286, 4000.0, 4000.0, 2473.0, 1643.0)
    small = lens.scaled(1237, 822)
    assert small.straight and small.fl_x == small.fl_y == pytest.approx(1000.5, abs=0.1)
    points = np.array([[-0.6, -0.4], [0.6, 0.4], [0.0, 0.0]])
    exact = lens.pixels(points) * (1237 / 4946, 822 / 3286)
    assert np.abs(small.pixels(points) - exact).max() < 0.25


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_distorted_lenses_are_scaled(model):
    keys = {"w": 96, "h": 64, "fl_x": 80.0, "fl_y": 81.0, "cx": 45.0, "cy": 33.0, "k1": -0.1}
    lens = _lens(keys | {"camera_model": model}, 96, 64, "here")
    small = lens.scaled(48, 32)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    assert np.allclose(small.pixels(points), lens.pixels(points) / 2)
    assert small.camera(np.eye(4)).fl_x == pytest.approx(lens.camera(np.eye(4)).fl_x / 2, rel=1e-3)


def test_photographs_of_another_shape_are_refused(project, meshes, tmp_path):
    first, second = sorted((project / "images").iterdir())[:2]
    save(np.zeros((8, 10, 3), np.uint8), first)
    save(np.zeros((9, 16, 3), np.uint8), second)
    with pytest.raises(ImportFaults) as caught:
        import_data(project, tmp_path / "data", meshes, tell=quiet)
    told = "; ".join(caught.value.faults)
    assert f"its camera is for 16 x 16 pixels, it has 10 x 8: {first.name}" in told
    assert "it has 16 x 9" in told and "Give the photographs that were posed" in told


def test_shapes_are_the_same_but_for_rounding():
    assert same_shape((1237, 822), (4946, 3286)) and same_shape((1236, 821), (4946, 3286))
    assert same_shape((9892, 6572), (4946, 3286))
    assert not same_shape((822, 1237), (4946, 3286)) and not same_shape((1237, 840), (4946, 3286))


def test_photographs_that_wait_to_be_turned_are_told(project, meshes, tmp_path):
    cameras = project / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("16 16", "12 16", 1))
    for file in sorted((project / "images").iterdir()):
        exif = Image.Exif()
        exif[ORIENTATION] = QUARTER
        Image.new("RGB", (16, 12)).save(file, exif=exif)
    with pytest.raises(ImportFaults, match=r"its EXIF says.*mogrify -auto-orient"):
        import_data(project, tmp_path / "data", meshes, tell=quiet)


def test_photographs_that_were_turned_are_told(project, meshes, tmp_path):
    cameras = project / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("16 16", "12 16", 1))
    for file in sorted((project / "images").iterdir()):
        Image.new("RGB", (32, 24)).save(file)  # twice as large
    told = r"for 12 x 16 pixels, it has 32 x 24; it was turned by 90 degrees, .*\. Turn it back"
    with pytest.raises(ImportFaults, match=told):
        import_data(project, tmp_path / "data", meshes, tell=quiet)


def test_photographs_that_programs_show_turned_are_told(project, meshes, tmp_path):
    """Square ones, and half turns, have the shape of their camera."""
    first, second, _ = sorted((project / "images").iterdir())
    for file, turn in ((first, QUARTER), (second, HALF)):
        exif = Image.Exif()
        exif[ORIENTATION] = turn
        Image.open(file).save(file, exif=exif)
    told = imported(project, tmp_path / "data", meshes)[1]
    asks = "the EXIF of 2 photographs asks to turn them; they are taken as stored: "
    assert f"{asks}{first.name}, {second.name}" in told
    Image.open(first).save(first, exif=Image.Exif())
    told = imported(project, tmp_path / "one", meshes)[1]
    asks = "the EXIF of one photograph asks to turn it; it is taken as stored: "
    assert f"{asks}{second.name}" in told


# ------------------------------------------------------------------------------------------ missing


def test_missing_photographs_may_be_left_out(captured, project, meshes, tmp_path):
    first = sorted((project / "images").iterdir())[0]
    first.unlink()
    with pytest.raises(ImportFaults, match=r"the image does not exist.*--leave-out-missing"):
        import_data(project, tmp_path / "data", meshes, tell=quiet)
    data, told = imported(project, tmp_path / "data", meshes, leave_out_missing=True)
    assert f"one photograph does not exist, left out: {first.name}" in told
    left = {view.name for view in captured.views} - {first.stem}
    assert {view.name for view in data.views} == left
    shutil.rmtree(project / "images")
    (project / "images").mkdir()
    folder = project / "images"
    none = f"None is in {folder}: name their folder with --images"
    with pytest.raises(ImportFaults) as caught:
        imported(project, tmp_path / "none", meshes, leave_out_missing=True)
    assert caught.value.faults == (f"no photograph of the source exists. {none}",)
    with pytest.raises(ImportFaults) as caught:
        imported(project, tmp_path / "none", meshes)
    (fault,) = caught.value.faults
    assert fault.startswith("the image does not exist: ")
    assert fault.endswith(f". {none}")


@pytest.mark.parametrize("suffix", [".JPG", ".jpg"])
def test_suffixes_may_be_of_another_case(suffix, captured, project, meshes, tmp_path):
    """Resizers write `.jpg` of the `.JPG` that was posed; the one that is named comes first."""
    model, smaller = project / "sparse" / "0" / "images.txt", tmp_path / "smaller"
    model.write_text(model.read_text().replace(".png", ".JPG"))
    for view in captured.views:
        save(codes(view), smaller / f"{view.name}{suffix}")
        save(codes(view), smaller / "masks" / f"{view.name}{suffix}.png")
    if suffix == ".JPG":
        for view in captured.views:
            save(np.zeros_like(codes(view)), smaller / f"{view.name}.jpg")
    table = tmp_path / "exposures.csv"
    rows = [f"{view.name}{suffix},2\n" for view in captured.views]
    table.write_text("name,exposure\n" + "".join(rows))
    more = {"masks": smaller / "masks", "exposures": table}
    data, told = imported(project, tmp_path / "data", meshes, images=smaller, **more)
    assert {view.name for view in data.views} == {view.name for view in captured.views}
    assert all(view.exposure == 2 for view in data.views)
    assert all(read_photograph(view)[..., :3].max() > 0.1 for view in data.views)
    assert not any("another format" in line for line in told)


def test_a_photograph_in_another_format_is_taken_where_there_is_one(
    captured, project, meshes, tmp_path
):
    for file in sorted((project / "images").iterdir()):
        file.rename(project / "images" / f"{file.stem}.TIFF")
    for view in captured.views:
        save(codes(view), project / "images" / f"{view.name}.TIFF")
    data, told = imported(project, tmp_path / "data", meshes)
    assert {view.name for view in data.views} == {view.name for view in captured.views}
    (line,) = (line for line in told if line.startswith("photographs of another format are taken"))
    first, second, _ = sorted(f"{view.name}.png" for view in captured.views)
    assert f"these do not exist: {first}, {second}, " in line
    save(np.zeros((16, 16, 3), np.uint8), project / "images" / f"{captured.views[0].name}.jpg")
    with pytest.raises(
        ImportFaults, match=r"does not exist: .*\.png\. --leave-out-missing imports"
    ):
        imported(project, tmp_path / "two", meshes)


def test_neither_a_photograph_nor_its_mask_takes_the_place_of_the_other(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    first, *others = content["frames"]
    photograph = folder / first["file_path"]
    mask = photograph.with_suffix(".jpg")
    first["mask_path"] = str(PurePath(first["file_path"]).with_suffix(".jpg"))
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ImportFaults, match="the mask does not exist"):
        imported(folder, tmp_path / "no-mask", meshes)
    save(np.full((16, 16, 3), 255, np.uint8), mask)
    photograph.unlink()
    data, told = imported(folder, tmp_path / "data", meshes, leave_out_missing=True)
    assert len(data.views) == len(others)
    assert not any("another format" in line for line in told)


@pytest.mark.parametrize("layout", [write_nerfstudio, write_blender])
def test_photographs_that_are_all_missing_are_told(layout, captured, meshes, tmp_path):
    layout(captured, tmp_path / "source")
    for file in (tmp_path / "source").rglob("*.png"):
        file.unlink()
    with pytest.raises(ImportFaults, match="no photograph of the source exists"):
        imported(tmp_path / "source", tmp_path / "none", meshes, leave_out_missing=True)


def test_names_that_windows_wrote_are_found(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        name = frame["file_path"].rsplit("/", 1)[1]
        save(np.full((16, 16, 3), 255, np.uint8), folder / "masks" / name)
        frame |= {"file_path": f"./.\\images\\{name}", "mask_path": f"masks\\{name}"}
    (folder / "transforms.json").write_text(json.dumps(content))
    data, _ = imported(folder, tmp_path / "data", meshes)
    assert sorted(view.name for view in data.views) == sorted(v.name for v in captured.views)
    assert all(view.mask is not None for view in data.views)


# -------------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize("named", ["{}.png", "{stem}.png", "{}.PNG", "{stem}.PNG"])
def test_masks_beside_the_images_of_colmap_are_taken(named, project, meshes, tmp_path):
    files = sorted((project / "images").iterdir())
    mask = np.full((16, 16), 255, np.uint8)
    mask[:, :4] = 0
    for file in files[1:]:
        save(mask, project / "masks" / named.format(file.name, stem=file.stem))
    data, told = imported(project, tmp_path / "data", meshes)
    assert f"one photograph has no mask: {files[0].name}" in told
    first, *others = data.views
    assert read_masked(first)[1].all()
    for view in others:
        assert np.array_equal(read_masked(view)[1], mask > 0)


def test_a_folder_of_masks_that_suit_no_photograph_is_told(project, meshes, tmp_path):
    save(np.zeros((16, 16), np.uint8), project / "masks" / "mask_0.png")
    data, told = imported(project, tmp_path / "data", meshes)
    assert all(view.mask is None for view in data.views)
    name = sorted(file.name for file in (project / "images").iterdir())[0]
    line = f"no photograph has a mask in the folder masks. They are named as {name}.png"
    assert line in told


def test_masks_of_the_size_of_the_whole_photograph_suit_a_smaller_one(project, meshes, tmp_path):
    mask = np.full((16, 16), 255, np.uint8)
    mask[:, :5] = 0
    for file in sorted((project / "images").iterdir()):
        save(np.asarray(Image.open(file).resize((8, 8))), project / "small" / file.name)
        save(mask, project / "other" / f"{file.name}.png")
    folders = {"images": project / "small", "masks": project / "other"}
    data, _ = imported(project, tmp_path / "data", meshes, **folders)
    for view in data.views:
        counted = read_masked(view)[1]
        assert not counted[:, :3].any() and counted[:, 3:].all(), "half of a pixel is masked"


def test_masks_that_are_given_come_before_those_of_the_source(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        name = frame["file_path"].rsplit("/", 1)[1]
        save(np.full((16, 16), 255, np.uint8), folder / "own" / name)
        save(np.eye(16, dtype=np.uint8), folder / "given" / name)
        frame["mask_path"] = f"own/{name}"
    (folder / "transforms.json").write_text(json.dumps(content))
    data, _ = imported(folder, tmp_path / "data", meshes)
    assert all(read_masked(view)[1].all() for view in data.views)
    data, _ = imported(folder, tmp_path / "other", meshes, masks=folder / "given")
    assert all((read_masked(view)[1] == np.eye(16)).all() for view in data.views)


def test_a_mask_that_could_be_of_several_photographs_is_a_fault(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    del content["train_filenames"], content["test_filenames"]
    for number, frame in enumerate(content["frames"][:2]):
        file = folder / frame["file_path"]
        frame["file_path"] = f"images/cam{number}/0001{file.suffix}"
        (folder / frame["file_path"]).parent.mkdir()
        file.rename(folder / frame["file_path"])
    (folder / "transforms.json").write_text(json.dumps(content))
    save(np.full((16, 16), 255, np.uint8), tmp_path / "masks" / "0001.png")
    with pytest.raises(ImportFaults, match=r"the mask has the name of several photographs: .*cam1"):
        import_data(folder, tmp_path / "data", meshes, masks=tmp_path / "masks", tell=quiet)
    for camera in ("cam0", "cam1"):
        save(np.full((16, 16), 255, np.uint8), tmp_path / "masks" / camera / "0001.png")
    imported(folder, tmp_path / "data", meshes, masks=tmp_path / "masks")


def test_a_mask_of_radiance_is_a_fault(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    write_exr(folder / "mask.exr", np.ones((16, 16, 3)))
    content["frames"][0]["mask_path"] = "mask.exr"
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ImportFaults, match="the mask is no PNG, JPEG or TIFF file"):
        import_data(folder, tmp_path / "data", meshes, tell=quiet)


def test_masks_do_not_lead_out_of_their_folder(project, meshes, tmp_path):
    file = sorted((project / "images").iterdir())[0]
    save(np.zeros((16, 16), np.uint8), tmp_path / "secret.png")
    (project / "masks").mkdir()
    (project / "masks" / f"{file.name}.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(ImportFaults, match=r"lies outside the folder of masks.*--allow-outside"):
        import_data(project, tmp_path / "data", meshes, tell=quiet)


def test_a_camera_whose_size_is_not_told_must_suit_its_image(captured, meshes, tmp_path):
    """Intrinsics of the whole photograph, and the photograph at a quarter."""
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    del content["w"], content["h"]
    for file in (folder / "images").iterdir():
        Image.open(file).resize((4, 4)).save(file)
    (folder / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(ImportFaults, match=r"'cx' is 8, and the image has 4 pixels.*Give 'w'"):
        import_data(folder, tmp_path / "data", meshes, tell=quiet)


def test_a_folder_without_masks_is_a_fault(project, meshes, tmp_path):
    (project / "empty").mkdir()
    for folder, told in (("empty", "no photograph has a mask"), ("none", "no folder of masks")):
        with pytest.raises(ImportFaults, match=told):
            import_data(project, tmp_path / "data", meshes, masks=project / folder, tell=quiet)


def test_a_folder_of_masks_that_there_is_not_is_told_beside_other_faults(project, meshes, tmp_path):
    shutil.rmtree(project / "images")
    (project / "images").mkdir()
    with pytest.raises(ImportFaults) as caught:
        import_data(project, tmp_path / "data", meshes, masks=project / "none", tell=quiet)
    told = "; ".join(caught.value.faults)
    assert "the image does not exist" in told and "there is no folder of masks" in told


def test_masks_that_leave_no_pixel_are_told(project, meshes, tmp_path):
    files = sorted((project / "images").iterdir())
    for number, file in enumerate(files):
        save(np.full((16, 16), 255 * (number > 0), np.uint8), tmp_path / "masks" / file.name)
    told = imported(project, tmp_path / "data", meshes, masks=tmp_path / "masks")[1]
    assert any(f"masks leave no pixel of 1 photographs: {files[0].name}" in line for line in told)
    for file in files:
        save(np.zeros((16, 16), np.uint8), tmp_path / "masks" / file.name)
    with pytest.raises(UserError, match="masks leave no pixel of any photograph to train on"):
        imported(project, tmp_path / "none", meshes, masks=tmp_path / "masks")
    assert not (tmp_path / "none").exists()


def test_photographs_are_made_smaller_by_the_mean_of_their_light(
    captured, project, meshes, tmp_path
):
    """Squares of 3 x 3 pixels become one; of 16 pixels along an edge one is left over."""
    names, masks = [], tmp_path / "masks"
    for number, file in enumerate(sorted((project / "images").iterdir())):
        codes = np.asarray(Image.open(file)).copy()
        if number == 0:
            codes[:3, :3] = 255  # a square that is clipped all over, and one in part
            codes[3, 3] = 255
            codes[3:6, 4:6] = codes[4:6, 3] = 40
        save(codes, file)
        mask = np.full((16, 16), 255, np.uint8)
        mask[7, 7] = 0
        save(mask, masks / file.name)
        names.append(file.name)
    whole, _ = imported(project, tmp_path / "whole", meshes, masks=masks)
    small, told = imported(project, tmp_path / "small", meshes, masks=masks, longest=6)
    count = len(names)
    assert f"sizes: 3 x 3 pixels become one: {count} of {count} photographs" in told
    for number, (large, view) in enumerate(zip(whole.views, small.views, strict=True)):
        (full, mask), (found, small_mask) = (read_masked(v) for v in (large, view))
        assert found.shape == (5, 5, 4) and (view.camera.width, view.camera.height) == (5, 5)
        means = full[:15, :15].reshape(5, 3, 5, 3, 4).mean((1, 3))
        np.testing.assert_allclose(found[..., :3], means[..., :3], atol=2e-4)
        wanted = mask[:15, :15].reshape(5, 3, 5, 3).all((1, 3))
        assert not wanted[2, 2]
        clipped = (full[:15, :15, :3] >= large.clipped).reshape(5, 3, 5, 3, 3).mean((1, 3))
        wanted &= np.isin(clipped, (0, 1)).all(2)
        if number == 0:
            assert not wanted[1, 1] and (found[0, 0, :3] >= view.clipped).all()
        np.testing.assert_array_equal(small_mask, wanted)
        # A pixel looks where the middle one of its square did.
        ways = [
            c.rays(*(np.array([x]) for x in at))[1]
            for c, at in ((large.camera, (4.5, 7.5)), (view.camera, (1.5, 2.5)))
        ]
        np.testing.assert_allclose(*ways, atol=1e-9)
    assert not any(
        "sizes:" in line for line in imported(project, tmp_path / "same", meshes, longest=16)[1]
    )


def test_a_picture_of_one_line_stays_one(captured):
    """As those that are made small for checks and previews."""
    lens = Lens(5000, 1, 100.0, 100.0, 2500.0, 0.5)
    shot = Shot("line", None, captured.views[0].image, lens, np.eye(4))
    assert block_for(shot, 2048) == 1 and block_for(shot, 0) == 1


@pytest.mark.parametrize("opaque", [True, False])
@pytest.mark.parametrize("limit", [None, 0.9, 2.0])
def test_photographs_are_straightened_as_if_all_was_resampled(opaque, limit):
    """Bit for bit: what is known beforehand is left out."""
    radial, rng = np.array([0.05, 0.01, 0]), np.random.default_rng(3)
    project = opencv((40.0, 40.0), (25.0, 16.0), radial, 0.001, 0.0)
    lens = Lens(48, 32, 40.0, 40.0, 25.0, 16.0, project)
    pixels = rng.random((32, 48, 4)).astype(np.float32)
    pixels[..., 2] *= 0.5  # is clipped nowhere
    if opaque:
        pixels[..., 3] = 1
    focal = lens.camera(np.eye(4)).fl_x
    found, exact = _straightened(lens, pixels, focal, limit)
    wanted = lens.straightened(pixels, focal)
    assert np.array_equal(found, wanted)
    if limit is None:
        assert exact is None
        return
    clipped = lens.straightened((pixels[..., :3] >= limit).astype(np.float32), focal)
    between = (clipped > 0) & (wanted[..., :3] < np.float32(limit))
    assert np.array_equal(exact, ~between.any(2)) and exact.all() == (limit == 2)


def test_photographs_are_the_same_whether_read_alone_or_together(captured, meshes, tmp_path):
    write_nerfstudio(captured, tmp_path / "nerf")
    content = json.loads((tmp_path / "nerf" / "transforms.json").read_text())
    (tmp_path / "nerf" / "transforms.json").write_text(json.dumps(content | {"k1": 0.02}))
    told, files = [], []
    for at_once in (1, 3):
        with (
            patch("unbake.importing.progress.decoded_at_once", return_value=at_once),
            patch("unbake.importing.progress.EVERY", 0.0),
        ):
            out = tmp_path / f"data{at_once}"
            told.append(imported(tmp_path / "nerf", out, meshes)[1])
            found = (file for file in sorted(out.rglob("*")) if file.is_file())
            files.append({str(f.relative_to(out)): f.read_bytes() for f in found})
    assert files[0] == files[1] and told[0] == told[1]
    for what in ("read", "wrote"):
        assert [f"{what} {n} of 3 photographs" in told[0] for n in (1, 2, 3)] == [True, True, False]


def test_photographs_that_the_disk_has_no_room_for_are_refused_first(
    project, meshes, tmp_path, monkeypatch
):
    need = sum(file.stat().st_size for file in (project / "images").iterdir())
    monkeypatch.setattr(views, "free_disk", lambda folder: need)
    imported(project, tmp_path / "data", meshes)
    monkeypatch.setattr(views, "free_disk", lambda folder: need - 1)
    with pytest.raises(UserError, match=r"take about .* are free.*--longest 2048"):
        imported(project, tmp_path / "none", meshes)
    assert not (tmp_path / "none").exists()


def test_photographs_may_have_more_pixels_than_pillow_takes(project, meshes, tmp_path, monkeypatch):
    """Cameras of telephones have 200 million, and Pillow calls 179 million an attack."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    data, _ = imported(project, tmp_path / "data", meshes)
    assert len(data.views) == 3 and read_photograph(data.views[0]).shape == (16, 16, 4)
    assert Image.MAX_IMAGE_PIXELS == 100


def test_more_pixels_than_a_fit_can_have_are_told_before_anything_is_written(
    project, meshes, tmp_path, monkeypatch
):
    monkeypatch.setattr(importing, "MOST_PIXELS", 300)
    with pytest.raises(UserError, match="have 768 pixels, more than 300"):
        imported(project, tmp_path / "data", meshes)
    assert not (tmp_path / "data").exists()
    imported(project, tmp_path / "data", meshes, longest=8)
    monkeypatch.setattr(importing, "MOST_PIXELS", 1 << 32)
    monkeypatch.setattr(importing, "_MANY", 100)
    told = imported(project, tmp_path / "many", meshes)[1]
    assert any("a fit draws few" in line and "--longest 2048" in line for line in told)
    # Whoever followed that advice is not given it again.
    told = imported(project, tmp_path / "few", meshes, longest=8)[1]
    assert not any("a fit draws few" in line for line in told)
    monkeypatch.setattr(importing, "MOST_PIXELS", 30)
    with pytest.raises(UserError) as caught:
        imported(project, tmp_path / "more", meshes, longest=8)
    assert "Make them smaller with --longest 4" in str(caught.value)


# -------------------------------------------------------------------------------- alpha and colours


@pytest.mark.parametrize("background", ["auto", "visible", "hidden"])
def test_transparent_pixels_that_are_fitted_as_black_are_told(
    background, captured, project, meshes, tmp_path
):
    """One opaque photograph among cut-outs shows the background of all."""
    first, *others = sorted((project / "images").iterdir())
    for file in others:
        alpha = np.full((16, 16, 1), 255, np.uint8)
        alpha[:4] = 0
        save(np.concatenate([np.asarray(Image.open(file)), alpha], 2), file)
    settings, told = ImportSettings(background=background), []
    import_data(project, tmp_path / "data", meshes, settings, tell=told.append)
    names = ", ".join(file.name for file in others)
    wanted = f"black background: {names}, beside opaque ones ({first.name}). Give --background hid"
    assert any(wanted in line for line in told) == (background != "hidden")


def test_a_background_that_alpha_leaves_in_is_masked_by_the_mesh(captured, tmp_path):
    """Alpha cuts out a corner of one photograph alone, and the mesh is a small ball."""
    write_nerfstudio(captured, tmp_path / "nerf")
    first, second, third = sorted((tmp_path / "nerf" / "images").iterdir())
    clear = np.full((16, 16, 1), 255, np.uint8)
    clear[0, 0] = 0
    save(np.concatenate([np.asarray(Image.open(first)), clear], 2), first)
    ball = trimesh.creation.icosphere(2, 0.4)
    ball.export(tmp_path / "ball.ply")
    background = {"background": "hidden"}
    found, told = imported(
        tmp_path / "nerf", tmp_path / "data", [tmp_path / "ball.ply"], **background
    )
    assert all(view.mask_from_mesh for view in found.views)
    views = {view.name: read_masked(view)[1] for view in found.views}
    assert 0 < views[first.stem].mean() < 0.6
    line = "hidden, by the alpha of photographs (1 with transparent pixels) and where the mesh is "
    assert any(f"{line}not seen (2 photographs)" in each for each in told)
    assert any(f"which is masked as well: images/{first.name}" in line for line in told)
    # Cut out as the mesh is, alpha alone tells
    for file in (first, second, third):
        counted = views[file.stem].astype(np.uint8)[..., None] * 255
        save(np.concatenate([np.asarray(Image.open(file))[..., :3], counted], 2), file)
    found, told = imported(
        tmp_path / "nerf", tmp_path / "cut", [tmp_path / "ball.ply"], **background
    )
    assert not any(view.mask_from_mesh for view in found.views)
    wanted = "background: hidden, by the alpha of photographs (3 with transparent pixels)"
    assert wanted in told and not any("masked as well" in line for line in told)


def test_grey_photographs_among_others_are_told(project, meshes, tmp_path):
    first, *others = sorted((project / "images").iterdir())
    save(np.full((16, 16), 90, np.uint8), first)
    told = imported(project, tmp_path / "data", meshes)[1]
    assert any(f"takes their grey for the colour: {first.name}. Remove" in line for line in told)
    for file in others:
        save(np.full((16, 16), 90, np.uint8), file)
    told = imported(project, tmp_path / "grey", meshes)[1]
    assert not any("grey" in line for line in told), "all are grey"


# ---------------------------------------------------------------------------------- colour profiles


@pytest.mark.parametrize("suffix", [".png", ".tif", ".jpg"])
def test_profiles_are_read(suffix, tmp_path):
    file, p3 = tmp_path / f"a{suffix}", profile_of(P3, 2.2)
    Image.new("RGB", (4, 4)).save(file, icc_profile=p3)
    assert read_profile(file) == p3
    Image.new("RGB", (4, 4)).save(file, icc_profile=imagecodecs.cms_profile("srgb"))
    assert read_profile(file) is None, "that of sRGB changes nothing"
    Image.new("RGB", (4, 4)).save(file)
    assert read_profile(file) is None
    assert profile_name(p3)


def test_profiles_of_tiff_with_16_bits_are_read(tmp_path):
    file, p3 = tmp_path / "a.tif", profile_of(P3, 2.2)
    pixels = np.random.default_rng(0).integers(0, 1 << 16, (4, 4, 3), np.uint16)
    tifffile.imwrite(file, pixels, photometric="rgb", iccprofile=p3)
    assert read_profile(file) == p3


@pytest.mark.parametrize("deep", [False, True], ids=["8 bits", "16 bits"])
def test_colours_become_those_of_srgb(deep):
    colours = np.random.default_rng(0).random((1, 500, 3))
    most, kind = ((1 << 16) - 1, np.uint16) if deep else (255, np.uint8)
    read = np.round(most * colours).astype(kind)
    expected = ((read / most) ** 2.2) @ TO_SRGB.T
    assert linear_srgb(read, profile_of(P3, 2.2)) == pytest.approx(expected, abs=1.5e-3)


def test_photographs_with_a_profile_are_converted(captured, meshes, tmp_path):
    """What a camera wrote in Display P3 comes back as the light that it took."""
    folder, kept = tmp_path / "nerf", {}
    write_nerfstudio(captured, folder)
    for view in captured.views:
        linear = np.clip(read_photograph(view)[..., :3], 0, 0.8)
        wide = np.clip(linear @ np.linalg.inv(TO_SRGB).T, 0, 1)
        file = folder / "images" / f"{view.name}.png"
        stored = np.round(255 * wide ** (1 / 2.2)).astype(np.uint8)
        Image.fromarray(stored).save(file, icc_profile=profile_of(P3, 2.2))
        kept[view.name] = linear
    data, told = imported(folder, tmp_path / "data", meshes)
    assert any("converted to sRGB: 3" in line for line in told)
    assert not any("sRGB lacks" in line for line in told)
    for view in data.views:
        found = read_photograph(view)[..., :3]
        assert np.abs(to_srgb(found) - to_srgb(kept[view.name])).mean() < 3e-3
        assert view.clipped == pytest.approx(from_srgb(CLIPPED_CODE), abs=0.03)


def test_pixels_whose_colours_are_clipped_in_part_do_not_count(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    pixels = np.full((16, 16, 3), 100, np.uint8)
    pixels[:, :4], pixels[:, 4:8] = (255, 100, 100), 255
    for view in captured.views:
        file = folder / "images" / f"{view.name}.png"
        Image.fromarray(pixels).save(file, icc_profile=profile_of(P3, 2.2))
    data, _ = imported(folder, tmp_path / "data", meshes)
    for view in data.views:
        shown, counted = read_masked(view)
        assert not counted[:, :4].any() and counted[:, 4:].all()
        assert (shown[:, 4:8, :3] >= view.clipped).all()
        assert (shown[:, 8:, :3] < view.clipped).all()


def test_colours_that_srgb_lacks_are_told(captured, meshes, tmp_path):
    write_nerfstudio(captured, tmp_path / "nerf")
    name = captured.views[0].name
    vivid = np.full((16, 16, 3), (20, 230, 20), np.uint8)
    file = tmp_path / "nerf" / "images" / f"{name}.png"
    Image.fromarray(vivid).save(file, icc_profile=profile_of(P3, 2.2))
    _, told = imported(tmp_path / "nerf", tmp_path / "data", meshes)
    assert any("colours that sRGB lacks are cut off in" in line and name in line for line in told)


def test_adobe_rgb_is_told_by_exif_as_well(tmp_path):
    """Cameras write 'uncalibrated', and R03 in the directory of interoperability."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    Image.new("RGB", (4, 4)).save(tmp_path / "other.jpg", exif=exif)
    assert read_profile(tmp_path / "other.jpg") is None
    exif.get_ifd(0xA005)[1] = "R03"
    exif.get_ifd(0x8769)[0xA005] = dict(exif.get_ifd(0xA005))
    Image.new("RGB", (4, 4)).save(tmp_path / "adobe.jpg", exif=exif)
    profile = read_profile(tmp_path / "adobe.jpg")
    assert profile is not None and "Adobe" in profile_name(profile)


def test_photographs_of_srgb_are_copied_as_they_are(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    for view in captured.views:
        file = folder / "images" / f"{view.name}.png"
        Image.fromarray(codes(view)).save(file, icc_profile=imagecodecs.cms_profile("srgb"))
    data, told = imported(folder, tmp_path / "data", meshes)
    assert not any("profile" in line for line in told)
    for view in data.views:
        assert view.image.read_bytes() == (folder / "images" / f"{view.name}.png").read_bytes()


def test_a_damaged_profile_is_a_fault(captured, meshes, tmp_path):
    folder = tmp_path / "nerf"
    write_nerfstudio(captured, folder)
    damaged = profile_of(P3, 2.2)[:200]
    file = folder / "images" / f"{captured.views[0].name}.png"
    Image.fromarray(codes(captured.views[0])).save(file, icc_profile=damaged)
    with pytest.raises(ImportFaults, match="its colour profile cannot be used"):
        import_data(folder, tmp_path / "data", meshes, tell=quiet)


def test_tiff_with_16_bits_may_be_packed(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 1 << 16, (16, 16, 3), np.uint16)
    for packing in ("lzw", "deflate", None):
        file = tmp_path / f"{packing}.tif"
        tifffile.imwrite(file, pixels, photometric="rgb", compression=packing)
        assert np.array_equal(read_codes(file), pixels)
    tifffile.imwrite(
        tmp_path / "planes.tif",
        np.moveaxis(pixels, 2, 0),
        photometric="rgb",
        planarconfig="separate",
    )
    assert np.array_equal(read_codes(tmp_path / "planes.tif"), pixels)
    assert decode(pixels).shape == (16, 16, 4)


def test_no_profile_is_read_of_what_is_no_image(tmp_path):
    for name in ("a.png", "a.tif", "a.jpg"):
        (tmp_path / name).write_bytes(b"nothing")
        assert read_profile(tmp_path / name) is None
    with pytest.raises(UserError, match="cannot be read"):
        read_codes(tmp_path / "a.png")
