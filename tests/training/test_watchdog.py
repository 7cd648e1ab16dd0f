"""The watchdog: no fit ends with numbers that are not finite, or silently with nothing learned."""

import dataclasses
import json
import re
import shutil

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, assert_only_replayed, built_in_cameras, grey_photographs

from unbake.dataset.pixels import PixelSource
from unbake.errors import UserError
from unbake.training import watchdog as watchdog_module
from unbake.training.batch_loss import BatchLoss
from unbake.training.checkpoint import Progress
from unbake.training.diagnosis import diagnose
from unbake.training.loss_scaling import next_scale
from unbake.training.problem import make_problem
from unbake.training.run_folder import RunFolder
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.training.watchdog import (
    COMPARED,
    EXPLOSION,
    GIVE_UP_AFTER,
    LONG_ENOUGH,
    SLOWER,
    Watchdog,
)

RATES = dict.fromkeys(("albedo", "roughness", "radiance"), 1e-2)


@pytest.fixture
def begun(built_in):
    """A fit of a few pixels before its first step: its step, and the state that it changes."""

    def start(source=None, **changes):
        config = dataclasses.replace(TINY_FIT, **changes)
        problem = make_problem(built_in("cornell"), "visible", config, 0.2)
        pixels = source or grey_photographs(built_in_cameras("cornell", 8, views=2))
        return TrainingStep(problem, pixels, config), initial_state(problem)

    return start


def numbers(state):
    return [
        np.array(array).ravel().copy()
        for _, optimizer in state.optimizers()
        for value, _, _, extra in optimizer.state.values()
        for array in (dr.detach(value), *extra[:3])
    ]


def spoil(state, word="radiance", value=np.nan):
    """Make the last parameter of an unknown, or of L_θ, not finite: behind layers that hide it."""
    optimizer = state.theta if word == "radiance" else state.phi
    of_word = word != "radiance"
    key = [k for k in optimizer if k.startswith(word) == of_word and not k.startswith("guide")][-1]
    # Not by NumPy: where a step is recorded, the memory of its arrays cannot be released.
    optimizer[key] = dr.full(type(optimizer[key]), value, optimizer[key].shape)


# --------------------------------------------------------------------------------- the state


def test_a_state_goes_back_to_a_snapshot_and_on_as_before(begun, one_thread):
    step, state = begun()
    for i in range(3):
        step(state, i, RATES)
    snapshot, before = state.snapshot(), numbers(state)
    runs = []
    for _ in range(2):
        for i in range(3, 6):
            step(state, i, RATES)
        runs.append(numbers(state))
        state.restore(snapshot)
        for a, b in zip(before, numbers(state), strict=True):
            np.testing.assert_array_equal(a, b)
    for a, b in zip(*runs, strict=True):
        np.testing.assert_array_equal(a, b)
    assert any((a != b).any() for a, b in zip(before, runs[0], strict=True))


def test_snapshots_do_not_make_steps_be_traced_again(begun):
    step, state = begun()

    def rates(i):
        state.restore(state.snapshot())
        return RATES

    assert_only_replayed(step, state, rates)


