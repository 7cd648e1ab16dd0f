"""Signals and closed pipes, at any instant: what is done is saved, and nothing is a traceback."""

import os
import runpy
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from unbake import cli, signals
from unbake.training.checkpoint import newest_progress
from unbake.training.run_folder import RunFolder

SOURCE = str(Path(cli.__file__).parents[2])


def python(code, *words, **named):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        env=os.environ | {"PYTHONPATH": SOURCE, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **named,
    )  # fmt: skip


def ended(process):
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


PROGRAM = """
import os, sys, time
from unbake import signals
def command():
{}
signals.run_program(command)
"""


def program(*lines, **named):
    return python(PROGRAM.format("".join(f"    {line}\n" for line in lines)), **named)


@pytest.mark.parametrize("number", signals.STOPPING)
def test_a_signal_ends_the_program_and_removes_what_is_unfinished(number, tmp_path):
    waiting = program(
        f"file = {str(tmp_path / 'unfinished')!r}",
        "open(file, 'w').close()",
        "with signals.cleaned_up(lambda: os.remove(file)):",
        "    print('now')",
        "    time.sleep(100)",
    )
    assert waiting.stdout.readline() == "now\n"
    waiting.send_signal(number)
    assert ended(waiting) == (128 + number, "", "interrupted\n")
    assert not list(tmp_path.iterdir())


def test_a_second_signal_ends_the_program_at_once():
    stubborn = program(
        "with signals.deferred() as stop:",
        "    print('now')",
        "    while not stop: time.sleep(0.01)",
        "    print(*stop)",
        "    time.sleep(100)",
    )
    assert stubborn.stdout.readline() == "now\n"
    stubborn.send_signal(signal.SIGTERM)
    assert stubborn.stdout.readline() == "15\n"
    stubborn.send_signal(signal.SIGINT)
    assert ended(stubborn) == (130, "", "")


def test_a_signal_that_the_caller_ignores_stays_ignored():
    """As under nohup."""
    process = program(
        "os.kill(os.getpid(), 1)",
        "with signals.deferred() as stop:",
        "    os.kill(os.getpid(), 1)",
        "    time.sleep(0.01)",
        "    print(stop)",
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
    )
    assert ended(process) == (0, "[]\n", "")


def test_the_interpreters_own_end_is_not_disturbed():
    process = program(
        "import atexit, signal",
        "atexit.register(os.kill, os.getpid(), signal.SIGINT)",
        "sys.exit(7)",
    )
    assert ended(process) == (7, "", "")


def test_a_closed_pipe_ends_a_command_that_prints():
    process = program("while True: print('line')")
    process.stdout.readline()
    process.stdout.close()
    process.wait(100)
    assert (process.returncode, process.stderr.read()) == (141, "interrupted\n")
    process.stderr.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux alone has this device")
def test_output_to_a_full_disk_is_told_once_and_the_work_goes_on(tmp_path):
    with open("/dev/full", "w") as full:
        line = f"{PROGRAM.format('    for n in range(9): print(n)')}\nprint('more')\nsys.exit(3)"
        process = subprocess.run(
            [sys.executable, "-c", line], env=os.environ | {"PYTHONPATH": SOURCE},
            stdout=full, stderr=subprocess.PIPE, text=True, timeout=100,
        )  # fmt: skip
    assert process.returncode == 3
    assert process.stderr == (
        "warning: what this program prints cannot be written (No space left on device); "
        "it goes on\n"
    )


def test_a_command_without_output_streams_runs(tmp_path):
    words = [sys.executable, "-m", "unbake", "fit", tmp_path / "none", "--out", tmp_path / "run"]
    script = ["sh", "-c", 'exec "$@" >&- 2>&-', "sh", *words]
    done = subprocess.run(script, env=os.environ | {"PYTHONPATH": SOURCE}, timeout=100)
    assert done.returncode == 2


def test_a_fit_whose_reader_goes_away_is_saved(cornell, tiny, tmp_path):
    run = RunFolder(tmp_path / "run")
    code = "from unbake.__main__ import main; main()"
    fit = python(
        code, "fit", cornell, "--out", run.path, "--settings", tiny, "--method", "direct",
        "--seconds", "1000",
    )  # fmt: skip
    while "step " not in fit.stdout.readline():
        assert fit.poll() is None
    fit.stdout.close()
    assert fit.wait(100) == 141 and fit.stderr.read() == ""
    fit.stderr.close()
    assert newest_progress(run).step == run.log()[-1]["step"] > 0


def test_signals_before_mitsuba_is_loaded_are_no_traceback(tmp_path):
    """Mitsuba, NumPy and the command line take most of a second to import."""
    for number in signals.STOPPING:
        process = python("from unbake.__main__ import main; print('now'); main()", "doctor")
        process.stdout.readline()
        time.sleep(0.1)
        process.send_signal(number)
        status, _, err = ended(process)
        assert status == 128 + number and err == "interrupted\n", err


def test_a_library_call_is_interrupted_by_an_exception():
    """The process belongs to somebody else."""
    with signals.deferred() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop == [signal.SIGTERM] and not signals.received()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


@pytest.fixture
def benchmark(repository, monkeypatch):
    """The functions of a script in `benchmarks`."""
    monkeypatch.syspath_prepend(repository / "benchmarks")
    return lambda name: runpy.run_path(str(repository / "benchmarks" / name))


@pytest.mark.slow
def test_killed_fits_go_on(benchmark, tmp_path, monkeypatch):
    """`make kill` does so 200 times."""
    monkeypatch.setenv("PYTHONPATH", SOURCE)
    result = benchmark("kill.py")["kill"](tmp_path, kills=3, seed=0)
    assert result["survived"] == result["kills"] >= 3 and not result["failures"]


@pytest.mark.slow
def test_interrupted_fits_are_saved(benchmark, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", SOURCE)
    result = benchmark("signals.py")["interrupt"](tmp_path, each=1, seed=0, only=["fit"])
    assert result["sent"] == 3 and not result["failures"]


@pytest.mark.slow
def test_commands_end_by_a_signal_at_any_instant(benchmark, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", SOURCE)
    others = ["import", "data check", "export", "render", "relight", "view", "solve", "degrade"]
    result = benchmark("signals.py")["interrupt"](tmp_path, each=1, seed=0, only=others)
    assert result["ends"].keys() == set(others) and not result["failures"]


def test_the_campaign_of_signals_has_every_command(benchmark, tmp_path, monkeypatch):
    commands = benchmark("signals.py")["_commands"]
    monkeypatch.setitem(commands.__globals__, "start", lambda words: subprocess.Popen(["true"]))
    data, done = tmp_path / "data", tmp_path / "done"
    for folder in (done, data / "images", data / "scene" / "meshes"):
        folder.mkdir(parents=True)
    (data / "transforms.json").write_text('{"scene": "scene/scene.xml", "frames": []}')
    fit = ["fit", "data", "--settings", "settings.toml"]
    tried = commands(tmp_path, data, fit, done, tmp_path / "out").values()
    assert {words[0] for words in tried} == {name.split()[0] for name in cli.COMMANDS}
