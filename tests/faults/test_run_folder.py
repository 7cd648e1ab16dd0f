"""Run folders: of one run and one process, and what happens where they cannot be written."""

import json
import os
import random
import resource
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest
from support import at_step

from unbake import cli
from unbake.errors import UserError
from unbake.evaluation import evaluate as evaluation
from unbake.report.page import write_report
from unbake.training import saving
from unbake.training.checkpoint import Progress, newest_progress
from unbake.training.run_folder import Origin, RunFolder
from unbake.training.saving import FIRST, SHARE, Saving


@pytest.fixture
def run(tmp_path):
    return RunFolder(tmp_path / "run")


@pytest.fixture
def often(tiny, tmp_path):
    """Settings with a checkpoint after every step."""
    file = tmp_path / "often.toml"
    kinds = ("albedo", "roughness")
    small = "".join(f"\n[materials.{kind}.neural.pieces]\nmost = 0\n" for kind in kinds)
    file.write_text("checkpoint_seconds = 0\n" + tiny.read_text() + small)
    return file


@pytest.fixture
def fit(unbake, cornell, often, run):
    """Fit with the cheapest method: `fit("--steps", 3)`, `fit("--resume", data=folder)`."""

    def call(*words, data=cornell):
        start = () if "--resume" in words else ("--settings", often, "--method", "direct")
        return unbake("fit", data, "--out", run.path, *start, *words)

    return call


def one_line(outcome, *told):
    assert outcome.status == 2 and outcome.err.count("\n") == 1, outcome
    for words in told:
        assert words in outcome.err


# --------------------------------------------------------------------------------- one run, one fit


def test_a_second_fit_of_a_run_is_refused_and_names_the_first(fit, run):
    assert fit("--steps", 1).status == 0
    with run.lock():
        one_line(fit("--resume", "--steps", 2), f"number {os.getpid()}) fits in this folder")
    assert fit("--resume", "--steps", 2).status == 0


def test_two_fresh_fits_do_not_share_a_folder(fit, run):
    with run.lock():
        one_line(fit("--steps", 1), "another process", "give another folder")
    assert not run.exists and not run.origin_file.exists()


def test_two_evaluations_at_once_are_refused(fit, run, unbake):
    assert fit("--steps", 1).status == 0
    with run.lock_evaluation():
        one_line(unbake("evaluate", run.path, "--spp", 1), "another process", "evaluates in")
    with run.lock():  # while a fit runs
        assert unbake("evaluate", run.path, "--spp", 1).status == 0


@pytest.mark.parametrize("part", ["checkpoints", "log.jsonl", "evaluation"])
def test_parts_of_another_run_are_neither_mixed_nor_erased(part, fit, run, unbake):
    assert fit("--steps", 4).status == 0
    assert unbake("evaluate", run.path, "--spp", 1).status == 0
    parts = {"config.toml", "checkpoints", "log.jsonl", "evaluation", "previews"}
    for name in parts - {part}:
        path = run.path / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    before = {p: p.read_bytes() for p in run.path.rglob("*") if p.is_file()}
    outcome = fit("--steps", 2)
    one_line(outcome, f"holds parts of another run ({part})", "give another --out")
    assert before == {p: p.read_bytes() for p in run.path.rglob("*") if p.is_file()}


def test_a_fit_that_was_killed_before_it_began_is_begun_again(fit, run):
    run.write_origin(Origin("data", 1.0, False, "a"))
    run.log_file.touch()
    assert fit("--steps", 1).status == 0


def test_files_of_other_programs_stay_in_the_folder_of_a_fit(fit, run):
    """It may be the present one: `--out .`."""
    theirs = [".config.toml.swp.tmp", ".notes.0123456789abcdef.tmp", "step-000001.partial"]
    theirs += [".log.jsonl.tmp", ".origin.json.0123456789ABCDEF.tmp"]
    ours = [".config.toml.0123456789abcdef.tmp", ".log.jsonl.4711.tmp"]
    (run.path / ".work.tmp").mkdir(parents=True)
    (run.path / ".work.tmp" / "a.txt").write_text("theirs")
    for name in (*theirs, *ours):
        (run.path / name).write_text("theirs")
    assert fit("--steps", 1).status == 0
    left = {path.name for path in run.path.iterdir()}
    assert {*theirs, ".work.tmp"} <= left and not left & {*ours}
    assert (run.path / ".work.tmp" / "a.txt").read_text() == "theirs"


