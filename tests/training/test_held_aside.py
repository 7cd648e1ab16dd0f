"""Pixels that are held aside: what is measured on them, and what it says of a fit."""

import dataclasses
import io
import json
import shutil
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console
from support import interrupt_at, last_state, nothing_compiled, one_thread_from_first_step

from unbake.config import from_toml, preset, read_toml
from unbake.dataset.pixels import HELD_GROUPS, CameraRays
from unbake.dataset.views import Dataset, read_view
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.settings import EvaluationSettings
from unbake.training.fresh_fit import begin_fit
from unbake.training.held_aside import HeldAside, HeldOutPhotographs, convergence
from unbake.training.loop import fit
from unbake.training.monitor import Monitor
from unbake.training.poses import PoseModel
from unbake.training.run_folder import RunFolder


@pytest.fixture(scope="module")
def config(tiny):
    """The cheapest fit of the room, 512 pixels, that holds 128 of them aside."""
    return dataclasses.replace(read_toml(tiny), method="direct", held_aside=0.25, steps=40)


@pytest.fixture(scope="module")
def run(cornell, config, tmp_path_factory):
    """A run whose every part was measured, and what it said."""
    folder, said = tmp_path_factory.mktemp("held") / "run", io.StringIO()
    fit(cornell, folder, config, console=Console(file=said, width=80))
    return folder, said.getvalue()


def lines(folder, key="held_aside"):
    log = (folder / "log.jsonl").read_text().splitlines()
    return [line for line in map(json.loads, log) if key in line]


def test_the_error_is_logged_after_each_quarter_and_told(run):
    folder, said = run
    log = lines(folder)
    assert {10, 20, 30, 40} <= {line["step"] for line in log}
    for line in log:
        assert len(line["held_aside_groups"]) == HELD_GROUPS
        assert line["held_aside"] == pytest.approx(np.mean(line["held_aside_groups"]), abs=1e-6)
        assert "photometric" in line
    assert log[-1]["held_aside"] < log[0]["held_aside"]
    told = [
        line
        for line in said.splitlines()
        if line.startswith("held-aside pixels: still improving; error fell")
    ]
    assert len(told) == 1 and "in the last quarter" in told[0] and len(told[0]) <= 80


def test_an_evaluation_has_what_the_fit_told(run, tmp_path):
    folder = shutil.copytree(run[0], tmp_path / "run")
    few = EvaluationSettings(spp=2, max_depth=3, train_views=0)
    found = evaluate(folder, few, tell=lambda line: None)["convergence"]
    errors = {line["step"]: line["held_aside"] for line in lines(folder)}
    assert found["error"] == pytest.approx(errors[40]) and found["trend"] == "improving"
    assert found["before"] == pytest.approx(errors[30]) and found["share"] == 0.25
    assert f"{-100 * found['change']:.1f} ± " in run[1]
    assert RunFolder(folder).metrics()["convergence"] == found


def test_measuring_disturbs_nothing_and_a_resumed_fit_measures_the_same(
    cornell, config, tmp_path, monkeypatch
):
    def train(name, **more):
        with one_thread_from_first_step():
            return fit(cornell, tmp_path / name, config, **more).step

    assert train("whole") == 40
    interrupt_at(monkeypatch, 23)
    assert train("parts") == 24
    assert train("parts", resume=True) == 40
    monkeypatch.setattr(HeldAside, "measure", lambda self, state: {})
    assert train("unmeasured") == 40
    whole, parts, unmeasured = (last_state(tmp_path / n) for n in ("whole", "parts", "unmeasured"))
    for key, value in whole.items():
        assert np.array_equal(value, parts[key]) and np.array_equal(value, unmeasured[key]), key
    measured = [
        [line["held_aside"] for line in lines(tmp_path / n) if line["step"] % 10 == 0]
        for n in ("whole", "parts")
    ]
    assert measured[0] == measured[1] and len(measured[0]) == 4
    assert not lines(tmp_path / "unmeasured")


