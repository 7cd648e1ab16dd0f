"""What logs tell: time of a step, score curves, time to quality."""

import runpy

import pytest

from unbake.evaluation.convergence import (
    milliseconds_per_step,
    score_curve,
    seconds_to,
    smoothed,
    time_to_quality,
)


def curve(*points):
    return [{"seconds": t, "step": i, "albedo_psnr": v} for i, (t, v) in enumerate(points)]


def test_a_step_takes_the_median_of_what_it_takes_after_the_first_ones():
    log = [{"step": s, "seconds": t} for s, t in ((0, 0.0), (20, 9.0), (40, 10.0), (60, 11.0))]
    assert milliseconds_per_step(log) == pytest.approx(50)
    # A hiccup counts as many steps as it holds, and repeated lines of a step count once.
    log += [{"step": 60, "seconds": 11.0, "validation": {}}, {"step": 61, "seconds": 16.0}]
    assert milliseconds_per_step(log) == pytest.approx(50)


def test_a_log_without_a_measurement_gives_none():
    assert milliseconds_per_step([]) is None
    assert (
        milliseconds_per_step([{"step": 0, "seconds": 0.0}, {"step": 20, "seconds": 9.0}]) is None
    )
    slow = [{"step": s, "seconds": t} for s, t in ((0, 0), (1, 30), (2, 60), (4, 64), (6, 68))]
    assert milliseconds_per_step(slow) == pytest.approx(2000)


def test_a_score_curve_has_each_step_once_and_in_order():
    def line(step, value):
        return {"step": step, "seconds": step / 2, "score": {"albedo_psnr": value}}

    log = [line(20, 9.0), {"step": 30, "seconds": 15.0}, line(0, 1.0), line(20, 8.0)]
    found = score_curve(log)
    assert [p["step"] for p in found] == [0, 20]
    assert found[1] == {"seconds": 10, "step": 20, "albedo_psnr": 8.0, "roughness_psnr": None}


def test_a_target_is_reached_on_a_straight_line_between_scores():
    assert seconds_to(curve((0, 10), (10, 20), (20, 22)), 15) == pytest.approx(5)
    assert seconds_to(curve((0, 10), (10, 20), (20, 22)), 22) == pytest.approx(20)


RISING = [(t, min(10.0 + t, 20.0)) for t in range(15)]


@pytest.mark.parametrize("at", range(1, 15))
def test_a_lucky_score_does_not_count(at):
    lucky = [(t, v + 50 * (t == at)) for t, v in RISING]
    # The curve is one score further up, but not where the lucky one is.
    for target in (12.5, 16.5, 18.5):
        assert seconds_to(curve(*lucky), target) == pytest.approx(target - 10, abs=1)
    assert seconds_to(curve(*lucky), 22) is None


@pytest.mark.parametrize("at", range(1, 15))
def test_a_single_dip_does_not_count(at):
    dip = [(t, v - 9 * (t == at)) for t, v in RISING]
    for target in (12.5, 16.5, 18.5):
        assert seconds_to(curve(*dip), target) == pytest.approx(target - 10, abs=1)


def test_a_curve_that_stays_noisy_has_a_score_when_its_middle_has_it():
    """Rates that decay slowly leave scores noisy for long, which is no reason to count for less."""
    noise = [0.0, 1.5, -1.5, 0.8, -0.8]
    noisy = curve(*((t, min(10 + t, 20) + noise[t % 5]) for t in range(200)))
    assert [p["albedo_psnr"] < 19 for p in noisy[100:]].count(True) == 20
    assert seconds_to(noisy, 19) == pytest.approx(9, abs=1.5)
    (end, *_) = time_to_quality({"noisy": noisy})
    assert end.psnr == pytest.approx(20, abs=0.81)


def test_the_ends_of_a_curve_have_shorter_windows():
    assert smoothed([0, 9, 3, 4, 5, 8, 1]) == [0, 3, 4, 5, 4, 5, 5]
    assert smoothed([1, 5, 2, 9]) == [1, 5, 2, 9]


@pytest.mark.parametrize(
    ("points", "seconds"),
    [([(0, 10), (10, 18), (20, 19)], None), ([], None), ([(0, None)], None), ([(3, 25)], 3),
     ([*RISING[:8], (8, 30)], None)],
)  # fmt: skip
def test_a_curve_that_stays_below_never_reached_it(points, seconds):
    assert seconds_to(curve(*points), 20) == seconds


