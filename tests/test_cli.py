"""The command line, the whole way, as a user walks it."""

import json
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import fields
from html.parser import HTMLParser
from inspect import getsource, signature
from itertools import pairwise
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from support import MPIEXEC, needs_mpi

from unbake import cli
from unbake.cli.flags import flags, of_preset, options, with_options
from unbake.config import (
    QUALITIES,
    FitConfig,
    NetworkConfig,
    PresetName,
    preset,
    read_toml,
    with_quality,
)
from unbake.errors import UserError
from unbake.fields import registry
from unbake.imaging.pictures import read_exr, write_exr
from unbake.solver.settings import SolveSettings
from unbake.training.monitor import SHORT
from unbake.transport.methods import METHODS
from unbake.version import VERSION

SOURCE = str(Path(cli.__file__).parents[2])
COMMANDS = tuple(cli.COMMANDS)
PSNRS = ("render_psnr", "albedo_psnr", "roughness_psnr")


@pytest.fixture
def walked(unbake, tiny, tmp_path, monkeypatch) -> dict:
    """Outcomes of capture, fit, evaluate and report in an empty folder, by command."""
    monkeypatch.chdir(tmp_path)
    sizes = ("--views", 2, "--held-out", 1, "--resolution", 16, "--spp", 8, "--max-depth", 6)
    return {
        "capture": unbake("capture", "cornell", "--out", "data", *sizes),
        "fit": unbake("fit", "data", "-o", "run", "--settings", tiny, "--seed", 3),
        "evaluate": unbake("evaluate", "run", "--spp", 4, "--max-depth", 4, "--train-views", 1),
        "report": unbake("report", "run", "--out", "page/report.html"),
    }


def test_from_a_scene_to_a_page(walked, tmp_path):
    for command, outcome in walked.items():
        assert outcome.status == 0, (command, outcome)
        assert outcome.err == ""
    assert "next: unbake fit data --out RUN" in walked["capture"].out
    assert "next: unbake evaluate run" in walked["fit"].out
    assert "next: unbake report run --out report.html" in walked["evaluate"].out
    assert re.search(r"render_ssim 0\.\d{3}, render_flip 0\.\d{3}, albedo", walked["evaluate"].out)
    assert not list(tmp_path.rglob("*.partial")) and not list(tmp_path.rglob("*.tmp"))
    check_data(tmp_path / "data")
    check_run(tmp_path / "run")
    check_metrics(tmp_path / "run" / "evaluation")
    check_page(tmp_path / "page" / "report.html")


def check_data(data: Path) -> None:
    names = ["heldout_000", "train_000", "train_001"]
    for folder in ("images", "truth/albedo", "truth/roughness"):
        assert sorted(p.stem for p in (data / folder).iterdir()) == names
        for path in (data / folder).iterdir():
            pixels = read_exr(path)
            assert pixels.shape == (16, 16, 4) and np.isfinite(pixels).all() and pixels.min() >= 0
    content = json.loads((data / "transforms.json").read_text())
    assert content["scene"] == "scene/scene.xml" and (data / content["scene"]).is_file()
    assert content["background"] == "visible" and 0 < content["coverage"] <= 1
    render = {"spp": 8, "max_depth": 6, "integrator": "path", "seed": 0}
    assert render.items() <= content["render"].items()
    assert {"mitsuba", "variant", "rr_depth"} <= content["render"].keys()
    keys = {"file_path", "split", "w", "h", "fl_x", "fl_y", "cx", "cy", "transform_matrix"}
    assert all(frame.keys() == keys for frame in content["frames"])


def check_run(run: Path) -> None:
    entries = {"config.toml", "origin.json", "log.jsonl", "checkpoints", "previews", "evaluation"}
    entries |= {".lock"}
    assert {p.name for p in run.iterdir()} == entries
    config = read_toml(run / "config.toml")
    assert (
        config.steps,
        config.seed,
        config.method,
        config.materials["albedo"]["neural"].width,
    ) == (30, 3, "ours", 8)
    assert [p.name for p in (run / "checkpoints").iterdir()] == ["step-000000030"]
    assert [p.name for p in (run / "previews").iterdir()] == ["step-000030.png"]
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    steps = [line for line in lines if "validation" not in line]
    assert [line["step"] for line in steps] == [20, 30]
    terms = {"photometric", "prior", "lhs", "samples_per_second", "memory_mb", "learning_rate"}
    for line in steps:
        assert terms <= line.keys() and all(math.isfinite(line[key]) for key in terms)
        assert line["samples"] == 256 * line["step"] and line["skipped"] == 0
    (last,) = [line for line in lines if "validation" in line]
    assert last["step"] == 30 and last["validation"]["split"] == "heldout"
    assert all(math.isfinite(last["validation"][key]) for key in PSNRS[1:])


