"""Imports: a captured data set written in the layout of another program comes back as it was."""

import json
import re
import shlex
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from layouts import (
    APERTURE,
    ISO,
    SECONDS,
    codes,
    intrinsics,
    photograph_through,
    quiet,
    same_as_captured,
    save,
    straightened_as_seen,
    write_blender,
    write_colmap,
    write_json,
    write_nerfstudio,
)
from PIL import Image
from support import TINY_FIT

from unbake.config import to_toml
from unbake.config.light import LightConfig
from unbake.dataset.photographs import Photographs
from unbake.dataset.views import Dataset, read_masked, read_photograph
from unbake.errors import UserError
from unbake.imaging.coded import encode
from unbake.imaging.pictures import write_exr
from unbake.importing.faults import ImportFaults
from unbake.importing.import_data import import_data
from unbake.importing.meshes import TO_Z_UP
from unbake.importing.settings import ImportSettings
from unbake.scene.edit import material_names
from unbake.scene.free_space import trace
from unbake.scene.parse import parse


@pytest.fixture
def nerfstudio(captured, tmp_path):
    """A folder with one `transforms.json`, whose cameras have been moved."""
    write_nerfstudio(captured, tmp_path / "nerfstudio")
    return tmp_path / "nerfstudio"


def change(folder, edit, name="transforms.json"):
    content = json.loads((folder / name).read_text())
    edit(content)
    (folder / name).write_text(json.dumps(content))


def test_nerfstudio_comes_back(captured, nerfstudio, meshes, tmp_path):
    out, told = tmp_path / "data", []
    import_data(nerfstudio, out, meshes, tell=told.append)
    found = same_as_captured(captured, out)
    assert found.background == "visible"
    assert "background: visible, pixels beside the mesh show the environment" in told
    assert told[0].endswith("2 training and 1 held-out views of 16 x 16 pixels")
    assert "before 'applied_transform'" in told[1]
    assert "100 % of the pixels see it" in told[-1]
    # Photographs are copies, and geometry is that of the meshes, part by part
    name = captured.views[0].name
    image = nerfstudio / "images" / f"{name}.png"
    assert (out / "images" / f"{name}.png").read_bytes() == image.read_bytes()
    parts = sorted(file.name for file in (out / "scene" / "meshes").iterdir())
    assert parts == [mesh.name for mesh in meshes]
    mine, theirs = (parse(file).instantiate() for file in (found.scene, captured.scene))
    assert np.allclose(np.ravel(mine.bbox().min), np.ravel(theirs.bbox().min), atol=1e-6)
    assert np.allclose(np.ravel(mine.bbox().max), np.ravel(theirs.bbox().max), atol=1e-6)
    assert mine.environment() is not None


def test_an_applied_transform_may_stay(captured, nerfstudio, meshes, tmp_path):
    settings = ImportSettings(keep_applied_transform=True, holdout=0)
    with pytest.raises(UserError, match="no photograph sees the mesh") as caught:
        import_data(nerfstudio, tmp_path / "data", meshes, settings, tell=quiet)
    assert "--keep-applied-transform" not in caught.value.remedy
    assert not (tmp_path / "data").exists()
    poses = [view.camera.to_world.tolist()[:3] for view in captured.views]

    def put_back(content):
        for frame, pose in zip(content["frames"], poses, strict=True):
            frame["transform_matrix"] = pose

    change(nerfstudio, put_back)
    with pytest.raises(UserError, match="no photograph sees the mesh") as caught:
        import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    assert "--keep-applied-transform" in caught.value.remedy
    import_data(nerfstudio, tmp_path / "data", meshes, settings, tell=quiet)
    same_as_captured(captured, tmp_path / "data")


def test_a_scale_that_was_applied_is_taken_back(captured, nerfstudio, meshes, tmp_path):
    def scale(content):
        content["applied_scale"] = 0.25
        for frame in content["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 0.25

    change(nerfstudio, scale)
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "data")


def test_blender_comes_back(captured, meshes, tmp_path):
    source = tmp_path / "blender"
    write_blender(captured, source)
    told = []
    import_data(source, tmp_path / "data", meshes, tell=told.append)
    found = same_as_captured(captured, tmp_path / "data")
    assert found.background == "hidden"
    assert any("transforms_val.json is left out" in line for line in told)


def test_an_alpha_of_1_everywhere_hides_no_background(captured, meshes, tmp_path):
    source, boxes = tmp_path / "blender", [m for m in meshes if m.stem in ("short", "tall")]
    write_blender(captured, source, least_alpha=255)
    import_data(source, tmp_path / "data", meshes, tell=quiet)
    assert Dataset.load(tmp_path / "data").background == "visible"
    import_data(source, tmp_path / "cut", boxes, ImportSettings(background="hidden"), tell=quiet)
    for view in Dataset.load(tmp_path / "cut").views:
        assert 0 < (read_photograph(view)[..., 3] > 0).mean() < 1


def test_a_transparent_colour_is_an_alpha(captured, nerfstudio, meshes, tmp_path):
    for view in captured.views:
        picture = codes(view)
        picture[0, 0] = (1, 2, 3)
        file = nerfstudio / "images" / f"{view.name}.png"
        Image.fromarray(picture).save(file, transparency=(1, 2, 3))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    found = Dataset.load(tmp_path / "data")
    assert found.background == "hidden"
    assert all(read_photograph(view)[0, 0, 3] == 0 for view in found.views)


def test_negative_pixels_are_told_and_taken_as_zero(captured, nerfstudio, meshes, tmp_path):
    view = captured.views[1]
    pixels = read_photograph(view)[..., :3]
    pixels[2, 3] = -0.01
    write_exr(nerfstudio / "images" / f"{view.name}.exr", pixels)
    change(nerfstudio, set_frame("file_path", f"images/{view.name}.exr"))
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    assert f"negative pixels, taken as zero: images/{view.name}.exr" in told[-1]
    found = read_photograph(Dataset.load(tmp_path / "data").views[1])
    assert np.allclose(found[..., :3], np.maximum(pixels, 0), rtol=1e-3)


def test_images_of_another_folder_are_found_by_the_end_of_their_names(
    captured, nerfstudio, meshes, tmp_path
):
    (nerfstudio / "images").rename(tmp_path / "elsewhere")
    import_data(nerfstudio, tmp_path / "data", meshes, images=tmp_path / "elsewhere", tell=quiet)
    same_as_captured(captured, tmp_path / "data")


