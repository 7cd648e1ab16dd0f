"""Jobs that are commands: their time is limited, their ends are told apart."""

import os
import signal
import sys
import threading
import time

import pytest

from unbake.errors import UserError
from unbake.experiments.commands import command
from unbake.experiments.jobs import Unfinished

#: Writes a file when it is stopped, as a fit writes its checkpoint.
PATIENT = """
import pathlib, signal, sys, time
def stop(number, frame):
    pathlib.Path(sys.argv[1]).write_text("kept")
    sys.exit(130)
signal.signal(signal.SIGTERM, stop)
pathlib.Path(sys.argv[2]).write_text("ready")
time.sleep(60)
"""


def python(code, *words):
    return [sys.executable, "-c", code, *words]


def test_what_a_command_prints_is_copied_to_a_file(tmp_path, capfd):
    command(python("import sys; print('out'); print('err', file=sys.stderr)"), log=tmp_path / "log")
    assert sorted((tmp_path / "log").read_text().split()) == ["err", "out"]
    assert sorted(capfd.readouterr().out.split()) == ["err", "out"]


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("import sys; sys.exit(3)", r"the command failed \(exit status 3\)"),
        ("import os; os.kill(os.getpid(), 6)", r"the command failed \(ended by signal 6\)"),
    ],
)
def test_a_command_that_fails_is_told_from_one_that_was_stopped(code, message):
    with pytest.raises(UserError, match=message):
        command(python(code))
    for status in ("sys.exit(130)", "os.kill(os.getpid(), 15)"):
        with pytest.raises(Unfinished):
            command(python(f"import os, sys; {status}"))


def test_a_program_that_is_missing_is_named(tmp_path):
    with pytest.raises(UserError, match="none: the program cannot be started"):
        command([tmp_path / "none"])


def test_a_command_is_stopped_when_its_time_is_up(tmp_path):
    kept, ready = tmp_path / "kept", tmp_path / "ready"
    start = time.monotonic()
    with pytest.raises(Unfinished):
        command(python(PATIENT, kept, ready), until=start + 2)
    assert time.monotonic() - start < 30 and kept.read_text() == "kept"
    command(python("pass"), until=time.monotonic() + 30)


def test_an_interrupt_reaches_the_command(tmp_path):
    kept, ready = tmp_path / "kept", tmp_path / "ready"

    def interrupt():
        while not ready.exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        command(python(PATIENT, kept, ready))
    thread.join()
    assert kept.read_text() == "kept"
