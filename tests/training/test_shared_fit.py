"""Fits of several ranks: the same step on all, and runs that do not tell how many there were."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import mitsuba as mi
import numpy as np
import psutil
import pytest
from support import MPIEXEC, needs_mpi, one_thread, tiny_fields

from unbake.config import to_toml
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.ranks import Ranks
from unbake.training.checkpoint import newest_progress, state_digest
from unbake.training.problem import pixels_of, problem_of
from unbake.training.run_folder import RunFolder
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep, with_share
from unbake.transport.methods import METHODS


class Fake(Ranks):
    """A rank of two in this process, with a mean of its own."""

    def __init__(self, rank, mean):
        super().__init__()
        self.rank, self.size, self.mean = rank, 2, mean


def steps_of(data, config, ranks, take):
    """The digest of the state after some steps, the terms of the last one, and the step."""
    dataset = Dataset.load(data)
    pixels = pixels_of(dataset, config, clip_negative=False)
    problem = problem_of(dataset, config, pixels.photographs.level)
    step, state = TrainingStep(problem, pixels, config, ranks), initial_state(problem)
    terms = {}
    with one_thread():
        for number in range(take):
            terms = step(state, number, learning_rates(config, number, 0.0))
    return state_digest(state), {name: float(value[0]) for name, value in terms.items()}, step


def test_a_step_by_the_mean_is_that_of_all_its_gradients(cornell):
    config = replace(tiny_fields(), pixels=64)
    shared, terms, step = steps_of(cornell, config, Fake(0, lambda own: own), 5)
    half = replace(config, pixels=32)
    alone, expected, _ = steps_of(cornell, half, None, 5)
    assert shared == alone and terms == expected
    assert 1 <= step.recordings() <= 3


def test_ranks_draw_different_pixels_and_take_the_same_step(cornell):
    config, drawn = replace(tiny_fields(), pixels=64, method="direct"), {}

    def noted(rank):
        return lambda own: drawn.setdefault(rank, own.copy())

    for rank in (0, 1):
        steps_of(cornell, config, Fake(rank, noted(rank)), 1)
    assert (drawn[0] != drawn[1]).any()
    mean = (drawn[0] + drawn[1]) / np.float32(2)
    digests = {steps_of(cornell, config, Fake(rank, lambda own: mean), 1)[0] for rank in (0, 1)}
    assert len(digests) == 1


def test_ranks_may_take_some_steps_by_themselves_before_they_share_what_they_learned(cornell):
    config = replace(tiny_fields(), pixels=64, sync_every=4)
    half, shared = replace(config, pixels=32), []

    def noted(own):
        shared.append(own.copy())
        return own

    for steps, times in ((3, 0), (4, 1), (7, 1), (8, 2)):
        shared.clear()
        digest, terms, _ = steps_of(cornell, config, Fake(0, noted), steps)
        alone, expected, _ = steps_of(cornell, half, None, steps)
        assert digest == alone and terms == expected and len(shared) == times


def test_shared_states_are_the_mean_of_all_numbers(cornell):
    config = replace(tiny_fields(), pixels=64, sync_every=4)
    others = {}

    def noted(rank):
        return lambda own: others.setdefault(rank, own.copy())

    for rank in (0, 1):
        steps_of(cornell, config, Fake(rank, noted(rank)), 4)
    assert (others[0] != others[1]).any() and np.isfinite(others[0]).all()
    mean = (others[0] + others[1]) / np.float32(2)
    found = []
    for rank in (0, 1):
        digest, _, step = steps_of(cornell, config, Fake(rank, lambda own: mean), 4)
        assert 1 <= step.recordings() <= 3
        found.append(digest)
    assert found[0] == found[1]


def test_losses_are_told_as_the_mean_of_all_ranks(cornell):
    config = replace(tiny_fields(), pixels=64, sync_every=4, method="direct")
    _, terms, step = steps_of(cornell, config, Fake(0, lambda own: 3 * own), 1)
    read = step.read([{name: mi.Float(value) for name, value in terms.items()}] * 2)
    assert len(read) == 2 and set(read[0]) == set(terms)
    assert all(read[1][name] == pytest.approx(3 * value) for name, value in terms.items())


def test_a_fit_of_one_process_does_not_ask_how_often_others_share(cornell):
    config = replace(tiny_fields(), pixels=64)
    often, seldom = (
        steps_of(cornell, replace(config, sync_every=every), None, 5)[:2] for every in (1, 3)
    )
    assert often == seldom


def test_batches_that_cannot_be_shared_equally_are_refused():
    config = tiny_fields()
    assert with_share(replace(config, pixels=96), 3).pixels == 32
    with pytest.raises(UserError, match="--batch 99"):
        with_share(replace(config, pixels=100), 3)


def test_batches_that_would_do_are_those_of_all_ranks(cornell):
    _, _, step = steps_of(cornell, replace(tiny_fields(), pixels=64), Fake(0, lambda own: own), 0)
    assert step._smaller(5) == "Lower --batch from 64 to 10, or --spp"
    crops = replace(tiny_fields(), pixels=62, pixel_sampling="one-view-crop")
    with pytest.raises(UserError, match=r"of each of 2 processes cannot have 31 pixels.* 60,"):
        steps_of(cornell, crops, Fake(0, lambda own: own), 0)
    crops = replace(crops, pixels=64)
    _, _, step = steps_of(cornell, crops, Fake(0, lambda own: own), 0)
    assert step._smaller(11) == "Lower --batch from 64 to 18, or --spp"


@pytest.mark.parametrize("ranks", [1, 2, 4, 8])
def test_crops_are_shared_by_any_number_of_processes_that_a_power_of_two_has(cornell, ranks):
    class Several(Fake):
        def __init__(self):
            super().__init__(0, lambda own: own)
            self.size = ranks

    crops = replace(tiny_fields(), pixels=64, pixel_sampling="one-view-crop", method="direct")
    _, terms, _ = steps_of(cornell, crops, Several(), 1)
    assert np.isfinite(terms["photometric"])


def command(*words, ranks=2):
    return [MPIEXEC, "-n", str(ranks), sys.executable, "-m", "unbake", "fit", *map(str, words)]


def run(words, **more):
    return subprocess.run(words, capture_output=True, text=True, timeout=200, **more)


@pytest.fixture
def settings(tmp_path):
    file = tmp_path / "settings.toml"
    config = replace(tiny_fields(), method="direct", pixels=64, checkpoint_seconds=1)
    file.write_text(to_toml(config))
    return file


@needs_mpi
@pytest.mark.parametrize("every", [1, 8])
def test_a_run_of_two_ranks_goes_on_with_one(cornell, settings, tmp_path, unbake, every):
    out = tmp_path / "run"
    options = ["--settings", settings, "--sync-every", every]
    done = run(command(cornell, "--out", out, *options, "--steps", 24))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("24 steps, 0.0 M samples") == 1
    assert [line["step"] for line in RunFolder(out).log() if "photometric" in line] == [20, 24]
    samples = RunFolder(out).log()[-1]["samples"]
    assert samples == 24 * 64 * tiny_fields().spp
    more = unbake("fit", cornell, "--out", out, "--resume", "--steps", 30)
    assert more.status == 0, more.err
    log = [line["step"] for line in RunFolder(out).log() if "photometric" in line]
    assert log == [20, 24, 30]


@needs_mpi
def test_ranks_with_other_settings_are_refused(cornell, settings, tmp_path):
    wrong = [*command(cornell, "--out", tmp_path / "other", "--settings", settings, ranks=1)]
    wrong += ["--seed", "1", ":", *wrong[1:]]
    refused = run(wrong)
    assert refused.returncode == 2
    assert "do not work on the same: other settings on process 1" in refused.stderr
    assert not (tmp_path / "other").exists() and refused.stderr.count("\n") == 1


@needs_mpi
@pytest.mark.slow
def test_all_end_with_one_that_is_killed(cornell, settings, tmp_path):
    out = tmp_path / "run"
    words = command(cornell, "--out", out, "--settings", settings, "--steps", 200_000)
    program = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        ranks = until_saved(program, out)
        ranks[1].send_signal(signal.SIGKILL)
        _, left = psutil.wait_procs(ranks, timeout=2)
        assert not left
        assert program.wait(timeout=5) != 0
    finally:
        program.kill()
    done = run([*command("--resume", cornell, "--out", out, "--steps", 1, ranks=2)])
    assert done.returncode in (0, 130), done.stderr
    manifest = max((out / "checkpoints").glob("step-*")) / "manifest.json"
    assert json.loads(manifest.read_text())["step"] > 0


def until_saved(program, out):
    """Wait for the first checkpoint of a fit of two; its ranks, in their order."""
    while not list((out / "checkpoints").glob("step-*")) and program.poll() is None:
        time.sleep(0.1)
    children = psutil.Process(program.pid).children(recursive=True)
    ranks = [child for child in children if "unbake" in child.cmdline()]
    assert len(ranks) == 2
    return sorted(ranks, key=lambda rank: rank.environ()["PMI_RANK"])


@needs_mpi
@pytest.mark.parametrize("number", [0, 1])
def test_a_signal_to_one_rank_ends_all_after_the_step_with_a_checkpoint(
    cornell, settings, tmp_path, number
):
    out = tmp_path / "run"
    words = command(cornell, "--out", out, "--settings", settings, "--steps", 200_000)
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(words, **pipes) as program:
        try:
            ranks = until_saved(program, out)
            ranks[number].send_signal(signal.SIGTERM)
            _, left = psutil.wait_procs(ranks, timeout=10)
            assert not left
            text, errors = program.communicate(timeout=10)
        finally:
            program.kill()
    assert program.returncode == (143, 130)[number], errors  # the first one tells it
    stopped = re.search(r"stopped at step (\d+); go on with --resume", text)
    assert newest_progress(RunFolder(out)).step == int(stopped[1])


#: A command whose disk is full, of the first of two ranks.
_FULL = """
import errno, os, sys
def full(number):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
os.fsync = full
from unbake.__main__ import main
main()
"""


@needs_mpi
def test_a_full_disk_of_the_first_rank_ends_all_in_one_line(cornell, settings, tmp_path, unbake):
    out = tmp_path / "run"
    first = unbake("fit", cornell, "--out", out, "--settings", settings, "--steps", 4)
    assert first.status == 0, first.err
    more = ["fit", str(cornell), "--out", str(out), "--resume", "--steps", "8"]
    several = [MPIEXEC, "-n", "1", sys.executable, "-c", _FULL, *more, ":"]
    done = run([*several, "-n", "1", sys.executable, "-m", "unbake", *more])
    own = [line for line in done.stderr.splitlines() if not line.startswith("Abort(2)")]  # MPICH's
    assert done.returncode == 2 and len([line for line in own if line]) == 1, done.stderr
    assert own[0].startswith("process 0: ") and "No space left on device" in own[0]
    assert "next:" not in done.stdout
    assert newest_progress(RunFolder(out)).step == 4 and not list(out.rglob("*.tmp"))


@needs_mpi
def test_an_image_that_only_one_rank_cannot_read_is_told_with_its_name(cornell, settings, tmp_path):
    data, out = tmp_path / "data", tmp_path / "run"
    shutil.copytree(cornell, data)
    image = Dataset.load(data).train[1].image
    content = image.read_bytes()
    image.write_bytes(content[: len(content) // 2])
    done = run(command(data, "--out", out, "--settings", settings, "--steps", 4))
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
    assert "process 1: " in done.stderr and image.name in done.stderr
    assert not out.exists()


@needs_mpi
def test_a_fit_of_one_rank_is_that_of_no_mpi_bit_by_bit(cornell, tiny, tmp_path, repository):
    program = [sys.executable, str(repository / "benchmarks" / "one_process.py"), "fit"]
    found = []
    for name, start in (("alone", []), ("ranks", [MPIEXEC, "-n", "1"])):
        out = tmp_path / name
        words = [*start, *program, str(cornell), "--out", str(out), "--settings", str(tiny)]
        # With one thread sums have one order.
        done = run(
            words, preexec_fn=lambda: os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
        )
        assert done.returncode == 0, done.stderr
        (state,) = out.glob("checkpoints/step-*/state.safetensors")
        log = [line for line in RunFolder(out).log() if "photometric" in line]
        terms = [{k: v for k, v in line.items() if k in METHODS["ours"].terms} for line in log]
        found.append((state.read_bytes(), terms))
    assert found[0] == found[1] and len(found[0][1]) >= 2