def test_nothing_is_compiled_or_recorded_after_the_first_time(cornell, config):
    begun = begin_fit(Dataset.load(cornell), config)
    pixels = begun.pixels.holding_aside(0.25, 0)
    aside = HeldAside(begun.step, pixels.rays, pixels.held_aside(), begun.config)
    rates = dict.fromkeys(begun.step.rate_names, 1e-3)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for number in range(3):
            begun.step(begun.state, number, rates)
            first = aside.measure(begun.state)
        recorded = begun.step.recordings()
        with nothing_compiled():
            begun.step(begun.state, 3, rates)
            again = aside.measure(begun.state)
    assert begun.step.recordings() == recorded
    assert again["held_aside"] != first["held_aside"]
    assert aside.measure(begun.state) == again  # the same samples each time


class Halves:
    """A step whose pictures are given: two of each pixel, around its number."""

    epsilon = 0.001

    def __init__(self, first, second):
        self.first, self.second = first, second

    def probe(self, state, rays, pixels, seed):
        numbers, _ = pixels.read()
        return np.stack([np.repeat(self.first(numbers)[:, None], 3, 1),
                         np.repeat(self.second(numbers)[:, None], 3, 1)], 1)  # fmt: skip


def test_the_error_is_the_product_of_both_halves_over_the_reference(cornell, config):
    dataset = Dataset.load(cornell)
    pixels = begin_fit(dataset, config).pixels.holding_aside(0.25, 0)
    step = Halves(lambda n: 0.1 + n / 100, lambda n: 0.2 + n / 50)
    aside = HeldAside(step, pixels.rays, pixels.held_aside(), config)
    numbers, colours = pixels.held_aside().read()
    target, reference = colours[:, :3].astype(float), colours[:, 3:].astype(float)
    first, second = (0.1 + numbers / 100)[:, None], (0.2 + numbers / 50)[:, None]
    squared = (first - target) * (second - target)
    expected = squared / (reference**2 + Halves.epsilon)
    assert aside.measure(None)["held_aside"] == pytest.approx(expected.mean(), rel=1e-5)


def test_pixels_without_a_finite_estimate_are_left_out(cornell, config):
    pixels = begin_fit(Dataset.load(cornell), config).pixels.holding_aside(0.25, 0)
    numbers, _ = pixels.held_aside().read()

    def measured(*broken):
        def halves(found):
            return np.where(np.isin(found, broken), np.nan, 0.1 + found / 100)

        step = Halves(halves, lambda n: 0.2 + n / 50)
        return HeldAside(step, pixels.rays, pixels.held_aside(), config).measure(None)

    whole, part = measured(), measured(numbers[3])
    assert np.isfinite(part["held_aside"])
    assert part["held_aside"] == pytest.approx(whole["held_aside"], rel=0.2)
    other = [n for n in range(16) if n != 3]
    assert all(part["held_aside_groups"][n] == whole["held_aside_groups"][n] for n in other)
    assert part["held_aside_groups"][3] != whole["held_aside_groups"][3]
    assert measured(*numbers[3::16]) == {}


def test_photographs_of_held_out_views_are_compared_in_full(cornell, config):
    dataset = Dataset.load(cornell)
    (view,) = dataset.heldout
    rays = CameraRays.of([v.camera for v in (*dataset.train, view)])
    step = Halves(lambda n: np.full(len(n), 0.25), lambda n: np.full(len(n), 0.5))
    probe = HeldOutPhotographs(step, rays, dataset, config, clip_negative=False)
    photograph = read_view(view.image, view)[..., :3].astype(float).clip(max=1)
    error = ((0.25 - photograph) * (0.5 - photograph)).mean()
    assert probe.measure(None) == {
        "split": "heldout",
        "render_psnr": pytest.approx(-10 * np.log10(error), abs=1e-4),
    }


def test_pixels_without_an_estimate_do_not_lose_the_others(cornell, config):
    dataset = Dataset.load(cornell)
    rays = CameraRays.of([v.camera for v in (*dataset.train, *dataset.heldout)])

    def measured(broken):
        step = Halves(lambda n: np.where(np.arange(len(n)) < broken, np.nan, 0.25),
                      lambda n: np.full(len(n), 0.5))  # fmt: skip
        probe = HeldOutPhotographs(step, rays, dataset, config, clip_negative=False)
        return probe.measure(None)

    assert measured(3)["render_psnr"] == pytest.approx(measured(0)["render_psnr"], abs=1.0)
    assert measured(10**6) is None


