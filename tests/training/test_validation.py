"""Scores in training are the numbers of an evaluation, and cost no training."""

import dataclasses
import json
import shutil
import time
from itertools import pairwise

import numpy as np
import pytest

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import read_toml
from unbake.dataset.fingerprint import truth_fingerprint
from unbake.dataset.ground_truth import GroundTruth
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation.evaluate import _true_scene, evaluate
from unbake.evaluation.settings import EvaluationSettings
from unbake.imaging.metrics import HIGHEST
from unbake.imaging.pictures import read_exr, write_exr, write_png
from unbake.training.loop import TIME_EVERY, fit
from unbake.training.recovered import load_run
from unbake.training.validation import MaterialBuffers, Score

FEW = EvaluationSettings(spp=2, max_depth=3, train_views=0)


@pytest.fixture(scope="module")
def scored(cornell, tiny, tmp_path_factory):
    """A run with a score at every reading of the loss."""
    run = tmp_path_factory.mktemp("scored") / "run"
    config = dataclasses.replace(read_toml(tiny), steps=24, method="direct", score_seconds=1e-9)
    fit(cornell, run, config)
    return run


def lines(run):
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def test_scores_are_logged_from_start_to_end(scored):
    log = [line for line in lines(scored) if "score" in line]
    assert [line["step"] for line in log] == list(range(0, 25, TIME_EVERY))
    for line in log:
        assert {"step", "seconds", "samples", "score"} <= line.keys()
        assert line["score"]["views"] == 1
        assert line["samples"] == 256 * line["step"]
        assert all(np.isfinite(line["score"][k]) for k in ("albedo_psnr", "roughness_psnr"))
    assert len({line["score"]["albedo_psnr"] for line in log}) == len(log)


def test_a_score_is_what_an_evaluation_says(scored):
    recovered = load_run(scored)
    score = Score(recovered.problem, recovered.dataset.heldout)
    logged, said = lines(scored)[-2]["score"], evaluate(scored, FEW, tell=lambda line: None)
    assert score.measure() == pytest.approx(logged, abs=1e-3)
    for key in ("albedo_psnr", "roughness_psnr"):
        # One held-out view: with the same samples and seed, the same picture.
        same = score.measure(spp=FEW.material_spp, seed=2)
        assert same[key] == pytest.approx(said["heldout"][key], abs=1e-5)
        assert logged[key] == pytest.approx(said["heldout"][key], abs=0.5)


def test_albedo_whose_scale_is_open_is_scored_after_alignment(scored, monkeypatch):
    recovered = load_run(scored)
    view = recovered.dataset.heldout[0]
    plain = Score(recovered.problem, [view])
    score = Score(recovered.problem, [view], shares_scale=True)
    assert "albedo_psnr_aligned" not in plain.measure()
    found = score.measure()
    assert found["albedo_psnr_aligned"] > found["albedo_psnr"] == plain.measure()["albedo_psnr"]
    real = MaterialBuffers.of

    def dimmed(*words):
        seen = real(*words)
        factors = np.array([0.5, 0.25, 0.4], np.float32)
        return [dataclasses.replace(s, values=s.values | {"albedo": s.values["albedo"] * factors})
                for s in seen]  # fmt: skip

    monkeypatch.setattr(MaterialBuffers, "of", dimmed)
    dim = score.measure()
    assert dim["albedo_psnr"] < found["albedo_psnr"] - 1
    assert dim["albedo_psnr_aligned"] == pytest.approx(found["albedo_psnr_aligned"], abs=1e-3)
    partly = dataclasses.replace(view, truth={"roughness": view.truth["roughness"]})
    scores = Score(recovered.problem, [partly], shares_scale=True).measure()
    assert scores["albedo_psnr_aligned"] is None and scores["roughness_psnr"] is not None


def test_a_fit_of_materials_and_light_logs_aligned_albedo(tiny, tmp_path):
    small = CaptureSettings(views=2, held_out=1, resolution=12, spp=4, max_depth=4)
    data = capture("still", tmp_path / "data", small, tell=lambda line: None).folder
    changes = {"unknown": "materials+lighting", "method": "direct", "score_seconds": 1e-9}
    fit(data, tmp_path / "run", dataclasses.replace(read_toml(tiny), steps=2, **changes))
    scores = [line["score"] for line in lines(tmp_path / "run") if "score" in line]
    assert scores and all(s["albedo_psnr_aligned"] > s["albedo_psnr"] for s in scores)


