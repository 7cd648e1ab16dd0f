"""The report: complete, self-contained, safe, and clear about what is missing."""

from __future__ import annotations

import base64
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from support import BROWSERS, found_browser

from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.imaging import pictures
from unbake.report import charts, display
from unbake.report.page import write_report
from unbake.report.runs import read_run, read_views

SIZE = (24, 32)
TRAINING, HELDOUT = 6, 2
CAMERA = {
    "w": SIZE[1], "h": SIZE[0], "fl_x": 30.0, "fl_y": 30.0, "cx": 16.0, "cy": 12.0,
    "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}  # fmt: skip
EVIL = '<script>alert("1")<'


def _save(path: Path, rgb: np.ndarray, alpha: np.ndarray | None = None) -> None:
    pictures.write_exr(path, rgb if alpha is None else np.dstack([rgb, alpha]))


def _truth(index: int) -> dict[str, np.ndarray]:
    """A made-up picture, its albedo and its roughness, and where they count."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]] / 32
    albedo = np.stack([x, y, 0.5 + 0.4 * np.sin(9 * x + index)], axis=-1)
    roughness = np.repeat((0.2 + 0.6 * y)[..., None], 3, axis=2)
    mask = (x - 0.5) ** 2 + (y - 0.4) ** 2 < 0.1
    return {"render": 2 * albedo * (1 - x)[..., None], "albedo": albedo, "roughness": roughness,
            "mask": mask.astype(float)}  # fmt: skip


def _names(prefix: str = "") -> list[tuple[str, str]]:
    training = [(f"{prefix}train_{i:03d}", "train") for i in range(TRAINING)]
    return training + [(f"{prefix}heldout_{i:03d}", "heldout") for i in range(HELDOUT)]


def _make_data(folder: Path, prefix: str = "", known: bool = True) -> Path:
    frames = []
    for index, (name, split) in enumerate(_names(prefix)):
        truth = _truth(index)
        _save(folder / "images" / f"{name}.exr", truth["render"], np.ones(SIZE))
        for kind in ("albedo", "roughness") if known else ():
            _save(folder / "truth" / kind / f"{name}.exr", truth[kind], truth["mask"])
        frames.append(CAMERA | {"file_path": f"images/{name}.exr", "split": split})
    (folder / "scene").mkdir()
    (folder / "scene" / "scene.xml").write_text("<scene version='3.0.0'/>")
    transforms = {
        "scene": "scene/scene.xml",
        "background": "visible",
        "coverage": 0.93,
        "render": {"integrator": "path", "max_depth": 8, "spp": 64},
        "frames": frames,
    }
    (folder / "transforms.json").write_text(json.dumps(transforms))
    return folder


def _make_run(
    folder: Path, data: Path, method: str, noise: float, prefix: str = "", known: bool = True
) -> Path:
    rng = np.random.default_rng(3)
    rows = []
    for index, (name, split) in enumerate(_names(prefix)):
        row: dict[str, object] = {"name": name, "split": split}
        for kind in ("render", "albedo", "roughness"):
            picture = _truth(index)[kind] + noise * rng.standard_normal((*SIZE, 3))
            _save(folder / "evaluation" / split / f"{name}_{kind}.exr", picture)
            has_truth = known or kind == "render"
            row[f"{kind}_psnr"] = -20 * math.log10(noise) + index if has_truth else None
        rows.append(row)
    means = {key: rows[0][key] for key in rows[0] if key.endswith("psnr")}
    metrics = {
        "method": method, "steps": 200, "samples": 1_638_400, "seconds": 12.5,
        "heldout": {"views": HELDOUT} | means, "train": {"views": TRAINING} | means,
        "per_view": rows, "data": str(data), "render": {"spp": 64, "max_depth": 8},
        "definitions": {"psnr": "10 log10(1/MSE)", "colour_space": "linear", "mask": "alpha"},
    }  # fmt: skip
    (folder / "evaluation" / "metrics.json").write_text(json.dumps(metrics))
    (folder / "config.toml").write_text(
        f"method = {json.dumps(method)}\nsteps = 200\n[radiance]\nwidth = 32\nflag = true\n"
    )
    with (folder / "log.jsonl").open("w") as log:
        for step in range(200):
            loss = math.exp(-step / 50) + noise
            record = {"step": step, "seconds": step / 16, "photometric": loss, "lhs": 2 * loss}
            log.write(json.dumps(record | {"prior": 0.0 if method == "direct" else loss}) + "\n")
            if step % 50 == 0:
                scores = {"split": "heldout", "albedo_psnr": step / 9, "roughness_psnr": step / 12}
                log.write(json.dumps(record | {"validation": scores}) + "\n")
        log.write('{"step": 200, "seco')
    return folder


class _Page(HTMLParser):
    """Collects the tags and attributes of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def count(self, tag: str) -> int:
        return sum(name == tag for name, _ in self.tags)

    def images(self) -> list[str]:
        return [str(a["alt"]) for name, a in self.tags if name == "img" and a["alt"]]


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, list[Path]]:
    data = _make_data(tmp_path / "room")
    ours = _make_run(tmp_path / "runs" / "ours", data, "ours", 0.01)
    return data, [ours, _make_run(tmp_path / "runs" / "direct", data, "direct", 0.1)]


def test_the_page_shows_every_view_run_and_number(made, tmp_path: Path):
    out = write_report(made[1], tmp_path / "out" / "report.html")
    assert [p.name for p in out.parent.iterdir()] == ["report.html"]
    text = out.read_text(encoding="utf-8")
    page = _Page(text)
    for name in ("heldout_000", "heldout_001", "train_000", "train_002", "train_003", "train_005"):
        for quantity in ("Rendering", "Albedo", "Roughness"):
            shown = [alt for alt in page.images() if name in alt and alt.startswith(quantity)]
            assert len(shown) == 1 + 2 + 2, (name, quantity)
    assert "train_001" not in text
    assert "4 of 6 views, evenly spaced" in text
    assert text.index("heldout_000") < text.index("train_000")
    assert page.count("svg") == 4 + 6
    assert "<title>Photometric loss over training time, seconds</title>" in text
    assert re.findall(r"<g><title>(\w+)</title>", text).count("ours") == 4 + 6
    assert "40.00" in text and "20.00" in text and "1.64\N{NO-BREAK SPACE}M" in text
    assert '<td class="n best first">40.00</td>' in text
    assert "10 log10(1/MSE)" in text


def test_one_run_needs_no_list(made, tmp_path: Path):
    run = made[1][0]
    listed = write_report([run], tmp_path / "listed.html").read_bytes()
    for number, given in enumerate((run, str(run))):
        assert write_report(given, tmp_path / f"{number}.html").read_bytes() == listed
    for key in ("exported", "relit"):
        with pytest.raises(UserError, match="nothing"):
            write_report(run, tmp_path / "page.html", **{key: str(tmp_path / "nothing")})


def test_of_many_held_out_views_some_are_shown(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "HELDOUT", 30)
    data = _make_data(tmp_path / "room")
    run = _make_run(tmp_path / "run", data, "ours", 0.01)
    text = write_report([run], tmp_path / "report.html").read_text()
    assert text.count('data-view="heldout_') == 24
    assert "heldout_000" in text and "heldout_029" in text
    assert "24 of 30 views, evenly spaced" in _section(text, "heldout")


@pytest.mark.parametrize(("runs", "shown"), [(3, 16), (20, 4)])
def test_of_many_runs_fewer_views_are_shown(runs, shown, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "HELDOUT", 30)
    data = _make_data(tmp_path / "room", known=False)
    made = [_make_run(tmp_path / f"run-{i}", data, "ours", 0.01, known=False) for i in range(2)]
    views = read_views(Dataset.load(data), [read_run(made[i % 2], str(i)) for i in range(runs)])
    assert sum(view.split == "heldout" for view in views) == shown


def test_each_evaluated_picture_is_read_once(made, tmp_path: Path, monkeypatch):
    read, read_exr = [], pictures.read_exr
    monkeypatch.setattr(pictures, "read_exr", lambda path: read.append(path) or read_exr(path))
    write_report(made[1], tmp_path / "report.html")
    evaluated = [path for path in read if "evaluation" in path.parts]
    assert len(evaluated) == len(set(evaluated)) == 2 * 3 * (HELDOUT + 4)


