"""What the ranks of a fit tell each other, and how they end together."""

import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support import MPIEXEC, needs_mpi, on_ranks, tiny_fields

from unbake import ranks as module
from unbake.config import CameraConfig
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.ranks import SIZES, Agreed, Ranks, alone, started
from unbake.scene.parse import parse
from unbake.training import first_gains as gains_module
from unbake.training import plausibility
from unbake.training.checkpoint import Progress
from unbake.training.diagnosis import diagnose
from unbake.training.first_gains import begin_cameras, shared_points
from unbake.training.loop import _log_entry
from unbake.training.problem import pixels_of, problem_of
from unbake.training.step import Replay


class Request:
    """One that is done after some looks; never without a number."""

    def __init__(self, looks=3):
        self.looks = looks

    def Test(self):
        if self.looks is None:
            return False
        self.looks -= 1
        return self.looks < 0


class Two:
    """A communicator of two ranks, whose other rank says what the test lets it say."""

    size = 2

    def __init__(self, rank=0, others=(), looks=3):
        self.rank, self.others, self.looks, self.status = rank, list(others), looks, None
        self.signs = []  # of life that were sent
        self.coming = None  # signs that have not been received yet; None: one at each look
        self.looked = False

    def Iallreduce(self, send, total):
        total[:] = send + self.others.pop(0)
        return Request(self.looks)

    def Iallgather(self, send, rows):
        other = self.others.pop(0)
        rows[self.rank], rows[1 - self.rank] = send, send if other is None else other
        return Request(self.looks)

    def Ibcast(self, array, root):
        assert root == 0
        if self.rank:
            array[:] = self.others.pop(0)
        return Request(self.looks)

    def Isend(self, sign, dest, tag):
        self.signs.append(dest)
        return Request()

    def Iprobe(self, source, tag):
        assert source == 1 - self.rank
        if self.coming is None:
            self.looked = not self.looked
            return self.looked
        return self.coming > 0

    def Recv(self, sign, source, tag):
        assert source == 1 - self.rank
        if self.coming is not None:
            assert self.coming, "nothing will come"
            self.coming -= 1

    def Irecv(self, sign, source, tag):
        self.Recv(sign, source, tag)
        return Request(self.looks)

    def Abort(self, status):
        self.status = status


@pytest.fixture
def alarms(monkeypatch):
    """Ends of the process are exits of the test, and what would end it later is noted."""
    noted = []
    for name in ("_AFTER_YOU", "_PASSED_ON"):
        monkeypatch.setattr(module, name, 0.0)
    monkeypatch.setattr(signal, "alarm", noted.append)
    monkeypatch.setattr(os, "_exit", lambda status: (_ for _ in ()).throw(SystemExit(status)))
    return noted


def error_of(what, where="", remedy=""):
    """An error as `together` sends it."""
    text = "\0".join((what, where, remedy)).encode()
    return np.frombuffer(text.ljust(4096, b"\0"), np.uint8)


def test_one_process_tells_itself_what_it_knows(monkeypatch):
    for name in SIZES:
        monkeypatch.delenv(name, raising=False)
    alone, numbers = Ranks.of_environment(), np.ones(3, np.float32)
    assert (alone.rank, alone.size, alone.here, alone.leads) == (0, 1, 1, True)
    assert alone.mean(numbers) is numbers and alone.of_first(2.5) == 2.5
    assert alone.joined(lambda: numbers) is numbers and alone.gather("it") == ["it"]
    assert alone.any(True, False) == (True, False)
    alone.require_same({"seed": "0"})
    with pytest.raises(UserError, match="bad"):
        alone.together(lambda: fail("bad"))
    with pytest.raises(UserError, match="bad"), alone.guarded(print):
        fail("bad")


@pytest.fixture
def environment(monkeypatch):
    """Set what launchers tell, and nothing else of theirs; whether the input is a terminal."""

    def told(terminal=False, **sizes):
        for name in SIZES:
            monkeypatch.delenv(name, raising=False)
        for name, size in sizes.items():
            monkeypatch.setenv(name, str(size))
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: terminal))

    return told


