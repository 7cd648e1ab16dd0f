"""The examples run, at a size that takes seconds, and show what they say."""

import json
import os
import re
import subprocess
import sys

import pytest


@pytest.fixture
def example(repository):
    """Run an example in a process of its own, and return what it prints."""

    def run(name, *words):
        done = subprocess.run(
            [sys.executable, "-W", "error", str(repository / "examples" / name), *map(str, words)],
            env=os.environ | {"PYTHONPATH": str(repository / "src")},
            capture_output=True,
            text=True,
            timeout=250,
        )
        assert done.returncode == 0, done.stderr[-4000:]
        return done.stdout

    return run


@pytest.mark.slow
def test_a_method_of_ones_own_is_compared_with_ours(example, tmp_path):
    out = example("custom_method.py", "--out", tmp_path, "--steps", 6, "--resolution", 12)
    result = json.loads((tmp_path / "comparison" / "compare.json").read_text("utf-8"))
    assert list(result["methods"]) == ["ours", "luminance-prior"]
    for name, row in result["methods"].items():
        assert "error" not in row and row["steps"] == 6
        assert f"{name}: albedo {row['heldout']['albedo_psnr']:.1f} dB" in out
        log = (tmp_path / "comparison" / name / "log.jsonl").read_text("utf-8").splitlines()
        entry = json.loads(log[0])
        assert ("luminance_prior" in entry) == (name == "luminance-prior")
    report = (tmp_path / "comparison" / "report.html").read_text("utf-8")
    assert "luminance-prior" in report and "Prior relative to luminance" in report
    told = re.search(r"step 6 .*luminance_prior (\S+)", out)  # the progress tells it, too
    assert told and float(told[1]) == pytest.approx(entry["luminance_prior"], rel=0.01)


def test_a_training_loop_of_ones_own_lowers_the_loss(example, cornell):
    out = example("custom_training_loop.py", cornell, "--steps", 40)
    found = re.search(r"mean loss (\S+) at first, (\S+) last", out)
    assert found and float(found[2]) < 0.8 * float(found[1])


def test_a_representation_of_ones_own_is_fitted(example, cornell, tmp_path):
    run = tmp_path / "run"
    out = example("custom_field.py", cornell, "--out", run, "--steps", 6, "--pixels", 64)
    assert re.search(r"Fourier features: albedo \d+\.\d dB", out)
    settings = (run / "config.toml").read_text("utf-8")
    assert 'representation = "fourier"' in settings
    assert "[materials.albedo.fourier]\ncount = 32" in settings
    assert "[materials.roughness.fourier]\ncount = 16" in settings
