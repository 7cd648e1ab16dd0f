"""Memory: what is free within a container's limit, what is resident, and how far it rises."""

import numpy as np
import psutil
import pytest

from unbake.training import memory
from unbake.training.memory import free_bytes, memory_mb, peak_bytes

MB = 1_000_000


@pytest.fixture
def limits(tmp_path, monkeypatch):
    """Make this process one of a control group with these files."""

    def make(limit, used):
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


def test_resident_memory_and_its_peak_are_those_of_an_array():
    before = memory_mb()
    array = np.ones(25 * MB // 2)  # 100 MB
    assert memory_mb() - before == pytest.approx(100, abs=20)
    del array
    rise = peak_bytes(lambda: np.ones(25 * MB // 2).sum())
    if rise is None:
        pytest.skip("the peak of this process cannot be reset here")
    assert rise / MB == pytest.approx(100, abs=20)
    assert peak_bytes(lambda: None) < 20 * MB
