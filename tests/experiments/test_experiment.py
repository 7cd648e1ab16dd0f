"""What experiments have in common: their jobs run once, and their results are written."""

import dataclasses
import json
import tarfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from rich.console import Console

from unbake.config import FitConfig, read_toml
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.experiments import Name, experiment, fig6, load
from unbake.experiments.experiment import (
    Experiment,
    ExperimentContext,
    ExperimentResult,
    reproduce,
)
from unbake.experiments.fig4 import agreement, published_tables, smoothed
from unbake.experiments.jobs import Job, Unfinished
from unbake.experiments.scene_fits import ABLATION, Fit, SceneFits, steps_of
from unbake.experiments.scenes import SCENES, STAIRCASE, _raise_albedo
from unbake.experiments.seeds import across_seeds, plus_minus, spread
from unbake.experiments.tables import markdown
from unbake.imaging.coded import read_picture
from unbake.imaging.pictures import write_exr
from unbake.scene.edit import to_principled
from unbake.scene.parse import parse, referenced
from unbake.training.fresh_fit import compile_kernels
from unbake.training.run_folder import RunFolder
from unbake.training.step import TrainingStep


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


def test_the_time_of_each_scene_is_kept(tmp_path):
    def jobs(_):
        names = {"a-data": "a", "a-0": "a", "b": ""}
        return [Job(n, {}, dict, 1.0, group=group) for n, group in names.items()]

    by_scene = dataclasses.replace(squares([]), jobs=jobs, by_scene=True)
    reproduce(by_scene, context(tmp_path))
    for name, seconds in {"a-data": 1.25, "a-0": 2.5, "b": 4.0}.items():
        file = tmp_path / "work" / "smoke" / "squares" / f"{name}.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"seconds": seconds}))
    reproduce(by_scene, context(tmp_path))
    data = json.loads((tmp_path / "squares" / "data.json").read_text())
    assert data["seconds_by_scene"] == {"a": 3.8, "b": 4.0} and data["seconds"] == 7.8


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


def test_an_albedo_that_materials_share_is_raised_once(tmp_path):
    write_exr(tmp_path / "wood.exr", np.full((2, 2, 3), 0.25))
    file = '<string name="filename" value="wood.exr"/>'
    texture = f'<texture type="bitmap" name="base_color" id="wood">{file}</texture>'
    one = f'<bsdf type="principled" id="one">{texture}</bsdf>'
    other = '<bsdf type="principled" id="other"><ref name="base_color" id="wood"/></bsdf>'
    plain = '<bsdf type="principled" id="plain"><rgb name="base_color" value="0.25"/></bsdf>'
    shapes = "".join(
        f'<shape type="cube"><ref id="{i}"/></shape>' for i in ("one", "other", "plain")
    )
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0">{one}{other}{plain}{shapes}</scene>'
    )
    scene = parse(tmp_path / "scene.xml")
    to_principled(scene)
    _raise_albedo(scene, 0.5, tmp_path)
    for node in scene.principled_nodes():
        colour = node.props["base_color"]
        texture = referenced(scene, colour)
        if texture is None:
            assert list(colour) == pytest.approx([0.5] * 3)
        else:
            raised = read_picture(Path(texture.props["filename"]))
            assert raised[..., :3] == pytest.approx(np.full((2, 2, 3), 0.5), abs=0.005)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.folder)
def test_camera_files_hold_the_views_that_are_stated(scene):
    cameras = json.loads(scene.cameras.read_text())["cameras"]
    splits = [camera["split"] for camera in cameras]
    assert splits.count("train") == scene.views and splits.count("heldout") == 6


def test_both_passes_of_the_slow_fit_count_at_equal_samples():
    """Half the steps of two passes are as many samples as all steps of one."""
    shared = FitConfig(pixels=64, spp=4)
    quick = [dataclasses.replace(shared, method=m) for m in ("ours", "no-prior", "direct")]
    two = dataclasses.replace(shared, method="prb", estimator="two-pass")
    one = dataclasses.replace(shared, method="prb", estimator="split-halves")
    assert steps_of(100 * two.samples_per_step, quick) == 200
    assert steps_of(100 * one.samples_per_step, quick) == 100
    assert steps_of(383, quick) == 1 and steps_of(385, quick) == 2
    with pytest.raises(ValueError, match=r"\[256, 512\] samples cannot have the same length"):
        steps_of(1000, [*quick, two])


