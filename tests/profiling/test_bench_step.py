"""`unbake bench`: the numbers it prints are those of its file, for one method and for several."""

import json
import shutil
from datetime import date, timedelta

import pytest
from support import TINY

from unbake.comparison import bench_methods
from unbake.errors import UserError
from unbake.imaging.pictures import read_exr, write_exr
from unbake.version import VERSION


def bench(unbake, what, data, tiny, out, *methods):
    words = ("--data", data, "--settings", tiny, "--steps", 10, "--out", out)
    return unbake("bench", what, *words, f"--method{'s' * (what == 'methods')}", *methods)


@pytest.mark.slow
def test_methods_are_measured_side_by_side(unbake, cornell, tiny, tmp_path):
    out = tmp_path / "deep" / "methods.json"
    named = ("ours", "prb:grid:all-pairs", "prb:grid:two-pass", "ad-pt", "direct:bitmap")
    done = bench(unbake, "methods", cornell, tiny, out, *named)
    assert done.status == 0, done.err
    written = json.loads(out.read_text())
    rows = written["rows"]
    assert written["unbake"] == VERSION
    said = [(r["method"], r["representation"], r["radiance"], r["estimator"]) for r in rows]
    assert said == [
        ("ours", "neural", "neural", "all-pairs"),
        ("prb", "grid", None, "all-pairs"),
        ("prb", "grid", None, "two-pass"),
        ("ad-pt", "neural", None, "two-pass"),
        ("direct", "bitmap", None, "all-pairs"),
    ]
    first = rows[0]["milliseconds_per_step"]
    for row in rows:
        assert row["times_the_first"] == pytest.approx(row["milliseconds_per_step"] / first)
        passes = {"all-pairs": 1, "two-pass": 2}[row["estimator"]]
        rate = row["samples_per_second"] * row["milliseconds_per_step"]
        assert rate == pytest.approx(passes * 256e3)
        assert f"{row['milliseconds_per_step']:.1f}" in done.out


PHASES = {"batch", "ray tracing", "BSDFs and lights", "losses", "gradients", "optimiser"}


def test_a_method_that_fails_does_not_keep_others_from_being_measured(
    unbake, cornell, tiny, tmp_path, monkeypatch
):
    measured = bench_methods._timed

    def timed(dataset, config, *others):
        if config.method == "prb":
            raise UserError("no memory for a step")
        return measured(dataset, config, *others)

    monkeypatch.setattr(bench_methods, "_timed", timed)
    out = tmp_path / "methods.json"
    done = bench(unbake, "methods", cornell, tiny, out, "direct", "prb")
    assert done.status == 1 and "failed" in done.out
    direct, prb = json.loads(out.read_text())["rows"]
    assert direct["milliseconds_per_step"] > 0 and prb["error"] == "no memory for a step"
    done = bench(unbake, "methods", cornell, tiny, out, "prb")
    assert done.status == 2 and "no memory for a step" in done.err


@pytest.mark.parametrize(
    ("method", "more"),
    [
        ("ours", {"material nets", "radiance net"}),
        ("direct", {"material nets"}),
        ("prb", {"paths"}),
    ],
)
def test_one_method_is_taken_apart(unbake, cornell, tiny, tmp_path, method, more):
    out = tmp_path / "step.json"
    done = bench(unbake, "step", cornell, tiny, out, method)
    assert done.status == 0, done.err
    result = json.loads(out.read_text())
    assert result["unbake"] == VERSION
    assert abs(date.today() - date.fromisoformat(result["made"])) <= timedelta(1)
    assert result["method"] == method and result["compiled"] == 0 and result["launches"] > 0
    phases = result["phases"]
    wanted = PHASES | more if method != "prb" else more | {"batch", "gradients", "optimiser"}
    assert wanted <= phases.keys()
    assert all(row["launches"] > 0 and row["milliseconds"] > 0 for row in phases.values())
    assert result["milliseconds_in_kernels"] > 0 and result["milliseconds_in_python"] > 0
    assert f"{result['milliseconds_per_step']:.1f} ms a step" in done.out
    assert result["memory_mb"]["peak"] >= result["memory_mb"]["now"] > 0
    assert (result["roofline"] is None) == (method == "prb")


