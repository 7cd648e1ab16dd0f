"""Memory: what is free within the limits of a container and of a process, and what is refused."""

import os
import resource
import subprocess
import sys

import psutil
import pytest

from unbake import memory
from unbake.errors import UserError
from unbake.memory import free_bytes, largest, require_memory, size

MB = 1_000_000


@pytest.fixture
def limits(tmp_path, monkeypatch):
    """Make this process one of a control group with these files."""

    def make(limit, used, statistics=""):
        (tmp_path / "memory.stat").write_text(statistics)
        files = (tmp_path / "memory.max", tmp_path / "memory.current")
        for file, text in zip(files, (limit, used), strict=True):
            file.write_text(f"{text}\n")
        monkeypatch.setattr(memory, "_LIMITS", ((tmp_path / "none", tmp_path / "none"), files))

    return make


def test_a_container_has_what_its_limit_leaves(limits):
    limits(100 * MB, 30 * MB)
    assert free_bytes() == 70 * MB
    limits(100 * MB, 130 * MB)
    assert free_bytes() == 0


@pytest.mark.parametrize(
    "statistics",
    [
        f"anon {5 * MB}\nactive_file {8 * MB}\ninactive_file {20 * MB}\n",
        f"inactive_file 0\ntotal_active_file {8 * MB}\ntotal_inactive_file {20 * MB}\n",
    ],
)
def test_files_that_the_kernel_holds_in_memory_can_be_had(limits, statistics):
    limits(100 * MB, 90 * MB, statistics)
    assert free_bytes() == 38 * MB
    limits(100 * MB, 90 * MB, "damaged")
    assert free_bytes() == 10 * MB


def test_without_a_limit_the_memory_of_the_machine_is_free(limits):
    limits("max", 30 * MB)
    assert free_bytes() == pytest.approx(psutil.virtual_memory().available, rel=0.2)
    limits(10**18, 30 * MB)
    assert free_bytes() == pytest.approx(psutil.virtual_memory().available, rel=0.2)


def test_without_proc_nothing_is_known_of_free_memory(monkeypatch):
    def fail():
        raise FileNotFoundError("/proc/meminfo")

    monkeypatch.setattr(psutil, "virtual_memory", fail)
    assert free_bytes() is None


@pytest.mark.parametrize("kind", ["RLIMIT_AS", "RLIMIT_DATA"])
def test_a_process_has_what_its_own_limits_leave(kind, repository):
    """In a process of its own: a limit cannot be taken back."""
    code = f"""
import resource
from unbake.memory import free_bytes
resource.setrlimit(resource.{kind}, (10**9, resource.RLIM_INFINITY))
before = free_bytes()
block = bytearray(100 * 10**6)
print(before, before - free_bytes())
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(repository / "src")},
    )
    assert done.returncode == 0, done.stderr
    before, taken = map(int, done.stdout.split())
    assert 0.5e9 < before < 1e9
    assert taken == pytest.approx(100 * MB, rel=0.05)


def test_without_limits_of_the_process_its_size_does_not_count(monkeypatch):
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda number: unlimited)
    monkeypatch.setattr(memory, "_used", lambda key: pytest.fail("asked for nothing"))
    assert free_bytes() > 0


def test_what_does_not_fit_is_refused_with_both_numbers(monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: 21 * 10**9)
    require_memory(21e9, "it needs", "Lower it")
    require_memory(None, "it needs", "Lower it")
    told = "a.toml: it needs about 104 GB of memory, 21.0 GB are free. Lower it to 21"
    with pytest.raises(UserError) as error:
        require_memory(104e9, "it needs", lambda free: f"Lower it to {free // 10**9}", "a.toml")
    assert str(error.value) == told
    monkeypatch.setattr(memory, "free_bytes", lambda: None)
    require_memory(104e9, "it needs", "Lower it")


def test_sizes_are_told_in_units_of_their_own():
    assert [size(x) for x in (0, 20e6, 2.5e9, 104e9)] == ["0 MB", "20 MB", "2.5 GB", "104 GB"]


def test_the_largest_number_that_fits():
    assert [largest(lambda n, m=m: n <= m, 100) for m in (0, 1, 37, 100, 500)] == [
        0,
        1,
        37,
        100,
        100,
    ]
