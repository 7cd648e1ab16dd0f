"""White balances of camera RAW, by what LibRaw tells of it; a stand-in for rawpy has no files."""

import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from unbake.importing.import_data import _balanced
from unbake.importing.raw import raw_balances
from unbake.importing.source import Shot, Source

#: What files tell: factors that the camera chose, and those of daylight.
TOLD = {
    "first": ([2.0, 1.0, 1.5, 0.0], [2.2, 1.0, 1.25, 0.0]),
    "same sensor": ([1.7, 1.0, 1.9, 0.0], [2.2, 1.0, 1.25, 0.0]),
    "other sensor": ([9.0, 9.0, 9.0, 9.0], [1.76, 1.0, 2.0, 1.1]),
    "unknown": ([3.0, 1.0, 2.0, 1.0], [0.0, 0.0, 0.0, 0.0]),
    "nothing": ([0.0, 1.0, 1.0, 0.0], [2.2, 1.0, 1.25, 0.0]),
}


@pytest.fixture
def shots(monkeypatch):
    """`shots(name, …)`: photographs of a source, which tell that of `TOLD`."""

    def read(path):
        chosen, daylight = TOLD[Path(path).stem]
        raw = SimpleNamespace(camera_whitebalance=chosen, daylight_whitebalance=daylight)
        return nullcontext(raw)

    fake = SimpleNamespace(imread=read, LibRawError=type("LibRawError", (Exception,), {}))
    monkeypatch.setitem(sys.modules, "rawpy", fake)

    def make(*names):
        return tuple(Shot(n, None, Path(f"{n}.dng"), None, np.eye(4)) for n in names)

    return make


def test_one_light_has_other_factors_for_another_sensor(shots):
    found = _balanced(Source("test", shots("first", "same sensor", "other sensor", "unknown")))
    first, same, other, unknown = (shot.balance for shot in found.shots)
    assert first == same == unknown == (2.0, 1.0, 1.5, 1.0)
    assert other == pytest.approx((1.6, 1.0, 2.4, 1.1))
    assert [note.split(",")[0] for note in found.notes] == [
        "white balance: cameras chose several",
        "white balance: sensors differ",
    ]


def test_sensors_that_are_alike_are_not_told_apart(shots):
    assert len(_balanced(Source("test", shots("first", "same sensor", "unknown"))).notes) == 1
    assert not _balanced(Source("test", shots("first"))).notes


def test_without_a_balance_of_the_first_all_have_that_of_their_daylight(shots):
    assert raw_balances(shots("nothing")[0].image) == (None, (2.2, 1.0, 1.25, 1.0))
    found = _balanced(Source("test", shots("nothing", "other sensor")))
    assert [shot.balance for shot in found.shots] == [None, None]
    assert [note.split(", ")[1] for note in found.notes] == ["all have that of daylight"]


def test_a_first_sensor_that_nobody_knows_changes_no_factors(shots):
    found = _balanced(Source("test", shots("unknown", "same sensor", "other sensor")))
    assert len({shot.balance for shot in found.shots}) == len(found.notes) == 1