def test_logged_terms_without_a_title_have_charts_too(made, tmp_path: Path):
    """Regularizers, and terms of methods that are not registered here."""
    log = made[1][0] / "log.jsonl"
    line = {"step": 1, "seconds": 0.1, "samples_per_second": 9, "learning_rate": 1, "skipped": 0}
    terms = {"roughness_smoothness": 0.5, f"term{EVIL}": 0.25}
    log.write_text(json.dumps(line | terms) + "\n" + json.dumps(line | terms | {"step": 2}) + "\n")
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert "<title>Roughness smoothness over step</title>" in text
    assert "<title>Term" in text and EVIL.lower() not in text.lower()
    assert "Learning rate over" not in text and "Skipped over" not in text


def test_skipped_steps_and_what_was_noted_of_a_fit_are_told(made, tmp_path: Path):
    line = {"step": 190, "seconds": 1.0}
    noted = [{"skipped": 3}, {"skipped": 4}, {"note": f"nothing was learned{EVIL}"}]
    (made[1][0] / "log.jsonl").write_text("".join(json.dumps(line | x) + "\n" for x in noted))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert text.count("7 of 200 steps skipped") == 1 == text.count("nothing was learned")
    assert EVIL not in text


@pytest.mark.parametrize("steps", [0, 200])
def test_a_run_that_went_on_after_its_evaluation_is_told(made, tmp_path: Path, steps):
    run = made[1][0]
    _edit(run, lambda m: m.update(steps=steps))
    (run / "log.jsonl").write_text("")
    assert "evaluated after" not in write_report(made[1], tmp_path / "before.html").read_text()
    (run / "log.jsonl").write_text(json.dumps({"step": 8000, "seconds": 9.0}) + "\n")
    told = f"evaluated after {steps} of 8 000 steps"
    text = _words(write_report(made[1], tmp_path / "killed.html").read_text())
    assert text.count(told) == 1 and "unbake evaluate" not in text  # nothing else was saved
    (run / "checkpoints" / "step-000008000").mkdir(parents=True)
    text = _words(write_report(made[1], tmp_path / "saved.html").read_text())
    assert re.search(re.escape(f"{told}; run `unbake evaluate ") + r"\S*/ours` again", text)


@pytest.mark.parametrize("why", ["nothing learned", "worse than untrained"])
def test_a_run_that_learned_nothing_is_marked(made, tmp_path: Path, why):
    """In the table, and at each of its pictures, which may be plain white."""
    before = write_report(made[1], tmp_path / "before.html").read_text()
    marked = f'<span class="failed">{why}</span>'
    assert marked not in before
    if why == "nothing learned":
        note = {"step": 190, "seconds": 1.0, "note": "nothing was learned: no gradient"}
        (made[1][0] / "log.jsonl").write_text(json.dumps(note) + "\n")
    else:
        first = {"albedo_psnr": 60.0, "roughness_psnr": 60.0}
        found = {"ceiling": None, "constant": first, "untrained": first}
        _edit(made[1][0], lambda m: m.update(yardsticks=found))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    shown = text.count('data-name="Rendering"') + 2 * text.count('data-name="Albedo"')
    assert text.count(marked) == 1 + shown


def test_an_albedo_that_is_right_but_for_its_scale_is_not_marked(made, tmp_path: Path):
    run, first = made[1][0], {"albedo_psnr": 60.0, "roughness_psnr": 60.0}
    found = {"ceiling": None, "constant": first, "untrained": first}
    _optimize_environment(run, 0.05)
    _edit(run, lambda m: m.update(yardsticks=found))
    _edit(run, lambda m: m["definitions"].update(albedo_psnr_aligned="after scaling"))
    for decibels, marked in ((59.0, True), (61.0, False)):
        aligned = {"albedo_psnr_aligned": decibels}
        _edit(run, lambda m, a=aligned: [m[split].update(a) for split in ("heldout", "train")])
        text = write_report(made[1], tmp_path / f"{decibels}.html").read_text()
        assert ("worse than untrained" in text) == marked


def test_whether_a_fit_was_still_improving_is_told(made, tmp_path: Path):
    metrics = made[1][0] / "evaluation" / "metrics.json"
    found = {"trend": "improving", "change": -0.031, "noise": 0.004, "share": 0.25}
    metrics.write_text(json.dumps(json.loads(metrics.read_text()) | {"convergence": found}))
    log = made[1][0] / "log.jsonl"
    lines = [{"step": s, "seconds": 1.0 * s, "held_aside": 1 / s} for s in (50, 100, 150, 200)]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    told = "still improving (the error on held-aside pixels fell by 3.1 ± 0.4 % over the last 25 %"
    assert text.count(told) == 1
    assert "<title>Photometric loss, held-aside pixels over" in text
    found |= {"change": -1.55, "noise": 0.7}  # below zero
    metrics.write_text(json.dumps(json.loads(metrics.read_text()) | {"convergence": found}))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert "fell by 2.2 times its noise over the last 25 %" in text


def test_the_settings_that_differ_stand_out(made, tmp_path: Path):
    text = write_report(made[1], tmp_path / "report.html").read_text()
    differing, shared = text.split("What differs between the runs.")[1].split("<details>")
    assert "method" in differing and "steps" not in differing
    assert "radiance.neural.width" in shared and "<td>true</td>" in shared


def test_methods_without_a_radiance_field_show_no_searches(made, tmp_path: Path):
    for run, radiance in zip(made[1], ("neural", None), strict=True):
        with (run / "config.toml").open("a") as config:
            config.write("[roughness_search]\ntimes = 3\n")
        file = run / "evaluation" / "metrics.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"radiance": radiance}))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    differing = text.split("What differs between the runs.")[1].split("<details>")[0]
    row = differing.split("roughness_search.times")[1].split("</tr>")[0]
    assert re.findall(r"<td[^>]*>(\d+)</td>", row) == ["3", "0"]


def test_the_page_loads_nothing(made, tmp_path: Path):
    text = write_report(made[1], tmp_path / "report.html").read_text()
    for tag, attributes in _Page(text).tags:
        for key in ("src", "href", "srcset", "action", "data", "poster"):
            assert str(attributes.get(key, "#")).startswith(("data:image/png;", "#")), tag
    assert "://" not in text and "url(" not in text and "@import" not in text
    assert "default-src 'none'" in text


def test_names_cannot_inject_markup(tmp_path: Path):
    data = _make_data(tmp_path / EVIL, prefix=EVIL)
    run = _make_run(tmp_path / "runs" / EVIL, data, "</script><script>alert(2)</script>", 0.1, EVIL)
    text = write_report([run], tmp_path / "report.html").read_text()
    assert _Page(text).count("script") == 1
    assert "<script>alert" not in text and "&lt;script&gt;alert" in text


def test_a_finished_page_is_the_same_each_time(made, tmp_path: Path):
    first = write_report(made[1], tmp_path / "a.html").read_bytes()
    assert write_report(made[1], tmp_path / "b.html").read_bytes() == first


