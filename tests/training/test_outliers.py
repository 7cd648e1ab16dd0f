"""Blocks of photographs that stay unexplained lose their weight."""

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras

from unbake.config import ObjectiveConfig, from_toml, read_toml, to_toml
from unbake.dataset.pixels import CameraRays
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.outliers import evaluate_outliers
from unbake.evaluation.settings import EvaluationSettings
from unbake.imaging.pictures import read_exr, read_png, tonemap, write_exr, write_png
from unbake.report.page import write_report
from unbake.training.loop import fit
from unbake.training.outliers import OutlierModel
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder
from unbake.transport.loss import RelativeL2

FEW = EvaluationSettings(spp=4, max_depth=3, train_views=0)


def test_pixels_have_the_weight_of_their_block():
    cameras = built_in_cameras("cornell", 10, views=2)
    model = OutlierModel(cameras, 4, 10.0)
    odds = np.linspace(-8, 4, 18).astype(np.float32)  # two views of 3 x 3 blocks
    model.assign({"outliers.odds": mi.Float(odds)})
    rays = CameraRays.of(cameras)
    roots = np.array(model.roots(rays, dr.arange(mi.UInt32, rays.pixels), None))
    row, column = np.divmod(np.arange(100), 10)
    block = row // 4 * 3 + column // 4
    expected = 1 / (1 + np.exp(-(np.concatenate([odds[block], odds[9 + block]]) + 3)))
    np.testing.assert_allclose(roots, expected, rtol=1e-5)
    masks = np.concatenate([mask.ravel() for mask in model.masks()])
    np.testing.assert_array_equal(masks, expected**2 < 0.5)
    assert masks.any() and not masks.all()


def test_shares_are_of_pixels_that_count():
    """Blocks at edges are smaller, and what is masked was drawn by no step."""
    cameras = built_in_cameras("cornell", 10, views=2)
    model = OutlierModel(cameras, 4, 10.0)
    counted = np.random.default_rng(0).random((10, 10)) < 0.5
    for mask in (None, counted):
        found = model.pixels_in(1, mask)
        each = np.ones((10, 10), bool) if mask is None else mask
        rows = [
            [each[4 * i : 4 * i + 4, 4 * j : 4 * j + 4].sum() for j in range(3)] for i in range(3)
        ]
        np.testing.assert_array_equal(found, rows)


@pytest.mark.parametrize("masked", [False, True])
def test_masked_pixels_are_no_part_of_the_share_of_outliers(masked, painted, tmp_path, monkeypatch):
    """Of many views no more masks are made than there are pictures."""
    data = shutil.copytree(painted, tmp_path / "data", ignore=lambda *_: [".cache"])
    transforms = json.loads((data / "transforms.json").read_text())
    if masked:
        mask = np.full((16, 16), 255, np.uint8)
        mask[:4], mask[8:] = 0, 0
        write_png(data / "mask.png", mask)
        transforms["frames"][0]["mask_path"] = "mask.png"
    (data / "transforms.json").write_text(json.dumps(transforms))
    dataset = Dataset.load(data)
    model = OutlierModel([view.camera for view in dataset.train], 8, 10.0)
    odds = np.zeros(8, np.float32)
    odds[0] = -9  # the first of four blocks of the first view
    model.assign({"outliers.odds": mi.Float(odds)})
    problem = SimpleNamespace(outliers=model)
    recovered = SimpleNamespace(problem=problem, dataset=dataset, clip_negative=False)
    made, whole = [], OutlierModel.mask
    monkeypatch.setattr(OutlierModel, "mask", lambda *x: made.append(x[1]) or whole(*x))
    lines: list[str] = []
    with RunFolder(tmp_path).new_evaluation() as out:
        found = evaluate_outliers(recovered, out, lines.append)["outliers"]
        picture = read_png(out.picture("train", "train_000", "outliers", ".png"))
    first = 32 / 64 if masked else 64 / 256
    assert [row["share"] for row in found["images"]] == [first, 0.0]
    assert found["share"] == (32 / (64 + 256) if masked else 64 / 512)
    assert found["shown"] == ["train_000"] and made == [0]
    plain = tonemap(read_exr(dataset.train[0].image)[..., :3])
    tinted = (picture != plain).any(-1)
    expected = np.zeros((16, 16), bool)
    expected[4 * masked : 8, :8] = True
    np.testing.assert_array_equal(tinted, expected)