@pytest.mark.parametrize(
    ("sizes", "several"),
    [
        ({}, 1),
        ({"PMI_SIZE": 4}, 4),
        ({"OMPI_COMM_WORLD_SIZE": 4, "PMI_SIZE": 1}, 4),
        # mpiexec starts one process by srun on each of two machines, which starts four.
        ({"PMI_SIZE": 8, "SLURM_STEP_NUM_TASKS": 2}, 8),
        ({"SLURM_STEP_NUM_TASKS": 4}, 4),
        ({"SLURM_STEP_NUM_TASKS": 4, "terminal": True}, 1),
        ({"SLURM_NTASKS": 4}, 1),  # of an allocation, in whose script one process runs
        ({"PMI_SIZE": "none"}, 1),
    ],
)
def test_launchers_tell_how_many_they_started(environment, sizes, several):
    environment(**sizes)
    assert started() == several


def test_processes_that_their_mpi_takes_for_one_each_are_refused(environment, monkeypatch):
    world = Two()
    world.Split_type = lambda kind: SimpleNamespace(size=2)
    mpi = SimpleNamespace(
        COMM_WORLD=world,
        COMM_TYPE_SHARED=0,
        THREAD_MULTIPLE=3,
        Query_thread=lambda: 3,
        get_vendor=lambda: ("Some MPI", (5, 0)),
    )
    monkeypatch.setitem(sys.modules, "mpi4py", SimpleNamespace(MPI=mpi))
    environment(PMI_SIZE=2)
    assert Ranks.of_environment().size == 2
    world.size = 1
    assert_foreign()
    environment(OMPI_COMM_WORLD_SIZE=2, PMI_SIZE=1)
    assert_foreign()
    environment(SLURM_STEP_NUM_TASKS=2)
    assert_foreign()


def assert_foreign():
    with pytest.raises(
        UserError, match=r"^2 processes .*, but Some MPI of mpi4py knows of 1\. .*pmi2"
    ):
        Ranks.of_environment()


@needs_mpi
def test_processes_of_another_mpi_are_refused(repository):
    more = {"OMPI_COMM_WORLD_SIZE": "2", "PYTHONPATH": str(repository / "src")}
    words = [sys.executable, "-m", "unbake", "fit", "data", "--out", "run"]
    run = {"capture_output": True, "text": True, "timeout": 60, "env": alone() | more}
    done = subprocess.run(words, **run)
    assert done.returncode == 2 and "2 processes were started, but" in done.stderr
    assert done.stderr.count("\n") == 1


def fail(what):
    raise UserError(what, "a file", "Mend it")


def test_means_and_answers_are_those_of_all():
    ranks = Ranks(Two(others=[np.float32([3, 5]), np.array([0, 1, 0])]))
    np.testing.assert_array_equal(ranks.mean(np.float32([1, 2])), [2, 3.5])
    assert ranks.any(True, False, False) == (True, True, False)
    assert ranks.of_first(4.0) == 4
    follower = Ranks(Two(1, [[7.5]]))
    assert not follower.leads and follower.of_first(4.0) == 7.5


def test_ranks_with_other_input_are_named():
    Ranks(Two(others=[None])).require_same({"settings": "a", "data set": "b"})
    other = np.zeros(64, np.uint8)
    with pytest.raises(Agreed, match="other settings on process 1; other data set on process 1"):
        Ranks(Two(others=[other])).require_same({"settings": "a", "data set": "b"})


@pytest.mark.parametrize("rank", [0, 1])
def test_an_error_of_one_rank_is_told_on_all(rank):
    gathered = [np.uint8([rank == 0]), error_of("no memory", "a file", "Mend it")]
    work = int if rank == 0 else lambda: fail("no memory")
    with pytest.raises(Agreed, match=r"^a file: process 1: no memory\. Mend it$"):
        Ranks(Two(rank, gathered)).together(work)


def test_an_error_of_all_ranks_is_that_of_each():
    with pytest.raises(Agreed, match=r"^a file: bad\. Mend it$"):
        Ranks(Two(others=[np.uint8([1]), None])).together(lambda: fail("bad"))
    assert Ranks(Two(others=[np.uint8([0])])).together(lambda: 5) == 5