def test_the_present_folder_may_be_filled(captured, nerfstudio, meshes, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    import_data(nerfstudio, ".", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "here")
    assert {path.name for path in Path().iterdir()} == {"images", "scene", "transforms.json"}


def test_names_that_no_terminal_shows_become_ones_that_do(captured, nerfstudio, meshes, tmp_path):
    name = captured.views[1].name
    image = nerfstudio / "images" / f"{name}.png"
    image.rename(image.with_name("a\x07b.png"))
    change(nerfstudio, set_frame("file_path", "images/a\x07b.png"))
    change(nerfstudio, set_top("train_filenames", None))
    change(nerfstudio, set_top("test_filenames", None))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    assert {view.name for view in Dataset.load(tmp_path / "data").views} > {"a_b"}


@pytest.mark.parametrize("frames", ["without images", "none"])
def test_cameras_of_blender_without_pictures_are_left_out(frames, captured, meshes, tmp_path):
    """As the add-on writes them for tests, and all names as it writes them on Windows."""
    source = tmp_path / "blender"
    write_blender(captured, source)
    for file in source.glob("transforms_*.json"):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].removeprefix("./").replace("/", "\\") + ".png"
        if file.name != "transforms_train.json" and frames == "none":
            content["frames"] = []
        file.write_text(json.dumps(content))
    shutil.rmtree(source / "test")
    shutil.rmtree(source / "val")
    told = []
    settings = ImportSettings(holdout=2)
    import_data(source, tmp_path / "data", meshes, settings, tell=told.append)
    assert sum("is left out: its cameras have no pictures" in line for line in told) == 2
    found = Dataset.load(tmp_path / "data")
    # What is held out is chosen as where nothing is said of it
    assert (len(found.train), len(found.heldout)) == (1, 1)


def test_names_that_are_equal_when_joined_are_told(captured, meshes, tmp_path):
    source, frames = tmp_path / "source", []
    for name, view in zip(("a_b/c", "a/b_c", "c"), captured.views, strict=True):
        save(codes(view), source / f"{name}.png")
        pose = view.camera.to_world.tolist()
        frames.append({"file_path": f"{name}.png", "transform_matrix": pose})
    frames[2]["file_path"] = "a/c.png"
    (source / "c.png").rename(source / "a" / "c.png")
    top = intrinsics(captured.views[0].camera)
    write_json(source / "transforms.json", top | {"frames": frames})
    told = "has the name of a_b/c.png once folders are joined by _: a/b_c.png"
    with pytest.raises(ImportFaults, match=told):
        import_data(source, tmp_path / "data", meshes, tell=quiet)


def test_names_in_two_folders_are_kept_apart(captured, meshes, tmp_path):
    source = tmp_path / "blender"
    for short in ("train", "test"):
        view = captured.views[0]
        save(codes(view), source / short / "r_0.png")
        frame = {"file_path": f"{short}/r_0", "transform_matrix": view.camera.to_world.tolist()}
        content = intrinsics(view.camera) | {"frames": [frame]}
        write_json(source / f"transforms_{short}.json", content)
    import_data(source, tmp_path / "data", meshes, tell=quiet)
    names = {(view.name, view.split) for view in Dataset.load(tmp_path / "data").views}
    assert names == {("train_r_0", "train"), ("test_r_0", "heldout")}


def saved_frames(captured, source, names):
    """Save the photographs of a data set by these names; returns their frames, with their poses."""
    frames = []
    for name, view in zip(names, captured.views, strict=True):
        save(codes(view), source / "images" / f"{name}.png")
        pose = view.camera.to_world.tolist()
        frames.append({"file_path": f"images/{name}.png", "transform_matrix": pose})
    return frames


def test_lists_tell_images_of_one_name_apart(captured, meshes, tmp_path):
    source = tmp_path / "source"
    frames = saved_frames(captured, source, ("a/001", "b/001", "b/002"))
    # As the frames name them, and from another folder
    lists = {
        "train_filenames": ["./images/a/001.png", "b/002.png"],
        "val_filenames": ["images/b/001.png"],
    }
    top = intrinsics(captured.views[0].camera) | lists | {"frames": frames}
    write_json(source / "transforms.json", top)
    import_data(source, tmp_path / "data", meshes, tell=quiet)
    splits = [view.split for view in Dataset.load(tmp_path / "data").views]
    assert splits == ["train", "heldout", "train"]


def test_every_eighth_view_is_held_out(captured, nerfstudio, meshes, tmp_path):
    def without_lists(content):
        del content["train_filenames"], content["test_filenames"]

    change(nerfstudio, without_lists)
    import_data(nerfstudio, tmp_path / "a", meshes, ImportSettings(holdout=2), tell=quiet)
    import_data(nerfstudio, tmp_path / "b", meshes, ImportSettings(holdout=0), tell=quiet)
    names = sorted(view.name for view in captured.views)
    held = {view.name for view in Dataset.load(tmp_path / "a").heldout}
    assert held == set(names[::2])
    assert Dataset.load(tmp_path / "b").heldout == ()


def test_photographs_of_one_pose_are_held_out_together(captured, meshes, tmp_path):
    """As those of a bracket; where all have one pose, none is."""
    source, frames = tmp_path / "source", []
    rng = np.random.default_rng(0)
    for view in captured.views:
        for end in "abc":
            save(codes(view), source / "images" / f"{view.name}-{end}.png")
            pose = view.camera.to_world + np.pad(rng.normal(0, 1e-10, (3, 4)), ((0, 1), (0, 0)))
            frame = {"file_path": f"images/{view.name}-{end}.png"}
            frames.append(frame | {"transform_matrix": pose.tolist()})
    top = intrinsics(captured.views[0].camera)
    write_json(source / "transforms.json", top | {"frames": frames})
    settings = ImportSettings(holdout=2)
    import_data(source, tmp_path / "data", meshes, settings, tell=quiet)
    names = sorted(view.name for view in captured.views)
    held = {view.name for view in Dataset.load(tmp_path / "data").heldout}
    assert held == {f"{name}-{end}" for name in names[::2] for end in "abc"}
    write_json(source / "transforms.json", top | {"frames": frames[:3]})
    import_data(source, tmp_path / "one", meshes, settings, tell=quiet)
    assert len(Dataset.load(tmp_path / "one").train) == 3


# ------------------------------------------------------------------------------------- photographs


def test_a_part_of_a_picture_is_a_fault(captured, nerfstudio, meshes, tmp_path):
    """Focal length and centre of its camera are those of the whole, as of a render region."""
    file = nerfstudio / "images" / "part.exr"
    write_exr(file, read_photograph(captured.views[1])[..., :3])
    change(nerfstudio, without_lists)
    change(nerfstudio, set_frame("file_path", "images/part.exr"))
    import_data(nerfstudio, tmp_path / "whole", meshes, tell=quiet)
    window = b"displayWindow\0box2i\0" + struct.pack("<i", 16)
    head, rest = file.read_bytes().split(window)
    file.write_bytes(head + window + struct.pack("<4i", 0, 0, 31, 31) + rest[16:])
    what = "not the whole picture: its data window is not its display window: images/part.exr"
    with pytest.raises(ImportFaults, match=what):
        import_data(nerfstudio, tmp_path / "part", meshes, tell=quiet)