def test_checkpoints_of_another_run_are_not_evaluated(fit, run, unbake, tmp_path):
    assert fit("--steps", 4).status == 0
    shutil.copytree(run.checkpoints, tmp_path / "other")
    shutil.rmtree(run.path)
    assert fit("--steps", 1).status == 0
    shutil.copytree(tmp_path / "other", run.checkpoints, dirs_exist_ok=True)
    assert unbake("evaluate", run.path, "--spp", 1).status == 0
    assert run.metrics()["steps"] == 1
    # They do not keep the checkpoints of this run from being kept, either.
    assert fit("--resume", "--steps", 3).status == 0
    assert newest_progress(run).step == 3


def test_an_evaluation_takes_the_place_of_the_one_before_as_a_whole(fit, run, unbake, monkeypatch):
    assert fit("--steps", 1).status == 0
    evaluate = ("evaluate", run.path, "--max-depth", 2, "--spp")
    assert unbake(*evaluate, 1, "--train-views", 2).status == 0
    (run.evaluation / "my notes.txt").touch()

    def found():
        return {p: p.read_bytes() for p in run.evaluation.rglob("*") if p.is_file()}

    before = found()
    assert sum("train_001" in file.name for file in before) == 6
    real = evaluation.render_camera
    for error, status in ((KeyboardInterrupt(), 130), (UserError("no luck"), 2)):
        count = iter(range(2))

        def ended(*words, error=error, count=count, **more):
            if next(count, None) is None:  # after two views, whose pictures are written
                raise error
            return real(*words, **more)

        with monkeypatch.context() as patch:
            patch.setattr(evaluation, "render_camera", ended)
            assert unbake(*evaluate, 2, "--train-views", 2).status == status
        after = found()
        assert {p: x for p, x in after.items() if p.name != ".lock"} == {
            p: x for p, x in before.items() if p.name != ".lock"
        }
    assert unbake(*evaluate, 2, "--train-views", 1).status == 0
    after = found()
    assert before.keys() - after.keys() == {p for p in before if "train_001" in p.name}
    assert not after.keys() - before.keys() and run.metrics()["render"]["spp"] == 2
    picture = run.picture("heldout", "heldout_000", "render")
    assert before[picture] != after[picture]


def test_a_run_that_is_deleted_while_it_is_evaluated(fit, run, unbake, monkeypatch):
    """The evaluation ended well, in a new folder without a run."""
    assert fit("--steps", 1).status == 0
    real = evaluation._evaluate_view

    def deleted(*words):
        found = real(*words)
        shutil.rmtree(run.path)
        return found

    monkeypatch.setattr(evaluation, "_evaluate_view", deleted)
    one_line(unbake("evaluate", run.path, "--spp", 1), "the folder was deleted, moved or replaced")
    assert not run.path.exists()


# ---------------------------------------------------------------------------------- links and pipes


@pytest.mark.parametrize("part", ["checkpoints", "previews", "log.jsonl", ".lock"])
def test_nothing_is_written_through_a_link(part, fit, run, tmp_path):
    assert fit("--steps", 1).status == 0
    outside = shutil.move(run.path / part, tmp_path / "outside")
    (run.path / part).symlink_to(outside)
    files = [outside, *outside.rglob("*")] if outside.is_dir() else [outside]
    before = [(p, p.stat().st_mtime_ns) for p in files]
    one_line(fit("--resume", "--steps", 3), part)
    assert before == [(p, p.stat().st_mtime_ns) for p in files]


def test_no_picture_is_written_through_a_link(fit, run, unbake, tmp_path):
    assert fit("--steps", 1).status == 0
    (tmp_path / "outside").mkdir()
    run.evaluation.mkdir()
    (run.evaluation / "train").symlink_to(tmp_path / "outside")
    one_line(unbake("evaluate", run.path, "--spp", 1), "train: is a symbolic link")
    assert not list((tmp_path / "outside").iterdir())


def test_a_pipe_in_the_place_of_the_lock_is_one_line(fit, run):
    assert fit("--steps", 1).status == 0
    (run.path / ".lock").unlink()
    os.mkfifo(run.path / ".lock")
    one_line(fit("--resume", "--steps", 2), ".lock: is not a plain file. Remove it")


# --------------------------------------------------------------------------- disks and lost folders


@pytest.mark.parametrize("act", [shutil.rmtree, lambda path: path.rename(f"{path}.moved")])
def test_a_folder_that_is_gone_ends_the_fit_in_one_line(act, fit, run, monkeypatch):
    at_step(monkeypatch, 5, lambda: act(run.path))
    outcome = fit("--steps", 100)
    one_line(outcome, "run: the folder was deleted, moved or replaced")
    assert "next:" not in outcome.out and not run.path.exists()


