"""The training step: frozen as well as not, proof against NaN, repeatable, flat in memory."""

import dataclasses
import gc
import os
import re
import subprocess
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_frozen_as_unfrozen,
    assert_only_replayed,
    built_in_cameras,
    grey_photographs,
    parameters_of,
)

import unbake.memory as memory_module
import unbake.transport.samplers as samplers_module
from unbake.config import PathConfig
from unbake.dataset.pixels import PixelSource
from unbake.errors import UserError
from unbake.training.memory import memory_mb, peak_bytes
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep


def start(built_in, config=TINY_FIT, pixels=None, scene="cornell"):
    """A fresh fit of a built-in scene: its step, and the state it changes."""
    # What earlier tests left would be freed in between, and counted.
    gc.collect()
    problem = make_problem(built_in(scene), "visible", config, 0.2)
    pixels = pixels or grey_photographs(built_in_cameras(scene, 8, views=2))
    return TrainingStep(problem, pixels, config), initial_state(problem)


def moments(state):
    """Adam's moving averages."""
    return [
        np.array(m).ravel().copy()
        for _, optimizer in state.optimizers()
        for key in optimizer
        for m in optimizer.state[key][3][1:3]
    ]


def rates(i):
    """Learning rates that are others in each step, as those of a fit are."""
    φ, θ = 2e-3 * 0.9**i, 5e-3 * 0.95**i
    return {"albedo": φ, "roughness": φ, "environment": φ, "emission": φ, "radiance": θ}


# --------------------------------------------------------------------------------------- frozen


def with_passes(config, passes):
    """With the best estimator of so many passes."""
    return dataclasses.replace(
        config, estimator=config.one_pass if passes == "one-pass" else passes
    )


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "ours"},
        {"method": "ours", "prior": "one-bounce"},
        {"method": "ours", "bounces": 2},
        {"method": "direct"},
        {"method": "ad-pt", "path": PathConfig(max_depth=8, rr_depth=2)},
        {"method": "prb"},
        {"method": "prb", "representation": "grid"},
        {"method": "prb", "representation": "bitmap"},
        {"method": "prb", "representation": "triplane"},
        {"representation": "triplane", "radiance_representation": "triplane"},
    ],
    ids=lambda settings: ", ".join(map(str, settings.values())),
)
@pytest.mark.parametrize("passes", ["one-pass", "two-pass"])
def test_frozen_and_unfrozen_steps_are_the_same(built_in, one_thread, settings, passes):
    config = with_passes(dataclasses.replace(TINY_FIT, **settings), passes)
    fits = [start(built_in, config) for _ in range(2)]
    assert_frozen_as_unfrozen(*fits, rates, of_terms={"rtol": 1e-5}, atol=1e-6)


@pytest.mark.parametrize(
    "settings",
    [
        {"method": "ours"},
        {"method": "prb"},
        {"method": "prb", "representation": "grid"},
        {"method": "ad-pt", "path": PathConfig(max_depth=8, rr_depth=2)},
        {"representation": "triplane", "radiance_representation": "triplane"},
        {"pixel_sampling": "one-view-crop", "pixels": 36},
    ],
    ids=lambda settings: ", ".join(map(str, settings.values())),
)
def test_nothing_is_compiled_or_traced_after_the_third_step(built_in, settings):
    step, state = start(built_in, dataclasses.replace(TINY_FIT, **settings))
    assert_only_replayed(step, state, rates, steps=5)


# ------------------------------------------------------------------------- paths to their end


SHORT = {"representation": "grid", "path": PathConfig(max_depth=3, rr_depth=2)}


@pytest.mark.parametrize("passes", ["one-pass", "two-pass"])
def test_ad_pt_and_prb_see_the_same_loss(built_in, passes):
    """They follow paths of one length, with other random numbers; one pass: pairs or halves."""
    means = []
    for method in ("prb", "ad-pt"):
        config = dataclasses.replace(TINY_FIT, method=method, spp=64, **SHORT)
        config = with_passes(config, passes)
        step, state = start(built_in, config)
        before = parameters_of(state)
        # Rates so small that all losses are those of the start
        rate = dict.fromkeys(rates(0), 1e-6)
        losses = [float(step(state, i, rate)["photometric"][0]) for i in range(12)]
        assert len(set(losses)) == len(losses)
        assert all((v != before[k]).any() for k, v in parameters_of(state).items())
        means.append(np.mean(losses))
    print(f"{means[0]:.4f} and {means[1]:.4f}")
    np.testing.assert_allclose(means[0], means[1], rtol=0.01)


