"""The script for GPU machines runs through, at a scale where nothing takes long."""

import json
import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest


def cuda(repository, out, *jobs):
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
        },
        capture_output=True,
        text=True,
        timeout=600,
    )


def numbers(file):
    result = json.loads(file.read_text())
    assert result["milliseconds_per_step"] > 0 and result["parts"]
    return result


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
    for _ in range(2):
        done = cuda(repository, tmp_path, "staircase")
        assert done.returncode == 0, done.stderr[-3000:]
    assert "going on after step 20" in done.stdout


def test_without_a_folder_the_script_tells_how_to_use_it(repository):
    done = cuda(repository, "")
    assert done.returncode == 2 and "OUT [JOB ...]" in done.stdout + done.stderr


def test_the_page_of_the_papers_figures_is_the_one_that_their_results_make(repository):
    page = runpy.run_path(str(repository / "scripts" / "write_reproduction.py"))["page"]
    assert page() == (repository / "docs" / "reproduction.md").read_text(encoding="utf-8")
