"""The script for GPU machines runs through, at a scale where nothing takes long."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


def cuda(repository, out, *jobs, **others):
    """Run the script's jobs on this machine's variant."""
    paths = os.pathsep.join(p for p in sys.path if p)
    return subprocess.run(
        ["bash", str(repository / "scripts" / "cuda.sh"), str(out), *jobs],
        env={
            **os.environ,
            "SCALE": "smoke",
            "SCENES": str(Path(out) / "no-scenes"),
            "PYTHON": sys.executable,
            "PYTHONPATH": paths,
            **others,
        },
        capture_output=True,
        text=True,
        timeout=600,
    )


def numbers(file):
    result = json.loads(file.read_text())
    assert result["milliseconds_per_step"] > 0 and result["phases"]
    return result


@pytest.mark.slow
def test_the_script_for_gpu_machines_runs_through(repository, tmp_path):
    done = cuda(repository, tmp_path, "doctor", "step", "staircase", "table2", "fig3")
    assert done.returncode == 0, done.stderr[-3000:]
    assert "can work on this machine" in (tmp_path / "doctor.txt").read_text()
    for method in ("ours", "prb", "ad-pt"):
        assert numbers(tmp_path / f"step-{method}.json")["method"] == method
    assert (tmp_path / "staircase" / "evaluation" / "metrics.json").is_file()
    assert (tmp_path / "reproduction" / "table2" / "table.md").is_file()
    assert "fig3 is left out" in done.stdout


@pytest.mark.slow
def test_a_long_fit_goes_on_where_the_last_call_ended(repository, tmp_path):
    for steps in (20, 30):
        done = cuda(repository, tmp_path, "staircase", STEPS=str(steps))
        assert done.returncode == 0, done.stderr[-3000:]
    assert "going on after step 20" in done.stdout
    metrics = json.loads((tmp_path / "staircase" / "evaluation" / "metrics.json").read_text())
    assert metrics["steps"] == 30


@pytest.mark.slow
def test_what_the_time_of_a_call_does_not_suffice_for_is_left_to_the_next(repository, tmp_path):
    jobs = ("doctor", "staircase", "table2")
    first = cuda(repository, tmp_path, *jobs, MINUTES="0.001", STEPS="1000000")
    assert first.returncode == 0, first.stderr[-3000:]
    assert "left: data-demo staircase table2; the same command continues" in first.stdout
    assert "can work on this machine" in (tmp_path / "doctor.txt").read_text()
    stopped = cuda(repository, tmp_path, *jobs, MINUTES="0.5", STEPS="1000000")
    assert stopped.returncode == 0, stopped.stderr[-3000:]
    assert "doctor ─" in first.stdout and "doctor ─" not in stopped.stdout
    assert "left: staircase table2; the same command continues" in stopped.stdout
    metrics = json.loads((tmp_path / "staircase" / "evaluation" / "metrics.json").read_text())
    assert 0 < metrics["steps"] < 1_000_000


def test_a_job_that_fails_does_not_end_the_others(repository, tmp_path):
    done = cuda(repository, tmp_path, "staircase", "doctor", STAIRCASE=str(tmp_path / "none"))
    assert done.returncode == 1 and "failed: staircase" in done.stderr
    assert "can work on this machine" in (tmp_path / "doctor.txt").read_text()
    record = json.loads((tmp_path / "jobs" / "staircase.json").read_text())
    assert "exit status 2" in record["error"]


@pytest.mark.parametrize(
    ("jobs", "others", "message"),
    [
        (("speed",), {}, "no job named 'speed'. There are doctor, tests, step"),
        ((), {"SCALE": "cpu"}, "SCALE: it is paper or smoke, not cpu"),
    ],
)
def test_a_call_that_makes_no_sense_is_told_in_one_line(
    repository, tmp_path, jobs, others, message
):
    done = cuda(repository, tmp_path, *jobs, **others)
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1


def test_without_a_folder_the_script_tells_how_to_use_it(repository):
    done = cuda(repository, "")
    assert done.returncode == 2 and "OUT [JOB ...]" in done.stdout + done.stderr