def test_ad_pt_is_refused_where_memory_is_short(built_in, monkeypatch):
    config = dataclasses.replace(TINY_FIT, method="ad-pt", pixels=2048, **SHORT)
    step, state = start(built_in, config)
    before = parameters_of(state)
    monkeypatch.setattr(memory_module, "free_bytes", lambda: 100_000)
    with pytest.raises(UserError) as error:
        step(state, 0, rates(0))
    message = str(error.value)
    print(message)
    needed = re.fullmatch(
        r"a step of 8192 paths by ad-pt needs about (\S+) MB of memory, 0 MB are free\. "
        r"Lower --batch from 2048 to 1, or --spp or path\.max_depth, or use --method prb",
        message,
    )
    assert needed and 0 <= float(needed[1]) < 5000
    # The probe leaves nothing behind, and with memory the step is taken.
    after = parameters_of(state)
    assert all((before[name] == after[name]).all() for name in before)
    assert all(not np.array(dr.grad(v)).any() for v in state.phi.values())
    for free in (None, 10**12):
        monkeypatch.setattr(memory_module, "free_bytes", lambda free=free: free)
        step, state = start(built_in, config)
        assert np.isfinite(float(step(state, 0, rates(0))["photometric"][0]))


def test_the_estimate_of_memory_is_what_a_step_then_takes(built_in):
    config = dataclasses.replace(TINY_FIT, method="ad-pt", pixels=32768, **SHORT)
    step, state = start(built_in, config)
    forecast = step.forecast(state)
    if forecast is None:
        pytest.skip("the memory of a step cannot be measured here")
    estimate = forecast.bytes(config.pixels)
    state.set_learning_rates(rates(0))
    step.unfrozen(state, 1)
    taken = peak_bytes(lambda: step.unfrozen(state, 1))
    print(f"estimated {estimate / 1e6:.1f} MB, taken {taken / 1e6:.1f} MB")
    assert 0.5 * taken < estimate < 2 * taken


@pytest.mark.slow
def test_russian_roulette_saves_memory(built_in):
    """In a closed room, where all other paths go on to the longest."""
    needed = {}
    for rr_depth in (1, 24):
        path = PathConfig(max_depth=24, rr_depth=rr_depth)
        config = dataclasses.replace(
            TINY_FIT, method="ad-pt", pixels=8192, representation="grid", path=path
        )
        step, state = start(built_in, config, scene="furnace")
        forecast = step.forecast(state)
        if forecast is None:
            pytest.skip("the memory of a step cannot be measured here")
        needed[rr_depth] = forecast.bytes(config.pixels)
    print({depth: f"{need / 1e6:.1f} MB" for depth, need in needed.items()})
    assert 0 < needed[1] < 0.7 * needed[24]


def test_dr_jit_running_out_of_memory_is_told_in_one_line(built_in, monkeypatch):
    config = dataclasses.replace(TINY_FIT, method="prb", **SHORT)
    step, state = start(built_in, config)

    def fails(*arguments):
        raise RuntimeError("jit_malloc(): out of memory! Could not allocate 8 bytes")

    monkeypatch.setattr(samplers_module, "path_radiance", fails)
    with pytest.raises(UserError, match=r"no memory for a step of 128 paths. Lower --batch"):
        step(state, 0, rates(0))


# ------------------------------------------------------------------------------------ NaN and inf


def test_a_gradient_that_is_not_finite_is_dropped_and_no_other(built_in, monkeypatch):
    step, state = start(built_in)
    name = next(k for k in state.phi if k.endswith("1.bias"))  # of the first network's outputs
    objective, broken = samplers_module.objective, [True]

    def with_broken_entry(*arguments):
        terms = objective(*arguments)
        if broken[0]:
            # Zero, with a gradient that is not a number in a single entry.
            bias = state.phi[name].array
            first = dr.arange(mi.UInt32, dr.width(bias)) == 0
            root = dr.sqrt(dr.opaque(mi.Float, 0) * bias)
            terms["broken"] = dr.sum(dr.select(first, root, 0))
        return terms

    monkeypatch.setattr(samplers_module, "objective", with_broken_entry)

    def move(i):
        before = parameters_of(state)
        state.set_learning_rates(dict.fromkeys(rates(0), 1e-3))
        terms = step.unfrozen(state, i)
        assert float(terms["skipped"][0]) == 0
        after = parameters_of(state)
        assert all(np.isfinite(v).all() for v in (*after.values(), *moments(state)))
        return {k: after[k] != before[k] for k in after}

    moved = move(1)
    assert not moved[f"phi.{name}"][0]
    assert moved[f"phi.{name}"][1:].all()
    assert all(m.any() for m in moved.values())
    # Nothing of it stays behind in Adam's averages.
    broken[0] = False
    assert move(2)[f"phi.{name}"].all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_step_without_a_finite_loss_changes_nothing_and_is_counted(built_in, bad):
    cameras = built_in_cameras("cornell", 8, views=2)
    rgb = np.full((128, 3), 0.3)
    rgb[[5, 80]] = bad
    pixels = PixelSource.of(cameras, rgb, np.ones(128), foreground_only=False)
    # A smoothed reference would spread the bad pixels over every batch.
    few = dataclasses.replace(TINY_FIT, pixels=32, loss_reference="photograph")
    step, state = start(built_in, few, pixels)
    outcomes = []
    for i in range(16):
        before = parameters_of(state), moments(state)
        terms = step(state, i, rates(i))
        after = parameters_of(state), moments(state)
        skipped = float(terms["skipped"][0])
        total = sum(float(v[0]) for k, v in terms.items() if k != "skipped")
        assert skipped == (not np.isfinite(total))
        same = all((before[0][k] == after[0][k]).all() for k in before[0])
        assert same == bool(skipped)
        if skipped:
            for a, b in zip(before[1], after[1], strict=True):
                np.testing.assert_array_equal(a, b)
        outcomes.append(skipped)
    assert {0.0, 1.0} == set(outcomes), "the test needs steps of both kinds"
    assert all(np.isfinite(v).all() for v in parameters_of(state).values())