def test_photographs_of_held_out_views_are_compared_with_refined_intrinsics(cornell, config):
    dataset = Dataset.load(cornell)
    cameras, (view,) = [v.camera for v in dataset.train], dataset.heldout
    rays, shot = CameraRays.of([*cameras, view.camera]), []

    class Watched(Halves):
        def probe(self, state, rays, pixels, seed):
            shot.append(np.array(rays.lens).reshape(-1, 4))
            return super().probe(state, rays, pixels, seed)

    step = Watched(lambda n: np.full(len(n), 0.25), lambda n: np.full(len(n), 0.5))
    poses = PoseModel(cameras, np.ones(len(cameras)), 100.0, poses=False, intrinsics=True)
    probe = HeldOutPhotographs(step, rays, dataset, config, clip_negative=False, poses=poses)
    moves = [2.0, 1.0, -1.0]  # half the width is 2 pixels longer; the principal point moves
    probe.measure(SimpleNamespace(phi={"intrinsics.moves": mi.Float(moves)}))
    longer = 1 + 2 / (view.camera.width / 2)
    c = view.camera
    expected = [c.fl_x * longer, c.fl_y * longer, c.cx + 1, c.cy - 1]
    np.testing.assert_allclose(shot[0][-1], expected, rtol=1e-5)
    np.testing.assert_allclose(shot[0][:-1], np.array(rays.lens).reshape(-1, 4)[:-1])


@pytest.mark.parametrize("heldout", [True, False])
def test_without_truth_photographs_are_the_validation(heldout, cornell, config, tmp_path):
    data, said = shutil.copytree(cornell, tmp_path / "data"), io.StringIO()
    shutil.rmtree(data / "truth")
    if not heldout:
        described = json.loads((data / "transforms.json").read_text())
        described["frames"] = [f for f in described["frames"] if f["split"] == "train"]
        (data / "transforms.json").write_text(json.dumps(described))
    short = dataclasses.replace(config, steps=8)
    fit(data, tmp_path / "run", short, console=Console(file=said, width=80))
    (line,) = lines(tmp_path / "run", "validation")
    if heldout:
        assert line["validation"]["split"] == "heldout"
        assert 3 < line["validation"]["render_psnr"] < 40
        assert "photographs of held-out views, explained to " in said.getvalue()
    else:
        (logged,) = [x for x in lines(tmp_path / "run") if x["step"] == 8]
        assert line["validation"] == {"held_aside": pytest.approx(logged["held_aside"], abs=1e-6)}
        assert "held-aside pixels, error " in said.getvalue()
    assert all(x["step"] <= 8 for x in RunFolder(tmp_path / "run").log())


# ---------------------------------------------------------------------------------- what it says


def log_of(errors, spread=0.0, by="step"):
    """Lines of a log with errors at even distances, of groups that differ."""
    rng = np.random.default_rng(0)
    fixed = rng.normal(0, 0.3, HELD_GROUPS)
    found = []
    for number, error in enumerate(errors, start=1):
        groups = error * (1 + fixed) + spread * rng.normal(size=HELD_GROUPS)
        line = {by: 200 * number, "held_aside": error, "held_aside_groups": groups.tolist()}
        found += [{by: 200 * number - 100}, line]
    return found


