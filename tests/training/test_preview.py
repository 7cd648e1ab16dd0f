"""Previews: one picture of what is learned above the truth, and lines for the log."""

import dataclasses
import errno
import io
import json
import math
import shutil

import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console
from support import TINY_FIT

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import LightingConfig
from unbake.dataset.lighting import ROWS, true_environment
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.imaging.pictures import tonemap
from unbake.training import preview as preview_module
from unbake.training.checkpoint import Progress
from unbake.training.monitor import Monitor
from unbake.training.preview import Preview
from unbake.training.problem import make_problem
from unbake.training.run_folder import RunFolder

SIZE, GAP = 16, 2
START = 0.2  # radiance of the untrained light
AFTER = Progress(step=40, seconds=18.2, samples=1000)


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A data set under an environment, to be read alone."""
    folder = tmp_path_factory.mktemp("captured") / "still"
    small = CaptureSettings(views=2, held_out=1, resolution=SIZE, spp=4, max_depth=4)
    capture("still", folder, small, tell=lambda line: None)
    return folder


def preview(data, unknown, folder):
    """Of an untrained problem, written to `folder`: the problem, and the lines for the log."""
    config = dataclasses.replace(TINY_FIT, unknown=unknown, lighting=LightingConfig(resolution=8))
    dataset = Dataset.load(data)
    problem = make_problem(dataset.scene, dataset.background, config, START)
    return problem, Preview(problem, dataset, RunFolder(folder)).show(AFTER)


def picture(folder):
    """The one picture of the folder, (H, W, 3) uint8."""
    (file,) = (folder / "previews").iterdir()
    assert file.name == "step-000040.png"
    return np.array(mi.Bitmap(str(file)))


def tile(sheet, row, height, width, left=GAP):
    """A tile of a sheet with rows of equal height."""
    top = GAP + row * (height + GAP)
    return sheet[top : top + height, left : left + width]


def test_an_environment_is_shown_above_the_true_one(still, tmp_path):
    problem, lines = preview(still, "lighting", tmp_path)
    sheet = picture(tmp_path)
    assert sheet.shape == (2 * ROWS + 3 * GAP, 2 * ROWS + 2 * GAP, 3)
    assert lines == [] and problem.materials is None
    learned, true = (tile(sheet, row, ROWS, 2 * ROWS) for row in (0, 1))
    assert (learned == tonemap(np.float32(START))).all()
    assert np.array_equal(true, tonemap(true_environment(still))) and true.std() > 10


def test_without_truth_the_environment_is_shown_alone(still, tmp_path):
    bare = tmp_path / "bare"
    shutil.copytree(still, bare, ignore=shutil.ignore_patterns("truth"))
    preview(bare, "lighting", tmp_path / "out")
    assert picture(tmp_path / "out").shape == (ROWS + 2 * GAP, 2 * ROWS + 2 * GAP, 3)


def test_a_large_photograph_has_a_small_preview(still, tmp_path, monkeypatch):
    """Photographs are fitted at full size. What is seen of them in a picture need not be."""
    monkeypatch.setattr(preview_module, "_LONGEST", SIZE // 3)
    bare = tmp_path / "bare"
    shutil.copytree(still, bare, ignore=shutil.ignore_patterns("truth"))
    rendered = []
    plain = preview_module.MaterialBuffers.of

    def counted(problem, views, *rest, **more):
        rendered.extend((view.camera.width, view.camera.height) for view in views)
        return plain(problem, views, *rest, **more)

    monkeypatch.setattr(preview_module.MaterialBuffers, "of", counted)
    preview(bare, "materials", tmp_path / "small")
    assert rendered == [(4, 4)]
    assert picture(tmp_path / "small").shape == (4 + 2 * GAP, 2 * 4 + 3 * GAP, 3)
    # Truth is compared at its own size, and shown at a part of it.
    _, lines = preview(still, "materials", tmp_path / "true")
    assert rendered[1:] == [(SIZE, SIZE)] and "albedo_psnr" in lines[0]["validation"]
    assert picture(tmp_path / "true").shape == (2 * 4 + 3 * GAP, 2 * 4 + 3 * GAP, 3)


def test_materials_and_environment_share_a_sheet(still, tmp_path):
    _, lines = preview(still, "materials+lighting", tmp_path)
    sheet = picture(tmp_path)
    materials = 2 * SIZE + 3 * GAP
    assert sheet.shape == (materials + 2 * ROWS + 3 * GAP, 2 * ROWS + 2 * GAP, 3)
    true = tile(sheet[materials:], 1, ROWS, 2 * ROWS)
    assert np.array_equal(true, tonemap(true_environment(still)))
    assert tile(sheet, 1, SIZE, SIZE).std() > 10  # true albedo
    assert (sheet[:materials, 2 * SIZE + 3 * GAP :] == 255).all()
    assert lines[0]["validation"].keys() == {"split", "albedo_psnr", "roughness_psnr"}


def test_materials_alone_are_a_sheet_of_four(cornell, tmp_path):
    _, lines = preview(cornell, "materials", tmp_path)
    assert picture(tmp_path).shape == (2 * SIZE + 3 * GAP, 2 * SIZE + 3 * GAP, 3)
    assert lines[0]["step"] == 40 and lines[0]["validation"]["split"] == "heldout"


def test_lights_are_told_in_a_line_and_have_no_picture(cornell, tmp_path):
    problem, lines = preview(cornell, "emission", tmp_path)
    assert not (tmp_path / "previews").exists()
    (name,) = problem.emitter_names
    assert lines[0]["validation"] == {"emission": {name: pytest.approx([START] * 3)}}
    said = io.StringIO()
    with Monitor(tmp_path / "log.jsonl", Console(file=said, width=200), 100) as monitor:
        monitor.validation(lines[0])
    assert said.getvalue() == f"step 40, 18 s: {name} 0.2 0.2 0.2\n"
    logged = json.loads((tmp_path / "log.jsonl").read_text())
    assert logged["validation"]["emission"].keys() == {name} and logged["step"] == 40


def test_a_loss_that_no_step_had_is_left_out_of_the_log(tmp_path):
    """JSON has no NaN: other programs would not read the file."""
    entry = {"step": 4, "seconds": 1.5, "samples_per_second": 2e3, "memory_mb": 9.0, "skipped": 4}
    with Monitor(tmp_path / "log.jsonl", Console(file=io.StringIO()), 100) as monitor:
        monitor.record(4, entry | {"lhs": math.nan, "prior": math.inf, "photometric": 0.5})
    logged = (tmp_path / "log.jsonl").read_text()
    assert json.loads(logged) == entry | {"photometric": 0.5}


def test_no_preview_is_written_through_a_link(cornell, tmp_path):
    """Also where a folder has become one while the fit runs."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "previews").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="previews: is a symbolic link"):
        preview(cornell, "materials", tmp_path)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_fit_beyond_its_time_is_done_and_no_more(tmp_path):
    """The last step may end after a limit of time."""
    said = io.StringIO()
    entry = {"step": 1, "seconds": 4.0, "samples_per_second": 1e3, "memory_mb": 100.0}
    with Monitor(tmp_path / "log.jsonl", Console(file=said, width=200), 2.0) as monitor:
        monitor.record(4.0, entry)
    assert said.getvalue().startswith("100 %") and said.getvalue().endswith(" 0 s left\n")


class SmallDisk:
    """A file on a disk with room for some bytes."""

    def __init__(self, file, room):
        self.file, self.room = file, room

    def write(self, content):
        part = content[: self.room]
        if not part:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.room -= len(part)
        return self.file.write(part)

    def close(self):
        self.file.close()


def test_lines_of_the_log_wait_for_room_on_the_disk(tmp_path):
    log, said = tmp_path / "log.jsonl", io.StringIO()
    wanted = []
    with Monitor(log, Console(file=said, width=200), 100) as monitor:
        disk = monitor._file = SmallDisk(monitor._file, room=100)
        for step in range(400):  # some 20 kB: more than a buffer holds
            monitor.note(step, step / 8, f"line {step}", say=False)
            wanted.append({"step": step, "seconds": step / 8, "note": f"line {step}"})
        assert len(monitor.failures) == 1 and log.stat().st_size == 100
        disk.room = 1 << 20
        monitor.note(400, 50.0, "there is room again", say=False)
        assert not monitor.failures
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert lines[:400] == wanted and lines[400]["step"] == 400
    assert said.getvalue().count("the log cannot be written") == 1