def test_every_run_sets_a_target_for_all():
    fast, slow = curve((0, 10), (4, 20), (8, 20)), curve((0, 10), (10, 15))
    targets = time_to_quality({"fast": fast, "slow": slow, "none": []})
    told = [(t.run, t.below, t.psnr) for t in targets]
    assert told == [("fast", b, 20 - b) for b in (0, 1, 2)] + [
        ("slow", b, 15 - b) for b in (0, 1, 2)
    ]
    assert targets[0].seconds == {"fast": 4, "slow": None, "none": None}
    assert targets[3].seconds == {"fast": 2, "slow": 10, "none": None}
    assert targets[5].seconds == {"fast": pytest.approx(1.2), "slow": 6, "none": None}


def test_every_scored_quantity_has_targets_of_its_own():
    points = [(0, 10.0, 8.0), (5, 20.0, None), (10, 21.0, 18.0)]
    scored = [{"seconds": t, "albedo_psnr": a, "gloss_psnr": g} for t, a, g in points]
    targets = time_to_quality({"one": scored, "other": curve((0, 10), (10, 30))})
    ends = {(t.run, t.quantity): t for t in targets if t.below == 0}
    assert ends.keys() == {("one", "albedo"), ("other", "albedo"), ("one", "gloss")}
    assert ends["one", "gloss"].seconds == {"one": 10, "other": None}
    assert seconds_to(scored, 13.0, "gloss") == pytest.approx(5)


def test_what_a_run_has_before_its_first_step_is_no_target():
    targets = time_to_quality(
        {"lazy": curve((0, 15.2), (10, 16.5)), "worse": curve((0, 9), (9, 8))}
    )
    assert [(t.run, t.below) for t in targets] == [("lazy", 0), ("lazy", 1), ("worse", 0)]


def test_a_score_that_is_noisy_at_the_end_changes_the_first_target_alone():
    """Which is why there are several: the curve is flat there."""
    steady = [(t, 10 + 10 * (1 - 2 ** (-t / 10))) for t in range(0, 100, 5)]
    ours = curve(*((t / 10, v) for t, v in steady))
    for noise in (-0.3, 0.3):
        rival = curve(*steady[:-3], *((t, 20 + noise) for t in (85, 90, 95)))
        times = {t.below: t.seconds for t in time_to_quality({"rival": rival, "ours": ours})[:3]}
        assert times[2]["rival"] / times[2]["ours"] == pytest.approx(10, rel=0.15)
    assert times[0]["ours"] is None


def test_the_table_of_benchmarks_and_the_comparison_agree_on_the_time_to_quality(
    repository, monkeypatch
):
    monkeypatch.syspath_prepend(repository / "benchmarks")
    table = runpy.run_path(str(repository / "benchmarks" / "tables.py"))["time_to_quality"]
    # Smoothed: 10, 19, 20, 22, 22.
    noisy = curve((0, 10), (10, 20), (20, 19), (30, 23), (40, 22))
    runs = {"methods": {"ours": {"score": noisy}}}
    end = {"methods": {"prb": {"score": curve((0, 10), (90, 21))}}}
    assert time_to_quality({"prb": curve((90, 21)), "ours": noisy})[0].seconds["ours"] == 25
    assert "| albedo | at its end | 21.0 dB | 90 s | 25 s | 3.6 |" in table(end, runs)
    assert "| albedo | 2 dB below | 19.0 dB | 74 s | 10 s | 7.4 |" in table(end, runs)
    end["methods"]["prb"]["score"] = curve((0, 10), (90, 22.5))
    assert "| albedo | at its end | 22.5 dB | 90 s | not in 1 of 1 runs |  |" in table(end, runs)


def test_albedo_whose_scale_is_open_races_after_alignment():
    def log(plain, aligned):
        pairs = zip(plain, aligned, strict=True)
        scores = [{"albedo_psnr": p, "albedo_psnr_aligned": a} for p, a in pairs]
        return [{"step": i, "seconds": i, "score": s} for i, s in enumerate(scores)]

    curves = {"a": score_curve(log((5, 9), (10, 20))), "b": score_curve(log((6, 30), (10, 15)))}
    assert curves["a"][1]["albedo_psnr"] == 9 and curves["a"][1]["albedo_psnr_aligned"] == 20
    targets = time_to_quality(curves)
    assert {target.quantity for target in targets} == {"aligned albedo"}
    first = {target.run: target.psnr for target in targets if not target.below}
    assert first == {"a": 20, "b": 15}
    assert targets[0].seconds == {"a": 1, "b": None}
    # Beside a run whose albedo has a scale, each is with its like.
    known = [{"step": i, "seconds": i, "score": {"albedo_psnr": 12 + i}} for i in range(2)]
    targets = time_to_quality(curves | {"c": score_curve(known)})
    runs = {(target.quantity, target.run) for target in targets}
    assert runs == {("albedo", "c"), ("aligned albedo", "a"), ("aligned albedo", "b")}
    assert all(t.seconds["a"] is None for t in targets if t.quantity == "albedo")
