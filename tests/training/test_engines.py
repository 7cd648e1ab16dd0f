"""Steps are the same on every engine; in half precision near it, unbiased, and safe."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, built_in_cameras, grey_photographs, parameters_of

from unbake.fields.perceptron import Perceptron, can_record_layout
from unbake.training.checkpoint import Progress, load_checkpoint, save_checkpoint
from unbake.training.problem import make_problem
from unbake.training.run_folder import RunFolder
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep

RATES = {"albedo": 2e-3, "roughness": 2e-3, "radiance": 5e-3}


def start(built_in, precision, **settings):
    config = dataclasses.replace(TINY_FIT, precision=precision, **settings)
    problem = make_problem(built_in("cornell"), "visible", config, 0.2)
    pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
    return TrainingStep(problem, pixels, config), initial_state(problem)


def gradients(step, state, number):
    """The loss terms of a step's batch, and the gradients of all parameters in one row."""
    terms = step.batch_loss.backward(step.prepare(state, number, RATES), state)
    rows = []
    for _, optimizer in state.optimizers():
        rows += [np.array(dr.grad(v)).ravel() for v in optimizer.values()]
        dr.clear_grad(dict(optimizer.items()))
    scale = 1.0 if state.scale is None else float(state.scale[0])
    return {k: float(v[0]) for k, v in terms.items()}, np.concatenate(rows).astype(float) / scale


def trained(built_in, steps):
    """Single and half precision with the same parameters, those of a short fit."""
    single, state = start(built_in, "single")
    for i in range(steps):
        single(state, i, RATES)
    half, other = start(built_in, "half")
    for (_, a), (_, b) in zip(state.optimizers(), other.optimizers(), strict=True):
        b.update({key: type(v)(v) for key, v in a.items()})
    return (single, state), (half, other)


@pytest.mark.skipif(not can_record_layout(), reason="the fused engine is for LLVM")
@pytest.mark.parametrize("engine", ["tensor", "coopvec"])
def test_one_step_is_the_same_on_every_engine(built_in, monkeypatch, engine):
    rows = []
    for used in ("fused", engine):
        monkeypatch.setattr(Perceptron, "_usual_engine", lambda self, used=used: used)
        rows.append(gradients(*start(built_in, "single"), 5))
    (terms, row), (others, other) = rows
    for name, value in terms.items():
        assert others[name] == pytest.approx(value, rel=1e-4), name
    assert np.linalg.norm(other - row) < 1e-4 * np.linalg.norm(row)


@pytest.mark.slow
def test_losses_and_gradients_are_those_of_single_precision(built_in):
    single, half = trained(built_in, 60)
    differences, exact = [], []
    for number in range(200, 248):
        (terms, row), (near, nearby) = gradients(*single, number), gradients(*half, number)
        for name, value in terms.items():
            assert near[name] == pytest.approx(value, rel=2e-2, abs=1e-4), name
        # A neuron next to its kink may be on in one precision and off in the other.
        assert np.linalg.norm(nearby - row) < 5e-2 * np.linalg.norm(row)
        differences.append(nearby - row)
        exact.append(row)
    bias, size = np.mean(differences, 0), np.linalg.norm(np.mean(exact, 0))
    print(f"bias {np.linalg.norm(bias) / size:.2e} of the mean gradient")
    assert np.linalg.norm(bias) < 2e-2 * size


def test_an_overflow_skips_the_step_and_lowers_the_scale(built_in):
    step, state = start(built_in, "half")
    step(state, 0, RATES)
    before = parameters_of(state)
    state.scale = dr.opaque(mi.Float, 1e30)
    terms = step(state, 1, RATES)
    assert float(terms["skipped"][0]) == 1 and float(state.scale[0]) == pytest.approx(5e29)
    for name, values in parameters_of(state).items():
        np.testing.assert_array_equal(values, before[name], err_msg=name)


def test_the_scale_grows_while_nothing_overflows(built_in):
    step, state = start(built_in, "half")
    scales = []
    for i in range(8):
        assert float(step(state, i, RATES)["skipped"][0]) == 0
        scales.append(float(state.scale[0]))
    assert scales == sorted(scales) and scales[-1] > scales[0]
    assert step.recordings() < 5


def test_half_precision_is_replayed_as_it_was_recorded(built_in):
    frozen, state_a = start(built_in, "half")
    unfrozen, state_b = start(built_in, "half")
    for i in range(5):
        a = frozen(state_a, i, RATES)
        state_b.set_learning_rates(RATES)
        b = unfrozen.unfrozen(state_b, i)
        assert a.keys() == b.keys()
        for term in a:
            assert float(a[term][0]) == pytest.approx(float(b[term][0]), rel=1e-2), term
    assert frozen.recordings() < 5


def test_a_checkpoint_keeps_the_scale(built_in, tmp_path):
    step, state = start(built_in, "half")
    for i in range(3):
        step(state, i, RATES)
    save_checkpoint(RunFolder(tmp_path), state, Progress(3, 1.0, 384))
    _, again = start(built_in, "half")
    assert float(again.scale[0]) != float(state.scale[0])
    load_checkpoint(RunFolder(tmp_path), again)
    assert float(again.scale[0]) == float(state.scale[0])