@pytest.mark.parametrize("known", [True, False])
def test_errors_of_renderings_are_of_pixels_that_count(known, tmp_path: Path, monkeypatch):
    data = _make_data(tmp_path / "data", known=known)
    half = np.ones((*SIZE, 3))
    half[:, : SIZE[1] // 2] = 0
    pictures.write_png(data / "mask.png", pictures.to_bytes(half))
    transforms = json.loads((data / "transforms.json").read_text())
    for frame in transforms["frames"]:
        frame["mask_path"] = "mask.png"
    (data / "transforms.json").write_text(json.dumps(transforms))
    run = _make_run(tmp_path / "run", data, "ours", 0.01, known=known)
    painted = _painted(monkeypatch)
    write_report([run], tmp_path / "page.html")
    expected = half[..., 0] > 0
    if known:
        expected &= _truth(0)["mask"] > 0
    assert (painted[0][1] == expected).all() and 0 < expected.sum() < expected.size
    for _, counted in painted[1:3] if known else ():  # albedo and roughness of the view
        assert (counted == expected).all()


def test_errors_are_not_of_pixels_that_see_other_things_in_part(made, tmp_path, monkeypatch):
    """As scores are: what the truth or the run covers in part does not count."""
    data, (run, _) = made
    partly = np.ones(SIZE)
    partly[:, :10] = 0.75
    albedo = data / "truth" / "albedo" / "heldout_000.exr"
    _save(albedo, pictures.read_exr(albedo)[..., :3], partly)
    own = run / "evaluation" / "heldout" / "heldout_000_albedo.exr"
    _save(own, pictures.read_exr(own), partly[:, ::-1])
    painted = _painted(monkeypatch)
    write_report([run], tmp_path / "page.html")
    inside = _truth(TRAINING)["mask"] > 0
    expected = inside & (partly == 1) & (partly[:, ::-1] == 1)
    assert (painted[1][1] == expected).all() and expected.sum() < inside.sum()


def test_clipped_photographs_are_compared_as_renderings_are(made, tmp_path: Path, monkeypatch):
    data, (run, _) = made
    frames = json.loads((data / "transforms.json").read_text())["frames"]
    _edit_data(data, frames=[frame | {"clipped": 0.5} for frame in frames])
    for index, (name, split) in enumerate(_names()):
        limited = np.minimum(_truth(index)["render"], 0.5)
        assert (_truth(index)["render"] > 0.6).any()
        _save(run / "evaluation" / split / f"{name}_render.exr", limited)
    painted = _painted(monkeypatch)
    write_report([run], tmp_path / "page.html")
    np.testing.assert_allclose(painted[0][0], 0, atol=1e-6)
    assert np.max(painted[1][0]) > 0  # of albedo, which nothing clips


def test_photographs_without_truth_are_shown_as_recovered(tmp_path: Path):
    data = _make_data(tmp_path / "photos", known=False)
    run = _make_run(tmp_path / "run", data, "ours", 0.1, known=False)
    text = write_report([run], tmp_path / "report.html").read_text()
    images = [alt for alt in _Page(text).images() if "heldout_000" in alt]
    assert len(images) == 3 + 1 + 1
    assert "no ground truth" not in text and "round truth" not in _words(text)
    assert 'class="box empty"' not in text and "—" not in _section(text, "numbers")
    assert "Rendering, photograph, view heldout_000" in images
    assert "<figcaption>Photograph</figcaption>" in text
    heads = re.findall(r'scope="col">(\w+)</th>', _section(text, "numbers"))
    assert "Rendering" in heads and "Albedo" not in heads


def test_a_relative_data_path_starts_at_the_run(made, tmp_path: Path):
    _edit(made[1][0], lambda metrics: metrics.update(data="../../room"))
    assert write_report(made[1], tmp_path / "report.html").is_file()


def test_runs_of_the_same_name_are_told_apart(made, tmp_path: Path):
    twin = _make_run(tmp_path / "older" / "ours", made[0], "ours", 0.2)
    text = write_report([made[1][0], twin], tmp_path / "report.html").read_text()
    assert "runs/ours" in text and "older/ours" in text


FACTS: dict[str, object] = {
    "unknown": "materials", "bounces": 1, "prior": "extra-bounce", "representation": "neural",
    "radiance": "neural", "estimator": "all-pairs",
}  # fmt: skip


def _words(text: str) -> str:
    """A page's text without its markup."""
    return " ".join(re.sub(r"<[^>]*>", "", text).split())


def test_each_run_tells_what_it_works_with(made, tmp_path: Path):
    start = {"folder": "solved", "scene": "room", "steps": 9, "sha256": "0", "scale": 0.5}
    solved = FACTS | {"warm_start": start}
    _edit(made[1][0], lambda m: m.update(solved, bounces=3, prior="one-bounce"))
    other = {"representation": "bitmap", "radiance": None, "estimator": "two-pass"}
    _edit(made[1][1], lambda m: m.update(FACTS, method="prb", **other))
    text = _words(write_report(made[1], tmp_path / "report.html").read_text())
    told = "φ network, Lθ network, Lθ solved before the fit, 3 bounces, one bounce prior, all pairs"
    assert f"ours {told}" in text or f"ours{told}" in text
    assert "prbφ bitmaps, no Lθ, two passes" in text
    assert "Materials recovered in room" in text


def _score(run: Path, values: dict[int, float]) -> None:
    with (run / "log.jsonl").open("w") as log:
        for step, value in values.items():
            scores = {"views": 2, "albedo_psnr": value, "roughness_psnr": value / 2}
            log.write(json.dumps({"step": step, "seconds": step / 4, "score": scores}) + "\n")


def test_scores_become_curves_and_a_race(made, tmp_path: Path):
    _score(made[1][0], {0: 10.0, 40: 30.0, 80: 31.0})
    _score(made[1][1], {0: 10.0, 40: 20.0})
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert _Page(text).count("svg") == 4
    assert "Held-out albedo PSNR" in text and "Validation during training" not in text
    rows = re.findall(r"<tr>.*?</tr>", text.split('class="race"')[1].split("</table>")[0], re.S)
    assert [re.findall(r'<td class="(.*?)">(.*?)</td>', row) for row in rows[1:]] == [
        [("n", "31.00"), ("n best", "20.0"), ("n", "—")],
        [("n", "30.00"), ("n best", "10.0"), ("n", "—")],
        [("n", "29.00"), ("n best", "9.5"), ("n", "—")],
        [("n", "20.00"), ("n best", "5.0"), ("n", "10.0")],
        [("n", "19.00"), ("n best", "4.5"), ("n", "9.0")],
        [("n", "18.00"), ("n best", "4.0"), ("n", "8.0")],
    ]
    assert text.count('class="race"') == 2 and "Roughness PSNR of" in text


def test_one_run_is_no_race(made, tmp_path: Path):
    _score(made[1][0], {0: 10.0, 40: 30.0})
    assert "Time to quality" not in write_report(made[1], tmp_path / "report.html").read_text()


def _environment() -> np.ndarray:
    """A made-up environment map, far brighter than 1 in places."""
    y, x = np.mgrid[0:128, 0:256] / 128
    return np.stack([8 * np.exp(-9 * (x - y) ** 2), 4 * y, x], axis=-1)


def _optimize_environment(run: Path, noise: float, unknown: str = "materials+lighting") -> None:
    """Make a run one that optimized the environment map, which it recovered up to noise."""
    map_ = _environment() + noise
    _save(run / "evaluation" / "environment.exr", map_)
    numbers = {"sh_error": noise, "sh_error_aligned": noise / 2}
    numbers |= {"relight_psnr": 4 / noise, "relight_psnr_aligned": 5 / noise}
    _edit(run, lambda m: m.update(FACTS, unknown=unknown, environment=numbers))
    _edit(run, lambda m: m["definitions"].update(sh_error="|c - c*|", relight_psnr="balls"))


def _optimize_emission(
    run: Path, area_emitters: dict[str, tuple[list[float], float | None]]
) -> None:
    """Make a run one that optimized the strengths of emitters, given with their errors by name."""
    rows = [
        {"name": name, "strength": strength, "emission_error": error,
         "truth": None if error is None else [17, 15.8, 13.8]}
        for name, (strength, error) in area_emitters.items()
    ]  # fmt: skip
    _know_materials(run)
    _edit(run, lambda m: m.update(unknown="emission", emission=rows))
    _edit(run, lambda m: m["definitions"].update(emission_error="of a colour"))


def _know_materials(run: Path) -> None:
    """Make a run one whose materials are known: no numbers of them, no pictures."""
    not_optimized = {"albedo_psnr": None, "roughness_psnr": None}
    _optimize_environment(run, 0.1, "lighting")

    def change(metrics: dict) -> None:
        metrics.update(representation=None)
        for row in (*metrics["per_view"], metrics["heldout"], metrics["train"]):
            row.update(not_optimized)

    _edit(run, change)
    for kind in ("albedo", "roughness"):
        for path in run.rglob(f"*_{kind}.exr"):
            path.unlink()


def test_a_run_with_known_materials_beside_one_that_seeks_them(made, tmp_path: Path):
    _know_materials(made[1][1])
    text = write_report(made[1], tmp_path / "report.html").read_text()
    shown = [alt for alt in _Page(text).images() if "heldout_000" in alt and "Albedo" in alt]
    assert len(shown) == 3 and not any("direct" in alt for alt in shown)
    assert "known, not optimized" in text and "lighting optimized" in text
    assert "Materials and lighting recovered" in text


def test_runs_with_known_materials_show_renderings_alone(made, tmp_path: Path):
    for run in made[1]:
        _know_materials(run)
    text = write_report(made[1], tmp_path / "report.html").read_text()
    shown = [alt for alt in _Page(text).images() if "heldout_000" in alt]
    assert len(shown) == 5 and all(alt.startswith("Rendering") for alt in shown)
    assert "Lighting recovered in room" in text and "not optimized" not in text


def _section(text: str, name: str) -> str:
    return text.split(f'<section id="{name}">')[1].split("</section>")[0]


def _cells(table: str) -> list[list[tuple[str, str]]]:
    """The class and the text of each cell, row by row."""
    rows = re.findall(r"<tr>(.*?)</tr>", table.split("<tbody>")[1], re.S)
    return [re.findall(r'<td class="(.*?)".*?>(.*?)</td>', row) for row in rows]


def test_runs_that_know_the_light_have_no_section_on_it(made, tmp_path: Path):
    _edit(made[1][0], lambda m: m["definitions"].update(albedo_psnr_aligned="x", sh_error="x"))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert 'href="#light"' not in text and "light recovered" not in _words(text)
    assert "Aligned" not in text and "SH error" not in text


def test_environment_maps_are_shown_beside_the_truth(made, tmp_path: Path):
    _save(made[0] / "truth" / "environment.exr", _environment(), np.ones((128, 256)))
    third = _make_run(tmp_path / "runs" / "prb", made[0], "prb", 0.05)
    _optimize_environment(made[1][0], 0.04)
    _optimize_environment(made[1][1], 0.2, "lighting")
    text = write_report([*made[1], third], tmp_path / "report.html").read_text()
    light = _section(text, "light")
    assert 'href="#light"' in text and "at -2.0 stops" in light and "0.05</span>" in light
    names = [alt.removeprefix("Environment map") for alt in _Page(light).images()]
    assert names == [
        ", ground truth", ", ours", " error, ours, SH error 4.00 %",
        ", direct", " error, direct, SH error 20.00 %",
    ]  # fmt: skip
    best = [("n best first", "4.00"), ("n best", "2.00"), ("n best first", "100.00")]
    assert _cells(light) == [
        [*best, ("n best", "125.00")],
        [("n first", "20.00"), ("n", "10.00"), ("n first", "20.00"), ("n", "25.00")],
        [("n first soft", "known, not optimized")],
    ]
    assert 'class="number best">SH error 4.00 %' in light and light.count("best") == 5
    assert "|c - c*|" in light and "balls" in light
    assert "|c - c*|" not in _section(text, "numbers")
    assert "albedo, roughness and light recovered" in _words(text)


def test_of_an_environment_that_is_seen_in_part_the_other_part_is_no_error(made, tmp_path: Path):
    """What lights nothing in view is not known. A column of scores says how good the rest is."""
    truth = _environment()
    _save(made[0] / "truth" / "environment.exr", truth, np.ones((128, 256)))
    _optimize_environment(made[1][0], 0.04)
    _optimize_environment(made[1][1], 0.2, "lighting")
    seen, folder = {"sh_error_seen": 0.031, "relight_psnr_seen": 40.9}, made[1][0] / "evaluation"

    def tell(metrics: dict) -> None:
        metrics["environment"] |= seen
        metrics["environment_seen_share"] = 0.49
        metrics["definitions"]["sh_error_seen"] = "what is seen"

    _edit(made[1][0], tell)
    found = truth.copy()
    found[64:] += 100
    _save(folder / "environment.exr", found)
    hidden = np.zeros((128, 256), np.uint8)
    hidden[64:] = 255
    Image.fromarray(hidden).save(folder / "environment_unobserved.png")
    light = _section(write_report(made[1], tmp_path / "report.html").read_text(), "light")
    assert [row[2] for row in _cells(light)] == [("n", "3.10"), ("n", display.DASH)]
    assert [row[5] for row in _cells(light)] == [("n", "40.90"), ("n", display.DASH)]
    assert "what is seen" in light
    assert "ours: Nothing is known of 51 % of the environment" in _words(light)
    embedded = re.findall(r'data-kind="error".*?src="[^,]*,(.*?)"', light, re.S)
    files = (io.BytesIO(base64.b64decode(text)) for text in embedded)
    ours, direct = (np.array(Image.open(file).convert("RGB")) for file in files)
    middle = len(ours) // 2
    assert (ours[middle + 1 :] == ours[-1, 0]).all() and np.ptp(ours[-1, 0]) == 0  # grey
    assert (direct[middle + 1 :] != ours[-1, 0]).any()
    Image.fromarray(hidden[:64]).save(folder / "environment_unobserved.png")
    with pytest.raises(UserError, match=r"environment_unobserved\.png.*another size"):
        write_report(made[1], tmp_path / "report.html")


def test_all_maps_have_the_exposure_that_suits_the_truth(made, tmp_path: Path):
    _save(made[0] / "truth" / "environment.exr", _environment(), np.ones((128, 256)))
    _optimize_environment(made[1][0], 50.0)
    light = _section(write_report(made[1], tmp_path / "report.html").read_text(), "light")
    assert "at -2.0 stops" in light
    truth, ours = re.findall(r'data-kind="picture".*?src="(.*?)"', light, re.S)
    assert truth == pictures.png_data_uri(pictures.tonemap(_environment(), -2.0))
    assert ours == pictures.png_data_uri(pictures.tonemap(_environment() + 50, -2.0))


def test_maps_without_truth_stand_alone(made, tmp_path: Path):
    for run in made[1]:
        _optimize_environment(run, 0.05)
        _edit(run, lambda m: m.update(environment=None))
    light = _section(write_report(made[1], tmp_path / "report.html").read_text(), "light")
    assert len(_Page(light).images()) == 2 and "round truth" not in light
    assert "<table" not in light and "The error is" not in light and "SH error" not in light


def test_lights_are_a_table_of_strengths(made, tmp_path: Path):
    _optimize_emission(
        made[1][0], {"lamp": ([17.217773, 15.829334, 13.7], 0.0084), EVIL: ([0, 0, 0], 0)}
    )
    _optimize_emission(
        made[1][1], {"lamp": ([170.5, 2.25, 0.001], 9.5), "sun": ([1e5, 2, 3], None)}
    )
    third = _make_run(tmp_path / "runs" / "prb", made[0], "prb", 0.05)
    text = write_report([*made[1], third], tmp_path / "report.html").read_text()
    light = _section(text, "light").replace("\N{EN SPACE}", " ")
    not_optimized, dash = ("n first soft", "known, not optimized"), [("n first", "—"), ("n", "—")]
    truth, ours = ("n first", "17.00 15.80 13.80"), ("n first", "17.22 15.83 13.70")
    assert _cells(light) == [
        [
            truth,
            ours,
            ("n best", "0.84"),
            ("n first", "170.5 2.2 0.0"),
            ("n", "950.00"),
            not_optimized,
        ],
        [truth, ("n first", "0.00 0.00 0.00"), ("n", "0.00"), *dash, not_optimized],
        [("n first", "—"), *dash, ("n first", "100000 2 3"), ("n", "—"), not_optimized],
    ]
    assert "of a colour" in light and _Page(text).images().count("Environment map") == 0
    assert _Page(text).count("script") == 1


def test_lights_alone_are_the_title_and_leave_out_columns_of_materials(made, tmp_path: Path):
    for run in made[1]:
        _optimize_emission(run, {"lamp": ([1, 2, 3], 0.1)})
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert "Lights recovered in room" in text and "light recovered" in _words(text)
    numbers = _section(text, "numbers")
    assert "Rendering" in numbers and "Albedo" not in numbers and "Roughness" not in numbers


def test_means_over_other_views_are_not_compared(made, tmp_path: Path):
    def fewer(metrics: dict) -> None:
        last = [row for row in metrics["per_view"] if row["split"] == "train"][-1]
        metrics["per_view"].remove(last)

    note = "Means over training views are of other views in some runs than in others"
    text = _section(write_report(made[1], tmp_path / "same.html").read_text(), "numbers")
    assert note not in text and text.count('class="n best') == 6
    _edit(made[1][0], fewer)
    text = _section(write_report(made[1], tmp_path / "other.html").read_text(), "numbers")
    assert note in text and text.count('class="n best') == 3, "of held-out views alone"


def test_an_aligned_albedo_has_its_column(made, tmp_path: Path):
    aligned = {"albedo_psnr_aligned": 43.21}
    _optimize_environment(made[1][0], 0.05)
    _edit(made[1][0], lambda m: [m[split].update(aligned) for split in ("heldout", "train")])
    _edit(made[1][0], lambda m: m["definitions"].update(albedo_psnr_aligned="after scaling"))
    text = _section(write_report(made[1], tmp_path / "report.html").read_text(), "numbers")
    assert text.count(">Aligned albedo</th>") == 2 and "after scaling" in text
    ours, direct = _cells(text)
    assert [cell for _, cell in ours[1:9]] == ["40.00", "40.00", "43.21", "40.00"] * 2
    assert [cell for _, cell in direct[1:9]] == ["20.00", "20.00", "—", "20.00"] * 2
    assert [kind for kind, _ in ours if kind.endswith("first")] == ["n best first"] * 2 + [
        "n first"
    ]


def test_a_ceiling_has_its_row_and_the_distance_to_it(made, tmp_path: Path):
    low, high = ({"albedo_psnr": 10.5, "roughness_psnr": x} for x in (12.0, 41.25))
    found = {"ceiling": high, "constant": low, "untrained": low}
    for run in made[1]:
        _edit(run, lambda m: m.update(yardsticks=found))
        _edit(run, lambda m: m["definitions"].update(yardsticks="what to measure by"))
    text = _section(write_report(made[1], tmp_path / "both.html").read_text(), "numbers")
    rows = text.split('<tbody class="soft">')[1]
    titles = re.findall(r'<th scope="row">(\w+)</th>', rows)
    assert titles == ["Ceiling", "Constant", "Untrained"] and "<small>of" not in rows
    assert "41.25" in rows and "what to measure by" in text and "distance to the ceiling" in text
    assert "<small>−1.25</small>" in text and "<small>+29.50</small>" in text

    _edit(made[1][1], lambda m: m.update(yardsticks=found | {"ceiling": None}, steps=0))
    text = _section(write_report(made[1], tmp_path / "one.html").read_text(), "numbers")
    titles = re.findall(r'<th scope="row">(\w+)</th>', text.split('<tbody class="soft">')[1])
    assert titles == ["Ceiling", "Constant"]  # the untrained run has a row of its own
    _edit(made[1][0], lambda m: m.update(yardsticks={"ceiling": {"albedo_psnr": "x"}}))
    with pytest.raises(UserError, match="`yardsticks` is of the wrong type"):
        write_report(made[1], tmp_path / "wrong.html")


def _liken(run: Path, ssim: float, flip: float) -> None:
    """Give an evaluation SSIM and FLIP."""
    found = {"render_ssim": ssim, "render_flip": flip}

    def change(metrics: dict) -> None:
        metrics["display_exposure"] = -0.5
        metrics["definitions"].update(render_ssim="windows", render_flip="flipping")
        for row in (*metrics["per_view"], metrics["heldout"], metrics["train"]):
            row.update(found)

    _edit(run, change)


def test_ssim_and_flip_stand_beside_psnr(made, tmp_path: Path):
    without = write_report(made[1], tmp_path / "old.html").read_text()
    assert "SSIM" not in _words(without) and "FLIP" not in _words(without)
    _liken(made[1][0], 0.9514, 0.1)
    text = write_report(made[1], tmp_path / "one.html").read_text()
    numbers = _section(text, "numbers")
    assert "(FLIP: lower)" in numbers and "windows" in numbers and "-0.5 stops" in numbers
    _liken(made[1][1], 0.5, 0.2)
    text = write_report(made[1], tmp_path / "both.html").read_text()
    table = _section(text, "numbers").split('<table class="light">')[1]
    best = [("n best first", "0.951"), ("n best", "0.100")]
    assert _cells(table) == [best * 2, [("n first", "0.500"), ("n", "0.200")] * 2]
    views = HELDOUT + 4
    assert text.count("<small>SSIM 0.951, FLIP 0.100</small>") == views


def _relit(
    folder: Path, run: Path, truth: Path | None = None, name: str = "sky.exr", **light: Any
) -> Path:
    """Pictures of a run, as `unbake relight` leaves them."""
    frames = [{"name": f"train_{i:03d}", "render_psnr": 30.0 + i} for i in range(TRAINING)]
    for number, frame in enumerate(frames):
        _save(folder / f"{frame['name']}.exr", 0.9 * _truth(number)["render"])
    found = {
        "format": 1, "run": {"folder": str(run.resolve())}, "settings": {"exposure": 1.0},
        "light": {"envmap": f"lights/{name}", "lights": None} | light, "frames": frames,
        "truth": None if truth is None else str(truth),
        "mean": {"views": TRAINING, "render_psnr": 32.5, "render_ssim": 0.9, "render_flip": 0.05},
    }  # fmt: skip
    (folder / "render.json").write_text(json.dumps(found))
    return folder


def test_pictures_under_another_light_are_strips(made, tmp_path: Path):
    data, runs = made
    text = write_report(runs, tmp_path / "without.html").read_text()
    assert "New pictures" not in text and 'class="strip"' not in text
    folders = [_relit(tmp_path / run.name, run, data) for run in runs]
    folders.append(_relit(tmp_path / "evening", runs[1], name=EVIL))
    page = write_report(runs, tmp_path / "report.html", relit=folders).read_text()
    section = _section(page, "relit")
    assert 'href="#relit"' in page and section.count('class="strip"') == 2
    assert "<h3>Environment map: sky.exr</h3>" in section and EVIL not in section
    sky = section.split("sky.exr</h3>")[1].split("</div>")[0]
    names = _Page(sky).images()
    assert len(names) == 6 + 2 * 6 and names[0] == "Relit, ground truth, view train_000"
    assert names[7] == "Relit, ours, 31.00 dB, view train_001"
    mean = "32.50 dB, mean of 6 views; SSIM 0.900, FLIP 0.050"
    assert sky.count(mean) == 2 and "At +1.0 stops" in section
    truth = pictures.png_data_uri(pictures.tonemap(_truth(0)["render"].astype(np.float32), 1.0))
    assert truth in sky
    other = section.replace(sky, "")
    assert len(_Page(other).images()) == 6 and "ground truth, view" not in other


def test_each_light_has_a_strip_of_its_own(made, tmp_path: Path):
    _, runs = made
    turned = {"envmap_rotate": 90.0, "envmap_scale": 2.0, "envmap_up": "+z", "keep_lights": True}
    folders = [_relit(tmp_path / "plain", runs[0]), _relit(tmp_path / "turned", runs[0], **turned)]
    page = write_report(runs, tmp_path / "report.html", relit=folders).read_text()
    section = _section(page, "relit")
    words = "turned by 90°, times 2, its first row at +z, with the scene&#39;s own lights"
    assert section.count('class="strip"') == 2
    for title in ("sky.exr", f"sky.exr, {words}"):
        assert f"<h3>Environment map: {title}</h3>" in section


def test_the_truth_of_another_light_is_as_bright_as_its_radiance(made, tmp_path: Path):
    data, runs = made
    bright = shutil.copytree(data, tmp_path / "bright")
    described = json.loads((bright / "transforms.json").read_text())
    for frame in described["frames"]:
        frame["exposure"] = 4.0
        image = bright / frame["file_path"]
        pictures.write_exr(image, 4 * pictures.read_exr(image))
    (bright / "transforms.json").write_text(json.dumps(described))
    folder = _relit(tmp_path / "relit", runs[0], bright)
    page = write_report(runs, tmp_path / "report.html", relit=[folder]).read_text()
    truth = pictures.png_data_uri(pictures.tonemap(_truth(0)["render"].astype(np.float32), 1.0))
    assert truth in _section(page, "relit")


def _exported(folder: Path, run: Path, count: int = 2, formats: tuple[str, ...] = ("textures",)):
    """An export of a run with this many materials; the last one is the largest."""
    sheet = np.stack([np.mgrid[0:8, 0:8][1] / 7] * 3, -1)
    rows = []
    for number in range(count):
        names = [f"stone{number}_albedo.exr", f"stone{number}_unobserved.png"]
        _save(folder / "textures" / names[0], sheet)
        pictures.write_png(folder / "textures" / names[1], np.eye(8, dtype=np.uint8) * 255)
        rows.append({
            "name": f"stone{number}{EVIL}", "textures": names, "resolution": 512,
            "unobserved_share": 0.125, "area": number,
        })  # fmt: skip
    found = {
        "format": 1, "run": {"folder": str(run.resolve())}, "formats": formats, "materials": rows,
        "texels_per_unit": 64.0, "unobserved_share": 0.25,
    }  # fmt: skip
    (folder / "export.json").write_text(json.dumps(found))
    return folder


def test_exported_textures_are_sheets(made, tmp_path: Path):
    folder = _exported(tmp_path / "exported", made[1][1], count=13)
    page = write_report(made[1], tmp_path / "report.html", exported=[folder]).read_text()
    section = _section(page, "textures")
    assert 'href="#textures"' in page and EVIL not in section
    assert "direct: 64 texels along a scene unit, 25.0 % of the surface unobserved" in section
    assert section.count("512 × 512 texels, 12.5 % unobserved") == 12
    assert "1 smaller materials are not shown" in section and "stone0" not in section
    assert section.index("stone12") < section.index("stone1&lt;")
    shown = re.findall(r'src="(.*?)"', section)
    assert len(shown) == 24
    sheet = np.stack([np.mgrid[0:8, 0:8][1] / 7] * 3, -1)
    assert shown[0] == pictures.png_data_uri(pictures.tonemap(sheet))
    assert shown[1] == pictures.png_data_uri(np.eye(8, dtype=np.uint8) * 255)


def test_what_was_made_of_another_state_of_a_run_is_told(made, tmp_path: Path):
    run = made[1][0]
    folder = _exported(_relit(tmp_path / "made", run), run)
    for steps, sections in ((200, 0), (100, 1)):
        for name in ("render.json", "export.json"):
            _edit_json(folder / name, run={"folder": str(run.resolve()), "steps": steps})
        page = tmp_path / f"{steps}.html"
        text = write_report(made[1], page, exported=[folder], relit=[folder]).read_text()
        for section in ("relit", "textures"):
            assert _section(text, section).count("made after 100 steps") == sections


def test_the_mean_of_relit_pictures_is_of_those_that_have_a_score(made, tmp_path: Path):
    folder = _relit(tmp_path / "relit", made[1][0])
    _edit_json(folder / "render.json", scored={"render_psnr": 5})
    text = write_report(made[1], tmp_path / "report.html", relit=[folder]).read_text()
    assert "32.50 dB, mean of 5 views; SSIM" in _section(text, "relit")


def test_relit_pictures_have_their_aligned_score_beside_the_other(made, tmp_path: Path):
    folder = _relit(tmp_path / "relit", made[1][0])
    mean = json.loads((folder / "render.json").read_text())["mean"]
    _edit_json(folder / "render.json", mean=mean | {"render_psnr_aligned": 41.25})
    text = write_report(made[1], tmp_path / "report.html", relit=[folder]).read_text()
    told = "32.50 dB, mean of 6 views; 41.25 dB once aligned in brightness; SSIM"
    assert told in _section(text, "relit")


def test_pictures_keep_their_shape(made, tmp_path: Path):
    """Also where pictures side by side have several; only empty boxes need one of the page."""
    text = write_report(made[1], tmp_path / "report.html").read_text()
    (style,) = re.findall(r"\.zoom img,\.box\{(.*?)\}", text)
    assert "aspect-ratio:auto var(--aspect)" in style.split(";")
    (style,) = re.findall(r"\.layer img\{(.*?)\}", text)
    assert "object-fit:contain" in style.split(";")


def test_large_pictures_of_outliers_are_averaged_down(made, tmp_path: Path):
    run = made[1][0]
    large = np.zeros((900, 1350, 3), np.uint8)
    large[:, :675] = 255
    pictures.write_png(run / "evaluation" / "train" / "train_000_outliers.png", large)
    images = [{"name": "train_000", "share": 0.5}]
    _edit(
        run, lambda m: m.update(outliers={"share": 0.5, "images": images, "shown": ["train_000"]})
    )
    text = _section(write_report([run], tmp_path / "report.html").read_text(), "outliers")
    (shown,) = re.findall(r'src="(.*?)"', text)
    assert shown == pictures.png_data_uri(large[::3, ::3])


def test_folders_of_runs_that_were_moved_are_known_by_name(made, tmp_path: Path):
    folder = _relit(tmp_path / "relit", tmp_path / "elsewhere" / "ours")
    text = write_report(made[1], tmp_path / "report.html", relit=[folder]).read_text()
    assert "Relit, ours" in text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda folder: (folder / "render.json").unlink(), r"render\.json.*unbake relight"),
        (lambda folder: _edit_json(folder / "render.json", run={}), r"render\.json: names no run"),
        (
            lambda folder: _edit_json(folder / "render.json", run={"folder": str(folder)}),
            "made of another run",
        ),
        (lambda folder: _edit_json(folder / "render.json", frames=3), r"render\.json: cannot be"),
        (
            lambda folder: _edit_json(folder / "render.json", frames=[{"name": "../x"}]),
            r"render\.json: cannot be read",
        ),
        (
            lambda folder: _edit_json(folder / "render.json", settings={"exposure": 10**400}),
            r"render\.json: cannot be read",
        ),
        (
            lambda folder: _edit_json(folder / "render.json", settings={"exposure": 1e308}),
            r"render\.json: cannot be read",
        ),
        (
            lambda folder: _edit_json(folder / "export.json", texels_per_unit=[1]),
            r"export\.json: cannot be read",
        ),
        (lambda folder: (folder / "train_000.exr").unlink(), r"train_000\.exr.*does not exist"),
        (lambda folder: (folder / "export.json").unlink(), r"export\.json.*--format textures"),
        (lambda folder: _edit_json(folder / "export.json", formats=["gltf"]), "holds no textures"),
        (lambda folder: _edit_json(folder / "export.json", materials=[1]), "cannot be read"),
        (lambda folder: _edit_json(folder / "export.json", format=99), "newer unbake"),
    ],
)
def test_folders_that_cannot_be_shown_are_named(made, tmp_path: Path, change, said: str):
    folder = _exported(_relit(tmp_path / "made", made[1][0]), made[1][0])
    change(folder)
    with pytest.raises(UserError, match=said):
        write_report(made[1], tmp_path / "report.html", exported=[folder], relit=[folder])
    assert not list(tmp_path.glob("*.html*"))