def test_masked_pixels_are_neither_drawn_nor_scored(captured, nerfstudio, meshes, tmp_path):
    def add_masks(content):
        for number, frame in enumerate(content["frames"][:2]):
            frame["mask_path"] = f"masks/{number}.png"

    first = np.zeros((16, 16), np.uint8)
    first[:, 4:] = 255
    second = np.full((16, 16, 3), 255, np.uint8)
    second[:3] = 0
    save(first, nerfstudio / "masks" / "0.png")
    save(second, nerfstudio / "masks" / "1.png")
    change(nerfstudio, add_masks)
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    assert "2 with masks" in told[0]
    found = Dataset.load(tmp_path / "data")
    kept = [first > 0, second[..., 0] > 0, np.ones((16, 16), bool)]
    for view, counted in zip(found.views, kept, strict=True):
        assert np.array_equal(read_photograph(view)[..., 3] > 0, counted)
    photographs = Photographs.load(found, False)
    train = [mask for view, mask in zip(found.views, kept, strict=True) if view.split == "train"]
    assert np.array_equal(photographs.chosen, np.flatnonzero(np.concatenate(train)))
    assert photographs.mean == pytest.approx(photographs.table[photographs.chosen, :3].mean())


def test_a_hidden_background_leaves_the_pixels_of_the_mesh(captured, nerfstudio, meshes, tmp_path):
    boxes = [mesh for mesh in meshes if mesh.stem in ("short", "tall")]
    save(np.zeros((16, 16), np.uint8), nerfstudio / "masks" / "0.png")
    change(nerfstudio, set_frame("mask_path", "masks/0.png"))
    settings = ImportSettings(background="hidden")
    import_data(nerfstudio, tmp_path / "data", boxes, settings, tell=quiet)
    found = Dataset.load(tmp_path / "data")
    assert found.background == "hidden"
    scene = parse(found.scene).instantiate()
    for number, view in enumerate(found.views):
        y, x = np.divmod(np.arange(256), 16)
        origins, directions = view.camera.rays(x + 0.5, y + 0.5)
        seen = np.isfinite(trace(scene, origins, directions).distance).reshape(16, 16)
        counted = read_photograph(view)[..., 3] > 0
        assert not (counted & ~seen).any() and 0 < seen.mean() < 1
        # Pixels of an edge see both, and the second frame is masked as a whole
        inner = seen.copy()
        for axis in (0, 1):
            inner &= np.roll(seen, 1, axis) & np.roll(seen, -1, axis)
        assert not counted.any() if number == 1 else (counted.sum() >= 0.8 * inner.sum() > 0)
        assert view.mask_from_mesh


def test_all_views_have_a_mask_where_one_has(nerfstudio, meshes, tmp_path):
    save(np.zeros((16, 16), np.uint8), nerfstudio / "masks" / "0.png")
    change(nerfstudio, set_frame("mask_path", "masks/0.png"))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    shown = [read_photograph(view)[..., 3] for view in Dataset.load(tmp_path / "data").views]
    assert [alpha.all() for alpha in shown] == [True, False, True]


def with_exif(folder, captured, tags):
    """Write the photographs as JPEG, with EXIF each."""
    for view, exif in zip(captured.views, tags, strict=True):
        (folder / "images" / f"{view.name}.png").unlink()
        save(codes(view), folder / "images" / f"{view.name}.jpg", exif)

    def rename(content):
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].replace(".png", ".jpg")

    change(folder, rename)


def frames_of(out):
    return json.loads((out / "transforms.json").read_text())["frames"]


def test_exposures_come_from_exif(captured, nerfstudio, meshes, tmp_path):
    values = ((0.01, 100, 2), (0.04, 50, 2), (0.01, 400, 4))
    tags = [dict(zip((SECONDS, ISO, APERTURE), row, strict=True)) for row in values]
    with_exif(nerfstudio, captured, tags)
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    found = np.array([frame["exposure"] for frame in frames_of(tmp_path / "data")])
    absolute = np.array([t[SECONDS] * t[ISO] / 100 / t[APERTURE] ** 2 for t in tags])
    assert np.allclose(found / found[0], absolute / absolute[0], rtol=1e-4)
    assert np.prod(found) == pytest.approx(1)
    assert any("1.0 stops apart), by EXIF" in line for line in told)
    limit = pytest.approx(((250 / 255 + 0.055) / 1.055) ** 2.4, abs=1e-6)
    assert [frame["clipped"] for frame in frames_of(tmp_path / "data")] == [limit] * 3


def test_radiance_is_not_clipped_where_other_photographs_have_codes(
    captured, nerfstudio, meshes, tmp_path
):
    name = captured.views[1].name
    shutil.copyfile(captured.views[1].image, nerfstudio / "images" / f"{name}.exr")
    change(nerfstudio, set_frame("file_path", f"images/{name}.exr"))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    views = Dataset.load(tmp_path / "data").views
    assert [view.encoding for view in views] == ["srgb", "linear", "srgb"]
    assert [view.clipped is None for view in views] == [False, True, False]


@pytest.mark.parametrize(
    ("tags", "line"),
    [
        ([{SECONDS: 0.01, ISO: 100}] * 2 + [{}], "2 of 3 tell time and ISO in EXIF"),
        (
            [{SECONDS: 0.01, ISO: 100, APERTURE: 2.0}] * 2 + [{SECONDS: 0.02, ISO: 100}],
            "2 of 3 tell an f-number in EXIF",
        ),
        ([{SECONDS: 0.01, ISO: 100}] * 3, "the same in all photographs, by EXIF"),
    ],
)
def test_exif_that_some_lack_is_told_and_not_used(
    tags, line, captured, nerfstudio, meshes, tmp_path
):
    with_exif(nerfstudio, captured, tags)
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    assert any(line in text for text in told)
    assert not any(text.startswith("warning") for text in told)
    assert not any("exposure" in frame for frame in frames_of(tmp_path / "data"))


