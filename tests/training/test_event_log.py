"""The log for TensorBoard is one that it reads."""

import time
from dataclasses import replace

import pytest
from support import tiny_fields

from unbake.errors import UserError
from unbake.training.event_log import EventLog
from unbake.training.loop import fit
from unbake.training.run_folder import RunFolder

#: Records that tensorboardX 2.6.5 writes at a wall time of 1.5: the version, the start of a session
#: at step 300, and two scalars at that step.
RECORDS = bytes.fromhex(
    "1800000000000000a37f4b2209000000000000f83f1a0d627261696e2e4576656e743a322a28646c"
    "100000000000000095fbfe1809000000000000f83f10ac023a020801713b788a"
    "3c00000000000000c8b7a35209000000000000f83f10ac022a2e0a120a0b70686f746f6d657472696315000080"
    "3e0a180a1173636f72652f616c6265646f5f70736e72150000ac41cecdd71e"
)
ENTRY = {"step": 300, "photometric": 0.25, "score": {"albedo_psnr": 21.5}, "note": "a text"}


@pytest.fixture
def clock(monkeypatch):
    """A clock that stands still."""
    monkeypatch.setattr(time, "time", lambda: 1.5)


def test_records_are_those_of_another_writer(clock, tmp_path):
    log = EventLog(tmp_path / "tensorboard", 300)
    log.add(ENTRY)
    log.add({"step": 301, "note": "no number"})
    log.close()
    log.add(ENTRY)  # nothing is written any more
    (file,) = (tmp_path / "tensorboard").iterdir()
    assert file.name.startswith("events.out.tfevents.1.")
    assert file.read_bytes() == RECORDS


def test_a_record_that_does_not_fit_leaves_no_torn_one(clock, tmp_path):
    log = EventLog(tmp_path / "tensorboard", 300)
    real = log._file

    class Full:
        """A file on a disk that takes ten bytes more."""

        def write(self, data):
            return real.write(data[:10])

        def __getattr__(self, name):
            return getattr(real, name)

    log._file = Full()
    log.add(ENTRY)
    log.add(ENTRY)
    (file,) = (tmp_path / "tensorboard").iterdir()
    assert file.read_bytes() == RECORDS[: len(file.read_bytes())] and real.closed
    assert len(file.read_bytes()) == 72  # two records


def test_a_fit_writes_what_its_log_has(cornell, tmp_path):
    config = replace(tiny_fields("grid"), method="direct", steps=2, score_seconds=0.0)
    fit(cornell, tmp_path / "run", config, tensorboard=True)
    folder = RunFolder(tmp_path / "run")
    (file,) = folder.tensorboard.iterdir()
    names = folder.log()[-1].keys() - {"step", "note"}
    assert names
    for name in names:
        assert name.encode() in file.read_bytes()
    with pytest.raises(UserError, match="there is a run"):
        fit(cornell, tmp_path / "run", config, tensorboard=True)
    file.parent.rename(tmp_path / "elsewhere")
    folder.tensorboard.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="symbolic link"):
        fit(cornell, tmp_path / "run", config, resume=True, tensorboard=True)
