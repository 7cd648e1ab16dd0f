"""`unbake bench`: the numbers it prints are those of its file, for one method and for several."""

import json

import pytest


def bench(unbake, what, data, tiny, out, *methods):
    words = ("--data", data, "--settings", tiny, "--steps", 10, "--out", out, "--methods", *methods)
    return unbake("bench", what, *words)


def test_methods_are_measured_side_by_side(unbake, cornell, tiny, tmp_path):
    out = tmp_path / "deep" / "methods.json"
    named = ("ours", "prb:grid:split-halves", "prb:grid", "ad-pt", "direct:bitmap")
    done = bench(unbake, "methods", cornell, tiny, out, *named)
    assert done.status == 0, done.err
    rows = json.loads(out.read_text())["rows"]
    said = [(r["method"], r["representation"], r["radiance"], r["estimator"]) for r in rows]
    assert said == [
        ("ours", "neural", "neural", "split-halves"),
        ("prb", "grid", None, "split-halves"),
        ("prb", "grid", None, "two-pass"),
        ("ad-pt", "neural", None, "two-pass"),
        ("direct", "bitmap", None, "split-halves"),
    ]
    first = rows[0]["milliseconds_per_step"]
    for row in rows:
        assert row["times_the_first"] == pytest.approx(row["milliseconds_per_step"] / first)
        assert row["samples_per_second"] * row["milliseconds_per_step"] == pytest.approx(256e3)
        assert f"{row['milliseconds_per_step']:.1f}" in done.out


def test_one_method_is_taken_apart(unbake, cornell, tiny, tmp_path):
    out = tmp_path / "step.json"
    done = bench(unbake, "step", cornell, tiny, out, "direct")
    assert done.status == 0, done.err
    result = json.loads(out.read_text())
    assert result["method"] == "direct" and result["compiled"] == 0
    assert sum(row["launches"] for row in result["kernels"].values()) == result["launches"] > 0
    assert f"{result['milliseconds_per_step']:.1f} ms a step" in done.out


@pytest.mark.parametrize(
    ("what", "methods", "message"),
    [
        ("step", ["ours", "prb"], "--methods: step takes one method. Or: unbake bench methods"),
        ("methods", ["best"], "--methods: no method named 'best'. There are ours, no-prior"),
        ("methods", ["prb:paint"], "no representation named 'paint'. There are neural, grid"),
        ("methods", ["prb:grid:both"], "no estimator named 'both'. There are auto, split-halves"),
        ("methods", ["prb:grid:auto:x"], "has too many parts"),
    ],
)
def test_what_cannot_be_measured_is_told_in_one_line(unbake, cornell, tiny, what, methods, message):
    done = bench(unbake, what, cornell, tiny, "unused.json", *methods)
    assert done.status == 2 and message in done.err
    assert done.err.count("\n") == 1