def test_what_failed_is_told_and_cannot_inject_markup(made, tmp_path: Path):
    page = tmp_path / "report.html"
    text = write_report(made[1], page, {"ad-pt": f"out of memory {EVIL}"}).read_text()
    assert "ad-pt failed: out of memory" in _words(text)
    boxes = text.count('<div class="box empty failed">failed</div>')
    assert boxes == 3 * 6 and '<figcaption title="ad-pt">' in text  # of each view and quantity
    assert _Page(text).count("script") == 1


#: What a reader does: another quantity, a drag of the line, the wheel; each is written down.
_READER = """<script>
const told = [], stage = document.querySelector(".stage");
const [under, over] = stage.querySelectorAll("img");
const box = stage.getBoundingClientRect(), quantity = document.querySelector("[data-of=quantity]");
told.push(document.querySelector(".compare").hidden, over.alt, under.alt);
quantity.value = "Albedo"; quantity.dispatchEvent(new Event("change"));
told.push(over.alt, under.alt);
const at = {clientX: box.left + box.width / 4, clientY: box.top + box.height / 2, bubbles: true};
try { stage.dispatchEvent(new PointerEvent("pointerdown", at)); } catch {}
told.push(stage.style.getPropertyValue("--at"));
stage.dispatchEvent(new WheelEvent("wheel", {...at, deltaY: -400, cancelable: true}));
const moved = over.style.transform;
told.push(moved === under.style.transform && moved.includes("scale(2.7"));
stage.dispatchEvent(new MouseEvent("dblclick"));
told.push(over.style.transform.includes("scale(1)"));
document.querySelector(".zoom").click(); told.push(document.getElementById("zoom").open);
document.body.dataset.told = JSON.stringify(told);
</script>"""


