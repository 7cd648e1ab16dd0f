"""`unbake bench gradients`: slopes are those of the loss itself, and noise is that of batches."""

import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console
from support import built_in_cameras, grey_photographs, tiny_fields

from unbake.config import CameraConfig, PathConfig, update
from unbake.profiling.bench_gradients import Spread, bench_gradients
from unbake.profiling.towards_truth import WAY, towards_truth
from unbake.training.loop import fit
from unbake.training.problem import make_problem, training_pixels
from unbake.training.recovered import load_run
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep

QUIET = Console(quiet=True)


def untrained(data, run, config):
    """A run whose fields are those before the first step."""
    fit(data, run, replace(config, steps=0), console=QUIET)
    return run


@pytest.fixture(scope="module")
def run(cornell, tmp_path_factory):
    return untrained(cornell, tmp_path_factory.mktemp("runs") / "ours", tiny_fields())


def stepping(run, **changes):
    """A training step of a run's problem, on the way to the truth."""
    recovered = load_run(run)
    config = replace(recovered.config, **changes)
    problem = towards_truth(recovered)
    step = TrainingStep(problem, training_pixels(recovered.dataset, clip_negative=False), config)
    return SimpleNamespace(step=step, state=initial_state(problem), config=config)


def slope(measured, name, number):
    """The derivative of the loss of a batch by the way of a quantity."""
    inputs = measured.step.prepare(measured.state, number, learning_rates(measured.config, 0, 0))
    return float(measured.step.gradients(inputs, measured.state)[f"{name}.{WAY}"][0])


def difference(measured, name, number, half):
    """The same from the losses at two points of the way, with the same random numbers."""
    losses = []
    for way in (half, -half):
        measured.state.phi[f"{name}.{WAY}"] = dr.opaque(mi.Float, way)
        losses.append(measured.step.replay(measured.state, number).terms["photometric"])
    measured.state.phi[f"{name}.{WAY}"] = dr.opaque(mi.Float, 0)
    return (losses[0] - losses[1]) / (2 * half)


@pytest.mark.parametrize(
    ("method", "representation"), [("ours", "neural"), ("direct", "bitmap"), ("prb", "grid")]
)
def test_the_slope_of_albedo_is_a_difference_of_losses(
    cornell, run, tmp_path, method, representation
):
    # How BSDFs are sampled does not depend on albedo: both losses are of the very same paths.
    if method != "ours":
        config = replace(tiny_fields(representation), method=method, estimator="all-pairs")
        config = replace(config, path=PathConfig(max_depth=3, rr_depth=10))
        run = untrained(cornell, tmp_path / "run", config)
    measured = stepping(run, pixels=128)
    for number in range(2):
        found = slope(measured, "albedo", number)
        assert found < -0.1
        assert found == pytest.approx(difference(measured, "albedo", number, 0.02), rel=1e-3)


def test_the_slope_of_roughness_is_a_difference_of_losses_in_the_mean(cornell, tmp_path):
    config = replace(tiny_fields("grid"), method="direct", pixels=512, spp=64)
    measured = stepping(untrained(cornell, tmp_path / "run", config))
    slopes = np.array([slope(measured, "roughness", i) for i in range(16)])
    apart = slopes - [difference(measured, "roughness", i, 0.1) for i in range(16)]
    error = apart.std(ddof=1) / len(apart) ** 0.5
    assert abs(apart.mean()) < 4 * error
    assert abs(slopes.mean()) > 8 * error


def test_runs_with_values_of_pieces_are_measured(cornell, tmp_path):
    pieces = {"most": 4, "brightnesses": 2, "colours": 1}
    fields = {"materials": {"roughness": {"neural": {"pieces": pieces}}}}
    config = replace(update(tiny_fields(), fields), method="direct")
    run = untrained(cornell, tmp_path / "run", config)
    found = bench_gradients(run, load_run(run).config, 3, None, QUIET)["quantities"]
    parts = {part["part"]: part for part in found["roughness"]["parts"]}
    assert abs(found["roughness"]["slope"]) > 1e-4
    assert (parts["pieces"]["entries"], parts["colours"]["entries"]) == (4 * 2, 2 * 2**3)
    assert parts["pieces"]["signal_to_noise"] > 0


def test_what_is_true_already_has_no_slope(cornell, tmp_path):
    # Untrained grids have the very grey that all surfaces have here.
    data = shutil.copytree(cornell, tmp_path / "data")
    scene = data / "scene" / "scene.xml"
    text, changed = re.subn(r'("base_color" value=)"[^"]*"', r'\1"0.5 0.5 0.5"', scene.read_text())
    assert changed >= 5
    scene.write_text(text)
    # Poses are refined, too: photographs need slopes then.
    config = replace(tiny_fields("grid"), method="direct", camera=CameraConfig(poses="refined"))
    run = untrained(data, tmp_path / "run", config)
    found = bench_gradients(run, load_run(run).config, 4, None, QUIET)["quantities"]
    assert abs(found["albedo"]["slope"]) < 1e-7
    assert abs(found["roughness"]["slope"]) > 1e-4
    (part,) = found["albedo"]["parts"]
    assert part["part"] == "corners" and part["signal_to_noise"] > 0