@pytest.mark.parametrize("word", ["albedo", "radiance"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_found_by_name(begun, word, value):
    step, state = begun()
    step(state, 0, RATES)
    assert state.broken() == []
    spoil(state, word, value)
    (name,) = state.broken()
    assert name.startswith(f"{word}.")


def test_moments_of_adam_count_as_well(begun):
    step, state = begun()
    step(state, 0, RATES)
    key, (value, promoted, rate, (count, first, second, _)) = next(iter(state.phi.state.items()))
    state.phi.state[key] = (value, promoted, rate, (count, first, second * mi.Float(np.inf), None))
    assert state.broken() == [key]


def test_a_gradient_whose_square_is_infinite_is_left_out(begun, monkeypatch):
    step, state = begun(method="direct")
    whole = BatchLoss.backward

    def huge(self, inputs, state):
        terms = whole(self, inputs, state)
        for value in state.phi.values():
            dr.set_grad(value, dr.full(type(dr.detach(value)), 1e30, value.shape))
        return terms

    monkeypatch.setattr(BatchLoss, "backward", huge)
    for i in range(3):
        step(state, i, RATES)
    assert state.broken() == []


# -------------------------------------------------------------------------------- skipped steps


def test_the_culprit_of_a_skipped_step_is_named(begun):
    cameras = built_in_cameras("cornell", 8, views=2)
    rgb = np.full((128, 3), 0.3)
    rgb[64 + 8 * 2 + 5] = 1e38
    pixels = PixelSource.of(cameras, rgb, np.ones(128), foreground_only=False)
    step, state = begun(pixels, pixels=4096, method="direct", loss_reference="photograph")
    before = numbers(state)
    told = diagnose(step, state, 0, ["train_000", "train_001"])
    assert re.search(r"view train_001, pixel \(5, 2\).*: rendered .*, photographed 1e\+38", told)
    for a, b in zip(before, numbers(state), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_radiance_field_that_is_not_finite_is_the_culprit_of_its_terms(begun):
    step, state = begun()
    spoil(state)
    told = diagnose(step, state, 0, ["train_000", "train_001"])
    assert re.match(r"the terms photometric, .* and lhs are not finite", told), told


# ------------------------------------------------------------------------------------ divergence


def reading(loss, skipped=0.0):
    return {"photometric": loss, "skipped": skipped}


def watching(begun, steps=20):
    step, state = begun(method="direct")
    progress = Progress()
    dog = Watchdog(state, step, progress, ["train_000", "train_001"])

    def read(losses, last=False):
        """Twenty steps with these losses, or all with the same one."""
        losses = losses if isinstance(losses, list) else [losses] * steps
        progress.step += len(losses)
        return dog.read([reading(x) for x in losses], last=last)

    return dog, state, progress, read


def test_an_exploding_loss_goes_back_once_and_then_ends_the_fit(begun):
    dog, state, progress, read = watching(begun)
    before = numbers(state)
    for _ in range(4):
        assert read(0.5) == []
    spoiled = mi.TensorXf if dr.is_tensor_v(next(iter(state.phi.values()))) else mi.Float
    key = next(iter(state.phi))
    state.phi[key] = spoiled(dr.detach(state.phi[key]) + 1)
    assert dog.trusts and read(0.5 * EXPLOSION * 1.1) == []
    assert not dog.trusts, "it is not to be saved"
    (line,) = read(0.5 * EXPLOSION * 2)
    assert re.fullmatch(
        r"step 120: the loss rose from about 0.5 to 30; back to the state of step 0, with 0.5 "
        r"times the learning rates",
        line,
    )
    assert dog.trusts and progress.rate == SLOWER and dog.rates({"albedo": 0.2}) == {"albedo": 0.1}
    for a, b in zip(before, numbers(state), strict=True):
        np.testing.assert_array_equal(a, b)
    assert read(0.5) == read(100.0) == []
    with pytest.raises(
        UserError, match=r"the fit diverged again: the loss rose from about 0\.5 to"
    ):
        read(100.0)
    assert state.broken() == []


def test_numbers_that_are_not_finite_go_back_at_once(begun):
    _, state, progress, read = watching(begun)
    read(0.5)
    spoil(state, "albedo")
    (line,) = read(0.5)
    assert re.match(r"step 40: albedo\.\S+ has numbers that are not finite; back to the", line)
    assert state.broken() == [] and progress.rate == SLOWER


def test_a_fit_does_not_end_with_an_exploded_loss(begun):
    _, _, _, read = watching(begun)
    for _ in range(4):
        read(0.5)
    with pytest.raises(UserError, match=r"the fit diverged: .*; the state of step \d+ is kept"):
        read(1e9, last=True)


@pytest.mark.parametrize("few", [1, 2, 4])
def test_a_firefly_in_the_last_steps_does_not_end_a_fit(begun, few):
    """The last reading may have a few steps only, of which one says nothing."""
    dog, _, progress, read = watching(begun)
    for _ in range(4):
        read(0.5)
    assert read([1e3, *[0.5] * (few - 1)], last=True) == []
    assert dog.trusts and progress.rate == 1


def test_short_readings_show_an_explosion_when_it_lasts(begun):
    _, _, progress, read = watching(begun, steps=1)
    for _ in range(8):
        assert read(0.5) == []
    told = [line for _ in range(8) for line in read(1e3)]
    assert len(told) == 1 and "the loss rose" in told[0] and progress.rate == SLOWER


def test_a_passing_rise_is_not_judged_twice_by_the_same_steps(begun):
    """A reading of one step follows, where an error is due: its median is that of before."""
    dog, _, progress, read = watching(begun)
    for _ in range(4):
        read(0.5)
    assert read(1e3) == [] and not dog.trusts
    assert read([0.5]) == read([0.5] * 2) == [] and not dog.trusts
    assert read([0.5] * 2) == [] and dog.trusts and progress.rate == 1


def test_a_fit_that_is_stopped_in_an_explosion_keeps_the_state_of_before(begun):
    dog, state, progress, read = watching(begun)
    before = numbers(state)
    for _ in range(4):
        read(0.5)
    assert dog.settle() == []
    key = next(iter(state.phi))
    spoiled = mi.TensorXf if dr.is_tensor_v(state.phi[key]) else mi.Float
    state.phi[key] = spoiled(dr.detach(state.phi[key]) + 1)
    assert read(1e3) == []
    (line,) = dog.settle()
    assert "saved is the state of step 0" in line and dog.trusts and progress.rate == 1
    for a, b in zip(before, numbers(state), strict=True):
        np.testing.assert_array_equal(a, b)


def test_fireflies_and_noise_are_no_explosion(begun):
    dog, _, progress, read = watching(begun)
    rng = np.random.default_rng(0)
    for _ in range(200):
        # Half of the losses of split halves are negative where little is left to learn
        losses = rng.standard_t(2, 20) * 0.01 + 1e-4
        losses[rng.integers(20)] *= 1e6
        assert read(losses.tolist()) == [] and dog.trusts
    assert progress.rate == 1


@pytest.mark.parametrize("steps", [3, 25])
def test_a_first_step_of_next_to_nothing_is_no_measure(begun, steps):
    """In a dim room paths of the first step may all miss the lamp: the loss is noise."""
    dog, _, progress, read = watching(begun)
    for _ in range(1 if steps == 3 else 3):
        losses = [0.1] * steps
        if not progress.step:
            losses[0] = 1e-4
        assert read(losses, last=steps == 3) == []
    assert dog.trusts and progress.rate == 1


def test_dim_steps_that_are_read_alone_are_no_measure(begun):
    dog, _, progress, read = watching(begun, steps=1)
    for loss in (1e-4, 1e-4, 1e-4, *[0.1] * 9):
        assert read(loss) == []
    assert dog.trusts and progress.rate == 1


def test_a_fit_that_goes_on_is_judged_by_its_own_loss(begun, monkeypatch):
    monkeypatch.setattr(TrainingStep, "loss_of_black", lambda _: 1.0)
    for number, told in ((0, 0), (400, 1)):
        _, _, progress, read = watching(begun)
        progress.step = number
        lines = read(1e-3) + read(10.0) + read(10.0)
        assert len(lines) == told, "10 is much beside 0.001, and little beside black images"


def test_three_steps_are_too_few_to_be_judged(begun):
    dog, _, _, read = watching(begun)
    assert read([1e-4, 1e4, 1e4], last=True) == [] and dog.trusts
    _, state, _, read = watching(begun)
    spoil(state, "albedo")
    with pytest.raises(UserError, match="not finite"):
        read([0.5] * 3, last=True)


def test_a_fit_that_explodes_from_the_start_goes_back(begun):
    _, _, progress, read = watching(begun)
    told = read([0.5, *[1e4] * 19]) + read(1e4)
    assert len(told) == 1 and "the loss rose" in told[0] and progress.rate == SLOWER


def test_steps_without_a_finite_loss_are_counted_and_too_many_end_the_fit(begun, monkeypatch):
    monkeypatch.setattr(watchdog_module, "diagnose", lambda *_: "the culprit")
    dog, _, progress, _ = watching(begun)

    def take(skipped, steps=20, last=False):
        progress.step += steps
        bad = [reading(np.nan, 1.0)] * skipped
        return dog.read([*bad, *[reading(0.5)] * (steps - skipped)], last=last)

    assert take(0) == []
    assert take(3) == ["step 21 was skipped: the culprit; further ones are counted"]
    assert take(2) == [] and progress.skipped == 5
    assert take(20) == take(20) == []
    progress.skipped += 10
    with pytest.raises(UserError, match=r"was not finite in 65 of 110 steps: the culprit\. Lower"):
        take(10, steps=10)
    assert progress.step >= GIVE_UP_AFTER


def test_a_short_fit_of_skipped_steps_does_not_end_well(begun, monkeypatch):
    monkeypatch.setattr(watchdog_module, "diagnose", lambda *_: "the culprit")
    dog, _, progress, _ = watching(begun)
    progress.step = 6
    with pytest.raises(UserError, match="not finite in 4 of 6 steps: the culprit"):
        dog.read([reading(np.nan, 1.0)] * 4 + [reading(0.5)] * 2, last=True)


# ------------------------------------------------------------------------------ the verdict


@pytest.mark.parametrize(
    ("before", "now", "learned"),
    [
        ([2.0, 1.0] * 4, [1.0, 0.5] * 4, True),
        ([2.0, 1.0] * 4, [2.0, 1.0] * 4, False),
        ([2.0, 1.0] * 4, [9.0, 8.0] * 4, False),
        # Most batches are better, one is lost in noise.
        ([2.0, 1.0] * 4, [0.2, 0.1] * 3 + [0.2, 30.0], True),
        # The noise of paths is so large that the batches do not tell.
        ([2.0, 1.0, -1.0, 4.0] * 2, [-3.0, 7.0, 1.5, 2.0] * 2, True),
        ([2.0, 1.0, -1.0, 4.0] * 2, [12.0, 17.0, 8.0, 21.0] * 2, False),
        # Hardly anything changed, with or without a sign.
        ([2.0, 1.0] * 4, [2.02, 0.995, 2.0, 1.01] * 2, False),
    ],
)
def test_only_what_the_batches_tell_is_said_of_a_fit(begun, monkeypatch, before, now, learned):
    dog, state, progress, _ = watching(begun)
    progress.step, progress.untrained = LONG_ENOUGH, tuple(before)
    monkeypatch.setattr(type(state), "moved", lambda _: True)
    monkeypatch.setattr(Watchdog, "_looked_at_again", lambda *_: [reading(x) for x in now])
    told = dog.verdict({"albedo": 0.01, "roughness": 0.01})
    assert (told is None) == learned, told
    assert learned or "no better than by the untrained fields" in told


def test_an_explosion_does_not_take_back_what_a_search_has_found(begun):
    dog, state, _, read = watching(begun)
    for _ in range(4):
        read(0.5)
    key = next(iter(state.phi))
    searched = mi.TensorXf if dr.is_tensor_v(state.phi[key]) else mi.Float
    state.phi[key] = searched(dr.detach(state.phi[key]) + 1)
    found = numbers(state)
    dog.keep()
    read(0.5 * EXPLOSION * 1.1)
    state.phi[key] = searched(dr.detach(state.phi[key]) + 1)
    (line,) = read(0.5 * EXPLOSION * 2)
    assert "back to the state of step 80," in line
    for a, b in zip(found, numbers(state), strict=True):
        np.testing.assert_array_equal(a, b)


def test_an_explosion_is_not_lost_in_the_loss_of_the_guide(begun):
    """That one is a cross-entropy, which is large all the time."""
    dog, _, progress, _ = watching(begun)
    told = []
    for loss in (0.01, 0.01, 0.01, 0.01, 10.0, 10.0):
        progress.step += 20
        told += dog.read([reading(loss) | {"guide": 4.3}] * 20, last=False)
    assert len(told) == 1 and "the loss rose from about 0.01 to 10; back to" in told[0]


def test_what_photographs_tell_is_not_lost_in_a_prior_that_rises(begun, monkeypatch):
    dog, state, progress, _ = watching(begun)
    first = [{"photometric": 2.0, "prior": 0.5, "skipped": 0} for _ in range(COMPARED)]
    progress.step = COMPARED
    dog.read(first, last=False)
    progress.step = LONG_ENOUGH
    monkeypatch.setattr(type(state), "moved", lambda _: True)
    for photometric, learned in ((0.2, True), (2.0, False)):
        now = [{"photometric": photometric, "prior": 5.0, "skipped": 0}] * COMPARED
        monkeypatch.setattr(Watchdog, "_looked_at_again", lambda *_, now=now: now)
        assert (dog.verdict({"albedo": 0.01, "roughness": 0.01}) is None) == learned


# ------------------------------------------------------------------------------- whole fits


@pytest.fixture
def fit(unbake, cornell, tiny, tmp_path):
    def run(*words, data=cornell, more="", name="run"):
        file = tmp_path / "settings.toml"
        file.write_text(
            f"{more}\n{tiny.read_text()}" if "[" not in more else tiny.read_text() + more
        )
        words = ("--settings", file, "--method", "direct", "--steps", LONG_ENOUGH, *words)
        return unbake("fit", data, "--out", tmp_path / name, *words), RunFolder(tmp_path / name)

    return run


def notes(run):
    return [line["note"] for line in run.log() if "note" in line]


def test_a_method_without_images_has_no_verdict_on_them(begun, monkeypatch):
    step, state = begun()
    dog = Watchdog(state, step, Progress(step=LONG_ENOUGH), ["view"])
    monkeypatch.setattr(type(state), "moved", lambda self: True)
    monkeypatch.setattr(Watchdog, "_looked_at_again", lambda *_: [{"prior": 0.1, "skipped": 0.0}])
    assert dog.verdict({"albedo": 0.01, "roughness": 0.01}) is None


def test_batches_of_other_processes_are_not_compared(begun, monkeypatch):
    step, state = begun()
    now = [{"photometric": 1.0, "skipped": 0.0}] * 8
    monkeypatch.setattr(type(state), "moved", lambda self: True)
    monkeypatch.setattr(Watchdog, "_looked_at_again", lambda *_: now)
    monkeypatch.setattr(type(step), "loss_of_black", lambda self: 1.0)
    for processes, told in ((1, True), (2, False)):
        progress = Progress(step=LONG_ENOUGH, untrained=(1.0,) * 8, processes=processes)
        dog = Watchdog(state, step, progress, ["view"])
        assert (dog.verdict({"albedo": 0.01, "roughness": 0.01}) is not None) == told


@pytest.mark.parametrize("unknown", ["materials", "emission"])
def test_a_loss_that_rises_is_no_verdict_where_lamps_are_unknown(unknown, begun, monkeypatch):
    """The untrained L_θ has the light of photographs, and lamps have to get it first."""
    step, state = begun()
    monkeypatch.setattr(step, "config", dataclasses.replace(step.config, unknown=unknown))
    monkeypatch.setattr(type(state), "moved", lambda self: True)
    now = [{"photometric": 2.0, "skipped": 0.0}] * 8
    monkeypatch.setattr(Watchdog, "_looked_at_again", lambda *_: now)
    monkeypatch.setattr(type(step), "loss_of_black", lambda self: 1.0)
    dog = Watchdog(state, step, Progress(step=LONG_ENOUGH, untrained=(1.0,) * 8), ["view"])
    told = dog.verdict({"albedo": 0.01, "roughness": 0.01})
    assert (told is None) == (unknown == "emission")


def test_a_fit_that_learns_ends_well(fit):
    outcome, run = fit()
    assert outcome.status == 0 and not notes(run), outcome
    manifest = json.loads(next(run.checkpoints.glob("step-*/manifest.json")).read_text())
    assert len(manifest["untrained"]) == 8 and manifest["rate"] == 1 and manifest["skipped"] == 0


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            "[rate_factors]\nalbedo = 1e-30\nroughness = 1e-30",
            "nothing was learned: 200 steps move the unknowns by .* at most. Raise the learning",
        ),
        (
            "[rate_factors]\nalbedo = 1000.0\nroughness = 1000.0\n"
            "[regularization]\nalbedo_smoothness = 0.0",
            "nothing was learned: the photographs are explained no better than by the untrained",
        ),
    ],
)
def test_a_fit_that_learns_nothing_says_so(fit, settings, message, unbake, cornell):
    outcome, run = fit(more=settings)
    assert outcome.status == 1, outcome
    assert re.search(f"warning: {message}", outcome.out)
    assert re.match(message, notes(run)[-1])
    told = len(notes(run))
    again = unbake("fit", cornell, "--out", run.path, "--resume", "--steps", LONG_ENOUGH)
    assert again.status == 1 and len(notes(run)) == told, "one verdict, however often it ends"


