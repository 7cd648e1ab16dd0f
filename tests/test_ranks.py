"""What the ranks of a fit tell each other, and how they end together."""

import time

import numpy as np
import pytest

from unbake.errors import UserError
from unbake.ranks import SIZES, Agreed, Ranks, alone


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

    def Abort(self, status):
        self.status = status


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
    assert alone.joined(lambda: numbers) is numbers and alone.told("it") == ["it"]
    assert alone.any(True, False) == (True, False)
    alone.require_same({"seed": "0"})
    with pytest.raises(UserError, match="bad"):
        alone.together(lambda: fail("bad"))
    with pytest.raises(UserError, match="bad"), alone.guarded(print):
        fail("bad")


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
    with pytest.raises(Agreed, match="other settings on rank 1; other data set on rank 1"):
        Ranks(Two(others=[other])).require_same({"settings": "a", "data set": "b"})


@pytest.mark.parametrize("rank", [0, 1])
def test_an_error_of_one_rank_is_told_on_all(rank):
    gathered = [np.uint8([rank == 0]), error_of("no memory", "a file", "Mend it")]
    work = int if rank == 0 else lambda: fail("no memory")
    with pytest.raises(Agreed, match=r"^a file: rank 1: no memory\. Mend it$"):
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


@pytest.mark.parametrize("rank", [0, 1])
def test_what_fails_on_one_rank_alone_ends_all(rank):
    world, told = Two(rank), []
    with pytest.raises(SystemExit, match="2"), Ranks(world).guarded(told.append):
        fail("disk full")
    assert told == [f"rank {rank}: a file: disk full. Mend it"] and world.status == 2


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
def test_an_error_of_one_rank_is_one_line_with_the_remedy(error, told):
    world, said = Two(1), []
    with pytest.raises(SystemExit, match="2"), Ranks(world).guarded(said.append):
        raise error
    assert len(said) == 1 and said[0].startswith(f"rank 1: {told}") and "\n" not in said[0]


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
    assert ranks.told(own) == [own, other]
    assert Ranks().told(own) == [own]


def test_a_process_that_ranks_start_is_none_of_them(monkeypatch):
    for name in ("PMI_SIZE", "PMI_FD", "OMPI_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS"):
        monkeypatch.setenv(name, "2")
    monkeypatch.setenv("PATH_OF_MINE", "here")
    found = alone()
    assert found["PATH_OF_MINE"] == "here" and not set(SIZES) & set(found)
    assert not any(name.startswith("PMI") for name in found)