@pytest.mark.skipif(found_browser() is None, reason=f"needs one of {BROWSERS}")
def test_a_browser_compares_pictures_and_enlarges_them(made, tmp_path: Path):
    page = write_report(made[1], tmp_path / "report.html")
    page.write_text(page.read_text().replace("</body>", f"{_READER}</body>"))
    words = [found_browser(), "--headless", "--no-sandbox", "--disable-gpu"]
    words += ["--window-size=1000,800"]
    words += [f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", page.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    (body,) = [a for name, a in _Page(done.stdout).tags if name == "body"]
    assert json.loads(body["data-told"] or "[]") == [
        False, "Rendering, photograph, view heldout_000", "Rendering, ours, view heldout_000",
        "Albedo, ground truth, view heldout_000", "Albedo, ours, view heldout_000",
        "25%", True, True, True,
    ]  # fmt: skip


def _edit(run: Path, change: Callable[[dict], object]) -> None:
    path = run / "evaluation" / "metrics.json"
    metrics = json.loads(path.read_text())
    change(metrics)
    path.write_text(json.dumps(metrics))


def _edit_json(file: Path, **changes: object) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def _painted(monkeypatch) -> list[tuple[np.ndarray, np.ndarray]]:
    """Gets the values and the mask of each error picture that is painted from now on."""
    painted, paint = [], display.painted

    def kept(values, scale, mask):
        painted.append((values, mask))
        return paint(values, scale, mask)

    monkeypatch.setattr(display, "painted", kept)
    return painted


def _edit_data(data: Path, **changes: object) -> None:
    _edit_json(data / "transforms.json", **changes)


def _remove(path: str) -> Callable[[Path, list[Path]], None]:
    def change(data: Path, runs: list[Path]) -> None:
        (data.parent / path).unlink()

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (_remove("runs/ours/evaluation/metrics.json"), r"metrics\.json.*unbake evaluate \S*ours"),
        (_remove("runs/ours/config.toml"), r"config\.toml"),
        (_remove("runs/ours/log.jsonl"), r"log\.jsonl"),
        (_remove("runs/ours/evaluation/heldout/heldout_001_albedo.exr"), r"heldout_001_albedo"),
        (_remove("room/images/heldout_001.exr"), r"heldout_001\.exr.*the image does not exist"),
        (_remove("room/transforms.json"), r"room: no transforms\.json"),
        (
            lambda data, runs: data.rename(data.with_name("moved")),
            r"data .* gone .*room.*fit DATA --out \S*ours --resume; then unbake evaluate \S*ours",
        ),
        (lambda data, runs: _edit(runs[1], lambda m: m.update(data="/")), "other data"),
        (lambda data, runs: _edit(runs[1], lambda m: m.pop("per_view")), "`per_view`"),
        (
            lambda data, runs: _edit(runs[1], lambda m: m["per_view"][0].update(name="x")),
            "no view named x",
        ),
        (
            lambda data, runs: _save(
                runs[0] / "evaluation/train/train_000_render.exr", np.zeros((3, 3, 3))
            ),
            "3 x 3 pixels",
        ),
        (
            lambda data, runs: (runs[0] / "log.jsonl").write_text('{"st\n{"step": 1}\n'),
            "line 1 is not JSON",
        ),
        (
            lambda data, runs: _edit_data(data, frames=[{"file_path": "../../x.exr"}]),
            "lies outside the data folder",
        ),
        (lambda data, runs: _edit_data(data, frames=[1]), "frame 0: the frame is not an object"),
        (lambda data, runs: _edit_data(data, frames={}), "'frames' is not a list"),
        (lambda data, runs: _edit(runs[0], lambda m: m["per_view"].append({})), "has no name"),
        (
            lambda data, runs: _edit(runs[0], lambda m: m.update(unknown="lighting")),
            r"environment\.exr.*picture is gone.*unbake evaluate \S*ours",
        ),
        (
            lambda data, runs: (
                _optimize_environment(runs[0], 0.1),
                _save(data / "truth" / "environment.exr", np.zeros((2, 4, 4))),
            ),
            r"truth/environment\.exr",
        ),
        (
            lambda data, runs: (
                _optimize_environment(runs[0], 0.1),
                _save(data / "truth" / "environment.exr", _environment(), np.ones((128, 256))),
                _save(runs[0] / "evaluation" / "environment.exr", np.zeros((2, 4, 3))),
            ),
            r"ours/evaluation/environment\.exr.*4 x 2 pixels",
        ),
        (lambda data, runs: _edit(runs[0], lambda m: m.update(environment=[])), "`environment` is"),
        (lambda data, runs: _edit(runs[0], lambda m: m.update(emission=[{}])), "has no name"),
        (
            lambda data, runs: _edit(runs[0], lambda m: m.update(unknown="emission")),
            "`emission` has no light",
        ),
        (lambda data, runs: runs.append(runs[0]), "given twice"),
        (lambda data, runs: runs.clear(), "at least one run"),
    ],
)
def test_what_is_missing_is_named(made, tmp_path: Path, change, said: str):
    data, runs = made
    change(data, runs)
    with pytest.raises(UserError, match=said):
        write_report(runs, tmp_path / "report.html")
    assert not list(tmp_path.glob("*.html*"))