@pytest.mark.parametrize("lacks", [{}, {SECONDS: 0.01, ISO: 100, APERTURE: 0.0}])
def test_exposures_that_one_photograph_takes_away_are_warned_of(
    lacks, captured, nerfstudio, meshes, tmp_path
):
    known = [{SECONDS: seconds, ISO: 100, APERTURE: 2.0} for seconds in (0.01, 0.04)]
    with_exif(nerfstudio, captured, [*known, lacks])
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    (line,) = (text for text in told if text.startswith("warning: exposures: 2 of 3 tell "))
    assert f"in EXIF, but not images/{captured.views[2].name}.jpg; all are taken" in line
    assert "although some are 2.0 stops apart. Give a table with --exposures table.csv" in line
    assert line.endswith("or fit with --exposures per-image")
    assert not any("exposure" in frame for frame in frames_of(tmp_path / "data"))


def test_exposures_come_from_a_table(captured, nerfstudio, meshes, tmp_path):
    table = tmp_path / "exposures.csv"
    names = [view.name for view in captured.views]
    lines = "name,exposure\n" + "".join(f"{n},{i + 1}\n" for i, n in enumerate(names))
    table.write_text(lines, encoding="utf-8-sig")  # as Excel does
    import_data(nerfstudio, tmp_path / "data", meshes, exposures=table, tell=quiet)
    assert [frame["exposure"] for frame in frames_of(tmp_path / "data")] == [1, 2, 3]
    table.write_text(f"name,exposure\n{names[0]},-1\n{names[1]},2\n\n,\n")
    with pytest.raises(ImportFaults) as caught:
        import_data(nerfstudio, tmp_path / "other", meshes, exposures=table, tell=quiet)
    assert caught.value.faults == (
        "a line of the table exposures.csv is no name and positive number: line 2. "
        "Write numbers as 0.5 or 1/60",
        f"the table exposures.csv has no line for a photograph: images/{names[2]}.png",
    )


@pytest.mark.parametrize("first", ["0,5", "0.5", "1/2", "1/2,0", " 0,5 "])
def test_a_table_of_exposures_may_have_semicolons_and_fractions(
    first, captured, nerfstudio, meshes, tmp_path
):
    table = tmp_path / "exposures.csv"
    one, two, three = (view.name for view in captured.views)
    lines = f"name;exposure\r\n{one};{first}\r\n{two}.png;1/4\r\n{three};2\r\n;\r\n"
    table.write_text(lines, encoding="utf-8-sig")
    import_data(nerfstudio, tmp_path / "data", meshes, exposures=table, tell=quiet)
    assert [frame["exposure"] for frame in frames_of(tmp_path / "data")] == [0.5, 0.25, 2]


@pytest.mark.parametrize("value", ["1/0", "1/2/3", "1/", "/2", "a", "inf/inf", "0/1", "0,5"])
def test_what_is_no_number_is_told_once(value, captured, nerfstudio, meshes, tmp_path):
    table = tmp_path / "exposures.csv"
    table.write_text("name,exposure\n" + "".join(f"{v.name},{value}\n" for v in captured.views))
    with pytest.raises(ImportFaults) as caught:
        import_data(nerfstudio, tmp_path / "data", meshes, exposures=table, tell=quiet)
    (fault,) = caught.value.faults
    assert "exposures.csv is no name and positive number: line 2, line 3, line 4. " in fault


def test_a_table_of_exposures_names_folders(captured, meshes, tmp_path):
    source = tmp_path / "source"
    frames = saved_frames(captured, source, ("cam1/0001", "cam2/0001", "cam2/0002"))
    top = intrinsics(captured.views[0].camera)
    write_json(source / "transforms.json", top | {"frames": frames})
    table = tmp_path / "exposures.csv"
    table.write_text("name,exposure\ncam1/0001,1\nimages/cam2/0001.png,2\n0002,3\n")
    import_data(source, tmp_path / "data", meshes, exposures=table, tell=quiet)
    assert [frame["exposure"] for frame in frames_of(tmp_path / "data")] == [1, 2, 3]
    table.write_text("name,exposure\n0001,1\n0002,3\n")
    told = "'0001', for several photographs: images/cam1/0001.png, images/cam2/0001.png. Name"
    with pytest.raises(ImportFaults, match=told):
        import_data(source, tmp_path / "other", meshes, exposures=table, tell=quiet)


@pytest.mark.parametrize(
    "keys",
    [
        {"camera_model": "OPENCV", "k1": -0.2, "k2": 0.05, "p1": 0.003, "p2": -0.002},
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01, "k3": 0.0, "k4": 0.0},
        {"is_fisheye": True, "k1": 0.02, "k2": -0.01},
        {"camera_model": "PINHOLE", "fl_y": 90.0},
        {"camera_model": "PINHOLE", "k1": -0.2, "k2": 0.05},
    ],
    ids=["opencv", "fisheye", "instant-ngp", "oblong pixels", "pinhole by name alone"],
)
@pytest.mark.parametrize("suffix", [".png", ".exr"])
def test_lenses_are_straightened(keys, suffix, captured, meshes, tmp_path):
    from unbake.importing.frames import _lens

    top = {"w": 96, "h": 64, "fl_x": 80.0, "fl_y": 81.0, "cx": 45.0, "cy": 33.0} | keys
    lens = _lens(top, 96, 64, "here")
    photograph = photograph_through(lens)
    source = tmp_path / "source"
    file = source / "images" / f"a{suffix}"
    file.parent.mkdir(parents=True)
    if suffix == ".exr":
        write_exr(file, photograph)
    else:
        save(np.round(encode(photograph) / 257).astype(np.uint8), file)
    pose = captured.views[0].camera.to_world.tolist()
    frame = {"file_path": f"images/a{suffix}", "transform_matrix": pose}
    write_json(source / "transforms.json", top | {"frames": [frame]})
    told = []
    import_data(source, tmp_path / "data", meshes, tell=told.append)
    assert "1 undistorted" in told[0]
    (view,) = Dataset.load(tmp_path / "data").views
    assert view.camera.fl_x == view.camera.fl_y
    straightened_as_seen(view, lens, 0.002 if suffix == ".exr" else 0.006)


def bent(folder, captured, keys):
    """A source of one grey photograph of 96 x 64 pixels, whose lens has these keys."""
    save(np.full((64, 96, 3), 60, np.uint8), folder / "images" / "a.png")
    frame = {"transform_matrix": captured.views[0].camera.to_world.tolist()}
    frames = [frame | {"file_path": "images/a.png"}]
    top = {"w": 96, "h": 64, "fl_x": 80.0} | keys
    write_json(folder / "transforms.json", top | {"frames": frames})
    return folder


