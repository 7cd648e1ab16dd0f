"""Damaged files of every format: each is read, or refused in one line; and the machinery for it."""

import sys

import pytest
from fuzzing.engine import Campaign, Worker, kept, shares
from fuzzing.formats import FORMATS

#: Damaged files of all formats in a run of the tests; `make fuzz` reads more.
INPUTS = 2000
COUNTS = shares(INPUTS, list(FORMATS))


@pytest.fixture(scope="module")
def worker():
    with Worker() as worker:
        yield worker


@pytest.mark.parametrize("name", FORMATS)
def test_whole_files_are_read(worker, name):
    for content in FORMATS[name].samples():
        assert worker.read(name, content) == {"verdict": "worked"}


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused_in_one_line(worker, name):
    campaign = Campaign(worker)
    campaign.mutate(name, COUNTS[name], start=0)
    assert campaign.total >= COUNTS[name]
    print(campaign.counts)
    assert not campaign.failures, [(f.told, f.content[:300]) for f in campaign.failures.values()]


def test_what_has_failed_once_is_refused_in_one_line(worker):
    campaign = Campaign(worker)
    campaign.replay()
    assert campaign.total == len(list(kept())) > 0
    assert not campaign.failures, [f.told for f in campaign.failures.values()]


def test_all_formats_get_their_share():
    assert sum(COUNTS.values()) >= INPUTS - len(COUNTS)
    assert all(shares(1, list(FORMATS)).values())


# ----------------------------------------------------------------------------------- the machinery

#: A worker with formats of its own, each of which goes wrong in one way.
BROKEN = """
import os, signal, sys, time
sys.path[:0] = {paths!r}
from fuzzing import formats, worker
from unbake.errors import UserError

def refuse(folder):
    raise UserError("is bad", folder / "file", "Mend it")

def leave(folder):
    (folder / "half").write_text("half")
    refuse(folder)

def quit_badly(folder):
    sys.exit(3)

def print_two_lines(folder):
    print("one", file=sys.stderr)
    refuse(folder)

def escape(folder):
    print("error: \\x1b[2J", file=sys.stderr)
    raise SystemExit(2)

def stop(folder):
    time.sleep(600)

readers = dict(
    good=lambda folder: None, refused=refuse, wrong=lambda folder: 1 / 0, leaves=leave,
    writes=lambda folder: (folder / "other").write_text(""), status=quit_badly,
    lines=print_two_lines, escapes=escape, hangs=stop, ends=lambda folder: os._exit(0),
    killed=lambda folder: os.kill(os.getpid(), signal.SIGSEGV),
    makes=lambda folder: (folder / "page").write_text("page"),
)
for name, read in readers.items():
    formats.FORMATS[name] = formats.Format("file", lambda: [b"a"], (), read, makes=("page",))
worker.main()
"""


@pytest.fixture(scope="module")
def broken(repository):
    script = BROKEN.format(paths=[str(repository / "tests")])
    with Worker(patience=3, command=[sys.executable, "-c", script]) as worker:
        yield worker


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("wrong", "ZeroDivisionError"),
        ("leaves", "files"),
        ("writes", "files"),
        ("status", "error line: exit status 3"),
        ("lines", "error line: not one line"),
        ("escapes", "error line: control characters"),
        ("hangs", "hang"),
        ("ends", "exit status 0"),
        ("killed", "SIGSEGV"),
    ],
)
def test_a_reader_that_goes_wrong_is_found_and_the_next_one_reads_on(broken, name, kind):
    found = broken.read(name, b"content")
    assert found["verdict"] == "failed" and found["kind"].startswith(kind), found
    assert broken.read("good", b"content") == {"verdict": "worked"}
    assert broken.read("makes", b"content") == {"verdict": "worked"}
    refused = broken.read("refused", b"content")
    assert refused["verdict"] == "refused" and refused["told"].endswith("file: is bad. Mend it")


def test_failures_alike_are_one_with_the_smallest_input(broken, tmp_path):
    campaign = Campaign(broken)
    for content in (b"longer", b"short", b"longest of all"):
        campaign.read("wrong", content)
    (failure,) = campaign.failures.values()
    assert failure.count == 3 and failure.content == b"short"
    assert campaign.counts == {"wrong": {"worked": 0, "refused": 0, "failed": 3}}
    assert failure.keep(tmp_path).read_bytes() == b"short"


def test_the_same_seed_damages_the_same_way():
    drawn = []
    for start in (0, 0, 1):
        inputs = []

        class Notes:
            def read(self, name, content, inputs=inputs):
                inputs.append(content)
                return {"verdict": "worked"}

        Campaign(Notes()).mutate("cameras", 40, start)
        drawn.append(inputs)
    assert drawn[0] == drawn[1] != drawn[2]
    assert len(drawn[0]) == len(set(drawn[0])) == 40