def test_lights_that_are_far_too_strong_are_told(fit, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    scene = data / "scene" / "scene.xml"
    bright = scene.read_text().replace("13 10 6.5", "13e8 10e8 6.5e8")
    assert bright != scene.read_text()
    scene.write_text(bright)
    outcome, run = fit(data=data)
    assert outcome.status == 1, outcome
    assert "nothing useful was learned: the loss is" in notes(run)[-1]


def test_a_loss_that_is_no_number_does_not_lower_the_scale_of_gradients(begun, monkeypatch):
    """In half precision one step in two thousand would have brought it to zero."""
    step, state = begun(method="direct", precision="half")
    before, whole = float(state.scale[0]), BatchLoss.backward

    def spoilt(self, inputs, state):
        terms = whole(self, inputs, state)
        return terms | {"photometric": terms["photometric"] * mi.Float(np.nan)}

    monkeypatch.setattr(BatchLoss, "backward", spoilt)
    for i in range(3):
        assert float(step(state, i, RATES)["skipped"][0]) == 1
    assert float(state.scale[0]) == before
    scale = mi.Float(1)
    for _ in range(100):
        scale = next_scale(scale, mi.Bool(False))
    assert float(scale[0]) > 0


def test_without_gradients_nothing_was_learned(fit, monkeypatch):
    whole = BatchLoss.backward

    def none(self, inputs, state):
        terms = whole(self, inputs, state)
        for value in state.phi.values():
            dr.set_grad(value, 0)
        return terms

    monkeypatch.setattr(BatchLoss, "backward", none)
    outcome, run = fit()
    assert outcome.status == 1 and "no gradient ever reached the unknowns" in notes(run)[-1]


@pytest.mark.parametrize("times", [1, 2])
def test_a_fit_goes_on_after_one_breakdown_and_ends_after_two(times, fit, monkeypatch):
    plain = TrainingStep.__call__

    def breaking(self, state, number, rates):
        if number in (70, 130)[:times]:
            spoil(state, "albedo")
        return plain(self, state, number, rates)

    monkeypatch.setattr(TrainingStep, "__call__", breaking)
    outcome, run = fit()
    told = notes(run)
    terms = "the terms photometric and albedo_smoothness are not finite"
    assert re.match(f"step 71 was skipped: {terms}; nor the gr", told[0])
    assert re.match(
        r"step 80: albedo\.\S+ has numbers .* not finite; back to the state of", told[1]
    )
    newest = max(run.checkpoints.glob("step-*"))
    manifest = json.loads((newest / "manifest.json").read_text())
    assert manifest["rate"] == SLOWER and manifest["skipped"] > 0
    if times == 1:
        assert outcome.status == 0 and "skipped)" in outcome.out, outcome
    else:
        assert outcome.status == 2, outcome
        assert re.fullmatch(r"error: .*the fit diverged again: albedo.*\n", outcome.err)