def test_waiting_has_a_limit():
    ranks, start = Ranks(Two(others=[1], looks=None), patience=0.05), time.monotonic()
    with pytest.raises(UserError, match="have not answered for 0 s"):
        ranks.any(True)
    assert 0.05 <= time.monotonic() - start < 1


def after_steps(rank, seconds, clock, **options):
    """A rank of two that has taken some steps of so many seconds."""
    ranks = Ranks(Two(rank, others=[1] * 200), **options)
    for _ in range(20):
        clock.now += seconds
        ranks.any(True)
    return ranks


class Clock:
    """The seconds that the test says; each look takes one of the given lengths."""

    def __init__(self, look=0.0):
        self.now, self.look = 0.0, look

    def __call__(self):
        self.now += self.look
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(time, "monotonic", clock)
    monkeypatch.setattr(time, "sleep", lambda _: None)
    return clock


def waits(ranks, clock, look=0.5):
    """The seconds after which a rank gives up."""
    ranks._communicator.looks, clock.look = None, look
    began = clock.now
    with pytest.raises(UserError, match="have not answered for"):
        ranks.any(True)
    clock.look = 0.0
    return clock.now - began


def test_the_limit_is_short_in_steps_and_long_where_one_may_have_something_else_to_do(clock):
    assert waits(after_steps(0, 0.1, clock), clock) == pytest.approx(20, abs=2)
    assert waits(after_steps(1, 5.0, clock), clock) == pytest.approx(50, abs=2)
    first = Ranks(Two(others=[1] * 9))
    assert first.any(True) and waits(first, clock) == pytest.approx(120, abs=2)
    follower, leader = after_steps(1, 0.1, clock), after_steps(0, 0.1, clock)
    for ranks, limit in ((follower, 120), (leader, 50)):
        ranks.announce()
        clock.now += 5  # rank 0 needs so long itself
        assert waits(ranks, clock) == pytest.approx(limit, rel=0.15)


def test_after_a_long_phase_the_limit_is_short_again(clock):
    ranks = after_steps(1, 0.1, clock)
    ranks.announce()
    clock.now += 100
    assert ranks.any(True) and ranks.any(True)
    assert waits(ranks, clock) == pytest.approx(20, abs=2)


def test_time_in_which_a_process_was_stopped_is_no_waiting(clock):
    ranks = after_steps(0, 0.1, clock)
    assert waits(ranks, clock, look=100.0) > 10 * 100


def test_rank_0_may_take_as_long_as_it_likes_while_it_gives_signs_of_life(clock):
    ranks = after_steps(1, 0.1, clock, beats=True)
    ranks.announce()
    ranks._communicator.looks, clock.look = 2000, 0.5
    assert ranks.any(True) == (True,) and clock.now > 900


def test_old_signs_of_life_count_once(clock):
    ranks = after_steps(1, 0.1, clock, beats=True)
    ranks._communicator.coming = 1000
    assert waits(ranks, clock) == pytest.approx(20, abs=2)
    assert not ranks._communicator.coming


@pytest.mark.parametrize("early", [0, 3])
def test_all_signs_of_life_are_received(early, clock):
    ranks = after_steps(1, 0.1, clock, beats=True)
    ranks.announce()
    world = ranks._communicator
    world.coming = early
    ranks._has_arrived(module._ALIVE, 0)  # as in a long wait
    world.coming = 7 - early
    world.others = [np.int32([1]), np.array([0, 7])]  # an answer, and how many were sent
    assert ranks.any(True) == (True,)
    assert not world.coming and not world.others


def test_a_sign_of_life_that_does_not_come_is_not_waited_for_without_an_end(clock):
    ranks = after_steps(1, 0.1, clock, beats=True)
    ranks.announce()
    ranks._communicator.others = [np.int32([1]), np.array([0, 7])]
    ranks._communicator.Irecv = lambda sign, source, tag: Request(None)
    ranks._communicator.coming, clock.look = 0, 0.5
    with pytest.raises(UserError, match="have not answered"):
        ranks.any(True)