# ------------------------------------------------------------------------------------------- curves


def _drawn(figure) -> tuple[list, list]:
    """The curves and the bands of a chart."""
    (axes,) = figure.axes
    curves = [line for line in axes.lines if (line.get_gid() or "").startswith("run-")]
    return curves, list(axes.collections)


def test_a_resumed_log_draws_each_step_once_and_in_order():
    log = [{"step": s, "v": v} for s, v in ((0, 1.0), (10, 2.0), (5, 3.0), (10, 4.0))]
    log += [{"step": 11, "v": math.nan}, {"step": 12}, {"step": 13, "v": None}]
    figure = charts.chart([log], "step", "step", lambda r: r.get("v"), False)
    assert figure is not None
    (curve,), bands = _drawn(figure)
    assert curve.get_xydata().tolist() == [[0, 1], [5, 3], [10, 4]] and not bands


def test_many_points_are_summarised_with_a_band_inside_the_chart():
    rng = np.random.default_rng(0)
    log = [{"step": s, "v": float(v)} for s, v in enumerate(rng.lognormal(0, 1, 5000))]
    figure = charts.chart([log, []], "step", "step", lambda r: r["v"], True)
    assert figure is not None
    (curve,), (band,) = _drawn(figure)
    x, y = curve.get_xydata().T
    assert len(x) == charts.BINS
    # Of a log-normal distribution with σ = 1: the mean, the 10th and the 90th percentile.
    np.testing.assert_allclose(np.log(y), 0.5, atol=0.8)
    np.testing.assert_allclose(np.log(y.mean()), 0.5, atol=0.1)
    edges = np.log(band.get_paths()[0].vertices[:, 1])
    assert np.mean(edges[edges < 0]) == pytest.approx(-1.28, abs=0.1)
    assert np.mean(edges[edges > 0]) == pytest.approx(1.28, abs=0.1)
    (axes,) = figure.axes
    (left, right), (low, high) = axes.get_xlim(), np.log(axes.get_ylim())
    assert left <= x.min() and x.max() <= right
    assert low <= edges.min() and edges.max() <= high and high - low < 1.2 * np.ptp(edges)
    assert axes.get_yscale() == "log" and len(_ticks(axes.yaxis)) > 1