def test_places_beyond_a_photograph_are_masked(captured, meshes, tmp_path):
    """As of a crop, whose principal point lies outside."""
    from unbake.importing.frames import _lens

    source = bent(
        tmp_path / "source", captured, {"cx": -20.0, "cy": 32.0, "fl_x": 100.0, "k1": 0.3}
    )
    told = []
    import_data(source, tmp_path / "data", meshes, tell=told.append)
    assert any("what lies beyond it is masked (images/a.png)" in line for line in told)
    (view,) = Dataset.load(tmp_path / "data").views
    counted, keys = read_masked(view)[1], json.loads((source / "transforms.json").read_text())
    y, x = np.divmod(np.arange(96 * 64), 96)
    points = (np.stack([x + 0.5, y + 0.5], 1) - (-20, 32)) / view.camera.fl_x
    at = _lens(keys, 96, 64, "here").pixels(points)
    inside = ((at >= 0) & (at <= (96, 64))).all(1)
    assert np.array_equal(counted.ravel(), inside) and 0.5 < inside.mean() < 1


@pytest.mark.parametrize(
    ("keys", "fault"),
    [
        ({"cx": -90.0, "k1": -0.3}, "its lens cannot be straightened"),
        ({"fl_x": 1.0, "k1": 0.1}, "its focal length of 1 pixels is too short"),
    ],
)
def test_a_lens_that_no_pinhole_stands_for_is_a_fault(keys, fault, captured, meshes, tmp_path):
    source = bent(tmp_path / "source", captured, keys)
    with pytest.raises(ImportFaults, match=fault):
        import_data(source, tmp_path / "data", meshes, tell=quiet)


def test_fisheye_lenses_are_cut_off(captured, meshes, tmp_path):
    keys = {"fl_x": 20.0, "camera_model": "OPENCV_FISHEYE"}
    told = []
    source = bent(tmp_path / "source", captured, keys)
    import_data(source, tmp_path / "data", meshes, tell=told.append)
    assert any(
        "more than 120 degrees: what lies beyond is cut off (images/a.png)" in x for x in told
    )
    (view,) = Dataset.load(tmp_path / "data").views
    assert 118 < np.degrees(2 * np.arctan(48 / view.camera.fl_x)) <= 120


def test_pixels_between_clipped_and_other_ones_do_not_count(captured, meshes, tmp_path):
    top = {"w": 96, "h": 64, "fl_x": 80.0, "fl_y": 80.0, "cx": 48.0, "cy": 32.0, "k1": -0.2}
    photograph = np.full((64, 96, 3), 60, np.uint8)
    photograph[20:44, 30:60] = 252
    save(photograph, tmp_path / "source" / "images" / "a.png")
    save(np.full((64, 96), 255, np.uint8), tmp_path / "source" / "images" / "b.png")
    pose = captured.views[0].camera.to_world.tolist()
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": pose} for n in ("a", "b")]
    write_json(tmp_path / "source" / "transforms.json", top | {"frames": frames})
    import_data(tmp_path / "source", tmp_path / "data", meshes, tell=quiet)
    one, other = Dataset.load(tmp_path / "data").views
    pixels = read_photograph(one)
    counted, values = pixels[..., 3] > 0, pixels[..., :3]
    dark = np.isclose(values, ((60 / 255 + 0.055) / 1.055) ** 2.4, atol=1e-4).all(2)
    clipped = (values >= one.clipped).all(2)
    assert np.array_equal(counted, dark | clipped)
    assert clipped.sum() > 500 and 50 < (~counted).sum() < 300
    # One that is clipped as a whole stays so, and has a mask as its neighbours have
    pixels = read_photograph(other)
    assert other.mask is not None and (pixels[..., 3] > 0).all()
    assert (pixels[..., :3] >= other.clipped).all()


# -------------------------------------------------------------------------------------------- light


def test_light_that_nobody_gave_is_unknown(nerfstudio, meshes, tmp_path, unbake):
    data = tmp_path / "data"
    given = [word for mesh in meshes for word in ("--mesh", mesh)]
    outcome = unbake("import", nerfstudio, *given, "--out", data)
    assert outcome.out.rstrip().endswith(f"next: unbake data check {data}")
    assert Dataset.load(data).light == "unknown"
    assert f"next: unbake fit {data} --out RUN" in unbake("data", "check", data).out


def test_a_room_without_lights_is_told(nerfstudio, meshes, tmp_path):
    walls, told, line = tmp_path / "walls.ply", [], "all cameras stand inside the mesh"
    trimesh.creation.box(extents=(1000, 1000, 1000)).export(walls)
    import_data(nerfstudio, tmp_path / "open", meshes, tell=told.append)
    assert not any(line in text for text in told)
    import_data(nerfstudio, tmp_path / "closed", [*meshes, walls], tell=told.append)
    assert line in told[-1] and "--lights FILE" in told[-1]
    lamp = tmp_path / "lamp.xml"
    lamp.write_text("<scene version='3.0.0'><emitter type='point'/></scene>")
    told.clear()
    light = LightConfig(lights=lamp)
    import_data(nerfstudio, tmp_path / "lit", [*meshes, walls], light=light, tell=told.append)
    assert told and not any(line in text for text in told)