def test_every_view_gets_its_own_pixels(scored, monkeypatch):
    recovered = load_run(scored)
    views = [
        dataclasses.replace(v, camera=dataclasses.replace(v.camera, width=3 + i, height=2))
        for i, v in enumerate(recovered.dataset.views)
    ]

    def numbered(scene_view, through, pixels, spp, *, seed):
        number = np.arange(pixels, dtype=np.float32)
        values = {"albedo": np.stack([number] * 3, -1), "roughness": number[:, None] + 0.25}
        return values, number + 0.5

    monkeypatch.setattr("unbake.training.validation.render_materials", numbered)
    seen = MaterialBuffers.of(recovered.problem, views, 4, seed=0)
    assert [s.coverage.shape for s in seen] == [(2, 3), (2, 4), (2, 5)]
    for part, first in zip(seen, (0, 6, 14), strict=True):
        expected = first + np.arange(part.coverage.size).reshape(part.coverage.shape)
        assert np.array_equal(part.values["albedo"][..., 2], expected)
        assert np.array_equal(part.values["roughness"][..., 0], expected + 0.25)
        assert np.array_equal(part.coverage, expected + 0.5)


def test_pixels_that_see_other_things_do_not_count():
    known = np.array([[True, True, True, False]])
    half = {"albedo": np.full((1, 4, 3), 0.5), "roughness": np.full((1, 4, 1), 0.5)}
    truth = GroundTruth(half, known)
    albedo, roughness = np.full((1, 4, 3), 0.5), np.full((1, 4, 1), 0.5)
    albedo[0, 0], roughness[0, 0] = 0.6, 0.4
    albedo[0, 2:], roughness[0, 2:] = 1e6, np.nan
    found = {"albedo": albedo, "roughness": roughness}
    seen = MaterialBuffers(found, np.array([[1, 1, 0.75, 1]]))
    assert seen.mask(truth).tolist() == [[True, True, False, False]]
    expected = 10 * np.log10(2 / 0.1**2)
    assert seen.psnr(truth) == pytest.approx({"albedo_psnr": expected, "roughness_psnr": expected})