def check_metrics(folder: Path) -> None:
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["method"] == "ours" and metrics["steps"] == 30
    assert metrics["samples"] == 30 * 256 and metrics["seconds"] > 0
    for split in ("heldout", "train"):
        assert metrics[split]["views"] == 1
        assert all(math.isfinite(metrics[split][key]) for key in PSNRS)
    assert [row["name"] for row in metrics["per_view"]] == ["heldout_000", "train_000"]
    assert metrics["render"] == {"spp": 4, "max_depth": 4}
    assert {"psnr", "colour_space", "mask"} <= metrics["definitions"].keys()
    assert Path(metrics["data"]).is_dir()
    for row in metrics["per_view"]:
        for kind in ("render", "albedo", "roughness"):
            path = folder / row["split"] / f"{row['name']}_{kind}.exr"
            assert np.isfinite(read_exr(path)).all() and path.with_suffix(".png").is_file()


class Links(HTMLParser):
    """Everything a page would load."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found += [v for k, v in attributes if k in ("src", "href", "srcset", "data")]


def check_page(page: Path) -> None:
    text = page.read_text()
    links = Links(text).found
    assert links and all(link.startswith(("data:", "#")) for link in links)
    assert "url(" not in text.replace("url(data:", "") and "@import" not in text
    for word in ("run", "heldout_000", "train_000", "Photometric loss", "Albedo PSNR"):
        assert word in text


def test_the_installed_command_runs(tmp_path):
    script = Path(sys.executable).with_name("unbake")
    start = [script] if script.is_file() else [sys.executable, "-m", "unbake"]
    done = subprocess.run(
        [*start, "capture", "cube", "--out", "data", "--views", "1", "--held-out", "0",
         "--resolution", "4", "--spp", "1"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": SOURCE}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and done.stderr == "", done
    assert (tmp_path / "data" / "images" / "train_000.exr").is_file()


def test_python_m_unbake_without_a_command_tells_which_there_are(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "unbake"],
        env=os.environ | {"PYTHONPATH": SOURCE}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2 and done.stdout == ""
    assert all(command.split()[0] in done.stderr for command in COMMANDS)
    assert "Traceback" not in done.stderr


def test_the_help_leads_from_nothing_to_a_result(unbake):
    outcome = unbake("--help")
    assert outcome.status == 0
    text = " ".join(outcome.out.split())
    for step in ("unbake capture demo --out DATA", "unbake fit DATA --out RUN",
                 "unbake evaluate RUN", "unbake report RUN --out report.html"):  # fmt: skip
        assert step in text
    assert all(command.split()[0] in text for command in COMMANDS)


def test_the_help_groups_commands_by_task_at_any_width(unbake, monkeypatch):
    for columns in (40, 80):
        monkeypatch.setenv("COLUMNS", str(columns))
        lines = unbake("-h").out.splitlines()
        assert max(map(len, lines)) <= columns
        at = [lines.index(f"{group}:") for group in cli.GROUPS]
        assert at == sorted(at) and len(at) >= 4
        told = [line.split()[0] for line in lines if re.match(r"  \w+  +[A-Z]", line)]
        assert told == list(dict.fromkeys(command.split()[0] for command in COMMANDS))
        lines = unbake("bench", "-h").out.splitlines()
        assert max(map(len, lines)) <= columns and lines[0] == "usage: unbake bench COMMAND ..."
        told = [line.split()[0] for line in lines if re.match(r"  \w+  +[A-Z]", line)]
        assert told == [c.removeprefix("bench ") for c in COMMANDS if c.startswith("bench ")]


def test_a_word_after_bench_is_wanted(unbake):
    outcome = unbake("bench")
    assert outcome.status == 2 and outcome.out == ""
    assert outcome.err.startswith("usage: unbake bench COMMAND ...") and "ceiling" in outcome.err
    outcome = unbake("bench", "stpe")
    assert outcome.status == 2 and "stpe" in outcome.err and "gradients" in outcome.err
    outcome = unbake("benhc")
    assert outcome.status == 2 and "bench" in outcome.err and "Traceback" not in outcome.err


def test_the_version_is_told(unbake):
    outcome = unbake("--version")
    assert (outcome.status, outcome.out) == (0, f"unbake {VERSION}\n")


#: Whether several processes share the work of a command. A new one must say so here.
SHARED = {
    "capture": False,
    "import": False,
    "data": False,
    "fit": True,
    "evaluate": False,
    "report": False,
    "export": False,
    "render": False,
    "relight": False,
    "view": False,
    "solve": False,
    "compare": True,
    "bench step": False,
    "bench methods": False,
    "bench rates": True,
    "bench gradients": False,
    "bench ceiling": False,
    "degrade": False,
    "reproduce": True,
    "doctor": False,
}


def test_it_is_said_of_every_command_whether_processes_share_it():
    assert set(COMMANDS) == set(SHARED) and {c for c in SHARED if SHARED[c]} == cli.SHARED
    for command, function in cli.COMMANDS.items():
        assert ("sharing_ranks()" in getsource(function)) == SHARED[command], command


@pytest.mark.parametrize("command", COMMANDS)
def test_several_processes_are_refused_by_commands_that_do_not_share_work(
    command, unbake, monkeypatch
):
    def called(*_, **__):
        raise UserError("called")

    monkeypatch.setenv("PMI_SIZE", "3")
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    assert unbake(*command.split(), "--help").status == 0
    monkeypatch.setattr("tyro.cli", called)
    outcome = unbake(*command.split())
    refused = f"error: 3 processes were started, and unbake {command} takes one. Run it without "
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("error: called" if SHARED[command] else refused)
    if not SHARED[command]:
        assert "processes share bench rates, compare, fit, reproduce" in outcome.err


@needs_mpi
def test_several_processes_are_refused_in_one_line(tmp_path):
    out = tmp_path / "data"
    words = [MPIEXEC, "-n", "2", sys.executable, "-m", "unbake", "capture", "cube", "--out", out]
    run = {"capture_output": True, "text": True, "timeout": 60}
    done = subprocess.run(words, env=os.environ | {"PYTHONPATH": SOURCE}, **run)
    assert done.returncode == 2 and not done.stdout and not out.exists()
    assert done.stderr.count("\n") == 1 and "2 processes were started" in done.stderr


@pytest.mark.parametrize(
    "command", [c for c in COMMANDS if "out" in signature(cli.COMMANDS[c]).parameters]
)
def test_o_is_short_for_out(command, unbake):
    told = unbake(*command.split(), "--help").out
    assert re.search(r"│ -o (PATH|FILE), --out (PATH|FILE) ", told)


@pytest.mark.parametrize(
    ("option", "choices"),
    [
        (
            "--unknown",
            "'auto', 'materials', 'lighting', 'emission', "
            "'materials+lighting', 'materials+emission', 'lighting+emission', "
            "'materials+lighting+emission'",
        ),
        ("--preset", "'cpu', 'paper', 'release', 'release-lighting'"),
        ("--quality", "'draft', 'normal', 'high'"),
        ("--pixel-sampling", "'all-views', 'one-view-crop'"),
    ],
)
def test_choices_are_listed_in_their_order(option, choices, unbake):
    outcome = unbake("fit", "data", "-o", "run", option, "None")
    assert outcome.status == 2
    assert f"invalid choice 'None' for argument '{option}'" in outcome.err
    assert f"Expected one of ({choices})" in " ".join(re.sub("│", " ", outcome.err).split())


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_is_explained(command, unbake):
    outcome = unbake(*command.split(), "--help")
    assert outcome.status == 0
    assert "None" not in outcome.out and "STR" not in outcome.out
    text = re.sub(r"[│\s]+", " ", outcome.out).partition(" options ")[2]
    options = re.findall(r"(--[a-z-]+)(?: [A-Z]+| \{[^}]*\})? (\S+ \S+)", text)
    for option, explained in options:
        assert re.match(r"[A-Za-z]", explained), option


def test_the_help_breaks_lines_where_they_are_full(unbake, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    for command in COMMANDS:
        lines = unbake(*command.split(), "--help").out.splitlines()
        assert max(map(len, lines)) <= 80
        texts = [line.strip("│ ") for line in lines if line.startswith("│  ")]
        full = max(map(len, texts), default=0)  # the column depends on the widths of all options
        for line, following in pairwise(texts):
            if line and line[-1] in ",a" and following[:1].islower():
                word = following.split()[0]
                assert len(line) + 1 + len(word) > full, (command, line, following)


def test_the_help_of_a_terminal_without_width_ends():
    done = subprocess.run(
        [sys.executable, "-m", "unbake", "doctor", "--help"], capture_output=True, timeout=60,
        env=os.environ | {"PYTHONPATH": SOURCE, "COLUMNS": "1"}, text=True,
    )  # fmt: skip
    assert done.returncode == 0 and "usage" in done.stdout


def test_the_terms_of_the_progress_are_explained(unbake):
    text = " ".join(unbake("fit", "--help").out.split())
    for term in METHODS["ours"].terms:
        assert f"{SHORT.get(term, term)}: " in text


def test_a_working_folder_that_was_deleted_is_one_line(tmp_path):
    """Mitsuba ended the process by SIGABRT."""
    (tmp_path / "gone").mkdir()
    words = ["sh", "-c", 'rmdir ../gone; exec "$@"', "sh", sys.executable, "-m", "unbake"]
    done = subprocess.run(
        [*words, "fit", tmp_path, "--out", tmp_path / "run"], cwd=tmp_path / "gone", timeout=60,
        env=os.environ | {"PYTHONPATH": SOURCE}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 2 and done.stderr.startswith("error: the working folder cannot")
    assert done.stderr.count("\n") == 1


def test_the_help_of_fit_tells_what_the_presets_say(unbake):
    text = re.sub(r"[│\s]+", " ", unbake("fit", "--help").out)
    cpu, paper, release = preset("cpu"), preset("paper"), preset("release")
    lighting = preset("release-lighting")
    for key in ("steps", "pixels"):
        assert getattr(paper, key) == getattr(release, key)
        told = f"cpu: {getattr(cpu, key)}; paper, release: {getattr(paper, key)}; "
        assert f"{told}release-lighting: {getattr(lighting, key)}" in text
    assert "cpu, release-lighting: 8; paper, release: 16" in text
    crops = "paper, release, release-lighting: one-view-crop"
    assert f"cpu: all-views; {crops}" in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps", "-3"), "--steps: must be 0 or more, not -3"),
        (("--seconds", "-1"), "--seconds: must be 0 or more"),
        (("--seconds", "nan"), "--seconds: must be a finite number"),
        (("--seconds", "inf"), "--seconds: must be a finite number"),
        (("--spp", "3"), "--spp: must be an even number, 2 or more, not 3"),
        (("--spp", "0"), "--spp: must be an even number"),
        (("--batch", "0"), "--batch: must be 1 or more, not 0"),
        (("--seed", "-1"), "--seed: must be 0 or more"),
        (("--batch", str(10**9)), "--batch: must be 67108864 or less, not 1000000000"),
        (("--spp", str(10**9)), "--spp: pixels * spp must be 67108864 or less, not 1024000000000"),
        (("--max-depth", str(10**10)), "--max-depth: must be 10000 or less, not 10000000000"),
        (("--method", "ad-pt", "--max-depth", "1"), "--max-depth: must be 2 or more for the"),
        (("--method", "prb", "--max-depth", "1"), "--max-depth: must be 2 or more for the"),
        (("--method", "ad-pt", "--max-depth", "10000"), "--max-depth: must be 256 or less for the"),
        (("--steps", "3", "--seconds", "4"), "--steps: cannot be given together with --seconds"),
        (("--pose-sigma", "2"), "--pose-sigma: no pose or lens is refined that could be uncertain"),
        (
            ("--unknown", "emission", "--quantities", "metallic"),
            "--quantities: no material is unknown with --unknown emission. Leave it out, or",
        ),
        (
            ("--preset", "release-lighting", "--representation", "grid"),
            "--representation: no material is unknown with --unknown lighting",
        ),
        (
            ("--method", "prb", "--radiance", "grid"),
            "--radiance: the method prb has no radiance field. Leave it out, or give --method ours",
        ),
        (("--method", "direct", "--radiance", "grid"), "--radiance: the method direct has no"),
        (("--max-depth", "5"), "--max-depth: the method ours does not follow paths to their end"),
        (("--preset", "cpu", "--settings", "a.toml"), "--preset: cannot be given together"),
        (("--settings", "none.toml"), "none.toml: the file does not exist"),
    ],
)
def test_a_wrong_option_of_fit_is_named(words, message, unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = unbake("fit", "data", "--out", "run", *words)
    assert outcome.status == 2 and outcome.err.startswith(f"error: {message}")
    assert outcome.err.count("\n") == 1 and not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [
        ("capture", "--views", 0),
        ("capture", "--held-out", -1),
        ("capture", "--resolution", 1),
        ("capture", "--spp", 0),
        ("capture", "--max-depth", 0),
        ("capture", "--seed", -1),
        ("capture", "--seed", 10**10),
        ("capture", "--views", 10**9),
        ("capture", "--resolution", 10**9),
        ("capture", "--spp", 10**9),
        ("capture", "--max-depth", 10**10),
        ("evaluate", "--spp", 10**9),
        ("evaluate", "--max-depth", 10**10),
        ("evaluate", "--spp", 0),
        ("evaluate", "--max-depth", -1),
        ("evaluate", "--train-views", -1),
        ("bench step", "--steps", 1),
    ],
)
def test_a_wrong_number_is_named(command, option, value, unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    place = {"capture": ("demo", "--out", "data"), "evaluate": ("run",), "bench step": ()}[command]
    outcome = unbake(*command.split(), *place, option, value)
    assert outcome.status == 2 and outcome.err.startswith(f"error: {option}: must be")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("word", ["--stepz", "--method=best", "--preset=fast", "--steps=many"])
def test_an_unknown_word_is_no_traceback(word, unbake, tmp_path):
    outcome = unbake("fit", "data", "--out", tmp_path / "run", word)
    assert outcome.status == 2 and "Traceback" not in outcome.err
    assert word.split("=")[0] in outcome.err and not (tmp_path / "run").exists()


def test_a_disk_error_is_one_line(unbake, tmp_path, monkeypatch):
    def full(*words, **named):
        raise OSError(28, "No space left on device", "data/images/train_000.exr")

    monkeypatch.setattr("unbake.acquisition.capture.capture", full)
    outcome = unbake("capture", "demo", "--out", tmp_path / "data")
    assert outcome.status == 2
    assert outcome.err == "error: data/images/train_000.exr: No space left on device\n"


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError("jit_malloc(): out of memory! Could not allocate 2 GiB of host memory."),
        RuntimeError("Resource temporarily unavailable"),
        ImportError("libopenblas.so: failed to map segment from shared object"),
    ],
)
def test_memory_that_runs_out_is_one_line(error, unbake, tmp_path, monkeypatch):
    def starved(*words, **named):
        raise error

    monkeypatch.setattr("unbake.acquisition.capture.capture", starved)
    outcome = unbake("capture", "demo", "--out", tmp_path / "data")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert outcome.err.startswith("error: out of memory. Lower the res")


def test_the_next_command_is_as_a_shell_takes_it(unbake, tmp_path, monkeypatch):
    monkeypatch.setattr("unbake.acquisition.capture.capture", lambda *words, **named: None)
    for out, word in {
        "my data": "'my data'",
        "-x": "./-x",
        "plain": "plain",
        "a\nb\x1b[31m": "'a\\nb\\x1b[31m'",
    }.items():
        outcome = unbake("capture", "demo", f"--out={out}")
        assert outcome.out.count("\n") == 1
        assert outcome.out.endswith(f"next: unbake fit {word} --out RUN\n")


def test_ctrl_c_while_nothing_is_written_yet(unbake, tmp_path, monkeypatch):
    def interrupted(*words, **named):
        raise KeyboardInterrupt

    monkeypatch.setattr("unbake.acquisition.capture.capture", interrupted)
    outcome = unbake("capture", "demo", "--out", tmp_path / "data")
    assert (outcome.status, outcome.err) == (130, "interrupted\n")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="Linux alone pins processes")
def test_one_core_is_enough(tmp_path):
    """Mitsuba's OpenEXR used to wait forever for a second thread."""
    cores = f"import os; os.sched_setaffinity(0, {{{min(os.sched_getaffinity(0))}}})"
    words = ["unbake", "capture", "cube", "--out", "data", "--views", "1", "--held-out", "0",
             "--resolution", "4", "--spp", "1"]  # fmt: skip
    call = f"{cores}; import sys; sys.argv = {words}; from unbake.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", call], cwd=tmp_path, timeout=100,
        env=os.environ | {"PYTHONPATH": SOURCE}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done