@pytest.mark.parametrize(
    ("errors", "spread", "trend", "change"),
    [
        ([8, 4, 2, 1.5, 1.2, 1.1, 1.0, 0.9], 0.0, "improving", 0.9 / 1.1 - 1),
        ([8, 4, 2, 1.5, 1.2, 1.1, 1.0, 0.9], 2.0, "unclear", 0.9 / 1.1 - 1),
        ([8, 4, 2, 1, 1, 1, 1, 1.002], 0.05, "plateau", 0.002),
        ([8, 4, 2, 1, 1, 1, 1, 0.998], 0.0, "plateau", -0.002),
        ([8, 4, 2, 1, 1, 1, 1.1, 1.3], 0.0, "rising", 0.3),
    ],
    ids=["improving", "noise", "little noise", "plateau", "rising"],
)
def test_a_change_counts_where_it_is_larger_than_its_noise(errors, spread, trend, change):
    found = convergence(log_of(errors, spread))
    assert (found.trend, found.change) == (trend, pytest.approx(change))
    assert (found.before, found.error) == (errors[5], errors[7])
    assert found.share == pytest.approx(0.25)
    assert all(len(line) <= 80 for line in found.told().splitlines())
    assert convergence(log_of(errors, spread, "seconds"), "seconds") == found


def log_of_rises(rises):
    """Lines of a log whose last quarter changed the errors of groups, which were 1, by so much."""
    lines = log_of([4, 2, 1, 1])
    for line in lines[-3:]:
        line |= {"held_aside": 1.0, "held_aside_groups": [1.0] * HELD_GROUPS}
    lines[-1] |= {"held_aside": 1 + np.mean(rises), "held_aside_groups": list(1 + rises)}
    return lines


@pytest.mark.parametrize(
    ("rises", "trend"),
    [
        ([0.02, 0.03] * 8, "rising"),
        ([0.02, 0.03] * 6 + [-0.001] * 4, "rising"),
        ([0.02, 0.03] * 5 + [-0.001] * 6, "plateau"),
        ([3.0, 3.5, 3.2, 3.1, 2.9] + [-0.2] * 11, "unclear"),
        ([0.3, 0.2, 0.25] * 3 + [-0.01] * 7, "unclear"),
        ([1.0, 0.01] * 7 + [-0.5, -0.4], "unclear"),
    ],
    ids=["all", "most", "little", "few", "about half", "2 to 3 standard errors"],
)
def test_a_fit_gets_worse_where_most_groups_do(rises, trend):
    found = convergence(log_of_rises(np.array(rises)))
    assert found.change > 2 * found.noise
    assert found.trend == trend


def test_a_fit_of_a_few_steps_does_not_get_worse():
    rise = np.array([0.02, 0.03] * 8)
    few, many = log_of_rises(rise), log_of_rises(rise)
    few[-1]["step"], many[-1]["step"] = 400, 600
    for lines in (few, many):
        for number, line in enumerate(lines):
            line["step"] = round(lines[-1]["step"] * (number + 1) / len(lines))
    assert convergence(few) is None
    found = convergence(many)
    assert found is not None and found.trend == "rising"


