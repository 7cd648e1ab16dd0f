"""What experiments have in common: their jobs run once, and their results are written."""

import dataclasses
import json
import tarfile
from functools import partial
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from rich.console import Console

from unbake.errors import UserError
from unbake.experiments import Name, experiment, load
from unbake.experiments.experiment import (
    Experiment,
    ExperimentContext,
    ExperimentResult,
    reproduce,
)
from unbake.experiments.fig4 import agreement, published_tables, smoothed
from unbake.experiments.jobs import Job, Unfinished
from unbake.experiments.scene_fits import SceneFits, at_equal_samples
from unbake.experiments.scenes import SCENES, STAIRCASE
from unbake.experiments.tables import markdown
from unbake.imaging.pictures import write_exr
from unbake.training.run_folder import RunFolder


@pytest.fixture(autouse=True)
def machine_of_reference(monkeypatch):
    """Nothing is rendered to tell how fast this machine is."""
    monkeypatch.setattr(experiment, "slowness", lambda: 1.0)


def context(folder, **others) -> ExperimentContext:
    return ExperimentContext("smoke", folder, folder, Console(quiet=True), **others)


def squares(done: list, numbers=(2, 3), offset=0, files=()) -> Experiment:
    """An experiment that notes what it does."""

    def work(number):
        done.append(number)
        for file in files:
            file.touch()
        return {"square": number**2 + offset}

    def jobs(_):
        settings = {"offset": offset}
        return [Job(f"of-{n}", settings, partial(work, n), 1.0, files=files) for n in numbers]

    def result(_, findings):
        rows = [{"job": name} | f for name, f in findings.items()]
        return ExperimentResult(rows, markdown(["a", "b"], [[1, None]]))

    return Experiment("squares", "Squares", jobs, result)


def test_jobs_that_are_done_are_not_done_again(tmp_path):
    done = []
    reproduce(squares(done), context(tmp_path))
    assert done == [2, 3]
    reproduce(squares(done, (2, 3, 4)), context(tmp_path))
    assert done == [2, 3, 4]
    data = json.loads((tmp_path / "squares" / "data.json").read_text())
    assert [row["square"] for row in data["rows"]] == [4, 9, 16] and len(data["machines"]) == 1
    assert (tmp_path / "squares" / "data.csv").read_text().splitlines()[1] == "of-2,4"
    assert (tmp_path / "squares" / "table.md").read_text().endswith("| 1 | — |\n")


def test_jobs_with_other_settings_or_damaged_are_done_again(tmp_path):
    done = []
    reproduce(squares(done), context(tmp_path))
    reproduce(squares(done, offset=1), context(tmp_path))
    assert done == [2, 3, 2, 3]
    (tmp_path / "work" / "smoke" / "squares" / "of-3.json").write_text("{")
    reproduce(squares(done, offset=1), context(tmp_path))
    assert done == [2, 3, 2, 3, 3]


def test_jobs_whose_files_are_gone_are_done_again(tmp_path):
    done, file = [], tmp_path / "picture.png"
    reproduce(squares(done, files=[file]), context(tmp_path))
    reproduce(squares(done, files=[file]), context(tmp_path))
    assert done == [2, 3]
    file.unlink()
    reproduce(squares(done, files=[file]), context(tmp_path))
    assert done == [2, 3, 2, 3]


def test_what_was_done_before_it_was_stopped_is_kept(tmp_path):
    done = []

    def stop():
        raise KeyboardInterrupt

    jobs = [*squares(done).jobs(None), Job("last", {}, stop, 1.0)]
    stopped = Experiment("squares", "", lambda _: jobs, squares(done).result)
    with pytest.raises(KeyboardInterrupt):
        reproduce(stopped, context(tmp_path))
    assert not (tmp_path / "squares").exists()
    reproduce(squares(done), context(tmp_path))
    assert done == [2, 3]


def test_without_all_findings_there_is_no_result(tmp_path):
    def stop():
        raise Unfinished

    jobs = [Job("first", {}, stop, 1.0), *squares([]).jobs(None)]
    with pytest.raises(KeyboardInterrupt):
        reproduce(Experiment("squares", "", lambda _: jobs, squares([]).result), context(tmp_path))
    assert not (tmp_path / "squares").exists()


def test_a_job_that_fails_does_not_keep_others_from_being_done(tmp_path):
    done = []

    def fail():
        raise UserError("no luck", remedy="Try again")

    jobs = [Job("first", {}, fail, 1.0), *squares(done).jobs(None)]
    failing = Experiment("squares", "", lambda _: jobs, squares(done).result)
    with pytest.raises(UserError, match=r"squares, first: no luck. Try again"):
        reproduce(failing, context(tmp_path))
    assert done == [2, 3] and not (tmp_path / "squares").exists()


def test_a_plan_does_nothing(tmp_path):
    done = []
    reproduce(squares(done), context(tmp_path), plan=True)
    assert not done and not list(tmp_path.iterdir())


def test_scenes_that_are_not_there_are_named(tmp_path):
    with pytest.raises(UserError, match=r"'staircase'.*--scenes"):
        STAIRCASE.capture(context(tmp_path))
    lego = next(scene for scene in SCENES if scene.name == "LEGO")
    (tmp_path / "lego").mkdir()
    with pytest.raises(UserError, match="'envmaps_blender'"):
        lego.capture(context(tmp_path))