def test_the_roofline_counts_what_a_step_must_do(unbake, cornell, tiny, tmp_path):
    out = tmp_path / "step.json"
    assert bench(unbake, "step", cornell, tiny, out, "ours").status == 0
    result = json.loads(out.read_text())
    work, rates, roofline = (result["roofline"][k] for k in ("work", "rates", "milliseconds"))
    samples, learned = 64 * 4, 64 * 2
    # From the camera and at x1 one to a light and one by the BSDF; at x2 where L learns of it.
    assert work["rays"] == 3 * samples + 2 * learned
    encoded = TINY.grid.levels * TINY.grid.features
    sizes = {"albedo": (encoded, 3), "roughness": (encoded, 1), "radiance": (encoded + 12, 6)}
    products = {k: TINY.width * (a + b) for k, (a, b) in sizes.items()}
    materials = products["albedo"] + products["roughness"]
    # With gradients, three times: materials at x1, and L at x1 and x2 where it learns.
    image = 3 * materials + products["albedo"] + products["radiance"]
    learning = materials + products["albedo"] + 7 * products["radiance"]
    assert work["multiply_adds"] == image * samples + learning * learned
    assert roofline["all"] == pytest.approx(sum(v for k, v in roofline.items() if k != "all"))
    for key, rate in rates.items():
        assert roofline[key] == pytest.approx(1e3 * work[key] / rate)
    # No machine that runs this is slower or faster than that.
    assert 1e5 < rates["rays"] < 1e11 and 1e8 < rates["bytes"] < 1e14
    assert 1e8 < rates["multiply_adds"] < 1e15


def test_a_scene_is_rendered_for_the_measurement(unbake, tiny, tmp_path):
    out = tmp_path / "step.json"
    words = ("--scene", "still", "--settings", tiny, "--steps", 10, "--out", out)
    done = unbake("bench", "step", *words)
    assert done.status == 0, done.err
    assert json.loads(out.read_text())["data"] == "still"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--data", "d", "--scene", "still"), "--scene: cannot be given together with --data"),
        (("--preset", "paper", "--settings", "f"), "--preset: cannot be given together"),
        (("--scene", "nowhere"), "nowhere"),
    ],
)
def test_options_that_make_no_sense_are_told_in_one_line(unbake, words, message):
    done = unbake("bench", "step", *words)
    assert done.status == 2 and message in done.err
    assert done.err.count("\n") == 1


@pytest.mark.parametrize(
    ("what", "methods", "message"),
    [
        ("step", ["best"], "--method: no method named 'best'. There are ours, no-prior"),
        ("methods", ["best"], "--methods: no method named 'best'. There are ours, no-prior"),
        ("methods", ["prb:paint"], "no representation named 'paint'. There are neural, grid"),
        ("methods", ["prb:grid:both"], "no estimator named 'both'. There are auto, all-pairs"),
        ("methods", ["prb:grid:auto:x"], "has too many parts"),
    ],
)
def test_what_cannot_be_measured_is_told_in_one_line(unbake, cornell, tiny, what, methods, message):
    done = bench(unbake, what, cornell, tiny, "unused.json", *methods)
    assert done.status == 2 and message in done.err
    assert done.err.count("\n") == 1


@pytest.mark.parametrize("what", ["step", "methods"])
def test_options_that_an_error_advises_are_there(unbake, cornell, tiny, tmp_path, what):
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    image = data / "images" / "train_000.exr"
    write_exr(tmp_path / "outside.exr", -1 - read_exr(image))
    image.unlink()
    image.symlink_to(tmp_path / "outside.exr")
    out, flags = tmp_path / "out.json", []
    for option in ("--allow-outside", "--clip-negative"):
        done = bench(unbake, what, data, tiny, out, "direct", *flags)
        assert done.status == 2 and option in done.err, done.err
        flags.append(option)
    assert bench(unbake, what, data, tiny, out, "direct", *flags).status == 0


@pytest.mark.parametrize(
    "words",
    [
        ("step", "--data"),
        ("methods", "--methods", "direct", "--data"),
        ("ceiling",),
    ],
)
def test_a_file_that_cannot_be_written_is_told_before_the_work(
    words, unbake, cornell, tiny, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("unbake.dataset.views.Dataset.load", None)
    for out in (".", tmp_path):
        done = unbake("bench", *words, cornell, "--settings", tiny, "--out", out)
        assert done.status == 2 and done.err.count("\n") == 1
        assert "cannot be written (there is a folder). Give the name of a file" in done.err
