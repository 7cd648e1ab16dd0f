"""Scores of renderings: what counts in them, and what does not."""

import json
import math
import shutil
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from unbake.config import read_toml
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation import evaluate as evaluate_module
from unbake.evaluation import forecast
from unbake.evaluation.evaluate import _require_room, evaluate, require_true_materials
from unbake.evaluation.placing import _Errors, _solved
from unbake.evaluation.rendering import render
from unbake.evaluation.renderings import (
    METRICS,
    NOT_FINITE,
    render_camera,
    render_psnr,
    render_scores,
)
from unbake.evaluation.settings import EvaluationSettings, RenderSettings
from unbake.evaluation.yardsticks import seen_materials
from unbake.imaging.metrics import HIGHEST
from unbake.report.page import write_report
from unbake.training.loop import fit
from unbake.training.run_folder import EvaluationFolder
from unbake.transport import render as transport

FEW = EvaluationSettings(spp=2, max_depth=3, train_views=0)


@pytest.fixture
def disc() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A textured photograph, an exact rendering of the disc in its middle, and where that is."""
    y, x = np.mgrid[0:48, 0:48] / 48
    photograph = np.stack([x, y, 0.5 + 0.4 * np.sin(40 * x * y)], -1).astype(np.float32)
    mask = (x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.09
    return np.where(mask[..., None], photograph, 0), photograph, mask


def test_what_is_masked_has_no_part_in_the_scores_of_pixels_beside_it(disc):
    scores = render_scores(*disc, 0.0)
    expected = {"render_psnr": HIGHEST, "render_psnr_unclamped": HIGHEST}
    assert scores == pytest.approx(expected | {"render_ssim": 1, "render_flip": 0}, abs=1e-6)
    assert list(scores) == list(METRICS)


def test_errors_of_pixels_that_count_are_seen_beside_masked_ones(disc):
    rendering, photograph, mask = disc
    scores = render_scores(0.5 * rendering, photograph, mask, 0.0)
    assert scores["render_ssim"] < 0.98 and scores["render_flip"] > 0.05


def test_pixels_that_are_not_finite_are_left_out_and_counted(disc):
    rendering, photograph, mask = disc
    rendering = (0.8 * rendering).astype(np.float32)
    broken, fewer = rendering.copy(), mask.copy()
    broken[24, 20:23], broken[0, 0] = (np.nan, 1, 1), np.inf  # the last one is masked
    fewer[24, 20:23] = False
    found = render_scores(broken, photograph, mask, 0.0)
    assert found == render_scores(rendering, photograph, fewer, 0.0) | {NOT_FINITE: 3}
    assert render_psnr(broken, photograph, mask) == found["render_psnr"]
    nothing = render_scores(np.full_like(broken, np.nan), photograph, mask, 0.0)
    assert nothing == dict.fromkeys(METRICS) | {NOT_FINITE: np.count_nonzero(mask)}


@pytest.fixture(scope="module")
def untrained(cornell, tiny, tmp_path_factory):
    """A run of no steps."""
    run = tmp_path_factory.mktemp("untrained") / "run"
    fit(cornell, run, replace(read_toml(tiny), steps=0, method="direct"))
    return run


def test_an_evaluation_tells_of_pixels_that_are_not_finite(untrained, tmp_path, monkeypatch):
    run = shutil.copytree(untrained, tmp_path / "run")

    def broken(*words, **more):
        picture = render_camera(*words, **more)
        picture[8, 3:5] = np.nan
        return picture

    monkeypatch.setattr(evaluate_module, "render_camera", broken)
    lines: list[str] = []
    metrics = evaluate(run, replace(FEW, truth=True), tell=lines.append)
    (row,) = metrics["per_view"]
    assert row[NOT_FINITE] == 2 and math.isfinite(row["true_render_psnr"])
    assert metrics["heldout"]["render_psnr"] == row["render_psnr"] > 0
    assert (
        NOT_FINITE not in metrics["heldout"] and "not numbers" in metrics["definitions"][NOT_FINITE]
    )
    assert any(line.endswith("2 pixels are not finite and left out") for line in lines)
    page = write_report([run], tmp_path / "report.html").read_text()
    assert "2 pixels of renderings are not finite and left out" in page


def test_materials_that_are_not_finite_are_told_with_their_view(untrained, monkeypatch):
    def broken(*words):
        seen = seen_materials(*words)
        return replace(seen, values={k: np.full_like(v, np.nan) for k, v in seen.values.items()})

    monkeypatch.setattr(evaluate_module, "seen_materials", broken)
    with pytest.raises(UserError, match=r"^heldout_000: materials: .* are not finite"):
        evaluate(untrained, FEW, tell=lambda line: None)


def test_pictures_that_take_long_tell_how_far_they_are(untrained, tmp_path, monkeypatch, clock):
    """Pictures of 16 x 16 pixels in parts of 64, each of which takes minutes."""
    run = shutil.copytree(untrained, tmp_path / "run")
    evaluation, rendering = replace(FEW, truth=True), RenderSettings(spp=FEW.spp, max_depth=3)

    def told(out: str) -> list[str]:
        lines: list[str] = []
        evaluate(run, evaluation, tell=lines.append)
        render(run, tmp_path / out, rendering, tell=lines.append)
        return [line for line in lines if " % rendered" in line or "--spp" in line]

    assert told("fast") == []
    monkeypatch.setattr(transport, "WAVEFRONT", 64 * FEW.spp)
    monkeypatch.setattr(forecast, "time", clock)
    clock.step = 60.0
    lines = told("slow")
    pictures = ["heldout_000", "heldout_000, true materials", "heldout_000"]
    shares = [(line.partition(": ")[0], line.partition(": ")[2][:4]) for line in lines]
    parts = [(name, share) for name, share in shares if not name.startswith("all")]
    assert parts == [(name, share) for name in pictures for share in ("25 %", "50 %", "75 %")]
    # Of `render` it is one picture, which takes less than that. Of first parts nothing is known.
    assert sum("a smaller --spp makes that shorter" in line for line in lines) == 1
    assert sum(" left" in line for line in lines) == len(parts) - 2


def rendered(made, names, clock, seconds, *, first):
    """Pictures of 1000 samples in four parts, of `seconds` each, and the very first of `first`."""
    for name in names:
        done = made.begin(name, 1000)
        for part in range(1, 5):
            clock.now += first if name == names[0] and part == 1 else seconds
            done(part / 4)


def test_what_all_pictures_take_is_told_once_where_it_is_long(monkeypatch, clock):
    monkeypatch.setattr(forecast, "time", clock)
    lines: list[str] = []
    # Kernels are compiled for the first part, which tells nothing of others.
    rendered(forecast.Forecast(10_000, lines.append), "ab", clock, 60.0, first=300.0)
    assert lines == [
        "a: 25 % rendered",
        "a: 50 % rendered, about 2 min left",
        "all pictures take about 38 min more: a smaller --spp makes that shorter",
        "a: 75 % rendered, about 60 s left",
        "b: 25 % rendered, about 3 min left",
        "b: 50 % rendered, about 2 min left",
        "b: 75 % rendered, about 60 s left",
    ]


def test_pictures_that_are_soon_there_are_not_told(monkeypatch, clock):
    monkeypatch.setattr(forecast, "time", clock)
    lines: list[str] = []
    rendered(forecast.Forecast(3000, lines.append), "abc", clock, 2.0, first=2.0)
    assert lines == []


def test_meshes_that_were_changed_are_not_those_of_the_photographs(cornell, tmp_path):
    """Renderings of them are no limit to what can be expected."""
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    file = DataFolder(data).degraded_file
    for meshes in ([], ["meshes/changed-0/box.ply"]):
        file.write_text(json.dumps({"displaced": {"meshes": meshes, "world_units": 0.1}}))
        dataset = Dataset.load(data)
        assert dataset.has_true_materials
        if not meshes:
            require_true_materials(dataset)
            continue
        with pytest.raises(UserError, match=r"displaced or decimated.*Leave out --truth"):
            require_true_materials(dataset)


def test_what_is_too_large_to_be_evaluated_is_refused_before_it_is_rendered(untrained, monkeypatch):
    monkeypatch.setattr(evaluate_module, "_PIXEL_BYTES", 1e15)
    monkeypatch.setattr(
        evaluate_module, "render_camera", lambda *_, **more: pytest.fail("rendered")
    )
    with pytest.raises(UserError, match=r"of memory.*--longest"):
        evaluate(untrained, FEW, tell=lambda line: None)


def test_pictures_without_room_on_the_disk_are_told_after_the_first_view(
    untrained, tmp_path, monkeypatch
):
    run = shutil.copytree(untrained, tmp_path / "run")
    settings = replace(FEW, train_views=2)
    monkeypatch.setattr(evaluate_module, "_MUCH", 1)
    lines: list[str] = []
    evaluate(run, settings, tell=lines.append)
    assert any("pictures of 2 more views need about 0 MB on the disk" in line for line in lines)
    before = (run / "evaluation" / "metrics.json").read_bytes()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    lines.clear()
    with pytest.raises(UserError, match=r"pictures of 2 more views need about .* are free. Make"):
        evaluate(run, settings, tell=lines.append)
    assert len([line for line in lines if "render" in line]) == 1
    assert (run / "evaluation" / "metrics.json").read_bytes() == before
    assert not (run / "evaluation" / ".new").exists()


def test_the_room_for_more_views_is_that_of_pictures_of_views(tmp_path, monkeypatch):
    """Not of an environment map, which is written once however many views there are."""
    out, told = EvaluationFolder(tmp_path), []
    out.environment().write_bytes(bytes(1_000_000))
    picture = out.picture("heldout", "a", "render")
    picture.parent.mkdir()
    picture.write_bytes(bytes(1000))
    camera = SimpleNamespace(width=4, height=4)
    views: Any = [SimpleNamespace(camera=camera, split="heldout")] * 3
    monkeypatch.setattr(evaluate_module, "_MUCH", 1)
    for free in (2000, 1999):
        monkeypatch.setattr(shutil, "disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        if free == 2000:
            _require_room(out, views, told.append)
            continue
        with pytest.raises(UserError, match="pictures of 2 more views need"):
            _require_room(out, views, told.append)
    assert len(told) == 1


# ------------------------------------------------------------------------------- held-out poses


class _Place:
    """A place along one axis, in pixels; points move as much as it does."""

    def __init__(self, move: np.ndarray) -> None:
        self.move = move

    def project(self, points: np.ndarray) -> np.ndarray:
        return points[:, :2] + self.move[:2]


def _compared(error_at: Any, told_slope: float = 1.0) -> Any:
    """Eight pixels whose errors are a function of the place, and whose slopes tell another one."""
    slopes = np.zeros((8, 3, 2))
    slopes[..., 0] = told_slope
    tried: list[float] = []

    def errors(place: _Place) -> _Errors:
        tried.append(float(place.move[0]))
        values = np.broadcast_to(np.asarray(error_at(tried[-1]), float)[..., None], (8, 3)).copy()
        return _Errors(values, slopes, np.zeros((8, 3)), np.isfinite(values).all(1))

    return SimpleNamespace(count=8, errors=errors, tried=tried)


def test_a_place_is_found_where_slopes_tell_it():
    pixels = _compared(lambda x: np.full(8, 2.0 - x))
    assert _solved(_Place, pixels, 1e6)[0] == pytest.approx(2, abs=0.02)


@pytest.mark.parametrize("told_slope", [0.3, -1.0])
def test_a_place_that_is_worse_than_the_one_before_is_not_taken(told_slope):
    """With slopes that tell too little each step goes too far, and the next one farther."""
    pixels = _compared(lambda x: np.full(8, 2.0 - x), told_slope)
    found = _solved(_Place, pixels, 1e6)[0]
    assert found == 0 and len(pixels.tried) == 2, "the given place is better than the first step"


def test_errors_that_are_not_finite_have_no_part_in_a_place():
    pixels = _compared(lambda x: np.array([np.nan, np.inf, *[2.0 - x] * 6]))
    assert _solved(_Place, pixels, 1e6)[0] == pytest.approx(2, abs=0.02)
    nothing = _compared(lambda x: np.full(8, np.nan))
    assert not _solved(_Place, nothing, 1e6).any()