@pytest.mark.parametrize("damage", ["no archive", "cut off", "other folder"])
def test_archives_that_are_damaged_are_named(tmp_path, damage):
    archive = tmp_path / "staircase.tar.xz"
    (tmp_path / "other").mkdir()
    with tarfile.open(archive, "w:xz") as file:
        file.add(tmp_path / "other", "other")
    if damage != "other folder":
        content = archive.read_bytes()
        archive.write_bytes(b"nothing" if damage == "no archive" else content[: len(content) // 2])
    with pytest.raises(UserError, match=r"staircase.tar.xz.*cannot be unpacked"):
        STAIRCASE.unpacked(context(tmp_path))
    assert not list((tmp_path / "work" / "published").iterdir())


def test_data_sets_of_other_settings_have_other_folders(tmp_path):
    small = context(tmp_path)
    other = dataclasses.replace(STAIRCASE, albedo_power=0.8)
    shots = dataclasses.replace(STAIRCASE.capture_settings(small), spp=7)
    folders = {STAIRCASE.data(small), other.data(small), STAIRCASE.data(small, shots)}
    assert len(folders) == 3 and STAIRCASE.data(small) == STAIRCASE.data(context(tmp_path))


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.folder)
def test_camera_files_hold_the_views_that_are_stated(scene):
    cameras = json.loads(scene.cameras.read_text())["cameras"]
    splits = [camera["split"] for camera in cameras]
    assert splits.count("train") == scene.views and splits.count("heldout") == 6


def test_scores_are_compared_at_the_samples_of_the_slowest():
    def row(each, *scores):
        curve = [
            {"step": step, "albedo_psnr": psnr, "roughness_psnr": None} for step, psnr in scores
        ]
        return {"steps": scores[-1][0], "samples": each * scores[-1][0], "score": curve}

    found = {
        "fast": row(10, (0, 0.0), (100, 10.0), (200, 30.0)),
        "slow": row(10, (0, 0.0), (150, 12.0)),
    }
    equal = at_equal_samples(found)
    assert equal["fast"] == {"samples": 1500, "albedo_psnr": 20.0, "roughness_psnr": None}
    assert equal["slow"]["albedo_psnr"] == 12.0


def test_smoothing_keeps_cubics_and_takes_noise_away():
    values = np.linspace(0.2, 0.9, 15)
    rng = np.random.default_rng(3)
    ramp = np.repeat(np.arange(4.0), 6)[:, None] * np.ones(3)  # 4 x 6 pixels
    clean = {v: {"image": ramp + v**3 - v} for v in values}
    noisy = {v: {"image": clean[v]["image"] + rng.normal(size=ramp.shape)} for v in values}
    for value, found in smoothed(clean, 4, 6, 2).items():
        rows = np.repeat([0.5, 2.5], 3) + value**3 - value
        assert found["image"] == pytest.approx(np.repeat(rows[:, None], 3, 1))
    off = [
        found["image"] - clean["image"]
        for found, clean in zip(
            smoothed(noisy, 4, 6, 2).values(), smoothed(clean, 4, 6, 2).values(), strict=True
        )
    ]
    assert np.std(off) == pytest.approx(0.5 * np.sqrt(4 / 15), rel=0.2)


def test_published_gradients_are_those_of_the_paper():
    """Their table, as others have summarised it."""
    tables = published_tables()
    reference = tables["reference"][1]
    told = {m: agreement(v, t, reference) for m, (v, t) in tables.items()}
    direct = [round(v, 2) for v in list(told["direct"].values())[:4]]
    assert direct == [0.87, 0.72, 0.74, 0.78]
    errors = [told[f"ours, k = {k}"]["relative_rmse"] for k in (1, 2, 4)]
    assert errors == sorted(errors, reverse=True)
    assert told["reference"]["relative_rmse"] == 0


def test_every_experiment_goes_by_its_name():
    assert [load(name).name for name in get_args(Name)] == list(get_args(Name))


def test_a_rendering_of_another_size_than_the_photograph_is_named(tmp_path, monkeypatch):
    run = RunFolder(tmp_path / "ours")
    view = SimpleNamespace(name="a", split="heldout", image=tmp_path / "a.exr")
    write_exr(view.image, np.ones((8, 8, 4)))
    write_exr(run.picture("heldout", "a", "render"), np.ones((4, 8, 4)))
    monkeypatch.setattr(SceneFits, "heldout", lambda *_: [view])
    monkeypatch.setattr(SceneFits, "run", lambda *_: run)
    fits = SceneFits(STAIRCASE, ["ours"], None, spp=1)
    with pytest.raises(UserError, match=r"a_render\.exr: the picture has 8 x 4 pixels"):
        fits.qualities(context(tmp_path), "ours", {"per_view": [{}]})


def test_the_albedo_of_staircase_is_the_one_that_was_calibrated(repository):
    file = repository / "benchmarks" / "results" / "staircase-albedo.json"
    calibrated = json.loads(file.read_text())["powers"][0]
    assert calibrated["power"] == STAIRCASE.albedo_power
    for method in ("PRB 10", "PRB 15"):
        here, paper = calibrated["relative_l2"][method], calibrated["published"][method]
        assert here["relative_rmse"] == pytest.approx(paper["relative_rmse"], rel=0.25)
        assert here["sign_agreement"] == paper["sign_agreement"] == 1