# ---------------------------------------------------------------------------- memory and repetition


def growth(step, state, warm_up, steps):
    """Resident memory gained after the warm-up, MB, and the number of live variables gained."""

    def now():
        dr.sync_thread()
        return memory_mb(), dr.whos(as_string=True).count("\n")

    for i in range(warm_up):
        step(state, i, rates(i))
    before = now()
    for i in range(warm_up, warm_up + steps):
        losses = step(state, i, rates(i))
        if i % 20 == 0:
            assert np.isfinite(float(losses["photometric"][0]))
    after = now()
    return after[0] - before[0], after[1] - before[1]


def test_memory_stays_flat(built_in):
    step, state = start(built_in)
    # What leaks grows again and again. The allocator may take some more once.
    for warm_up in (100, 1, 1):
        megabytes, variables = growth(step, state, warm_up=warm_up, steps=300)
        print(f"{megabytes:.2f} MB, {variables} variables")
        assert variables <= 8
        if megabytes <= 3:
            return
    pytest.fail(f"{megabytes:.2f} MB more after 300 steps, three times")


@pytest.mark.slow
def test_nothing_grows_over_ten_thousand_steps(built_in):
    def open_files():
        return len(os.listdir("/proc/self/fd")) if os.path.isdir("/proc/self/fd") else 0

    step, state = start(built_in)
    step(state, 0, rates(0))
    files = open_files()
    megabytes, variables = growth(step, state, warm_up=500, steps=10_000)
    print(f"{megabytes:.2f} MB, {variables} variables")
    assert megabytes <= 5
    assert variables <= 8
    assert open_files() <= files
    assert step.recordings() <= 3
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        step(state, 10_600, rates(10_600))
        dr.sync_thread()
        kernels = dr.kernel_history()
    assert kernels and all(k["cache_hit"] for k in kernels if "cache_hit" in k)


FIT = """
import gc, hashlib, sys
from pathlib import Path
from unbake import backend
backend.activate()
import drjit as dr, numpy as np
from support import TINY_FIT, built_in_cameras, grey_photographs
from unbake.transport import samplers as samplers_module
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep

def fit(steps):
    problem = make_problem(Path(sys.argv[1]), "visible", TINY_FIT, 0.2)
    pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
    step, state = TrainingStep(problem, pixels, TINY_FIT), initial_state(problem)
    gc.enable()
    rates = {"albedo": 2e-3, "roughness": 2e-3, "radiance": 5e-3}
    losses = [step(state, i, rates) for i in range(steps)]
    values = [*state.phi.values(), *state.theta.values()]
    values += [v for loss in losses for v in loss.values()]
    return hashlib.sha256(b"".join(np.array(v).tobytes() for v in values)).hexdigest()
"""


def in_a_process_of_its_own(script, built_in):
    """What a script that can call `fit` prints."""
    paths = [os.path.dirname(__file__) + "/..", *sys.path]
    result = subprocess.run(
        [sys.executable, "-c", FIT + script, str(built_in("cornell"))],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in paths if p)},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


def test_two_runs_with_one_thread_are_equal_bit_by_bit(built_in):
    script = "dr.set_thread_count(1)\nprint(fit(12))\n"
    first, second = (in_a_process_of_its_own(script, built_in) for _ in range(2))
    assert len(first) == 1 and first == second


def test_an_abandoned_fit_does_not_disturb_the_next_one(built_in):
    """Its scene and its recording are garbage in cycles.

    Freed while the next one is recorded, they would end the process. The collector runs at the
    worst of moments, if it is let.
    """
    script = """
gc.disable()
fit(4)
gc.disable()
objective = samplers_module.objective

def collecting(*arguments):
    if gc.isenabled():
        gc.collect()
    return objective(*arguments)

samplers_module.objective = collecting
fit(4)
print("done")
"""
    assert in_a_process_of_its_own(script, built_in) == ["done"]