def test_unknown_lighting_stays_as_it_was_learned(built_in):
    config = replace(tiny_fields("grid"), method="direct", unknown="materials+lighting")
    problem = make_problem(built_in("still"), "visible", config, 0.3)
    dataset = SimpleNamespace(scene=built_in("still"), root=None)
    problem = towards_truth(SimpleNamespace(problem=problem, dataset=dataset, config=config))
    step = TrainingStep(problem, grey_photographs(built_in_cameras("still", 8)), config)
    measured = SimpleNamespace(step=step, state=initial_state(problem), config=config)
    assert {name.partition(".")[0] for name in measured.state.phi} >= {"albedo", "environment"}
    found = slope(measured, "albedo", 0)
    assert found != 0
    assert found == pytest.approx(difference(measured, "albedo", 0, 0.02), rel=1e-3)


def test_the_table_is_that_of_the_batches(unbake, run, tmp_path):
    out = tmp_path / "deep" / "gradients.json"
    words = ("--batches", 4, "--batch", 128, "--spp", 8, "--out", out)
    done = unbake("bench", "gradients", run, *words)
    assert done.status == 0, done.err
    result = json.loads(out.read_text())
    settings = result["settings"]
    assert (settings["pixels"], settings["spp"], settings["radiance_spp"]) == (128, 8, 2)
    assert (result["batches"], result["left_out"], result["steps"]) == (4, 0, 0)
    assert "ours after 0 steps: 4 batches of 128 pixels x 8 samples, all-pairs" in done.out
    measured = stepping(run, pixels=128, spp=8)
    for name, row in result["quantities"].items():
        slopes = [slope(measured, name, number) for number in range(4)]
        deviation = np.std(slopes, ddof=1)
        assert row["slope"] == pytest.approx(np.mean(slopes), rel=1e-3)
        assert row["standard_error"] == pytest.approx(deviation / 2, rel=1e-3)
        assert row["signal_to_noise"] == pytest.approx(abs(np.mean(slopes)) / deviation, rel=1e-3)
        assert f"{row['slope']:.2e}" in done.out
        parts = {part["part"]: part["entries"] for part in row["parts"]}
        parameters = dict(measured.state.phi.items())
        own = sum(dr.width(a.array) for k, a in parameters.items() if k.startswith(f"{name}."))
        assert list(parts) == ["grid, 2 cells", "grid, 4 cells", "network"]
        assert sum(parts.values()) == own - 1  # but for the way
    assert max(map(len, done.out.splitlines())) <= 80


def test_signal_to_noise_is_that_of_one_batch():
    random, spread = np.random.default_rng(0), Spread()
    signal = np.full(400, 0.5)
    for _ in range(50):
        spread.add(signal + random.normal(0, 2, 400))
    assert spread.signal_to_noise() == pytest.approx(0.5 / 2, rel=0.1)
    noise = Spread()
    for sign in (1, -1):
        noise.add(sign * signal)
    assert noise.signal_to_noise() == 0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "RUN"),
        (("nowhere",), "nowhere: no run in this folder"),
        (("r", "--data", "d"), "--data"),
    ],
)
def test_wrong_words_are_told(unbake, words, message):
    done = unbake("bench", "gradients", *words)
    assert done.status == 2 and message in done.err and "Traceback" not in done.err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--batches", 1), "--batches: must be 2 or more, not 1"),
        (("--spp", 3), "--spp: must be an even number, 2 or more, not 3"),
    ],
)
def test_numbers_out_of_range_are_told_in_one_line(unbake, run, words, message):
    done = unbake("bench", "gradients", run, *words)
    assert done.status == 2 and message in done.err
    assert done.err.count("\n") == 1


def test_the_truth_must_be_known_and_materials_unknown(unbake, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    file = data / "transforms.json"
    described = json.loads(file.read_text())
    del described["render"]
    file.write_text(json.dumps(described))
    done = unbake("bench", "gradients", untrained(data, tmp_path / "run", tiny_fields()))
    assert done.status == 2 and "does not hold its true materials" in done.err
    lights = untrained(cornell, tmp_path / "lights", replace(tiny_fields(), unknown="emission"))
    done = unbake("bench", "gradients", lights)
    assert done.status == 2 and "recovered emission, and no materials" in done.err
    assert done.err.count("\n") == 1