def _ticks(axis) -> list[str]:
    """The labels of an axis that are seen."""
    low, high = axis.get_view_interval()
    places = zip(axis.get_ticklocs(), axis.get_ticklabels(), strict=True)
    return [label.get_text() for at, label in places if low <= at <= high]


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("values", [[5.0], [2.0, 2.0], [1e-9, 1e9], [0.3, 0.31], [1234567.0, 2.0]])
def test_axes_have_ticks_for_any_range(values: list[float], logarithmic: bool):
    log = [{"step": i, "v": v} for i, v in enumerate(values)]
    figure = charts.chart([log], "step", "step", lambda r: r["v"], logarithmic)
    assert figure is not None
    figure.draw_without_rendering()
    (axes,) = figure.axes
    for ticks in (_ticks(axes.xaxis), _ticks(axes.yaxis)):
        assert 2 <= len(ticks) <= 14
        assert len(set(ticks)) == len(ticks) and all(ticks)


def test_noise_below_zero_does_not_raise_the_curve_of_a_loss():
    """Products of independent errors have no bias, and are below zero at times."""
    rng = np.random.default_rng(0)
    values = 0.1 + 0.5 * rng.standard_normal(12_000)
    values[:100] -= 10.0  # a whole interval
    log = [{"step": s, "v": float(v)} for s, v in enumerate(values)]
    figure = charts.chart([log], "step", "step", lambda r: r["v"], True)
    assert figure is not None
    (curve,), (band,) = _drawn(figure)
    _, y = curve.get_xydata().T
    lost, count = charts.not_positive([log], "step", lambda r: r["v"])[0]
    assert count == charts.BINS and len(y) == count - lost and 1 <= lost < 20
    assert y.mean() == pytest.approx(0.1, abs=0.02)
    figure.draw_without_rendering()
    assert band.get_paths()[0].vertices[:, 1].min() > 0


