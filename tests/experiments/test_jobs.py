"""The job runner: what is done stays done, what is stopped goes on, what fails is recorded."""

import json
import os
import signal
import time

import pytest
from rich.console import Console

from unbake.errors import UserError
from unbake.experiments.jobs import Job, JobRunner, Unfinished, duration


@pytest.fixture
def runner(tmp_path):
    return JobRunner(tmp_path, Console(quiet=True), lambda: {"cores": 2}, lambda: 3.0)


def record(folder, name):
    return json.loads((folder / f"{name}.json").read_text())


def noted(done, name, **others):
    """A job that notes its name."""

    def work():
        done.append(name)
        return {"name": name}

    return Job(name, {"length": (1, 2)}, work, **others)


def failing(name, error):
    def work():
        raise error

    return Job(name, {"length": (1, 2)}, work)


def test_a_job_that_fails_is_recorded_and_runs_again(runner, tmp_path):
    done = []
    failed = runner.run([failing("a", UserError("no luck", "here")), noted(done, "b")])
    assert done == ["b"] and failed.findings == {"b": {"name": "b"}} and not failed.left
    assert list(failed.failed) == ["a"] and "findings" not in record(tmp_path, "a")
    assert record(tmp_path, "a")["error"] == "here: no luck"
    again = runner.run([noted(done, "a"), noted(done, "b")])
    assert done == ["b", "a"] and not again.failed and list(again.findings) == ["a", "b"]
    assert "error" not in record(tmp_path, "a") and record(tmp_path, "a")["machine"] == {"cores": 2}


def test_a_job_that_is_stopped_goes_on_and_its_time_adds_up(runner, tmp_path):
    done, sleeping = [], 0.05

    def stopped():
        time.sleep(sleeping)
        raise Unfinished

    settings = {"length": (1, 2)}
    first = runner.run([Job("a", settings, stopped), noted(done, "b")])
    assert first.left == ["a"] and done == ["b"] and not first.failed
    assert record(tmp_path, "a")["seconds"] >= sleeping
    runner.run([noted(done, "a"), noted(done, "b")])
    assert done == ["b", "a"] and record(tmp_path, "a")["seconds"] >= sleeping


def test_no_job_starts_after_the_time_is_up(runner):
    done = []
    until = time.monotonic() + 0.2
    jobs = [
        noted(done, "a"),
        Job("b", {}, lambda: time.sleep(0.3) or {}),
        noted(done, "c"),
    ]
    outcome = runner.run(jobs, until=until)
    assert done == ["a"] and list(outcome.findings) == ["a", "b"] and outcome.left == ["c"]
    assert not runner.run(jobs).left and done == ["a", "c"]


def test_sigterm_keeps_what_was_done(runner, tmp_path):
    done = []
    before = signal.getsignal(signal.SIGTERM)

    def stop():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(10)

    with pytest.raises(KeyboardInterrupt):
        runner.run([noted(done, "a"), Job("b", {}, stop), noted(done, "c")])
    assert done == ["a"] and signal.getsignal(signal.SIGTERM) is before
    assert record(tmp_path, "b").keys() == {"settings", "machine", "seconds"}
    assert [job.name for job in runner.left([noted(done, n) for n in "abc"])] == ["b", "c"]


def test_records_of_older_versions_are_read(runner, tmp_path):
    done = []
    old = {"settings": {"length": [1, 2]}, "machine": {}, "seconds": 4.0, "found": {"name": "old"}}
    (tmp_path / "a.json").write_text(json.dumps(old))
    (tmp_path / "b.json").write_text(json.dumps(old | {"settings": {"length": [3, 4]}}))
    outcome = runner.run([noted(done, "a"), noted(done, "b")])
    assert done == ["b"] and outcome.findings == {"a": {"name": "old"}, "b": {"name": "b"}}


def test_jobs_of_one_name_are_refused(runner):
    with pytest.raises(ValueError, match="same name"):
        runner.run([noted([], "a"), noted([], "a")])


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        ((10.0, 20.0), "0 of 2 jobs are done, the others take about 2 min on this machine"),
        ((10.0, None), "0 of 2 jobs are done, 1 of the others take about 60 s on this machine; "
                       "no estimate for the rest"),
        ((None, None), "0 of 2 jobs are done; no estimate for the others at this scale"),
    ],
)  # fmt: skip
def test_time_is_told_first(runner, seconds, words):
    jobs = [noted([], name, seconds=s, waits=30.0) for name, s in zip("ab", seconds, strict=True)]
    assert runner.plan(jobs) == words
    runner.run(jobs)
    assert runner.plan(jobs) == "all 2 jobs are done"


@pytest.mark.parametrize(
    ("seconds", "told"), [(0.2, "1 s"), (75, "75 s"), (600, "10 min"), (9000, "2.5 h")]
)
def test_lengths_of_time_are_told_in_words(seconds, told):
    assert duration(seconds) == told
