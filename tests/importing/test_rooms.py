"""Rooms in the layout of FIPT: a captured data set that is written in it comes back as it was."""

import re
from pathlib import Path

import numpy as np
import pytest
from layouts import codes, quiet, write_photographed_room, write_rendered_room
from PIL import Image

from unbake.dataset.views import Dataset, read_photograph
from unbake.errors import UserError
from unbake.importing.faults import ImportFaults
from unbake.importing.import_data import import_data
from unbake.importing.settings import ImportSettings

DOCS = Path(__file__).parents[2] / "docs" / "import.md"


@pytest.fixture
def photographed(captured, meshes, tmp_path):
    """A room with `cam.txt` and `K_list.txt`."""
    write_photographed_room(captured, meshes, tmp_path / "ClassRoom")
    return tmp_path / "ClassRoom"


@pytest.fixture
def rendered(captured, meshes, tmp_path):
    """A room with `train` and `val`."""
    write_rendered_room(captured, meshes, tmp_path / "kitchen")
    return tmp_path / "kitchen"


def require_same(found, views):
    """The same poses, lenses and pictures as those of `views`, one after the other."""
    for mine, known in zip(found, views, strict=True):
        assert np.abs(mine.camera.to_world - known.camera.to_world).max() < 1e-5
        for key in ("width", "height", "fl_x", "fl_y", "cx", "cy"):
            assert getattr(mine.camera, key) == pytest.approx(getattr(known.camera, key))
        assert mine.encoding == "linear" and mine.exposure == 1
        assert np.array_equal(read_photograph(mine)[..., :3], read_photograph(known)[..., :3])


def test_a_photographed_room_comes_back(captured, photographed, tmp_path):
    told = []
    settings = ImportSettings(holdout=0)
    import_data(photographed, tmp_path / "data", settings=settings, tell=told.append)
    found = Dataset.load(tmp_path / "data")
    require_same(found.train, captured.views)
    assert [view.name for view in found.views] == ["000_0001", "001_0001", "002_0001"]
    assert told[0].startswith("FIPT: 3 training")
    assert "100 % of the pixels see it" in told[-1]


def test_other_images_of_a_room_hold_code_values(captured, photographed, tmp_path):
    import_data(photographed, tmp_path / "data", images=photographed / "ldr", tell=quiet)
    found = Dataset.load(tmp_path / "data")
    assert {view.encoding for view in found.views} == {"srgb"}
    for mine, known in zip(found.views, captured.views, strict=True):
        assert np.abs(codes(mine).astype(int) - codes(known)).max() <= 1


def test_images_of_a_room_have_the_size_that_its_cameras_are_for(photographed, tmp_path):
    for file in (photographed / "ldr").glob("*.png"):
        with Image.open(file) as image:
            smaller = image.resize((image.width // 2, image.height // 2))
        smaller.save(file)
    with pytest.raises(
        UserError, match="the image has 8 x 8 pixels, and the cameras are for 16 x 16"
    ):
        import_data(photographed, tmp_path / "data", images=photographed / "ldr", tell=quiet)


def test_exposures_of_a_room_are_those_that_it_tells(photographed, tmp_path):
    told, cam = [], photographed / "ldr" / "cam"
    cam.mkdir()
    np.save(cam / "exposure.npy", np.array([0.5, 2.0, 4.0]))
    np.save(cam / "crf.npy", np.zeros((3, 1024)))
    import_data(photographed, tmp_path / "data", images=photographed / "ldr", tell=told.append)
    assert [view.exposure for view in Dataset.load(tmp_path / "data").views] == [0.5, 2.0, 4.0]
    assert any("by the source" in line for line in told)
    assert any("--response monotone" in line for line in told)


@pytest.mark.parametrize(
    "wrong",
    [
        np.array([1.0, 2.0]),
        np.array([1.0, 2.0, 0.0]),
        np.array([1.0, np.nan, 1.0]),
        np.array(["a", "b", "c"]),
        np.array([1.0, None, {}], object),
        b"",
        b"\x93NUMPY\x01\x00v\x00",
    ],
    ids=["too few", "zero", "NaN", "text", "objects", "empty", "cut"],
)
def test_exposures_that_cannot_be_are_refused(photographed, tmp_path, wrong):
    (photographed / "ldr" / "cam").mkdir()
    file = photographed / "ldr" / "cam" / "exposure.npy"
    if isinstance(wrong, bytes):
        file.write_bytes(wrong)
    else:
        np.save(file, wrong)
    with pytest.raises(ImportFaults, match="is not 3 positive numbers"):
        import_data(photographed, tmp_path / "data", images=photographed / "ldr", tell=quiet)


def test_a_rendered_room_comes_back(captured, rendered, tmp_path, unbake, monkeypatch):
    monkeypatch.chdir(tmp_path)
    block = re.search(
        r"<!-- run by the tests: fipt -->\n```sh\nunbake (.*)\n", DOCS.read_text("utf-8")
    )
    outcome = unbake(*block[1].split())
    assert outcome.status == 0 and outcome.err == ""
    found = Dataset.load("data")
    require_same(found.train, captured.train)
    require_same(found.heldout, captured.heldout)
    names = {view.name for view in found.views}
    assert names == {"train_000_0001", "train_001_0001", "val_000_0001"}
    assert [file.name for file in Path("data/scene/meshes").iterdir()] == ["scene.ply"]


@pytest.mark.parametrize(
    ("file", "content", "fault"),
    [
        ("cam.txt", "", "three rows of three"),
        ("cam.txt", "1\n0 0 0\n0 0 1\n0 1 0\n", "1 cameras in cam.txt, 3 in K_list.txt"),
        ("K_list.txt", "3\n" + "1 2\n" * 9, "three rows of three"),
        ("K_list.txt", "3\n" + "9 1 8\n0 9 8\n0 0 1\n" * 3, "no pinhole without skew"),
        ("cam.txt", "3\n" + "0 0 0\n0 0 1\n0 0 1\n" * 3, "not perpendicular"),
        ("cam.txt", "3\n" + "0 0 0\n0 0 0\n0 0 1\n" * 3, "not perpendicular"),
    ],
)
def test_what_is_wrong_with_cameras_is_told(photographed, tmp_path, file, content, fault):
    (photographed / file).write_text(content)
    with pytest.raises(ImportFaults, match=fault):
        import_data(photographed, tmp_path / "data", tell=quiet)


def test_images_that_are_missing_are_faults(rendered, photographed, tmp_path):
    (photographed / "Image" / "001_0001.exr").unlink()
    (rendered / "val" / "transforms.json").write_text('{"camera_angle_x": 4, "frames": [1]}')
    (rendered / "scene.obj").unlink()
    with pytest.raises(ImportFaults, match="the image does not exist: 001_0001"):
        import_data(photographed, tmp_path / "data", tell=quiet)
    with pytest.raises(ImportFaults) as caught:
        import_data(rendered, tmp_path / "data", images=tmp_path, tell=quiet)
    told = "; ".join(caught.value.faults)
    for part in ("no other folder of images", "'camera_angle_x' is not", "no mesh was given"):
        assert part in told
