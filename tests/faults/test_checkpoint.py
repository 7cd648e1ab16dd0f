"""Checkpoint files: whole or not at all, and no damage goes unnoticed."""

import dataclasses
import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unbake.errors import UserError
from unbake.training.checkpoint import Progress, load_checkpoint, save_checkpoint
from unbake.training.run_folder import KEEP, RunFolder
from unbake.training.state import State


def make_state(seed=0, width=3):
    """Two small optimisers that have taken a step."""
    rng = np.random.default_rng(seed)
    optimizers = []
    for size in (5, 7):
        weights = mi.TensorXf(rng.normal(size=(width, size)).astype(np.float32))
        adam = mi.ad.Adam(0.1, {"weights": weights, "grid": mi.Float(np.arange(size) / 8.0)})
        dr.backward(dr.sum(dr.square(adam["weights"]), axis=None) + dr.sum(adam["grid"]))
        adam.step()
        optimizers.append(adam)
    return State(*optimizers)


def contents(state):
    """All numbers of a state by name."""
    found = {}
    for name, optimizer in state.optimizers():
        for key, (value, _, _, (count, first, second, _)) in optimizer.state.items():
            numbers = (value, first, second, mi.Float(count))
            found[f"{name}.{key}"] = np.concatenate([np.ravel(x.numpy()) for x in numbers])
    return found


def same(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def test_what_is_saved_is_loaded(tmp_path):
    state, progress = make_state(1), Progress(12, 0.1 + 0.2, 10**12)
    path = save_checkpoint(RunFolder(tmp_path / "new" / "folder"), state, progress)
    assert path.name == "step-0000012.safetensors"
    other = make_state(2)
    assert not same(contents(state), contents(other))
    assert load_checkpoint(RunFolder(path.parents[1]), other) == progress
    assert same(contents(state), contents(other))
    for _, optimizer in other.optimizers():
        assert all(dr.grad_enabled(value) for value in optimizer.values())
        assert optimizer["weights"].shape == state.phi["weights"].shape or optimizer is other.theta


def test_a_loaded_state_goes_on_like_the_saved_one(tmp_path):
    state = make_state(1)
    save_checkpoint(RunFolder(tmp_path), state, Progress(1))
    other = make_state(2)
    load_checkpoint(RunFolder(tmp_path), other)
    for one in (state, other):
        one.set_learning_rates({"weights": 0.01, "grid": 0.01, "radiance": 0.02})
        for _, optimizer in one.optimizers():
            dr.backward(dr.sum(dr.sin(optimizer["weights"]), axis=None))
            optimizer.step()
    assert same(contents(state), contents(other))


def test_a_state_without_a_radiance_field_is_saved_too(tmp_path):
    state, other = (dataclasses.replace(make_state(seed), theta=None) for seed in (1, 2))
    save_checkpoint(RunFolder(tmp_path), state, Progress(1))
    assert load_checkpoint(RunFolder(tmp_path), other) == Progress(1)
    assert same(contents(state), contents(other))


def test_the_newest_few_are_kept(tmp_path):
    state = make_state()
    for step in (1, 20, 300, 4000, 50000):
        save_checkpoint(RunFolder(tmp_path), state, Progress(step))
    kept = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert len(kept) == KEEP and kept[-1] == "step-0050000.safetensors"
    assert load_checkpoint(RunFolder(tmp_path), state) == Progress(50000)


def test_an_empty_or_missing_folder_holds_none(tmp_path):
    assert load_checkpoint(RunFolder(tmp_path), make_state()) is None
    assert load_checkpoint(RunFolder(tmp_path / "none"), make_state()) is None


class Killed(BaseException):
    """The process is gone: no handler of the program runs any more."""


@pytest.mark.parametrize("moment", ["fsync", "replace"])
def test_a_kill_while_writing_leaves_the_checkpoint_before(moment, tmp_path, monkeypatch):
    state = make_state(1)
    save_checkpoint(RunFolder(tmp_path), state, Progress(1))
    saved = contents(state)

    def kill(*words):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(os, moment, kill)
        with pytest.raises(Killed):
            save_checkpoint(RunFolder(tmp_path), make_state(2), Progress(2))
    other = make_state(3)
    assert load_checkpoint(RunFolder(tmp_path), other) == Progress(1)
    assert same(saved, contents(other))
    # What was left behind goes with the next one
    save_checkpoint(RunFolder(tmp_path), other, Progress(3))
    assert {path.suffix for path in (tmp_path / "checkpoints").iterdir()} == {".safetensors"}


def test_any_flipped_bit_is_noticed(tmp_path):
    state = make_state(1)
    save_checkpoint(RunFolder(tmp_path), state, Progress(1))
    newer = make_state(2)
    newest = save_checkpoint(RunFolder(tmp_path), newer, Progress(2))
    whole = newest.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    rng = np.random.default_rng(0)
    places = {*range(0, 64), *rng.integers(0, header, 200), *rng.integers(header, len(whole), 64)}
    saved = {1: contents(state), 2: contents(newer)}
    for place in sorted(places):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        newest.write_bytes(damaged)
        other = make_state(3)
        # The newest may count where the flipped bit has no meaning, such as white space
        progress = load_checkpoint(RunFolder(tmp_path), other)
        assert progress in (Progress(1), Progress(2)), place
        assert same(saved[progress.step], contents(other)), place
    newest.write_bytes(whole)
    assert load_checkpoint(RunFolder(tmp_path), make_state(3)) == Progress(2)


@pytest.mark.parametrize("length", [0, 4, 8, 100, -1])
def test_a_cut_file_is_noticed(length, tmp_path):
    save_checkpoint(RunFolder(tmp_path), make_state(1), Progress(1))
    newest = save_checkpoint(RunFolder(tmp_path), make_state(2), Progress(2))
    newest.write_bytes(newest.read_bytes()[:length])
    assert load_checkpoint(RunFolder(tmp_path), make_state(3)) == Progress(1)


def test_only_damaged_checkpoints_are_an_error(tmp_path):
    path = save_checkpoint(RunFolder(tmp_path), make_state(), Progress(1))
    path.write_bytes(b"\xff" * 1000)
    with pytest.raises(UserError, match="no checkpoint in this folder can be read"):
        load_checkpoint(RunFolder(tmp_path), make_state())


def test_a_checkpoint_of_other_settings_is_an_error(tmp_path):
    path = save_checkpoint(RunFolder(tmp_path), make_state(width=3), Progress(1))
    with pytest.raises(UserError, match=r"does not fit the settings: phi.weights") as caught:
        load_checkpoint(RunFolder(tmp_path), make_state(width=4))
    assert caught.value.where == str(path) and "Resume with the settings" in caught.value.remedy
    without = dataclasses.replace(make_state(width=3), theta=None)
    save_checkpoint(RunFolder(tmp_path), without, Progress(2))
    with pytest.raises(UserError, match="does not fit the settings: theta"):
        load_checkpoint(RunFolder(tmp_path), make_state(width=3))


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match=r"the checkpoint cannot be written \(Not a directory"):
        save_checkpoint(RunFolder(tmp_path / "file"), make_state(), Progress(1))