def test_signs_of_life_end_when_all_meet_again(monkeypatch):
    monkeypatch.setattr(module, "_BEAT", 0.005)
    world = Two(others=[1, None, 1])
    ranks, before = Ranks(world, beats=True), threading.active_count()
    ranks.announce()
    ranks.announce()
    assert threading.active_count() == before + 1
    deadline = time.monotonic() + 5
    while len(world.signs) < 3 and time.monotonic() < deadline:
        time.sleep(0.005)
    assert ranks.any(True) and threading.active_count() == before
    sent = len(world.signs)
    assert sent >= 3 and set(world.signs) == {1}
    time.sleep(0.05)
    assert len(world.signs) == sent
    for quiet in (Ranks(Two(1), beats=True), Ranks(Two(0)), Ranks()):
        quiet.announce()
    assert threading.active_count() == before


#: Rank 0 does something for longer than the other one would wait without signs of life.
_LONG = """
import sys, time
from unbake import ranks as module
module._BEAT, module._LONG = 0.1, 0.2
ranks = module.Ranks.of_environment()
ranks._patience, ranks._beats = 0.6, sys.argv[1] == "True"
for _ in range(20):
    ranks.any(True)
ranks.announce()
start = time.monotonic()
if ranks.leads:
    time.sleep(1.2)
with ranks.guarded(print):
    ranks.any(True)
    ranks.any(True)
    sys.stdout.write(f"{ranks.rank} {time.monotonic() - start > 1.1}\\n")
"""


