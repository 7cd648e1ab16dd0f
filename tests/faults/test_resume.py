"""Runs that end early: what was learned stays, and goes on where it ended."""

import dataclasses
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from support import interrupt_at, last_state, one_thread_from_first_step, tiny_fields

from unbake import cli
from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import FitConfig, read_toml
from unbake.dataset import photographs
from unbake.errors import UserError
from unbake.fields.registry import representations
from unbake.imaging.pictures import read_exr, write_exr
from unbake.quantities import QUANTITIES
from unbake.training import loop
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder
from unbake.transport.methods import METHODS


@pytest.fixture
def fit(unbake, cornell, tiny, tmp_path):
    """Fit with the cheapest method: `fit("--steps", 3)`, `fit("--resume")`."""

    def run(*words, name="run", method="direct"):
        start = () if "--resume" in words else ("--settings", tiny, "--method", method)
        return unbake("fit", cornell, "--out", tmp_path / name, *start, *words)

    return run


@pytest.fixture
def started(cornell, tiny, tmp_path):
    """A fit in a process of its own which would take an hour, once its first lines are logged."""
    settings = tmp_path / "often.toml"
    settings.write_text("checkpoint_seconds = 0\n" + tiny.read_text())
    run = tmp_path / "run"
    process = subprocess.Popen(
        [sys.executable, "-m", "unbake", "fit", cornell, "--out", run, "--settings", settings,
         "--method", "direct", "--seconds", "3600"],
        env=os.environ | {"PYTHONPATH": str(Path(cli.__file__).parents[2])},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while len(list((run / "checkpoints").glob("step-*"))) < 3:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    yield process
    process.kill()
    process.communicate()


def steps_logged(run):
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [line["step"] for line in lines if "validation" not in line]


def checkpoints(run):
    return sorted((run / "checkpoints").glob("step-*"))


def step_of(checkpoint):
    return int(checkpoint.name.removeprefix("step-"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_a_fit_with_a_checkpoint(number, started, fit, tmp_path):
    run = tmp_path / "run"
    started.send_signal(number)
    out, err = started.communicate(timeout=60)
    assert started.returncode == 128 + number and err == ""
    last = step_of(checkpoints(run)[-1])
    assert f"stopped at step {last}; go on with --resume" in out
    assert steps_logged(run)[-1] == last

    outcome = fit("--resume", "--steps", last + 7)
    assert outcome.status == 0 and f"going on after step {last}" in outcome.out
    assert step_of(checkpoints(run)[-1]) == last + 7
    logged = steps_logged(run)
    assert logged[-1] == last + 7 and sorted(set(logged)) == logged


def test_a_killed_fit_goes_on(started, fit, tmp_path):
    run = tmp_path / "run"
    started.kill()
    started.communicate()
    unfinished = run / "checkpoints" / ".step-999999999.17.tmp"
    unfinished.mkdir()
    (unfinished / "state.safetensors").write_bytes(b"half a checkpoint")
    (run / ".config.toml.17.tmp").write_text("half")
    with (run / "log.jsonl").open("a") as log:
        log.write('{"step": 99999, "sec')
    last = step_of(checkpoints(run)[-1])
    outcome = fit("--resume", "--steps", last + 3)
    assert outcome.status == 0 and f"going on after step {last}" in outcome.out
    logged = steps_logged(run)
    assert logged[-1] == last + 3 and sorted(set(logged)) == logged
    assert not list(run.rglob("*.tmp"))


@pytest.mark.parametrize(
    ("method", "words"),
    [
        ("direct", ()),
        pytest.param("ad-pt", ("--max-depth", "5"), marks=pytest.mark.slow),
        ("ours", ()),
        ("ours", ("--representation", "triplane", "--radiance", "triplane")),
    ],
    ids=["direct", "ad-pt", "ours", "triplane"],
)
def test_a_resumed_fit_ends_where_an_uninterrupted_one_does(
    method, words, fit, tmp_path, monkeypatch
):
    with one_thread_from_first_step():
        assert fit("--steps", 12, *words, name="whole", method=method).status == 0
    interrupt_at(monkeypatch, 6)
    with one_thread_from_first_step():
        outcome = fit("--steps", 12, *words, name="parts", method=method)
    assert outcome.status == 130 and "stopped at step 7" in outcome.out
    with one_thread_from_first_step():
        assert fit("--resume", name="parts").status == 0
    whole, parts = (last_state(tmp_path / name) for name in ("whole", "parts"))
    assert whole.keys() == parts.keys() and len(whole) >= 8
    for key in whole:
        assert np.array_equal(whole[key], parts[key]), key
    settings = [read_toml(tmp_path / name / "config.toml") for name in ("whole", "parts")]
    assert settings[0] == settings[1] and settings[0].steps == 12


@pytest.fixture(scope="module")
def still(tmp_path_factory):
    """A captured data set whose environment can be unknown."""
    folder = tmp_path_factory.mktemp("captured") / "still"
    small = CaptureSettings(views=2, held_out=1, resolution=16, spp=8, max_depth=6)
    capture("still", folder, small, tell=lambda line: None)
    return folder


def in_parts_and_whole(data, config, folder, monkeypatch, threads=nullcontext):
    """The states of a fit of 12 steps at its end, uninterrupted and interrupted three times."""
    config = dataclasses.replace(config, steps=12)
    with threads():
        loop.fit(data, folder / "whole", config)
    with monkeypatch.context() as patch:
        interrupt_at(patch, 0, 5, 10)
        for after in (1, 6, 11, 12):
            with threads():
                progress = loop.fit(data, folder / "parts", config, resume=after > 1)
            assert progress.step == after
    return [last_state(folder / name) for name in ("whole", "parts")]


FORMS = [(form, "neural") for form in representations()]
FORMS += [("neural", form) for form in representations(radiance=True) if form != "neural"]
UNKNOWNS = ("lighting", "materials+lighting", "emission", "materials+emission")
MATRIX = [
    *({"method": method} for method in METHODS),
    *({"unknown": unknown} for unknown in UNKNOWNS),
    *({"unknown": unknown, "method": "prb"} for unknown in UNKNOWNS),
    *({"representation": a, "radiance_representation": b} for a, b in FORMS),
    {"quantities": tuple(QUANTITIES)},
    {"precision": "half"},
]


@pytest.mark.slow
@pytest.mark.parametrize("changes", MATRIX, ids=lambda row: "-".join(map(str, row.values())))
def test_every_fit_that_is_interrupted_three_times_ends_bit_for_bit_as_uninterrupted(
    changes, cornell, still, tmp_path, monkeypatch
):
    forms = ("representation", "radiance_representation")
    config = tiny_fields(*(changes.get(form, "neural") for form in forms))
    config = dataclasses.replace(config, **{"method": "ours"} | changes)
    data = still if "lighting" in config.unknown else cornell
    threads = one_thread_from_first_step
    whole, parts = in_parts_and_whole(data, config, tmp_path, monkeypatch, threads)
    assert whole.keys() == parts.keys() and len(whole) >= 4
    for key in whole:
        assert np.array_equal(whole[key], parts[key]), key


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ours", "prb"])
def test_with_several_threads_a_resumed_fit_ends_as_near_as_another_one(
    method, cornell, tmp_path, monkeypatch
):
    """Sums have no fixed order then."""
    config = dataclasses.replace(tiny_fields(), method=method)
    whole, parts = in_parts_and_whole(cornell, config, tmp_path, monkeypatch)
    assert whole.keys() == parts.keys() and len(whole) >= 4
    for key in whole:
        scale = np.abs(whole[key]).max()
        assert np.abs(whole[key].astype(float) - parts[key]).max() <= 1e-5 * scale, key


def test_a_resumed_fit_keeps_its_length_unless_told_otherwise(fit, tmp_path, monkeypatch):
    interrupt_at(monkeypatch, 2)
    assert fit("--steps", 9).status == 130
    assert fit("--resume").status == 0
    assert step_of(checkpoints(tmp_path / "run")[-1]) == 9
    again = fit("--resume")
    assert again.status == 0 and "9 steps" in again.out
    assert fit("--resume", "--steps", 11).status == 0
    assert step_of(checkpoints(tmp_path / "run")[-1]) == 11


def test_a_length_in_seconds_replaces_one_in_steps_and_back(fit, tmp_path):
    assert fit("--seconds", 0.01).status == 0
    last = step_of(checkpoints(tmp_path / "run")[-1])
    assert fit("--resume", "--steps", last + 2).status == 0
    config = read_toml(tmp_path / "run" / "config.toml")
    assert (config.steps, config.seconds) == (last + 2, 0)
    assert step_of(checkpoints(tmp_path / "run")[-1]) == last + 2


def test_a_run_is_not_mixed_with_another(fit, tmp_path):
    assert fit("--steps", 1).status == 0
    before = {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()}
    outcome = fit("--steps", 1)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "there is a run in this folder already. Go on with --resume" in outcome.err
    assert before == {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()}


def test_there_must_be_a_run_to_resume(fit, tmp_path):
    outcome = fit("--resume")
    assert outcome.status == 2
    assert "run: there is no run to resume in this folder. Leave out --resume" in outcome.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("words", [("--batch", 9), ("--preset", "cpu"), ("--method", "ours")])
def test_a_resumed_fit_keeps_its_settings(words, fit):
    assert fit("--steps", 1).status == 0
    outcome = fit("--resume", *words)
    assert outcome.status == 2
    assert outcome.err == f"error: {words[0]}: cannot be given together with --resume\n"


@pytest.mark.parametrize("version", ["0.1", "now"])
def test_a_resumed_fit_keeps_its_photographs(version, unbake, fit, cornell, tmp_path):
    """Version 0.1 knew of photographs nothing but their mean."""
    assert fit("--steps", 1).status == 0
    if version == "0.1":
        run = RunFolder(tmp_path / "run")
        run.write_origin(dataclasses.replace(run.origin(), fingerprint={}, level=None))
    other = shutil.copytree(cornell, tmp_path / "other")
    image = other / "images" / "train_000.exr"
    write_exr(image, read_exr(image) * [2, 2, 2, 1])
    outcome = unbake("fit", other, "--out", tmp_path / "run", "--resume", "--steps", 2)
    assert outcome.status == 2
    assert "other: this is not the data set that the run" in outcome.err
    assert "was started with: other photographs. Give" in outcome.err


@pytest.mark.parametrize("level", [0.7, None])
def test_a_resumed_fit_keeps_the_level_of_its_photographs(level, fit, tmp_path, monkeypatch):
    """Runs of earlier versions have none: theirs is the mean radiance, lamps and all."""
    monkeypatch.setattr(photographs, "LAMP", 0.5)
    assert fit("--steps", 1, method="ours").status == 0
    run, epsilons = RunFolder(tmp_path / "run"), []
    begun = run.origin()
    assert 0 < begun.level < 0.9 * begun.mean_radiance
    assert load_run(run.path).problem.radiance.scale == begun.level
    run.write_origin(dataclasses.replace(begun, level=level))
    monkeypatch.setattr(FitConfig, "epsilon", lambda _, mean: epsilons.append(mean) or 1e-3)
    assert fit("--resume", "--steps", 2).status == 0
    wanted = begun.mean_radiance if level is None else level
    assert set(epsilons) == {wanted}
    assert run.origin().level == level
    assert load_run(run.path).problem.radiance.scale == wanted


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_damaged_checkpoint_costs_only_the_steps_after_the_one_before(damage, fit, tmp_path):
    assert fit("--steps", 4).status == 0
    assert fit("--resume", "--steps", 6).status == 0
    older, newest = checkpoints(tmp_path / "run")
    state = newest / "state.safetensors"
    content = bytearray(state.read_bytes())
    if damage == "cut":
        del content[-100:]
    else:
        content[-100] ^= 1
    state.write_bytes(content)
    outcome = fit("--resume", "--steps", 8)
    assert outcome.status == 0 and f"going on after step {step_of(older)}" in outcome.out
    assert step_of(checkpoints(tmp_path / "run")[-1]) == 8


def test_no_checkpoint_that_can_be_read_is_an_error(unbake, fit, tmp_path):
    assert fit("--steps", 1).status == 0
    (checkpoints(tmp_path / "run")[0] / "manifest.json").write_bytes(b"")
    outcome = fit("--resume", "--steps", 2)
    assert outcome.status == 2
    assert "checkpoints: no checkpoint in this folder can be read" in outcome.err
    outcome = unbake("evaluate", tmp_path / "run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1


def test_a_full_disk_is_one_line_and_older_checkpoints_stay(fit, tmp_path, monkeypatch):
    assert fit("--steps", 2).status == 0
    before = (checkpoints(tmp_path / "run")[0] / "state.safetensors").read_bytes()

    def full(number):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        outcome = fit("--resume", "--steps", 4)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "the checkpoint cannot be written (No space left on device)" in outcome.err
    (kept,) = checkpoints(tmp_path / "run")
    assert (kept / "state.safetensors").read_bytes() == before
    outcome = fit("--resume", "--steps", 4)
    assert outcome.status == 0 and "going on after step 2" in outcome.out


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write anywhere")
def test_a_folder_that_may_not_be_written(fit, tmp_path):
    (tmp_path / "closed").mkdir(mode=0o555)
    outcome = fit("--steps", 1, name="closed/run")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "Permission denied" in outcome.err


def test_a_fit_in_another_thread_runs_without_handling_signals(cornell, tiny, tmp_path):
    config = dataclasses.replace(read_toml(tiny), steps=2)
    with ThreadPoolExecutor(1) as threads:
        progress = threads.submit(loop.fit, cornell, tmp_path / "run", config).result()
    assert progress.step == 2


def test_a_log_forgets_what_lies_after_a_step(tmp_path):
    log = tmp_path / "log.jsonl"
    lines = ['{"step": 20}', '{"step": 40}', '{"step": 40, "validation": {}}', '{"step": 60}']
    log.write_text("\n".join([*lines, '{"step": 8']))
    RunFolder(tmp_path).forget_after(40)
    assert log.read_text().splitlines() == lines[:3]
    RunFolder(tmp_path).forget_after(0)
    assert log.read_text() == ""
    RunFolder(tmp_path / "new").forget_after(0)
    assert (tmp_path / "new" / "log.jsonl").read_text() == ""


def test_a_log_that_is_no_text_is_named_and_forgotten_where_a_fit_goes_on(tmp_path):
    run = RunFolder(tmp_path)
    run.log_file.write_bytes(b'{"step": 1}\n\xff\xfe\n{"step": 2}\n')
    with pytest.raises(UserError, match=r"log\.jsonl: the file is not UTF-8 text"):
        run.log()
    run.forget_after(2)
    assert run.log() == [{"step": 1}, {"step": 2}]