def test_what_is_not_positive_is_counted_below_the_chart(made, tmp_path: Path):
    log = made[1][0] / "log.jsonl"
    lines = [{"step": s, "seconds": s, "photometric": 0.5 - (s == 2)} for s in range(4)]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    text = write_report(made[1], tmp_path / "report.html").read_text()
    assert text.count("Not positive, left out: ours 1 of 4") == 2  # over steps, over seconds


def test_a_chart_of_nothing_that_is_positive_says_so(made, tmp_path: Path):
    log = made[1][0] / "log.jsonl"
    lines = [{"step": s, "seconds": s, "photometric": -0.5} for s in range(4)]
    log.write_text("".join(json.dumps(line) + "\n" for line in lines))
    text = write_report(made[1][:1], tmp_path / "report.html").read_text()
    assert text.count("Not positive, left out: ours 4 of 4") == 2
    assert text.count("<b>Photometric loss</b>") == 2
    assert "<title>Photometric loss over" not in text and ">None<" not in text


def test_a_term_that_no_run_has_draws_no_chart():
    assert charts.chart([[{"step": 1, "v": 0.0}]], "step", "step", lambda r: r["v"], True) is None


def test_an_embedded_chart_takes_colours_and_fonts_from_the_page():
    """Ten runs: eight colours of the legend, then the same ones dashed. Names are no markup."""
    logs = [[{"step": s, "v": 1.5 + run + s} for s in range(200)] for run in range(10)]
    figure = charts.chart(logs, "step", "step", lambda r: r["v"], True)
    names = [f"{EVIL}{run}" for run in range(10)]
    svg = charts.inline_svg(figure, "Loss over step", names)
    assert svg == charts.inline_svg(figure, "Loss over step", names)
    root = ElementTree.fromstring(svg)
    assert root.tag == "svg" and root.find("title").text == "Loss over step"
    told = {
        group.find("title").text: group for group in root.iter("g") if len(group.findall("title"))
    }
    assert list(told) == names
    for run, name in enumerate(names):
        style = told[name].find("path").get("style")
        assert f"stroke: var(--c{run % 8})" in style and ("dasharray" in style) == (run >= 8)
    assert {t.text for t in root.iter("text")} >= {"step", "0", "50", "10", "100"}
    assert not re.search("#[0-9a-f]{6}|font|url|://|<style|<metadata", svg)


def test_charts_do_not_follow_the_matplotlib_configuration_of_a_user():
    import matplotlib

    log = [{"step": s, "v": s} for s in range(9)]
    texts = []
    for changes in ({}, {"axes.facecolor": "red", "lines.linewidth": 9, "svg.fonttype": "path"}):
        with matplotlib.rc_context(changes):
            figure = charts.chart([log], "step", "step", lambda r: r["v"], False)
            texts.append(charts.inline_svg(figure, "t", ["a"]))
            assert not changes or matplotlib.rcParams["lines.linewidth"] == 9
    assert texts[0] == texts[1]


def test_matplotlib_is_imported_by_drawing_alone():
    code = "import sys, unbake.cli, unbake.report.page; print('matplotlib' in sys.modules)"
    source = {"PYTHONPATH": str(Path(charts.__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | source, capture_output=True, text=True
    )
    assert done.stdout.split() == ["False"]


def _took(run: Path, *machines: dict[str, Any]) -> None:
    """Write down that these machines took the steps of a run."""
    origin = {"format": 2, "data": "room", "mean_radiance": 1.0, "clip_negative": False}
    (run / "origin.json").write_text(json.dumps(origin | {"machines": machines}))


def test_times_of_several_machines_are_not_ranked(made, tmp_path: Path):
    _score(made[1][0], {0: 10.0, 40: 30.0, 80: 31.0})
    _score(made[1][1], {0: 10.0, 40: 20.0})
    one = {"processor": "A", "cores": 4, "threads": 4}
    for others, apart in (
        ((one,), False),
        (({"processor": "A", "cores": 4},), False),  # of a version that did not count threads
        ((one | {"threads": 2},), True),
        ((one, one | {"processor": "B"}), True),
    ):
        _took(made[1][0], one)
        _took(made[1][1], *others)
        text = write_report(made[1], tmp_path / "report.html").read_text()
        race = text.split("<h3>Time to quality</h3>")[1].split("<h3>")[0]
        assert ('class="n best"' in race) != apart and ("Bold: the first" in race) != apart
        assert ("several machines or numbers of threads" in race) == apart
        assert ("on several machines" in _section(text, "numbers")) == apart


def test_scores_of_other_renderings_are_not_ranked(made, tmp_path: Path):
    """Those of materials are."""
    _liken(made[1][0], 0.9514, 0.1)
    _liken(made[1][1], 0.5, 0.2)
    for spp, alike in ((64, True), (4, False)):
        _edit(made[1][1], lambda m, n=spp: m["render"].update(spp=n))
        text = write_report(made[1], tmp_path / "report.html").read_text()
        numbers = _section(text, "numbers")
        assert numbers.count("other samples or path depths") == (not alike)
        assert ("cannot be compared: evaluate all alike" in numbers) != alike
        scores, similar = (part.split("</table>")[0] for part in numbers.split("<table")[1:3])
        assert scores.count(" best") == 2 * (2 + alike) and similar.count(" best") == 4 * alike
        views = HELDOUT + 4
        assert text.count('class="number best"') == views * (2 + alike)


def test_commands_of_the_page_are_quoted(made, tmp_path: Path):
    spaced = shutil.move(made[1][0], made[1][0].with_name("my run"))
    _edit(Path(spaced), lambda metrics: metrics.update(data=str(tmp_path / "gone")))
    with pytest.raises(UserError, match=r"--out '[^']*/my run' --resume; then .* '[^']*/my run'$"):
        write_report([spaced], tmp_path / "report.html")
