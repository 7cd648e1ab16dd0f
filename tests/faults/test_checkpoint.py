"""Checkpoints: whole or not at all, and no damage goes unnoticed."""

import dataclasses
import hashlib
import json
import os

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unbake.errors import UserError
from unbake.training.checkpoint import Progress, load_checkpoint, save_checkpoint
from unbake.training.run_folder import KEEP, Origin, RunFolder
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
    assert path.name == "step-000000012"
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
    assert len(kept) == KEEP and kept[-1] == "step-000050000"
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
    # What was left behind is swept at the start of the next fit
    save_checkpoint(RunFolder(tmp_path), other, Progress(3))
    RunFolder(tmp_path).sweep()
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["step-000000001", "step-000000003"]


@pytest.mark.parametrize("name", ["state.safetensors", "manifest.json"])
def test_any_flipped_bit_is_noticed(name, tmp_path):
    state = make_state(1)
    save_checkpoint(RunFolder(tmp_path), state, Progress(1))
    newer = make_state(2)
    newest = save_checkpoint(RunFolder(tmp_path), newer, Progress(2)) / name
    whole = newest.read_bytes()
    rng = np.random.default_rng(0)
    saved = {1: contents(state), 2: contents(newer)}
    for place in sorted({*range(0, 64), *rng.integers(0, len(whole), 200)}):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        newest.write_bytes(damaged)
        other = make_state(3)
        # The newest may count where the flipped bit has no meaning: white space of the manifest
        progress = load_checkpoint(RunFolder(tmp_path), other)
        assert progress in (Progress(1), Progress(2)), place
        assert progress == Progress(1) or name == "manifest.json"
        assert same(saved[progress.step], contents(other)), place
    newest.write_bytes(whole)
    assert load_checkpoint(RunFolder(tmp_path), make_state(3)) == Progress(2)


@pytest.mark.parametrize("name", ["state.safetensors", "manifest.json"])
@pytest.mark.parametrize("length", [0, 4, 8, 100, -1])
def test_a_cut_file_is_noticed(length, name, tmp_path):
    save_checkpoint(RunFolder(tmp_path), make_state(1), Progress(1))
    newest = save_checkpoint(RunFolder(tmp_path), make_state(2), Progress(2)) / name
    newest.write_bytes(newest.read_bytes()[:length].rstrip())
    found = load_checkpoint(RunFolder(tmp_path), make_state(3))
    # The last character of the manifest is the end of a line
    assert found == Progress(2 if (name, length) == ("manifest.json", -1) else 1)


def no_file(file):
    file.unlink()


def link(file):
    file.rename(file.with_name("elsewhere"))
    file.symlink_to(file.with_name("elsewhere"))


def pipe(file):
    file.unlink()
    os.mkfifo(file)


def folder(file):
    file.unlink()
    file.mkdir()


def large(file):
    with file.open("r+b") as content:
        content.truncate(1 << 30)


@pytest.mark.parametrize("name", ["state.safetensors", "manifest.json"])
@pytest.mark.parametrize("damage", [no_file, link, pipe, folder, large])
def test_what_is_no_plain_file_is_not_read(damage, name, tmp_path):
    save_checkpoint(RunFolder(tmp_path), make_state(1), Progress(1))
    damage(save_checkpoint(RunFolder(tmp_path), make_state(2), Progress(2)) / name)
    assert load_checkpoint(RunFolder(tmp_path), make_state(3)) == Progress(1)


@pytest.mark.parametrize("suffix", ["", ".safetensors"])
@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")])
def test_a_pipe_or_a_link_in_the_place_of_a_checkpoint_is_not_read(make, suffix, tmp_path):
    save_checkpoint(RunFolder(tmp_path), make_state(1), Progress(1))
    make(tmp_path / "checkpoints" / f"step-000000009{suffix}")
    assert load_checkpoint(RunFolder(tmp_path), make_state(3)) == Progress(1)


def test_the_newest_checkpoint_is_that_of_the_largest_number(tmp_path):
    for step in (9_999_999, 10_000_000, 1_000_000_000):
        save_checkpoint(RunFolder(tmp_path), make_state(), Progress(step))
    assert load_checkpoint(RunFolder(tmp_path), make_state()) == Progress(1_000_000_000)


def test_checkpoints_after_the_one_that_is_written_do_not_outlive_it(tmp_path):
    for step in (10, 20, 30):
        save_checkpoint(RunFolder(tmp_path), make_state(), Progress(step))
    (tmp_path / "checkpoints" / "step-000000030" / "manifest.json").unlink()
    save_checkpoint(RunFolder(tmp_path), make_state(), Progress(25))
    kept = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert kept == ["step-000000010", "step-000000020", "step-000000025"]
    assert load_checkpoint(RunFolder(tmp_path), make_state()) == Progress(25)


def test_checkpoints_of_another_run_do_not_count(tmp_path):
    run = RunFolder(tmp_path)
    run.write_origin(Origin("data", 1.0, False, run="a"))
    save_checkpoint(run, make_state(), Progress(1), {"run": "a"})
    save_checkpoint(run, make_state(), Progress(2), {"run": "b"})
    assert load_checkpoint(run, make_state()) == Progress(1)
    run.write_origin(Origin("data", 1.0, False, run="c"))
    with pytest.raises(UserError, match="the checkpoints in this folder are of another run"):
        load_checkpoint(run, make_state())


def test_a_checkpoint_with_numbers_that_are_not_finite_does_not_count(tmp_path):
    save_checkpoint(RunFolder(tmp_path), make_state(1), Progress(1))
    state = make_state(2)
    state.phi["grid"] = mi.Float([0.0, np.nan, 0.0, 0.0, 0.0])
    save_checkpoint(RunFolder(tmp_path), state, Progress(2))
    assert load_checkpoint(RunFolder(tmp_path), make_state(3)) == Progress(1)


def test_a_checkpoint_names_its_run_and_its_files(tmp_path):
    about = {"run": "a", "seed": 7, "settings": "seed = 7", "data": {"scene": "0f"}}
    path = save_checkpoint(RunFolder(tmp_path), make_state(), Progress(3, 0.5, 9), about)
    manifest = json.loads((path / "manifest.json").read_text())
    content = (path / "state.safetensors").read_bytes()
    assert manifest["files"]["state.safetensors"]["bytes"] == len(content)
    digest = manifest["files"]["state.safetensors"]["sha256"]
    assert digest == hashlib.sha256(content).hexdigest()
    said = {"format": 2, "step": 3, "seconds": 0.5, "samples": 9} | about
    assert {key: manifest[key] for key in said} == said


def test_only_damaged_checkpoints_are_an_error(tmp_path):
    path = save_checkpoint(RunFolder(tmp_path), make_state(), Progress(1))
    (path / "state.safetensors").write_bytes(b"\xff" * 1000)
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
