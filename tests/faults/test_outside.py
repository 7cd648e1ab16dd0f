"""Commands read files outside of a data set with --allow-outside alone, and refuse odd paths."""

import os
import shutil

import pytest


@pytest.fixture
def data(cornell, tmp_path):
    """A data set of one's own, to break."""
    return shutil.copytree(cornell, tmp_path / "data")


def refused(outcome, message):
    assert outcome.status == 2 and "Traceback" not in outcome.err
    (line,) = outcome.err.splitlines()
    assert line.startswith("error: ") and message in line


def test_true_lights_behind_a_link_need_the_option(unbake, data, tiny, tmp_path):
    moved = (data / "truth" / "emission.json").rename(tmp_path / "lights.json")
    (data / "truth" / "emission.json").symlink_to(moved)
    run = tmp_path / "run"
    words = ("--settings", tiny, "--unknown", "emission", "--steps", 1)
    assert unbake("fit", data, "--out", run, *words).status == 0
    words = ("evaluate", run, "--spp", 1, "--max-depth", 2, "--train-views", 0)
    refused(unbake(*words), "'truth/emission.json' lies outside the data folder")
    outcome = unbake(*words, "--allow-outside")
    assert outcome.status == 0 and "% off" in outcome.out
    report = ("report", run, "--out", tmp_path / "report.html")
    assert unbake(*report, "--allow-outside").status == 0


@pytest.mark.parametrize("command", ["fit", "evaluate", "capture", "data"])
def test_a_path_that_is_not_utf8_is_refused(command, unbake, data, tiny, tmp_path):
    odd = tmp_path / os.fsdecode(b"o\xffd")
    words = {
        "fit": ("fit", data, "--out", odd, "--settings", tiny),
        "evaluate": ("evaluate", odd),
        "capture": ("capture", "cube", "--out", odd),
        "data": ("fit", odd, "--out", tmp_path / "run", "--settings", tiny),
    }[command]
    if command in ("evaluate", "data"):
        odd.mkdir()
    refused(unbake(*words), "o\\xffd: the path of the")
    assert odd.exists() == (command in ("evaluate", "data"))


def test_terminal_escapes_in_a_name_are_not_sent_to_the_terminal(unbake, data, tiny, tmp_path):
    file = data / "transforms.json"
    file.write_text(file.read_text().replace('"split": "train"', r'"split": "\u001b[31mtrain"', 1))
    refused(unbake("fit", data, "--out", tmp_path / "run"), r"unknown split '\x1b[31mtrain'")
