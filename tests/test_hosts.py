"""Two emulated hosts: what crosses the cable between them, and fits that end when it is cut."""

import json
import os
import runpy
import subprocess
import sys
import time

import pytest
from support import needs_mpi

#: What each process of two finds: its host, how many it has here, and a mean of both.
_FOUND = """
import socket, numpy as np
from unbake.ranks import Ranks
ranks = Ranks.of_environment()
mean = ranks.mean(np.full(250_000, ranks.rank, np.float32))
line = f"{ranks.rank} {socket.gethostname()} {ranks.here} {mean[0]}\\n"
print(line, end="", flush=True)  # in one piece
"""


@pytest.fixture
def two_hosts(repository, monkeypatch):
    """The module that emulates hosts, where that is allowed."""
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    module = runpy.run_path(str(repository / "benchmarks" / "two_hosts.py"))
    if reason := module["why_not"]():
        pytest.skip(reason)
    return module


@needs_mpi
def test_two_hosts_share_a_cable_and_nothing_else(two_hosts, repository, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    with two_hosts["TwoHosts"]() as hosts:
        before = hosts.sent()
        process = hosts.start(sys.executable, "-c", _FOUND)
        text, errors = process.communicate(timeout=60)
        sent = [after - start for after, start in zip(hosts.sent(), before, strict=True)]
        assert process.returncode == 0, errors
        assert sorted(text.splitlines()) == ["0 host-1 1 0.5", "1 host-2 1 0.5"]
        assert all(1e6 < each < 1.3e6 for each in sent)
        assert not hosts.running(0) and not hosts.running(1)


#: Rank 0 tells that it lives, for some time; apart from the others, and while they wait for it.
_SIGNS = """
import time
from unbake import ranks as module
module._BEAT = 0.1
ranks = module.Ranks.of_environment()
with ranks.apart():
    time.sleep(0.5)
ranks.any(True)
ranks.announce()
if ranks.leads:
    time.sleep(0.5)
ranks.any(True)
"""


@needs_mpi
def test_mpi_ends_after_signs_of_life(two_hosts, repository, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    with two_hosts["TwoHosts"]() as hosts:
        process = hosts.start(sys.executable, "-c", _SIGNS)
        _, errors = process.communicate(timeout=20)
        assert process.returncode == 0, errors


#: Two processes with work of their own, one of which waits for the other.
_APART = """
import time
from unbake import ranks as module
module._BEAT = 0.2
ranks = module.Ranks.of_environment()
ranks._patience = 2.0
with ranks.guarded(print), ranks.apart():
    print("begun\\n", end="", flush=True)
    if ranks.leads:
        time.sleep(60)
    ranks.gather(None)
"""


@needs_mpi
@pytest.mark.slow
def test_ranks_with_work_of_their_own_end_where_the_network_is_cut(
    two_hosts, repository, monkeypatch
):
    monkeypatch.setenv("PYTHONPATH", str(repository / "src"))
    with two_hosts["TwoHosts"]() as hosts:
        process = hosts.start(sys.executable, "-c", _APART)
        assert [process.stdout.readline() for _ in range(2)] == ["begun\n"] * 2
        time.sleep(4)
        assert process.poll() is None, "they hear of each other"
        hosts.cut()
        end = time.monotonic() + 40  # the remote shell takes longest to notice
        while (left := hosts.running(0) + hosts.running(1)) and time.monotonic() < end:
            time.sleep(0.1)
        assert not left
        _, errors = process.communicate()
        assert process.returncode == 2
        assert "process 0: process 1 has not been heard of for 2 s" in errors


@needs_mpi
@pytest.mark.slow
@pytest.mark.usefixtures("two_hosts")
def test_fits_end_where_the_network_is_cut_or_a_rank_is_stopped(repository, tmp_path):
    out = tmp_path / "hosts.json"
    words = [sys.executable, "benchmarks/hosts.py", "cuts", "--times", "1", "--out", str(out)]
    done = subprocess.run(
        words, cwd=repository, env=os.environ, capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 0, done.stderr + done.stdout
    found = json.loads(out.read_text())["cuts"]
    assert found["well"] == found["times"] == 2 and found["cuts"] == found["stops"] == 1
    assert 15 < found["most_seconds_after_cut"] < 60
    assert [row["status"] for row in found["rows"]] == [2, 2]