def test_estimators_are_told_with_their_scenes_if_there_are_several():
    told = fig6._estimators
    assert told({"A": "two-pass", "B": "two-pass"}) == "two passes"
    mixed = told({"A": "two-pass", "B": "split-halves", "C": "two-pass"})
    assert mixed == "two passes in A, C, split halves in B"


@pytest.fixture
def fits_of_views(tmp_path, monkeypatch):
    """Fits of one view that are off by a given amount, one for each seed."""
    view = SimpleNamespace(name="a", split="heldout", image=tmp_path / "a.exr")
    write_exr(view.image, np.ones((4, 4, 4)))
    monkeypatch.setattr(SceneFits, "heldout", lambda *_: [view])

    def make(*albedo, **others):
        fits = []
        for seed, psnr in enumerate(albedo):
            run = RunFolder(tmp_path / f"{seed}")
            write_exr(run.picture("heldout", "a", "render"), np.full((4, 4, 4), 0.9))
            metrics = {"albedo_psnr": psnr, "roughness_psnr": None}
            found = {"steps": 4 + seed, "per_view": [metrics], "estimator": "two-pass"}
            fits.append(Fit(seed, run, found | others))
        return fits

    return make


def test_rows_of_seeds_follow_their_mean_and_spread(tmp_path, fits_of_views):
    scene_fits = SceneFits(STAIRCASE, ["ours"], FitConfig(), spp=1, seeds=(0, 1, 2))
    light = {"sh_error": 0.25, "relight_psnr_aligned": 30.0}
    fits = fits_of_views(20.0, 23.0, 26.0, environment=light)
    mean, *per_seed = scene_fits.rows(context(tmp_path), fits, method="PRB")
    assert (mean["method"], mean["scene"]) == ("PRB", "STAIRCASE") and mean["seeds"] == 3
    assert mean["albedo_psnr"] == 23.0 and mean["albedo_psnr_sd"] == 3.0  # n - 1
    assert mean["render_psnr"] == pytest.approx(20.0) and mean["render_psnr_sd"] == 0
    assert mean["steps"] == 5 and mean["sh_error"] == 0.25 and mean["relight_psnr_aligned"] == 30.0
    assert "roughness_psnr" not in mean and mean["estimator"] == "two-pass"
    assert [row["seed"] for row in per_seed] == [0, 1, 2]
    assert [row["albedo_psnr"] for row in per_seed] == [20.0, 23.0, 26.0]
    mean, _ = scene_fits.rows(context(tmp_path), fits[:1])
    assert mean["seeds"] == 1 and mean["albedo_psnr"] == 20.0 and "albedo_psnr_sd" not in mean


def test_a_spread_is_of_the_values_that_are_known():
    assert spread("x", []) == {} == spread("x", [None])
    assert spread("x", [2.0, None]) == {"x": 2.0}
    assert spread("x", [1.0, 2.0, 3.0, 6.0]) == {"x": 3.0, "x_sd": pytest.approx((14 / 3) ** 0.5)}
    row = across_seeds([{"x": 1.0, "y": 5}, {"x": 2.0}], ("x", "y", "z"))
    assert row == {"x": 1.5, "x_sd": pytest.approx(0.5**0.5), "y": 5}
    assert plus_minus(row, "x", 2) == "1.50 ± 0.71" and plus_minus(row, "y") == "5.0"
    assert plus_minus(row, "x", 0, 100) == "150 ± 71" and plus_minus(row, "z") is None


def test_a_few_steps_of_each_method_are_taken_to_compile_them(cornell, tiny, monkeypatch):
    steps = []
    real = TrainingStep.__call__

    def counted(self, state, number, rates):
        steps.append((self.config.method, number))
        return real(self, state, number, rates)

    monkeypatch.setattr(TrainingStep, "__call__", counted)
    shared = read_toml(tiny)
    configs = [dataclasses.replace(shared, method=method) for method in ("ours", "direct")]
    compile_kernels(Dataset.load(cornell), configs)
    assert steps == [(method, number) for method in ("ours", "direct") for number in range(3)]