def test_weights_settle_where_errors_and_their_cost_balance():
    """√w = μ / (μ + e), and errors of weight w count w times, also in their gradients."""
    camera = built_in_cameras("cornell", 4)
    model = OutlierModel(camera, 2, 4.0)
    errors = np.array([0.01, 0.04, 0.1, 1.0])  # of four blocks
    target = mi.Color3f(mi.Float(np.zeros(4, np.float32)))
    samples = mi.Color3f(mi.Float(np.sqrt(errors).repeat(2).astype(np.float32)))
    numbers = mi.UInt32([0, 2, 8, 10])
    adam, rays = mi.ad.Adam(0.1, model.parameters()), CameraRays.of(camera)
    mean = 0.0
    for _ in range(400):
        model.assign(dict(adam.items()))
        roots = model.roots(rays, numbers, None)
        loss = RelativeL2(1.0, trust=dr.square(roots))
        photometric = loss.error(samples, target, 2)
        dr.backward(photometric + model.cost(roots, photometric))
        adam.step()
        kept = np.array(dr.detach(roots)) ** 2
        mean = float(photometric[0]) / kept.mean()
        np.testing.assert_allclose(float(photometric[0]), (kept * errors).mean(), rtol=1e-4)
    np.testing.assert_allclose(np.sqrt(kept), 4 * mean / (4 * mean + errors), rtol=0.02)
    assert not dr.grad_enabled(loss.of_known_camera().error(samples, target, 2))
    # A loss that is not finite takes nothing for an outlier
    assert float(model.cost(roots, mi.Float(np.nan))[0]) == 0


@pytest.fixture(scope="module")
def painted(cornell, tmp_path_factory):
    """The room, with a bright corner in one training photograph."""
    data = shutil.copytree(cornell, tmp_path_factory.mktemp("painted") / "data")
    image = Dataset.load(data).train[0].image
    pixels = read_exr(image)
    pixels[:8, :8, :3] = (4, 0, 4)
    write_exr(image, pixels)
    return data


def test_a_fit_finds_what_was_painted_into_a_photograph(painted, tiny, tmp_path):
    run = tmp_path / "run"
    objective = ObjectiveConfig("found", block=8, tolerance=3.0, learning_rate=0.4)
    settings = replace(read_toml(tiny), method="direct", steps=60, objective=objective)
    fit(painted, run, settings)
    assert from_toml(to_toml(RunFolder(run).settings())).objective == objective
    model = load_run(run).problem.outliers
    assert model is not None
    first, second = model.masks()
    assert first[:8, :8].all() and first.mean() <= 0.5 and second.mean() <= 0.25
    found = evaluate(run, FEW, tell=lambda line: None)["outliers"]
    assert found["images"][0] == {"name": "train_000", "share": first.mean()}
    assert found["share"] == pytest.approx((first.mean() + second.mean()) / 2)
    picture = read_png(RunFolder(run).picture("train", "train_000", "outliers", ".png"))
    assert picture.shape[:2] == first.shape and "train_000" in found["shown"]
    assert json.loads(RunFolder(run).metrics_file.read_text())["outliers"] == found
    page = write_report([run], tmp_path / "report.html").read_text()
    assert "<h2>Outliers</h2>" in page and "stayed unexplained" in page


def test_what_is_kept_has_no_weights(unbake, cornell, tiny, tmp_path):
    words = ("--settings", tiny, "--method", "direct", "--steps", "0")
    for choice in ("kept", "found"):
        done = unbake("fit", cornell, "--out", tmp_path / choice, *words, "--outliers", choice)
        assert done.status == 0, done.err
        assert (load_run(tmp_path / choice).problem.outliers is None) == (choice == "kept")
    with pytest.raises(UserError, match="tolerance"):
        ObjectiveConfig(tolerance=0)