def test_a_full_disk_costs_nothing_once_there_is_room_again(fit, run, monkeypatch):
    plain = saving.save_checkpoint

    def full(folder, state, progress, about):
        if 3 <= progress.step < 6:
            raise UserError("the checkpoint cannot be written (No space left on device)")
        return plain(folder, state, progress, about)

    monkeypatch.setattr(saving, "save_checkpoint", full)
    outcome = fit("--steps", 8)
    assert outcome.status == 0 and newest_progress(run).step == 8
    assert outcome.out.count("No space left on device); the fit goes on, and tries again") == 3


def test_a_full_disk_at_the_end_is_no_success(fit, run, monkeypatch):
    plain = saving.save_checkpoint

    def full(folder, state, progress, about):
        if progress.step > 3:
            raise UserError("the checkpoint cannot be written (No space left on device)")
        return plain(folder, state, progress, about)

    with monkeypatch.context() as patch:
        patch.setattr(saving, "save_checkpoint", full)
        one_line(fit("--steps", 8), "No space left on device")
    assert newest_progress(run).step == 3
    assert "going on after step 3" in fit("--resume", "--steps", 8).out


def test_a_limit_on_the_size_of_files_keeps_the_last_good_checkpoint(cornell, often, run):
    """The log outgrows the limit first, and the fit goes on without it; its end is no success."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    done = subprocess.run(
        [sys.executable, "-m", "unbake", "fit", cornell, "--out", run.path, "--settings", often,
         "--method", "direct", "--steps", "150"],
        env=os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])},
        preexec_fn=limit, capture_output=True, text=True, timeout=200,
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "cannot be written (File too large)" in done.stderr
    assert newest_progress(run).step == 150 or "checkpoint" in done.stderr
    assert not list(run.path.rglob("*.tmp"))


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_that_becomes_read_only_is_one_line(fit, run, monkeypatch):
    at_step(monkeypatch, 3, lambda: run.checkpoints.chmod(0o555))
    one_line(fit("--steps", 6), "the checkpoint cannot be written (Permission denied)")
    run.checkpoints.chmod(0o755)
    assert newest_progress(run).step == 3


# --------------------------------------------------------------------------------- when it is saved


class Held:
    def require_held(self):
        pass


@pytest.fixture
def saved(monkeypatch):
    """Steps at which a checkpoint was written that took a number of seconds."""
    steps, clock, cost = [], [0.0], [0.0]

    def save(run, state, progress, about):
        steps.append(progress.seconds)
        clock[0] += cost[0]

    monkeypatch.setattr(saving, "save_checkpoint", save)
    monkeypatch.setattr(saving.time, "perf_counter", lambda: clock[0])

    def go(every, seconds, price):
        steps.clear()
        cost[0] = price
        timer = Saving(None, Held(), {}, every, 0.0)
        for second in range(1, seconds):
            if timer.due(second):
                assert timer.save(None, Progress(second, second)) == []
        return steps

    return go


def test_the_first_checkpoint_is_early_and_all_cost_little(saved):
    assert FIRST == 10 and SHARE == 0.01
    assert saved(60.0, 200, 0.01) == [10, 70, 130, 190]
    assert saved(5.0, 21, 0.01) == [5, 10, 15, 20]
    assert saved(60.0, 1000, 3.0) == [10, 310, 610, 910]
    assert saved(0.0, 5, 3.0) == [1, 2, 3, 4]


# ------------------------------------------------------------------------------------- the data set


@pytest.fixture
def data(cornell, tmp_path):
    """A copy of the data set, to be changed."""
    return shutil.copytree(cornell, tmp_path / "data")


def exchange_photographs(data):
    first, second = (data / "images" / f"train_00{i}.exr" for i in range(2))
    kept = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(kept)


def move_a_camera(data):
    file = data / "transforms.json"
    content = json.loads(file.read_text())
    content["frames"][0]["transform_matrix"][0][3] += 1e-3
    file.write_text(json.dumps(content))


def change_the_light(data):
    file = data / "scene" / "scene.xml"
    text = file.read_text()
    changed = text.replace('value="18.4', 'value="184.', 1)
    file.write_text(changed if changed != text else text.replace("</scene>", "<!-- --></scene>"))


def change_a_mesh(data):
    (mesh, *_) = sorted((data / "scene" / "meshes").glob("*.ply"))
    content = bytearray(mesh.read_bytes())
    content[-1] ^= 0  # the same size; the comment differs
    mesh.write_bytes(content.replace(b"ply\n", b"ply\ncomment x\n", 1))


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (exchange_photographs, "photographs"),
        (move_a_camera, "poses"),
        (change_the_light, "scene"),
        (change_a_mesh, "scene"),
    ],
)
def test_a_fit_goes_on_with_the_same_data_only(change, part, fit, run, data, unbake):
    assert fit("--steps", 1, data=data).status == 0
    moved = data.rename(data.with_name("moved"))
    assert fit("--resume", "--steps", 2, data=moved).status == 0
    change(moved)
    one_line(fit("--resume", "--steps", 3, data=moved), f"was started with: other {part}. Give")
    outcome = unbake("evaluate", run.path, "--spp", 1)
    assert outcome.status == 0 and f"warning: other {part} than the run was fit to" in outcome.out
    assert run.metrics()["data_changed"] == [part]
    page = run.path / "page.html"
    assert unbake("report", run.path, "--out", page).status == 0
    assert f"evaluated on other {part}" in page.read_text()
    # Photographs are not read again for what needs none.
    told = f"warning: other {part} than the run was fit to"
    words = (("render", "--spp", 1), ("export", "--format", "gltf", "--texels", 1))
    for command, *options in words:
        outcome = unbake(command, run.path, "--out", run.path / command, *options)
        assert outcome.status == 0, outcome
        assert (told in outcome.out) == (part != "photographs")


# -------------------------------------------------------------------------------------- its numbers


WRONG = ["text", [1], {"a": 1}, True, int("9" * 400)]


@pytest.mark.parametrize("key", ["step", "seconds", "samples", "score", "validation", "skipped"])
def test_a_log_with_wrong_types_is_one_line(key, run):
    for wrong in WRONG:
        if key in ("score", "validation") and wrong == {"a": 1}:
            continue
        run.path.mkdir(exist_ok=True)
        line = {"step": 1, "seconds": 0.5, "samples": 3} | {key: wrong}
        run.log_file.write_text(json.dumps({"step": 0}) + "\n" + json.dumps(line) + "\n")
        with pytest.raises(UserError, match=rf"log\.jsonl: line 2: `{key}` is "):
            run.log()
    for text in ("[1]", '"a"', "5"):
        run.log_file.write_text(f"{text}\n")
        with pytest.raises(UserError, match=r"line 1: is not a JSON object"):
            run.log()
    run.log_file.write_text('{"step": 1}\n' + " " * (1 << 21))
    with pytest.raises(UserError, match=r"a line has more than the 1048576 characters"):
        run.log()
    run.log_file.write_text("[" * 100_000 + '\n{"step": 1}\n')
    with pytest.raises(UserError, match=r"line 1 is not JSON"):
        run.log()


def places(value, path=()):
    """The paths of keys and indices to all values in a JSON value."""
    yield path
    if isinstance(value, dict | list):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, inner in items:
            yield from places(inner, (*path, key))


def replaced(whole, path, value):
    """A copy of a JSON value with another value at a path."""
    if not path:
        return value
    copy = json.loads(json.dumps(whole))
    place = copy
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return copy


def test_a_damaged_evaluation_is_a_page_or_one_line(fit, run, unbake):
    assert fit("--steps", 2).status == 0
    assert unbake("evaluate", run.path, "--spp", 1).status == 0
    whole, ends = json.loads(run.metrics_file.read_text()), []
    damages = list(product(list(places(whole)), (*WRONG, None, "<script>", -1, 1e308, [], {})))
    for path, wrong in random.Random(0).sample(damages, 60):
        run.metrics_file.write_text(json.dumps(replaced(whole, path, wrong)))
        try:
            write_report([run.path], run.path / "page.html")
            ends.append("page")
        except UserError:  # the command line tells it on one line
            ends.append("line")
    assert min(ends.count("page"), ends.count("line")) > 5


@pytest.mark.parametrize(
    "change",
    [
        {"data": {"a": 1}}, {"data": ""}, {"data": "a\0b"}, {"mean_radiance": "1"},
        {"mean_radiance": True}, {"mean_radiance": 0}, {"mean_radiance": int("9" * 400)},
        {"mean_radiance": float("nan")}, {"clip_negative": 1}, {"run": 5}, {"fingerprint": []},
        {"fingerprint": {"scene": 1}}, {"level": 0}, {"level": "1"}, {"level": float("inf")},
    ],
)  # fmt: skip
def test_an_origin_with_wrong_types_is_one_line(change, run):
    run.write_origin(Origin("data", 1.0, False, "a", {"scene": "b"}))
    good = json.loads(run.origin_file.read_text())
    assert run.origin() == Origin("data", 1.0, False, "a", {"scene": "b"})
    run.origin_file.write_text(json.dumps(good | change))
    with pytest.raises(UserError, match=r"origin\.json: cannot be read. Fit again"):
        run.origin()


def test_no_seconds_are_no_length(fit):
    one_line(fit("--seconds", 0), "--seconds: must be more than 0. --steps 0 trains nothing")