def test_every_wrong_option_is_told_at_once(unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = unbake("fit", "data", "--out", "run", "--steps", "-1", "--spp", "3", "--batch", "0")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    for told in ("--steps: must be 0", "--spp: must be an even", "--batch: must be 1"):
        assert told in outcome.err


def test_quality_is_a_length_and_a_length_that_is_given_comes_first(
    unbake, cornell, tiny, tmp_path
):
    def length(name, *words):
        run = tmp_path / name
        assert unbake("fit", cornell, "--out", run, "--settings", tiny, *words).status == 0
        settings = read_toml(run / "config.toml")
        return settings.steps, settings.seconds

    assert length("draft", "--quality", "draft") == (8, 0)  # a quarter of 30
    assert length("steps", "--quality", "high", "--steps", 2) == (2, 0)
    assert length("seconds", "--quality", "high", "--seconds", 0.1)[1] == 0.1
    again = ("--out", tmp_path / "draft", "--resume", "--quality", "high")
    outcome = unbake("fit", cornell, *again)
    told = "error: --quality: cannot be given together with --resume\n"
    assert outcome.status == 2 and outcome.err == told


def test_the_length_of_each_quality():
    assert [with_quality(FitConfig(), name).steps for name in QUALITIES] == [600, 2400, 9600]
    timed = with_quality(FitConfig(seconds=60.0), "draft")
    assert timed.seconds == 15.0 and with_quality(FitConfig(), "normal") == FitConfig()
    with pytest.raises(UserError, match="quality"):
        with_quality(FitConfig(), "best")


def test_options_are_made_of_the_settings(unbake):
    """Every field with a flag has its option in fit and, but for the method, in compare."""
    names = {option.name for option in options(FitConfig)}
    assert {"steps", "batch", "quantities", "max-depth", "radiance"} <= names
    for command, missing in (("fit", set()), ("compare", {"method"})):
        text = unbake(command, "--help").out
        assert {name for name in names if f"--{name} " not in text} == missing


def test_a_registered_representation_is_an_option_like_any_other(monkeypatch):
    with pytest.raises(UserError, match=r"--representation: must be one of neural, grid, bitmap"):
        with_options(FitConfig(), {"representation": "wide"})
    monkeypatch.setattr(registry, "_REPRESENTATIONS", dict(registry._REPRESENTATIONS))
    wide = registry.Representation("wide", "wide net", NetworkConfig(width=64), make="no:where")
    registry.register_representation(wide)
    (told,) = (f for f in fields(flags(FitConfig, presets=True)) if f.name == "representation")
    assert "wide (wide net)" in str(told.type)
    chosen = with_options(FitConfig(), {"representation": "wide"})
    assert chosen.material_settings["albedo"].width == 64


def test_the_help_makes_each_preset_once_and_leaves_it_as_it_is(monkeypatch):
    told = {f.name: str(f.type) for f in fields(flags(FitConfig, presets=True))}
    made = []

    def counted(name):
        made.append(name)
        return preset(name)

    of_preset.cache_clear()
    monkeypatch.setattr("unbake.config.preset", counted)
    again = {f.name: str(f.type) for f in fields(flags(FitConfig, presets=True))}
    assert sorted(made) == sorted(get_args(PresetName)) and set(again) == set(told)
    assert all(of_preset(name) == preset(name) for name in made)


def test_options_are_taken_together():
    """The order in which they are applied refuses none that suit each other."""
    chosen = with_options(SolveSettings(), {"batch": 3_000_000, "samples": 1})
    assert (chosen.batch, chosen.samples) == (3_000_000, 1)
    with pytest.raises(UserError, match=r"--batch: .* are too many"):
        with_options(SolveSettings(), {"batch": 3_000_000, "samples": 2})
    with pytest.raises(UserError, match=r"--spp: must be 1 or more.*; --seed: must be 0 or more"):
        with_options(SolveSettings(), {"spp": 0, "seed": -1, "batch": 64})
    wrong = {"spp": 0, "seed": -1, "batch": 0, "samples": 0, "resolution": 0}
    with pytest.raises(UserError) as caught:
        with_options(SolveSettings(), wrong)
    assert all(f"--{name}: must be" in str(caught.value) for name in wrong)


def test_usage_shows_where_a_command_writes_to(unbake):
    """Tyro lists many options as one, also those that are required."""
    for command in ("capture", "fit", "solve", "render", "relight", "export"):
        usage = " ".join(unbake(command, "--help").out.split("\n\n")[0].split())
        assert "-o PATH" in usage, command


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("fit", "data", "--out", "run", "--steps", "1e3"), "a whole number, not '1e3'"),
        (("bench", "step", "--steps", "ten"), "a whole number, not 'ten'"),
        (("compare", "d", "--methods", "prb", "-o", "o", "--score-seconds", "x"), "a number, not"),
        (("fit", "data", "--out", ""), "is empty: give . for the present folder"),
        (("report", "run", "--out="), "is empty: give . for the present folder"),
        (("bench", "step", "--out", ""), "is empty: give . for the present folder"),
    ],
)
def test_a_word_that_is_no_value_is_told_in_plain_words(words, told, unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = unbake(*words)
    assert outcome.status == 2 and not list(tmp_path.iterdir())
    text = " ".join(re.sub("│", " ", outcome.err).split())
    command = " ".join(words[: 1 + (words[0] == "bench")])
    assert told in text and f"unbake {command} --help" in text
    assert "None" not in text and "invalid literal" not in text


def test_a_run_that_goes_on_keeps_what_negative_pixels_are(unbake, tmp_path):
    outcome = unbake("fit", "data", "--out", tmp_path, "--resume", "--clip-negative")
    told = "error: --clip-negative: cannot be given together with --resume\n"
    assert outcome.status == 2 and outcome.err == told


def test_the_help_of_compare_tells_what_each_method_has_of_its_own(unbake):
    text = " ".join(re.sub("│", " ", unbake("compare", "--help").out).split())
    paragraph = text.partition("are the same for all. ")[2].partition(" are each method's own")[0]
    for told in ("rates", "decay", "estimator", "warm-up", "beta2", "bounces", "slope"):
        assert told in paragraph
    assert "if that is more than 0, else 5; with 0 there are no scores" in text


def test_pages_that_cannot_be_written_are_told_before_the_work(unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("unbake.report.page.write_report", None)
    monkeypatch.setattr("unbake.checks.check.check_data", None)
    for words in (("report", "run"), ("data", "check", "data")):
        outcome = unbake(*words, "--out", ".")
        assert outcome.status == 2 and outcome.err.count("\n") == 1
        assert "the page cannot be written (there is a folder)" in outcome.err


def test_commands_in_remedies_are_as_a_shell_takes_them(unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = unbake("report", "my run", "--out", "page.html")
    assert outcome.status == 2 and "unbake evaluate 'my run'" in outcome.err


def test_a_copy_of_negative_photographs_is_refused_in_its_own_words(unbake, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    image = data / "images" / "train_000.exr"
    write_exr(image, -1 - read_exr(image))
    outcome = unbake("degrade", data, "--out", tmp_path / "out", "--seed", 1)
    assert outcome.status == 2 and "pixels are negative" in outcome.err
    assert "--clip-negative" not in outcome.err and "Write the image again" in outcome.err
