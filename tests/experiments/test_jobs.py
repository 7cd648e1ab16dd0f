"""The job runner: what is done stays done, what is stopped goes on, what fails is recorded."""

import json
import os
import signal
import threading
import time

import pytest
from rich.console import Console

from unbake.errors import UserError
from unbake.experiments.jobs import Job, JobRunner, Unfinished, duration
from unbake.ranks import Ranks


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


def test_a_job_that_runs_out_of_memory_fails_alone(runner, tmp_path):
    done = []
    failed = runner.run([failing("a", MemoryError()), noted(done, "b")])
    assert done == ["b"] and list(failed.failed) == ["a"]
    assert record(tmp_path, "a")["error"].startswith("out of memory. Lower")
    with pytest.raises(RuntimeError, match="a mistake"):
        runner.run([failing("c", RuntimeError("a mistake"))])


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


def test_time_is_that_of_the_findings_alone(runner, tmp_path):
    """Not that of an attempt that failed, nor of one whose files are gone."""
    sleeping, tries, file = 0.3, [], tmp_path / "file"

    def work():
        tries.append(time.sleep(sleeping if len(tries) < 2 else 0))
        if len(tries) == 1:
            raise UserError("no luck")
        file.touch()
        return {}

    job = Job("a", {}, work, files=[file])
    assert list(runner.run([job]).failed) == ["a"]
    assert not runner.run([job]).failed
    assert sleeping <= record(tmp_path, "a")["seconds"] < 2 * sleeping
    file.unlink()
    assert not runner.run([job]).left and len(tries) == 3
    assert record(tmp_path, "a")["seconds"] < sleeping


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


# ------------------------------------------------------------------------------------------ ranks


class Half(Ranks):
    """A rank of two that are threads of this process."""

    def __init__(self, rank, shared, barrier):
        super().__init__()
        self.rank, self.size, self._shared, self._barrier = rank, 2, shared, barrier

    def gather(self, own):
        self._shared[self.rank] = json.loads(json.dumps(own))
        self._barrier.wait(10)
        every = list(self._shared)
        self._barrier.wait(10)
        return every


def run_by_two(folder, jobs_of):
    """What two ranks return that run the jobs which a function makes for each."""
    shared, barrier, outcomes = [None, None], threading.Barrier(2), [None, None]

    def run(rank):
        ranks = Half(rank, shared, barrier)
        runner = JobRunner(folder, Console(quiet=True), ranks=ranks)
        outcomes[rank] = runner.run(jobs_of(rank))

    threads = [threading.Thread(target=run, args=(rank,)) for rank in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(20)
    return outcomes


def test_ranks_share_jobs_by_group_and_keep_the_order_of_each(tmp_path):
    done = ([], [])
    names = {"a": ("a1", "a2"), "b": ("b1", "b2"), "c": ("c1",)}

    def jobs_of(rank):
        return [
            noted(done[rank], name, group=group) for group, jobs in names.items() for name in jobs
        ]

    first, second = run_by_two(tmp_path, jobs_of)
    assert done == (["a1", "a2", "c1"], ["b1", "b2"]) and not first.left
    assert list(first.findings) == ["a1", "a2", "b1", "b2", "c1"]
    assert first.findings == second.findings
    (tmp_path / "b2.json").unlink()
    again, _ = run_by_two(tmp_path, jobs_of)
    assert done[0][3:] == ["b2"] and not again.left, "what is left is dealt anew"


def test_jobs_without_a_group_are_of_the_first_rank(tmp_path):
    done = ([], [])
    run_by_two(tmp_path, lambda rank: [noted(done[rank], "a"), noted(done[rank], "b")])
    assert done == (["a", "b"], [])


def test_a_job_that_fails_on_one_rank_is_known_to_all_and_ends_no_other(tmp_path):
    done = ([], [])

    def jobs_of(rank):
        bad = failing("b1", UserError("no luck", "here", "Try again"))
        bad = Job(bad.name, bad.settings, bad.work, group="b")
        return [noted(done[rank], "a", group="a"), bad, noted(done[rank], "b2", group="b")]

    for outcome in run_by_two(tmp_path, jobs_of):
        assert str(outcome.failed["b1"]) == "here: no luck. Try again"
        assert list(outcome.findings) == ["a", "b2"] and not outcome.left
    assert done == (["a"], ["b2"])