def test_known_lights_take_the_place_of_the_unknown_environment(
    nerfstudio, meshes, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    lights = tmp_path / "lights.xml"
    lights.write_text(
        "<scene version='3.0.0'><emitter type='point'><point name='position' value='0, 0, 0.5'/>"
        "<rgb name='intensity' value='3'/></emitter></scene>"
    )
    light = LightConfig(lights=lights)
    import_data(nerfstudio, "data", meshes, light=light, tell=quiet)
    dataset = Dataset.load("data")
    assert dataset.light == "known"
    scene = parse(dataset.scene).instantiate()
    assert scene.environment() is None and len(scene.emitters()) == 1
    assert len(list(Path("data/scene/meshes").iterdir())) == len(meshes)
    lights.write_text("<scene version='3.0.0'>")
    with pytest.raises(ImportFaults, match="not a scene that Mitsuba can read"):
        import_data(nerfstudio, "other", [tmp_path / "none.ply"], light=light, tell=quiet)


def test_a_sky_that_lies_on_its_side_is_told(nerfstudio, meshes, tmp_path):
    told = []
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    for axis in ("+y", "+z"):
        light = LightConfig(envmap=tmp_path / "sky.exr", envmap_up=axis)
        import_data(nerfstudio, tmp_path / axis, meshes, light=light, tell=told.append)
    (line,) = [line for line in told if "the map's first row" in line]
    assert "lies at +y, while the cameras' up is +z: --envmap-up +z turns it" in line


# ------------------------------------------------------------------------------------------- faults


def test_all_faults_are_told_at_once(nerfstudio, meshes, tmp_path, unbake):
    names = sorted(file.name for file in (nerfstudio / "images").iterdir())
    (nerfstudio / "images" / names[0]).unlink()
    (nerfstudio / "images" / names[1]).write_bytes(
        (nerfstudio / "images" / names[1]).read_bytes()[:90]
    )

    def damage(content):
        del content["frames"][2]["transform_matrix"]
        content["frames"][2]["mask_path"] = "masks/none.png"

    change(nerfstudio, damage)
    broken = tmp_path / "broken.glb"
    broken.write_bytes(b"glTF")
    out = tmp_path / "data"
    outcome = unbake(
        "import", nerfstudio, "--mesh", meshes[0], "--mesh", broken, "--out", out,
        "--exposures", tmp_path / "none.csv",
    )  # fmt: skip
    assert outcome.status == 2 and not out.exists()
    *faults, last = outcome.err.splitlines()
    assert last.endswith("6 faults, listed above. Correct them and import again")
    told = "\n".join(faults)
    for part in ("the image does not exist", "the image cannot be read (", "truncated",
                 "the key 'transform_matrix' is missing", "none.csv", "broken.glb",
                 "masks/none.png"):  # fmt: skip
        assert part in told, told


def test_equal_faults_are_one_line(nerfstudio, meshes, tmp_path):
    shutil.rmtree(nerfstudio / "images")
    with pytest.raises(ImportFaults) as caught:
        import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    (fault,) = caught.value.faults
    assert fault.startswith("the image does not exist: ./images/") and fault.count(".png") == 3


def set_top(key, value):
    return lambda content: content.__setitem__(key, value)


def without_lists(content):
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        content.pop(key, None)


def all_held_out(content):
    without_lists(content)
    for frame in content["frames"]:
        frame["split"] = "test"


def set_frame(key, value):
    return lambda content: content["frames"][1].__setitem__(key, value)


@pytest.mark.parametrize(
    ("edit", "fault"),
    [
        (set_top("frames", 3), "'frames' is not a list of frames"),
        (set_top("camera_model", "EQUIRECTANGULAR"), "unknown camera_model 'EQUIRECTANGULAR'"),
        (set_top("k4", 0.1), "the lens has k4, k5 or k6"),
        (set_frame("file_path", "/etc/a.png"), "lies outside the source.*--allow-outside"),
        (set_top("w", 32), "its camera is for 32 x 16 pixels, it has 16 x 16"),
        (set_top("applied_transform", [1]), "'applied_transform' is not an array of 3 x 4"),
        (set_top("applied_transform", (2 * np.eye(4)).tolist()), "'applied_transform' is no rota"),
        (set_top("scene", "scene.xml"), "the folder is a data set already"),
        (set_frame("transform_matrix", np.diag([-1.0, 1, 1, 1]).tolist()), "left-handed"),
        (set_frame("file_path", "../secret.png"), "lies outside the source"),
        (set_frame("file_path", "images/train_000.png"), "two poses: images/train_000.png"),
        (set_frame("split", "holdout"), "unknown split 'holdout'.* There are train, heldout, test"),
        (set_frame("split", ["train"]), "unknown split"),
        (set_top("train_filenames", 5), "'train_filenames' is not a list of names"),
        (lambda c: c["frames"].__setitem__(0, 7), "the frame is not an object"),
        (lambda c: c.pop("fl_x"), "the key 'fl_x' is missing"),
        (all_held_out, "no photograph is left to train on"),
        (set_frame("file_path", "."), "the image"),
        (set_top("train_filenames", [""]), "'train_filenames' is not a list of names"),
    ],
)
def test_a_wrong_entry_is_a_fault(edit, fault, nerfstudio, meshes, tmp_path):
    change(nerfstudio, edit)
    with pytest.raises(ImportFaults, match=fault):
        import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    assert not (tmp_path / "data").exists()


def test_both_of_what_was_applied_are_told(nerfstudio, meshes, tmp_path):
    change(nerfstudio, lambda c: c.update(applied_transform="x", applied_scale=0))
    with pytest.raises(ImportFaults) as caught:
        import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    assert ["applied_transform" in fault for fault in caught.value.faults] == [True, False]
    assert "'applied_scale' is not positive" in caught.value.faults[1]


@pytest.mark.parametrize("split", ["test", "val", "eval", "heldout"])
def test_a_split_of_a_frame_decides_what_is_held_out(split, nerfstudio, meshes, tmp_path):
    def mark(content):
        for key in ("train_filenames", "val_filenames", "test_filenames"):
            content.pop(key, None)
        for frame in content["frames"]:
            frame["split"] = "train"
        content["frames"][1]["split"] = split

    change(nerfstudio, mark)
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    held = [view.name for view in Dataset.load(tmp_path / "data").heldout]
    assert held == [Path(json.loads((nerfstudio / "transforms.json").read_text())
                         ["frames"][1]["file_path"]).stem]  # fmt: skip


def test_frames_in_no_list_of_splits_are_left_out(captured, nerfstudio, meshes, tmp_path):
    """As nerfstudio does, and only where a list of those to train on names any."""
    names = [f"images/{view.name}.png" for view in captured.views]
    lists = {"train_filenames": names[:1], "test_filenames": names[1:2]}
    change(nerfstudio, lambda content: content.update(lists))
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    assert [view.name for view in Dataset.load(tmp_path / "data").views] == [
        view.name for view in captured.views[:2]
    ]
    assert f"frames in no list of splits are left out: {names[2]}" in told
    # Where images are of another format by now, names match without their suffix
    lists = {"train_filenames": [name.replace(".png", ".jpg") for name in names]}
    change(nerfstudio, lambda content: content.update(lists | {"test_filenames": []}))
    import_data(nerfstudio, tmp_path / "other", meshes, tell=quiet)
    assert len(Dataset.load(tmp_path / "other").train) == 3


def test_names_in_lists_of_splits_that_are_of_no_frame_are_told(nerfstudio, meshes, tmp_path):
    change(nerfstudio, set_top("test_filenames", ["images/none.png", "images/train_000.png"]))
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    assert any(line.endswith("name images that no frame has: images/none.png") for line in told)


def test_lists_of_splits_may_be_of_windows(captured, nerfstudio, meshes, tmp_path):
    names = [f"images\\{view.name}.png" for view in captured.views]
    lists = {"train_filenames": names[1:], "test_filenames": names[:1]}
    change(nerfstudio, lambda content: content.update(lists))
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    (held,) = Dataset.load(tmp_path / "data").heldout
    assert held.name == captured.views[0].name and not any("lists of splits" in x for x in told)


def test_radiance_comes_before_code_values_where_names_have_no_suffix(captured, meshes, tmp_path):
    source = tmp_path / "blender"
    write_blender(captured, source)
    for file in sorted(source.rglob("*.png")):
        write_exr(file.with_suffix(".exr"), np.full((16, 16, 3), 3.0, np.float32))
    import_data(source, tmp_path / "data", meshes, tell=quiet)
    for view in Dataset.load(tmp_path / "data").views:
        assert view.encoding == "linear" and read_photograph(view)[..., 0].max() == 3


def test_one_file_is_no_two_photographs(captured, nerfstudio, meshes, tmp_path):
    """The end of a name may mean a file of another folder."""
    images = tmp_path / "flat"
    shutil.copytree(nerfstudio / "images", images)
    first = captured.views[0].name
    change(nerfstudio, without_lists)
    change(nerfstudio, set_frame("file_path", f"other/{first}.png"))
    with pytest.raises(ImportFaults, match=f"is the file of .*{first}.png, too: other/{first}.png"):
        import_data(nerfstudio, tmp_path / "data", meshes, images=images, tell=quiet)


def test_links_do_not_lead_out_where_names_have_no_suffix(nerfstudio, meshes, tmp_path):
    secret = tmp_path / "secret.png"
    save(np.zeros((16, 16, 3), np.uint8), secret)
    (nerfstudio / "images" / "linked.png").symlink_to(secret)
    change(nerfstudio, set_frame("file_path", "images/linked"))
    with pytest.raises(ImportFaults, match=r"lies outside the source.*--allow-outside"):
        import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    import_data(nerfstudio, tmp_path / "data", meshes, allow_outside=True, tell=quiet)


def test_names_with_a_dot_may_lack_their_suffix(captured, meshes, tmp_path):
    source = tmp_path / "blender"
    write_blender(captured, source)
    names = {}
    for file in source.glob("transforms_*.json"):
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            old = source / f"{frame['file_path']}.png"
            new = old.with_name(f"shot.{len(names):04}.png")
            frame["file_path"] = str(new.relative_to(source).with_suffix(""))
            names[new.stem] = old.rename(new) if old.exists() else new
        file.write_text(json.dumps(content))
    import_data(source, tmp_path / "data", meshes, tell=quiet)
    views = [view.name for view in Dataset.load(tmp_path / "data").views]
    assert views and set(views) <= names.keys() and all(name.startswith("shot.0") for name in views)


def test_an_angle_of_a_frame_stands_before_a_focal_length_at_the_top(
    captured, nerfstudio, meshes, tmp_path
):
    def angles(content):
        for frame in content["frames"]:
            frame["camera_angle_x"] = 2 * float(np.arctan(8 / content["fl_x"]))
        content["fl_x"] = content["fl_y"] = 999

    change(nerfstudio, angles)
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "data")


