"""Memory: what is resident, and how far it rises."""

import numpy as np
import pytest

from unbake.training.memory import memory_mb, peak_bytes

MB = 1_000_000


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