def test_each_seed_has_a_job_and_a_folder_of_its_own(tmp_path, monkeypatch):
    (tmp_path / "staircase").mkdir()
    cpu = ExperimentContext("cpu", tmp_path, tmp_path, Console(quiet=True))
    scene_fits = SceneFits.of(cpu, STAIRCASE, ABLATION.values())
    assert scene_fits.seeds == (0, 1, 2)
    jobs = scene_fits.jobs(cpu)
    assert [job.name for job in jobs] == ["staircase-data", *(f"staircase-{n}" for n in range(3))]
    assert len({json.dumps(job.settings, sort_keys=True) for job in jobs}) == 4
    assert len({scene_fits.runs(cpu, seed) for seed in scene_fits.seeds}) == 3
    # Fits of other methods, or with fewer seeds, are in the same folders.
    fewer = SceneFits.of(cpu, STAIRCASE, ["ours"], 2)
    assert [fewer.runs(cpu, s) for s in (0, 1)] == [scene_fits.runs(cpu, s) for s in (0, 1)]
    times = [job.seconds + job.waits for job in jobs[1:]]
    assert times == [times[0]] * 3 and times[0] > 120 * len(ABLATION)


@pytest.mark.parametrize("name", ["fig6", "fig7", "fig8"])
def test_jobs_of_fewer_seeds_are_among_those_of_more(tmp_path, name):
    figure = load(name)
    for folder in ("envmaps_blender", *(scene.folder for scene in SCENES)):
        (tmp_path / folder).mkdir(exist_ok=True)
    cpu = ExperimentContext("cpu", tmp_path, tmp_path, Console(quiet=True))
    one, two = (figure.jobs(dataclasses.replace(cpu, seeds=seeds)) for seeds in (1, 2))
    kept = {job.name: dict(job.settings) for job in two}
    assert len(one) < len(two)
    assert all(kept[job.name] == dict(job.settings) for job in one)
    seeds = {job.settings["fit"]["seed"] for job in one if "fit" in job.settings}
    assert seeds == {0}


@pytest.mark.parametrize("name", ["table1", "fig3", "fig6"])
def test_experiments_by_scene_have_jobs_of_those_that_are_chosen(tmp_path, name):
    for folder in ("envmaps_blender", "kitchen", "lego"):
        (tmp_path / folder).mkdir()
    jobs = load(name).jobs(context(tmp_path, only=("lego", "kitchen")))
    scenes = list(dict.fromkeys(job.name.split("-")[0] for job in jobs))
    assert scenes == ["kitchen", "lego"]


def test_scenes_that_are_unknown_are_all_named(tmp_path):
    with pytest.raises(UserError, match="'attic' or 'cellar'"):
        load("fig6").jobs(context(tmp_path, only=("attic", "kitchen", "cellar")))


@pytest.mark.parametrize(("option", "value"), [("seeds", 2), ("only", ("kitchen",))])
def test_a_choice_that_an_experiment_does_not_have_is_refused(tmp_path, option, value):
    done = []
    with pytest.raises(UserError) as caught:
        reproduce(squares(done), context(tmp_path, **{option: value}))
    assert caught.value.where == f"--{option}" and not done


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
    fits = SceneFits(STAIRCASE, ["ours"], None, spp=1)
    with pytest.raises(UserError, match=r"a_render\.exr: the picture has 8 x 4 pixels"):
        fits.qualities(context(tmp_path), Fit(0, run, {"per_view": [{}]}))


def test_the_albedo_of_staircase_is_the_one_that_was_calibrated(repository):
    file = repository / "benchmarks" / "results" / "staircase-albedo.json"
    calibrated = json.loads(file.read_text())["powers"][0]
    assert calibrated["power"] == STAIRCASE.albedo_power
    here, paper = (calibrated[key]["PRB 15"] for key in ("relative_l2", "published"))
    # As far as its noise tells: the halves of the samples have the published error between them.
    least, most = sorted(here["halves"])
    assert least < paper["relative_rmse"] < most
    assert here["sign_agreement"] == paper["sign_agreement"] == 1