def test_intrinsics_may_be_texts(captured, nerfstudio, meshes, tmp_path):
    """As nerfstudio writes what RealityCapture tells."""
    change(nerfstudio, lambda c: [f.update(k1="0.0", p2="0") for f in c["frames"]])
    change(nerfstudio, lambda c: c.update(fl_x=str(c["fl_x"])))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "data")
    change(nerfstudio, lambda c: [f.update(k1="much") for f in c["frames"]])
    with pytest.raises(ImportFaults, match="'k1' is not a number"):
        import_data(nerfstudio, tmp_path / "other", meshes, tell=quiet)


def test_a_size_with_a_fraction_is_that_of_the_picture(captured, nerfstudio, meshes, tmp_path):
    """As Blender-NeRF writes it of a part of the resolution."""
    change(nerfstudio, lambda c: c.update(w=16.4, h=16.8))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "data")
    for size in (17.5, float("nan")):
        change(nerfstudio, set_top("w", size))
        with pytest.raises(ImportFaults):
            import_data(nerfstudio, tmp_path / "other", meshes, tell=quiet)


def test_a_scale_of_cameras_is_taken_out(captured, nerfstudio, meshes, tmp_path):
    """Blender renders the same with it."""

    def scale(content):
        pose = np.array(content["frames"][1]["transform_matrix"])
        pose[:3, :3] *= (2.0, 3.0, 0.5)
        content["frames"][1]["transform_matrix"] = pose.tolist()

    change(nerfstudio, scale)
    told = []
    import_data(nerfstudio, tmp_path / "data", meshes, tell=told.append)
    assert any(line.startswith("poses have a scale, which is taken out:") for line in told)
    found = Dataset.load(tmp_path / "data").views
    for mine, theirs in zip(found, captured.views, strict=True):
        np.testing.assert_allclose(mine.camera.to_world, theirs.camera.to_world, atol=1e-6)


def test_other_masks_take_the_place_of_missing_ones(nerfstudio, meshes, tmp_path):
    change(nerfstudio, lambda c: [f.update(mask_path="../gone.png") for f in c["frames"]])
    for frame in json.loads((nerfstudio / "transforms.json").read_text())["frames"]:
        name = Path(frame["file_path"]).name
        save(np.full((16, 16), 255, np.uint8), tmp_path / "masks" / name)
    told, masks = [], tmp_path / "masks"
    import_data(nerfstudio, tmp_path / "data", meshes, masks=masks, tell=told.append)
    assert "3 with masks" in told[0]
    with pytest.raises(ImportFaults, match=r"gone\.png"):
        import_data(nerfstudio, tmp_path / "other", meshes, tell=quiet)


def test_test_frames_are_held_out(captured, nerfstudio, meshes, tmp_path):
    """As ScanNet++ has them, beside `frames`."""
    change(nerfstudio, without_lists)
    change(nerfstudio, lambda c: c.update(test_frames=[c["frames"].pop(1)]))
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    splits = {view.name: view.split for view in Dataset.load(tmp_path / "data").views}
    names = [view.name for view in captured.views]
    assert splits == {names[0]: "train", names[1]: "heldout", names[2]: "train"}


def test_an_angle_that_contradicts_a_focal_length_is_told(nerfstudio, meshes, tmp_path):
    top = json.loads((nerfstudio / "transforms.json").read_text())
    angle = 2 * float(np.arctan(0.5 * top["w"] / top["fl_x"]))
    for factor, count in ((1.0, 0), (1.1, 1)):
        change(nerfstudio, set_top("camera_angle_x", factor * angle))
        told = []
        import_data(nerfstudio, tmp_path / f"{factor}", meshes, tell=told.append)
        assert sum("differ, the first is taken: ./images/" in line for line in told) == count
    # Those of a frame stand before the angle at the top
    change(nerfstudio, lambda c: [frame.update(fl_x=c["fl_x"]) for frame in c["frames"]])
    told = []
    import_data(nerfstudio, tmp_path / "own", meshes, tell=told.append)
    assert not any("differ" in line for line in told)


