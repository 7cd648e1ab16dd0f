"""What results are measured by: ceilings are those of the fields, and are kept with the data."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from unbake.config import FitConfig, read_toml
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation import yardsticks
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.settings import EvaluationSettings
from unbake.evaluation.yardsticks import (
    can_have_ceiling,
    find_ceiling,
    measure_ceiling,
    told_yardsticks,
)
from unbake.imaging.pictures import read_exr, write_exr
from unbake.training import truth_fit
from unbake.training.loop import fit
from unbake.training.truth_fit import true_means

FEW = EvaluationSettings(spp=2, max_depth=3, train_views=0)
KEYS = ["albedo_psnr", "roughness_psnr"]


@pytest.fixture(scope="module")
def data(cornell, tmp_path_factory):
    """A data set of its own, to keep ceilings in."""
    return shutil.copytree(
        cornell, tmp_path_factory.mktemp("data") / "cornell", ignore=lambda *_: [".cache"]
    )


@pytest.fixture(scope="module")
def untrained(data, tiny, tmp_path_factory):
    """A run of no steps."""
    run = tmp_path_factory.mktemp("untrained") / "run"
    fit(data, run, dataclasses.replace(read_toml(tiny), steps=0, method="direct"))
    return run


@pytest.fixture
def short(monkeypatch):
    """Ceilings take a second."""
    monkeypatch.setattr(yardsticks, "STEPS", 150)
    monkeypatch.setattr(truth_fit, "PIXELS", 256)


@pytest.mark.parametrize("known", [True, False])
def test_materials_of_views_are_held_only_where_there_is_truth(
    known, untrained, tmp_path, monkeypatch
):
    """Those of many large photographs would fill the memory, and nothing reads them."""
    run, held, find = shutil.copytree(untrained, tmp_path / "run"), [], yardsticks.find_yardsticks

    def spy(dataset, config, heldout):
        held.extend(heldout)
        return find(dataset, config, heldout)

    monkeypatch.setattr("unbake.evaluation.evaluate.find_yardsticks", spy)
    if not known:
        without = SimpleNamespace(of=lambda *words: None)
        monkeypatch.setattr("unbake.evaluation.evaluate.GroundTruth", without)
    metrics = evaluate(run, FEW, tell=lambda line: None)
    assert [(seen is None, truth is None) for seen, truth in held] == [(not known,) * 2]
    assert (metrics["heldout"]["albedo_psnr"] is None) != known


def forget(data):
    shutil.rmtree(DataFolder(data).cache, ignore_errors=True)


def test_a_ceiling_is_measured_once_and_stands_beside_every_result(
    data, untrained, tiny, unbake, short, tmp_path
):
    forget(data)
    before = unbake("evaluate", untrained, "--spp", 2, "--train-views", 0)
    assert before.status == 0 and "ceiling," not in before.out
    assert before.out.count(": a constant scores ") == 2
    words = f"unbake bench ceiling {data} --settings {untrained / 'config.toml'}"
    assert words in before.out
    first = json.loads((untrained / "evaluation" / "metrics.json").read_text())
    assert first["yardsticks"]["ceiling"] is None

    out = tmp_path / "ceiling.json"
    done = unbake(*words.split()[1:], "--out", out)
    assert done.status == 0 and done.err == "", done.err
    found = json.loads(out.read_text())
    scores = found["yardsticks"]
    assert list(scores["ceiling"]) == KEYS and found["steps"] == 150
    assert (found["train_views"], found["heldout_views"]) == (2, 1)
    for kind in ("untrained", "constant", "ceiling"):
        for key in KEYS:
            assert f"{scores[kind][key]:.2f}" in done.out
    # What is learned from the true maps is better than what needs no learning.
    for key in KEYS:
        assert scores["ceiling"][key] > max(scores["constant"][key], scores["untrained"][key]) + 0.2

    after = unbake("evaluate", untrained, "--spp", 2, "--train-views", 0)
    metrics = json.loads((untrained / "evaluation" / "metrics.json").read_text())
    assert metrics["yardsticks"] == scores
    gap = scores["ceiling"]["albedo_psnr"] - metrics["heldout"]["albedo_psnr"]
    assert f"  albedo {gap:.2f} dB below its ceiling, " in after.out
    assert "bench ceiling" not in after.out
    assert "ceiling" in metrics["definitions"]["yardsticks"]


def test_fields_are_scored_as_those_of_a_run(data, untrained, tiny):
    # Before their first step the fields are those of the run of no steps.
    found = measure_ceiling(Dataset.load(data), read_toml(tiny), steps=0, tell=lambda line: None)
    heldout = evaluate(untrained, FEW, tell=lambda line: None)["heldout"]
    for key in KEYS:
        assert found["yardsticks"]["ceiling"][key] == pytest.approx(heldout[key], abs=1e-6)
        assert found["yardsticks"]["untrained"][key] == pytest.approx(heldout[key], abs=0.01)


def test_the_constant_is_the_mean_of_the_true_maps(data, untrained):
    dataset = Dataset.load(data)
    metrics = evaluate(untrained, FEW, tell=lambda line: None)
    (view,) = dataset.heldout
    for name in ("albedo", "roughness"):
        channels = 3 if name == "albedo" else 1
        maps = [read_exr(v.truth[name]).reshape(-1, 4) for v in dataset.train]
        counted = np.concatenate([rows[rows[:, 3] >= 1, :channels] for rows in maps])
        assert true_means(dataset, [name])[name] == pytest.approx(counted.mean(0, dtype=float))
        held = read_exr(view.truth[name]).reshape(-1, 4)
        errors = held[held[:, 3] >= 1, :channels] - counted.mean(0)
        expected = -10 * np.log10(np.square(errors).mean())
        said = metrics["yardsticks"]["constant"][f"{name}_psnr"]
        assert said == pytest.approx(expected, abs=0.05)  # but for pixels at edges


def test_a_ceiling_is_found_for_the_same_fields_on_the_same_maps_alone(data, tiny, tmp_path, short):
    copy = shutil.copytree(data, tmp_path / "data", ignore=lambda *_: [".cache"])
    config, dataset = read_toml(tiny), Dataset.load(copy)
    assert find_ceiling(dataset, config) is None
    measure_ceiling(dataset, config, steps=1, tell=lambda line: None)
    assert find_ceiling(dataset, config) is None  # of another length
    told: list[str] = []
    found = measure_ceiling(dataset, config, tell=told.append)["yardsticks"]["ceiling"]
    assert len(told) == 1 and "2 training views, 150 steps" in told[0]
    moved = Dataset.load(shutil.copytree(copy, tmp_path / "moved"))
    for there in (dataset, moved):
        # Neither the method nor the seed of a run matters.
        for other in (config, dataclasses.replace(config, seed=7, method="prb", bounces=1)):
            assert find_ceiling(there, other) == found
    for other in (
        dataclasses.replace(config, representation="grid"),
        dataclasses.replace(config, quantities=("albedo", "roughness", "metallic")),
        FitConfig(),
    ):
        assert find_ceiling(dataset, other) is None

    (file,) = (p for p in DataFolder(copy).cache.iterdir() if '"steps": 150' in p.read_text())
    good = file.read_text()
    for damaged in ("{", "[]", good.replace('"heldout"', '"other"'), good[:-9] + 'x": "y"}}'):
        file.write_text(damaged)
        assert find_ceiling(dataset, config) is None
    file.write_text(good)
    assert find_ceiling(dataset, config) == found
    image = dataset.heldout[0].truth["albedo"]
    write_exr(image, read_exr(image) * 0.5)
    assert find_ceiling(Dataset.load(copy), config) is None


def test_a_quantity_without_true_maps_has_no_ceiling(data, tiny, tmp_path, short):
    copy = shutil.copytree(data, tmp_path / "data")
    shutil.rmtree(copy / "truth" / "roughness")
    dataset = Dataset.load(copy)
    found = measure_ceiling(dataset, read_toml(tiny), tell=lambda line: None)["yardsticks"]
    assert found["ceiling"]["albedo_psnr"] > found["constant"]["albedo_psnr"]
    assert all(found[kind]["roughness_psnr"] is None for kind in found)
    lines = told_yardsticks({"albedo_psnr": 20.0, "roughness_psnr": None}, found)
    assert len(lines) == 1 and lines[0].startswith("albedo ")
    # Where the constant was not told
    found = {"ceiling": {"metallic_psnr": 40.0}, "constant": {"metallic_psnr": None}}
    found["untrained"] = {"metallic_psnr": 20.0}
    (line,) = told_yardsticks({"metallic_psnr": 42.5}, found)
    assert line == "metallic 2.50 dB above its ceiling, 40.00 (untrained 20.00)"
    (line,) = told_yardsticks({"metallic_psnr": 42.5}, found | {"ceiling": None})
    assert line == "metallic: untrained fields 20.00 dB"
    found["constant"] = {"metallic_psnr": 43.0}
    for ceiling in (found["ceiling"], None):
        _, line = told_yardsticks({"metallic_psnr": 42.5}, found | {"ceiling": ceiling})
        assert line == "metallic is 0.50 dB worse than the mean of the truth everywhere"
    assert len(told_yardsticks({"metallic_psnr": 43.0}, found)) == 1
    found["constant"] = {"metallic_psnr": 120.0}  # there is no other value
    assert len(told_yardsticks({"metallic_psnr": 42.5}, found)) == 1


def test_where_nothing_is_known_there_is_no_ceiling(data, tiny, tmp_path, unbake):
    copy = shutil.copytree(data, tmp_path / "data", ignore=lambda *_: [".cache"])
    config = read_toml(tiny)
    lights = dataclasses.replace(config, unknown="emission")
    with pytest.raises(UserError, match="unknown is emission have no fields of materials"):
        measure_ceiling(Dataset.load(copy), lights)
    assert not can_have_ceiling(Dataset.load(copy), lights)
    for view in Dataset.load(copy).heldout:
        for image in view.truth.values():
            image.unlink()
    with pytest.raises(UserError, match="no held-out view has true maps of albedo or roughness"):
        measure_ceiling(Dataset.load(copy), config)
    shutil.rmtree(copy / "truth")
    assert not can_have_ceiling(Dataset.load(copy), config)
    done = unbake("bench", "ceiling", copy, "--settings", tiny)
    assert done.status == 2 and done.err.count("\n") == 1
    assert f"{copy}: no training view has true maps of albedo or roughness" in done.err
    assert "unbake capture SCENE --out DATA" in done.err
    assert not DataFolder(copy).cache.exists()


def test_a_ceiling_that_cannot_be_kept_is_told(data, tiny, tmp_path, short):
    copy = shutil.copytree(data, tmp_path / "data", ignore=lambda *_: [".cache"])
    DataFolder(copy).cache.symlink_to(tmp_path)
    told: list[str] = []
    found = measure_ceiling(Dataset.load(copy), read_toml(tiny), tell=told.append)
    assert found["yardsticks"]["ceiling"]["albedo_psnr"] is not None
    assert told[-1].startswith("warning: the ceiling is not kept") and "link" in told[-1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "DATA"),
        (["data", "--seeds", 1], "--seeds"),
        (["data", "--spp", 2], "--spp"),
        (["data", "--steps", 2], "--steps: must be 10 or more, not 2"),
    ],
)
def test_what_a_ceiling_cannot_be_measured_of_is_refused(words, said, unbake):
    done = unbake("bench", "ceiling", *words)
    assert done.status == 2 and done.out == "" and said in done.err


def test_the_ceiling_has_the_sizes_that_a_fit_of_the_data_set_has(
    data, tiny, unbake, short, tmp_path
):
    forget(data)
    settings, file, run = tmp_path / "open.toml", tmp_path / "ceiling.json", tmp_path / "run"
    settings.write_text(tiny.read_text().replace("levels = 2\n", ""))
    done = unbake("bench", "ceiling", data, "--settings", settings, "--out", file)
    assert done.status == 0, done
    fields = json.loads(file.read_text())["fields"]
    assert unbake("fit", data, "--out", run, "--settings", settings, "--steps", 0).status == 0
    config = read_toml(run / "config.toml")
    for name, found in config.material_settings.items():
        assert fields[name]["grid"]["levels"] == found.grid.levels > 0
    assert find_ceiling(Dataset.load(data), config) is not None