def test_masked_pixels_do_not_count_in_scores_of_materials(scored, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    half = np.full((16, 16), 255, np.uint8)
    half[:, :8] = 0
    write_png(data / "mask.png", half)
    transforms = json.loads((data / "transforms.json").read_text())
    for frame in transforms["frames"]:
        frame["mask_path"] = "mask.png"
    (data / "transforms.json").write_text(json.dumps(transforms))
    view, masked = (Dataset.load(folder).heldout[0] for folder in (cornell, data))
    whole, part = GroundTruth.of(view), GroundTruth.of(masked)
    np.testing.assert_array_equal(part.known, whole.known & (half > 0))
    assert 0 < part.known.sum() < whole.known.sum()
    recovered = load_run(scored)
    scores = [Score(recovered.problem, [v]).measure()["albedo_psnr"] for v in (view, masked)]
    assert scores[0] != scores[1]
    # What fields can learn of such maps is less, and has another key.
    prints = [truth_fingerprint(Dataset.load(d), ["albedo"])["truth"] for d in (cornell, data)]
    assert prints[0] != prints[1]


def test_what_cannot_be_compared_has_no_number(scored):
    recovered = load_run(scored)
    view = recovered.dataset.heldout[0]
    nameless = dataclasses.replace(view, truth={})
    assert GroundTruth.of(nameless) is None
    empty = {"views": 0, "albedo_psnr": None, "roughness_psnr": None}
    assert Score(recovered.problem, [nameless]).measure() == empty
    truth, (seen,) = GroundTruth.of(view), MaterialBuffers.of(recovered.problem, [view], 4, seed=0)
    nothing = dataclasses.replace(truth, known=np.zeros_like(truth.known))
    assert seen.psnr(nothing) == {"albedo_psnr": None, "roughness_psnr": None}
    equal = dataclasses.replace(truth, values={**truth.values, "albedo": seen.values["albedo"]})
    assert seen.psnr(equal)["albedo_psnr"] == HIGHEST > seen.psnr(equal)["roughness_psnr"]


def test_a_quantity_whose_truth_is_not_known_has_no_number(scored):
    recovered = load_run(scored)
    view = recovered.dataset.heldout[0]
    partly = dataclasses.replace(view, truth={"roughness": view.truth["roughness"]})
    scores = Score(recovered.problem, [partly]).measure()
    whole = Score(recovered.problem, [view]).measure()
    assert scores == {**whole, "albedo_psnr": None} and whole["albedo_psnr"] is not None


@pytest.mark.parametrize(("seconds", "count"), [(0.0, 0), (1e9, 2)])
def test_scores_are_as_frequent_as_asked_for(seconds, count, cornell, tiny, tmp_path):
    config = read_toml(tiny)
    config = dataclasses.replace(config, steps=6, method="direct", score_seconds=seconds)
    fit(cornell, tmp_path / "run", config)
    found = [line["step"] for line in lines(tmp_path / "run") if "score" in line]
    assert found == [0, 6][:count]


def test_a_resumed_fit_goes_on_with_its_scores(cornell, tiny, tmp_path):
    run = tmp_path / "run"
    config = dataclasses.replace(read_toml(tiny), steps=3, method="direct", score_seconds=1e-9)
    fit(cornell, run, config)
    fit(cornell, run, dataclasses.replace(config, steps=5), resume=True)
    assert [line["step"] for line in lines(run) if "score" in line] == [0, 3, 4, 5]


def test_scoring_is_not_part_of_the_training_time(cornell, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(Score, "measure", lambda self: time.sleep(0.5) or {"views": 0})
    config = dataclasses.replace(read_toml(tiny), steps=12, method="direct", score_seconds=1e-9)
    start = time.perf_counter()
    progress = fit(cornell, tmp_path / "run", config)
    assert time.perf_counter() - start > (1 + 12 / TIME_EVERY) * 0.5
    # Between the last steps nothing is compiled any more.
    log = [line for line in lines(tmp_path / "run") if "score" in line]
    assert log[-1]["seconds"] == pytest.approx(progress.seconds, abs=1e-6)
    assert min(b["seconds"] - a["seconds"] for a, b in pairwise(log)) < 0.4


def test_a_truth_that_cannot_be_read_is_named_before_anything_is_written(cornell, tiny, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    image = data / "truth" / "albedo" / "heldout_000.exr"
    write_exr(image, np.full_like(read_exr(image), np.nan))
    config = dataclasses.replace(read_toml(tiny), steps=2, score_seconds=1.0)
    with pytest.raises(UserError, match=r"heldout_000\.exr"):
        fit(data, tmp_path / "run", config)
    assert not (tmp_path / "run").exists()


def test_known_materials_are_not_evaluated(scored, tmp_path, monkeypatch):
    run = shutil.copytree(scored, tmp_path / "run", ignore=shutil.ignore_patterns("evaluation"))
    recovered = load_run(run)
    recovered.config = dataclasses.replace(recovered.config, unknown="lighting")
    monkeypatch.setattr("unbake.evaluation.evaluate.load_run", lambda *_, **__: recovered)
    lines: list[str] = []
    metrics = evaluate(run, FEW, tell=lines.append)
    assert lines[0].startswith("heldout_000: render ") and "albedo" not in "".join(lines)
    assert metrics["unknown"] == "lighting" and metrics["representation"] is None
    heldout = metrics["heldout"]
    assert heldout["albedo_psnr"] is heldout["roughness_psnr"] is None
    assert np.isfinite(heldout["render_psnr"])
    (row,) = (row for row in metrics["per_view"] if row["split"] == "heldout")
    for key in ("render_ssim", "render_flip"):
        assert 0 < heldout[key] == row[key] < 1
    assert 2 * metrics["display_exposure"] % 1 == 0
    written = {p.name for p in (run / "evaluation" / "heldout").iterdir()}
    assert written == {"heldout_000_render.exr", "heldout_000_render.png"}


def test_the_true_materials_are_rendered_alike(scored, cornell, tmp_path):
    run = shutil.copytree(scored, tmp_path / "run", ignore=shutil.ignore_patterns("evaluation"))
    few, many = (
        evaluate(
            run, dataclasses.replace(FEW, spp=spp, max_depth=32, truth=True), tell=lambda line: None
        )
        for spp in (2, 32)
    )
    for metrics in (few, many):
        (view,) = (row for row in metrics["per_view"] if row["split"] == "heldout")
        heldout = metrics["heldout"]
        assert heldout["true_render_psnr"] == view["true_render_psnr"]
        # What hardly any training recovered is no match for the truth.
        assert heldout["true_render_psnr"] > heldout["render_psnr"] + 1
    # Noise is all that is between the photograph and the true materials.
    gained = many["heldout"]["true_render_psnr"] - few["heldout"]["true_render_psnr"]
    assert gained > 3
    assert "true_render_psnr" not in evaluate(run, FEW, tell=lambda line: None)["heldout"]

    data = shutil.copytree(cornell, tmp_path / "data")
    described = json.loads((data / "transforms.json").read_text())
    del described["render"]
    (data / "transforms.json").write_text(json.dumps(described))
    recovered = load_run(run)
    recovered.dataset = Dataset.load(data)
    with pytest.raises(UserError, match="does not hold its true materials"):
        _true_scene(recovered)