@needs_mpi
@pytest.mark.parametrize("beats", [True, False])
def test_signs_of_life_arrive(beats, repository, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    words = [MPIEXEC, "-n", "2", sys.executable, "-c", _LONG, str(beats)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    if beats:
        assert sorted(done.stdout.splitlines()) == ["0 True", "1 True"] and not done.stderr
    else:
        assert (
            done.returncode == 2
            and "process 1: the other processes have not answered" in done.stdout
        )


#: Rank 1 works longer than the others would wait without signs of life.
_APART = """
import sys, time
from unbake import ranks as module
module._BEAT = 0.1
ranks = module.Ranks.of_environment()
ranks._patience = 0.7
with ranks.apart():
    if not ranks.leads:
        time.sleep(1.2)
    sys.stdout.write(f"{ranks.gather(ranks.rank)}\\n")  # a line of two processes in one piece
"""


@needs_mpi
def test_ranks_apart_wait_for_those_that_live(repository, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    words = [MPIEXEC, "-n", "2", sys.executable, "-c", _APART]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines() == ["[0, 1]"] * 2 and not done.stderr


#: Rank 1 does not come to the end at which MPI waits for it.
_STAYS = """
import sys, time
from unbake import ranks as module
module._LEAVE = int(sys.argv[1])
ranks = module.Ranks.of_environment()
ranks.any(True)
ranks.leave()
if not ranks.leads:
    time.sleep(float(sys.argv[2]))
"""


@needs_mpi
@pytest.mark.parametrize("stays", [0, 40])
def test_mpi_that_does_not_end_is_ended(stays, repository, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    words, start = [MPIEXEC, "-n", "2", sys.executable, "-c", _STAYS, "1", str(stays)], time.time()
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert time.time() - start < 20
    assert (done.returncode != 0) == (stays > 0)


def test_ranks_apart_end_where_one_is_silent_or_the_library_fails(monkeypatch, alarms, capsys):
    class Ended(Exception):
        pass

    monkeypatch.setattr(module, "_BEAT", 0.001)
    monkeypatch.setattr(os, "_exit", lambda status: (_ for _ in ()).throw(Ended(status)))
    ranks = Ranks(Two(), patience=0.02, beats=True)
    ranks._communicator.coming = 0
    with pytest.raises(Ended, match="2"):
        ranks._watch(threading.Event())
    assert "process 0: process 1 has not been heard of for 0 s. See" in capsys.readouterr().err
    monkeypatch.setattr(Two, "Isend", lambda *_, **__: fail("lost"))
    with pytest.raises(Ended, match="2"):
        ranks._watch(threading.Event())
    assert "process 0: a file: lost" in capsys.readouterr().err
    assert len(alarms) == 2


def test_a_connection_that_the_library_knows_is_lost_is_told(monkeypatch):
    def lost(self):
        raise RuntimeError("MPI_ERR_OTHER:\n known error not in list")

    monkeypatch.setattr(Request, "Test", lost)
    with pytest.raises(UserError, match=r"is lost \(MPI_ERR_OTHER: known .*go on with --resume"):
        Ranks(Two(others=[1])).any(True)


@pytest.mark.parametrize("rank", [0, 1])
def test_what_fails_on_one_rank_alone_ends_all(rank, alarms):
    world, told = Two(rank), []
    with pytest.raises(SystemExit, match="2"), Ranks(world).guarded(told.append):
        fail("disk full")
    assert told == [f"process {rank}: a file: disk full. Mend it"] and world.status == 2
    assert len(alarms) == 1 and 1 < alarms[0] < 60


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError(), "out of memory. Lower the resolution, --batch"),
        (RuntimeError("jit_malloc(): out of memory! Could not"), "out of memory. Lower the res"),
        (OSError(28, "No space left on device", "run/log.jsonl"), "run/log.jsonl: No space left"),
        (KeyboardInterrupt(), "stopped"),
        (ValueError("odd"), "ValueError: odd"),
        (AssertionError(), "AssertionError"),
    ],
)
@pytest.mark.usefixtures("alarms")
def test_an_error_of_one_rank_is_one_line_with_the_remedy(error, told):
    world, said = Two(1), []
    with pytest.raises(SystemExit, match="2"), Ranks(world).guarded(said.append):
        raise error
    assert len(said) == 1 and said[0].startswith(f"process 1: {told}") and "\n" not in said[0]


def test_what_all_know_of_is_told_by_the_first_and_ends_the_others():
    for rank, kind in ((0, Agreed), (1, SystemExit)):
        world, told = Two(rank), []
        with pytest.raises(kind), Ranks(world).guarded(told.append):
            raise Agreed("bad")
        assert not told and world.status is None


def test_jobs_are_dealt_like_cards_and_each_is_of_one_rank():
    jobs = ["a", "b", "c", "d", "e"]
    dealt = [list(Ranks(Two(rank)).mine(jobs)) for rank in (0, 1)]
    assert dealt == [["a", "c", "e"], ["b", "d"]]
    assert list(Ranks().mine(jobs)) == jobs


def test_what_each_rank_tells_is_known_to_all_and_may_take_its_time():
    own, other = {"a": [1, None, "ü"]}, {"other": 2.5}
    text = b'{"other": 2.5}'
    longest = len('{"a": [1, null, "\\u00fc"]}')
    lengths, padded = np.int64([len(text)]), np.frombuffer(text.ljust(longest, b"\0"), np.uint8)
    ranks = Ranks(Two(others=[lengths, padded], looks=200), patience=1e-9)
    assert ranks.gather(own) == [own, other]
    assert Ranks().gather(own) == [own]


def test_a_process_that_ranks_start_is_none_of_them(monkeypatch):
    for name in ("PMI_SIZE", "PMI_FD", "OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS"):
        monkeypatch.setenv(name, "2")
    monkeypatch.setenv("PATH_OF_MINE", "here")
    found = alone()
    assert found["PATH_OF_MINE"] == "here" and not set(SIZES) & set(found)
    assert not any(name.startswith("PMI") for name in found)


# ------------------------------------------------------------ what all decide as the first one does


class Machines:
    """Changes what a function of a module returns on the second of two ranks, as another CPU may.

    Ranks are threads here: `on_ranks` calls `of` first.
    """

    def __init__(self, monkeypatch):
        self._monkeypatch, self._here = monkeypatch, threading.local()

    def of(self, ranks):
        self._here.rank = ranks.rank

    def differ(self, where, name, change):
        whole = getattr(where, name)

        def changed(*args, **more):
            found = whole(*args, **more)
            return change(found) if getattr(self._here, "rank", 0) else found

        self._monkeypatch.setattr(where, name, changed)


@pytest.fixture
def machines(monkeypatch):
    return Machines(monkeypatch)


def moved(found):
    points, normals, valid = found
    return points + 0.05, normals, valid & (np.arange(len(valid)) % 7 > 0)


@pytest.mark.parametrize(
    ("name", "change"), [("_points", moved), ("_visible", np.zeros_like)], ids=["hits", "shadows"]
)
def test_ranks_whose_rays_differ_look_at_the_same_points(name, change, cornell, machines):
    dataset = Dataset.load(cornell)
    scene = parse(dataset.scene, dataset.root).instantiate()
    machines.differ(gains_module, name, change)

    def shared(ranks):
        machines.of(ranks)
        pixels = pixels_of(dataset, tiny_fields(), clip_negative=False, ranks=ranks)
        found = shared_points(scene, dataset.train, pixels)
        return [found.point, found.views, found.radius2, found.logs, found.bound, found.whole]

    (alone,) = on_ranks(1, shared)
    assert len(alone[0]) > 40
    for found in on_ranks(2, shared):
        for here, there in zip(found, alone, strict=True):
            np.testing.assert_array_equal(here, there)


@pytest.mark.parametrize("deals", [True, False])
def test_ranks_whose_sums_differ_begin_with_the_same_exposures(deals, cornell, machines):
    dataset = Dataset.load(cornell)
    config = replace(tiny_fields(), camera=CameraConfig(exposure="per-image"))
    problems = [problem_of(dataset, config, 0.2) for _ in range(3)]
    machines.differ(gains_module, "first_gains", lambda gains: gains * [[1], [1 + 1e-6]])

    def begun(ranks):
        machines.of(ranks)
        problem = problems[2 if ranks.size == 1 else ranks.rank]
        dealt = ranks if deals else None
        pixels = pixels_of(dataset, config, clip_negative=False, ranks=dealt)
        assert begin_cameras(problem, dataset, pixels, ranks) is None
        return np.array(problem.camera.parameters()["exposure.log"])

    (alone,) = on_ranks(1, begun)
    assert (alone != 0).any()
    for found in on_ranks(2, begun):
        np.testing.assert_array_equal(found, alone)


@pytest.mark.parametrize("doubts", [[], ["train_000"]])
def test_ranks_whose_rays_differ_check_the_same(doubts, cornell, machines, monkeypatch):
    dataset = Dataset.load(cornell)
    problem = problem_of(dataset, tiny_fields(), 0.2)
    monkeypatch.setattr(plausibility, "check_cameras", lambda *_: doubts)
    machines.differ(plausibility, "check_cameras", lambda names: [] if names else ["train_001"])

    def told(ranks):
        machines.of(ranks)
        pixels = pixels_of(dataset, tiny_fields(), clip_negative=False, ranks=ranks)
        return plausibility.data_warnings(dataset, pixels, problem)

    first, second = on_ranks(2, told)
    assert len(first) == len(doubts) and len(second) == 1 - len(doubts)


@pytest.mark.parametrize(("bad", "told"), [([1], "train_001"), ([0, 1], "train_000"), ([], None)])
def test_a_pixel_of_any_rank_explains_a_skipped_step(bad, told):
    def cause(ranks):
        image = np.full((4, 3), 0.5)
        image[2] = np.nan if ranks.rank in bad else 0.5
        colours, numbers = np.full((4, 3), 0.25), np.arange(4) + 10 * ranks.rank
        terms = {"photometric": float(image.sum())}
        replay = Replay(terms, [], numbers, image, colours, image - colours)
        step = SimpleNamespace(
            ranks=ranks, replay=lambda *_: replay, place=lambda pixel: (pixel // 10, pixel % 10, 3)
        )
        return diagnose(step, None, 5, ["train_000", "train_001"])

    first, second = on_ranks(2, cause)
    assert first == second
    if told is None:
        assert first == "the loss was not finite, and is by now"
    else:
        assert f"view {told}, pixel (2, 3): rendered nan nan nan" in first


def test_a_step_that_one_rank_of_four_skipped_counts_as_one():
    readings = [{"photometric": 0.5, "skipped": share} for share in (0.25, 0.0, 1.0, 0.25)]
    assert _log_entry(readings, Progress(), 0.01)["skipped"] == 3