def test_a_mesh_in_another_unit_around_the_cameras_is_told(captured, nerfstudio, tmp_path):
    origins = np.array([view.camera.origin for view in captured.views])
    for size, wanted in ((1000.0, True), (5.0, False)):
        box = trimesh.creation.box((size * np.ptp(origins, axis=0).max(),) * 3)
        box.apply_translation(0.5 * (origins.min(0) + origins.max(0)))
        box.export(tmp_path / "box.ply")
        told = []
        import_data(nerfstudio, tmp_path / f"{size}", [tmp_path / "box.ply"], tell=told.append)
        assert "all cameras stand inside the mesh" in told[-1]
        assert ("1000 times as wide as the space of the cameras" in told[-1]) == wanted


def test_a_train_file_that_cannot_be_read_is_one_fault(captured, meshes, tmp_path):
    write_blender(captured, tmp_path / "blender")
    (tmp_path / "blender" / "transforms_train.json").write_text("{")
    with pytest.raises(ImportFaults) as caught:
        import_data(tmp_path / "blender", tmp_path / "data", meshes, tell=quiet)
    (fault,) = caught.value.faults
    assert "is not readable JSON" in fault


def test_a_file_that_cannot_be_read_does_not_hide_other_faults(nerfstudio, tmp_path):
    (nerfstudio / "transforms.json").write_text("{")
    with pytest.raises(ImportFaults) as caught:
        import_data(nerfstudio, tmp_path / "data", [tmp_path / "none.ply"], tell=quiet)
    told = "; ".join(caught.value.faults)
    assert "transforms.json" in told and "none.ply" in told and len(caught.value.faults) == 2


def test_a_source_that_is_none_is_told_what_there_could_be(meshes, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no cameras were found") as caught:
        import_data(tmp_path / "empty", tmp_path / "data", meshes)
    assert "COLMAP" in caught.value.remedy
    with pytest.raises(UserError, match="the source does not exist"):
        import_data(tmp_path / "none", tmp_path / "data", meshes)


def test_a_foreign_folder_given_to_a_fit_is_told_to_import(nerfstudio, tmp_path):
    with pytest.raises(UserError, match="'scene' is missing") as caught:
        Dataset.load(nerfstudio)
    assert "unbake import" in caught.value.remedy
    (tmp_path / "project" / "sparse").mkdir(parents=True)
    with pytest.raises(UserError, match="looks like one of COLMAP: `unbake import"):
        Dataset.load(tmp_path / "project")


def test_the_command_leads_to_a_fit(nerfstudio, meshes, tmp_path, unbake):
    words = [word for mesh in meshes for word in ("--mesh", mesh)]
    outcome = unbake("import", nerfstudio, *words, "-o", tmp_path / "data")
    assert outcome.status == 0 and outcome.err == ""
    assert outcome.out.rstrip().endswith(f"next: unbake data check {tmp_path / 'data'}")
    assert Path(tmp_path / "data").is_dir()


# -------------------------------------------------------------------------------------------- docs

DOCS = Path(__file__).parents[2] / "docs" / "import.md"
BLOCKS = dict(
    re.findall(r"<!-- run by the tests: (\w+) -->\n```\w+\n(.*?)```", DOCS.read_text("utf-8"), re.S)
)


def as_one(meshes, file, *, y_up=False):
    """All meshes as one file of a format that the suffix of its name tells."""
    mesh = trimesh.util.concatenate([trimesh.load_mesh(mesh) for mesh in meshes])
    if y_up:
        mesh.apply_transform(np.linalg.inv(TO_Z_UP))
    mesh.export(file)


@pytest.mark.parametrize("name", ["nerfstudio", "blender", "colmap"])
def test_the_commands_of_the_guide_run(
    name, captured, nerfstudio, meshes, tmp_path, unbake, monkeypatch
):
    program, command, source, *words = shlex.split(BLOCKS[name])
    monkeypatch.chdir(tmp_path)
    # Blender's exporter turns up to +y.
    as_one(meshes, Path(words[words.index("--mesh") + 1]), y_up=name == "blender")
    if name == "nerfstudio":
        nerfstudio.rename(source)
    elif name == "blender":
        write_blender(captured, Path(source))
    else:
        pytest.importorskip("pycolmap", reason="COLMAP models need pycolmap")
        write_colmap(captured, Path(source))
    outcome = unbake(command, source, *words)
    assert (program, outcome.status, outcome.err) == ("unbake", 0, "")
    assert "one part" in outcome.out and "100 % of the pixels see it" in outcome.out
    assert len(Dataset.load("data").views) == len(captured.views)


PHONE = DOCS.parent / "guides" / "phone.md"


@pytest.mark.slow
def test_the_commands_of_the_guide_for_phones_run(captured, meshes, tmp_path, unbake, monkeypatch):
    pytest.importorskip("pycolmap", reason="COLMAP models need pycolmap")
    monkeypatch.chdir(tmp_path)
    write_colmap(captured, Path("project"))
    Path("project/dense").mkdir()
    as_one(meshes, Path("project/dense/mesh.ply"))
    Path("short.toml").write_text(to_toml(TINY_FIT))
    commands = [
        shlex.split(command)
        for command in re.findall(r"^ +(unbake .+)$|`(unbake .+?)`", PHONE.read_text("utf-8"), re.M)
        for command in command
        if command
    ]
    ran = [words[1] for words in commands]
    assert ran == ["import", "data", "fit", "evaluate", "report", "export"]
    for _, *words in commands:
        short = ["--settings", "short.toml", "--steps", "5"] if words[0] == "fit" else []
        outcome = unbake(*words, *short)
        assert outcome.status == 0, (words, outcome.err)
    assert Path("check.html").is_file() and Path("report.html").is_file()
    assert list(Path("textures").glob("*.glb"))


def test_the_smallest_scene_of_the_guide_is_one(meshes, tmp_path):
    (tmp_path / "scene.xml").write_text(BLOCKS["scene"])
    (tmp_path / "meshes").mkdir()
    shutil.copy(meshes[0], tmp_path / "meshes" / "vase.ply")
    parsed = parse(tmp_path / "scene.xml")
    assert material_names(parsed) == ["clay"]
    assert parsed.instantiate().environment() is not None


def test_a_byte_order_mark_is_skipped(captured, nerfstudio, meshes, tmp_path):
    file = nerfstudio / "transforms.json"
    file.write_text(file.read_text(), encoding="utf-8-sig")
    import_data(nerfstudio, tmp_path / "data", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "data")