def test_a_fit_of_a_few_steps_is_at_no_plateau_and_no_ratio_is_told_within_noise():
    flat = log_of([8, 4, 2, 1, 1, 1, 1, 1.002])
    few = [line | {"step": line["step"] // 100} for line in flat]
    assert [convergence(log).trend for log in (flat, few)] == ["plateau", "unclear"]
    about_zero = convergence(log_of_rises(np.linspace(-9, 8, HELD_GROUPS)))
    assert about_zero.noise >= 1
    assert "error changed by less than its noise in the last quarter" in about_zero.told()
    lines = log_of([4, 2, 1, 1])
    for line in lines:  # it begins about zero, and rises by more than that
        line |= {"held_aside": 0.001, "held_aside_groups": [0.001] * HELD_GROUPS}
    rises = np.linspace(0.3, 0.5, HELD_GROUPS) * np.tile([1, 4], HELD_GROUPS // 2)
    lines[-1] |= {"held_aside": 0.001 + rises.mean(), "held_aside_groups": list(0.001 + rises)}
    told = convergence(lines).told()
    assert "getting worse; error rose by 6.1 times its noise in the last quarter" in told
    # No error falls by more than all of it: below zero, noise says how far it fell
    falls = log_of_rises(np.linspace(-2.4, -2.2, HELD_GROUPS))
    assert "still improving; error fell by 144.9 times its noise" in convergence(falls).told()


def test_of_a_fit_of_lights_nothing_is_said_of_materials():
    found = convergence(log_of([8, 4, 2, 1, 1, 1, 1, 1.002]))
    gain = "materials may still gain"
    assert gain in found.told() and gain not in found.told(materials=False)


def test_an_error_below_zero_has_a_verdict_too():
    """Errors have no bias, so that those of a fit that explains photographs well lie about zero."""
    lines = log_of_rises(np.array([0.02, -0.01] * 8))
    for line in lines:
        if "held_aside" in line:
            line["held_aside"] -= 1.01
            line["held_aside_groups"] = [x - 1.01 for x in line["held_aside_groups"]]
    found = convergence(lines)
    assert found is not None and found.before < 0 and found.trend == "unclear"
    assert found.noise == pytest.approx(1)
    assert "too noisy; error rose by 1.3 times its noise" in found.told()


def test_too_few_errors_say_nothing():
    assert convergence([]) is None
    assert convergence(log_of([1.0])) is None
    broken = [line | {"held_aside_groups": [1.0]} for line in log_of([2.0, 1.0])]
    assert convergence(broken) is None
    assert convergence(log_of([2.0, 1.0], by="seconds")) is None


def test_runs_of_earlier_versions_hold_nothing_aside():
    assert preset("cpu").held_aside == 0.02 and preset("paper").held_aside == 0
    assert from_toml("").held_aside == 0.02
    assert from_toml("format = 2\n").held_aside == 0
    assert from_toml("format = 2\nheld_aside = 0.1\n").held_aside == 0.1


# ---------------------------------------------------------------------------------- the display


ENTRY = {
    "step": 240, "seconds": 30.0, "samples": 1, "photometric": 8.1141, "prior": 1.3893,
    "prior_extra": 0.064961, "lhs": 26.67, "samples_per_second": 23_000.0, "memory_mb": 635.0,
    "learning_rate": 1.0, "held_aside": 0.1,
}  # fmt: skip


@pytest.mark.parametrize(
    ("width", "line"),
    [
        (80, " 10 %  step 240  photo 8.11  prior 1.39  extra 0.0650  lhs 26.7  4 min left"),
        (50, " 10 %  step 240  photo 8.11  4 min left"),
        (
            120,
            " 10 %  step 240  photo 8.11  prior 1.39  extra 0.0650  lhs 26.7  "
            "23 k samples/s  635 MB  4 min left",
        ),
    ],
)
def test_the_line_of_progress_fits_the_terminal(width, line, tmp_path):
    said = io.StringIO()
    with Monitor(tmp_path / "log.jsonl", Console(file=said, width=width), 2400) as monitor:
        for step, seconds in ((1, 0.1), (4, 0.5), (240, 30.0)):
            monitor.record(step, ENTRY | {"step": step, "seconds": seconds})
    assert len(line) <= width
    assert said.getvalue().splitlines()[-1] == line


@pytest.mark.parametrize(
    ("begin", "told"), [(0, ["5 min left", "3 min left"]), (300, ["2 min left", "50 s left"])]
)
def test_time_left_is_told_by_steps_that_compile_nothing(begin, told, tmp_path):
    """A fit of 87 s began with "1.9 h left": its first step had taken 11 s."""
    said = io.StringIO()
    with Monitor(tmp_path / "log.jsonl", Console(file=said, width=200), 600) as monitor:
        for step, seconds in ((1, 11.0), (20, 21.0), (40, 31.0), (200, 111.0)):
            entry = {"step": begin + step, "seconds": begin + seconds}
            monitor.record(begin + step, ENTRY | entry)
    lines = said.getvalue().splitlines()
    assert ["left" in line for line in lines] == [False, False, True, True]
    assert all(map(str.endswith, lines[2:], told))


def test_the_bar_of_a_terminal_is_one_line(tmp_path):
    said = io.StringIO()
    console = Console(file=said, width=80, force_terminal=True, color_system=None)
    with Monitor(tmp_path / "log.jsonl", console, 2400) as monitor:
        monitor.record(240, ENTRY)
    bars = [part for part in said.getvalue().split("\r") if "step 240" in part]
    assert bars and all("photo 8.11" in bar and "prior 1.39" in bar for bar in bars)
    assert "\n step" not in said.getvalue() and "…" not in bars[-1]
