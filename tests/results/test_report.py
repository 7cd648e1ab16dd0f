"""The report: complete, self-contained, safe, and clear about what is missing."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from unbake.errors import UserError
from unbake.imaging import pictures
from unbake.results import curves
from unbake.results.report import write_report

SIZE = (24, 32)
TRAINING, HELDOUT = 6, 2
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
        frames.append({"file_path": f"images/{name}.exr", "split": split})
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
    assert "40.00" in text and "20.00" in text and "1.64\N{NO-BREAK SPACE}M" in text
    assert '<td class="n best first">40.00</td>' in text
    assert "10 log10(1/MSE)" in text


def test_the_settings_that_differ_stand_out(made, tmp_path: Path):
    text = write_report(made[1], tmp_path / "report.html").read_text()
    differing, shared = text.split("What differs between the runs.")[1].split("<details>")
    assert "method" in differing and "steps" not in differing
    assert "radiance.width" in shared and "<td>true</td>" in shared


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


def test_photographs_without_truth_are_shown_as_recovered(tmp_path: Path):
    data = _make_data(tmp_path / "photos", known=False)
    run = _make_run(tmp_path / "run", data, "ours", 0.1, known=False)
    text = write_report([run], tmp_path / "report.html").read_text()
    images = [alt for alt in _Page(text).images() if "heldout_000" in alt]
    assert len(images) == 3 + 1 + 1
    assert "no ground truth" in text and '<td class="n">—</td>' in text


def test_a_relative_data_path_starts_at_the_run(made, tmp_path: Path):
    _edit(made[1][0], lambda metrics: metrics.update(data="../../room"))
    assert write_report(made[1], tmp_path / "report.html").is_file()


def test_runs_of_the_same_name_are_told_apart(made, tmp_path: Path):
    twin = _make_run(tmp_path / "older" / "ours", made[0], "ours", 0.2)
    text = write_report([made[1][0], twin], tmp_path / "report.html").read_text()
    assert "runs/ours" in text and "older/ours" in text


def _edit(run: Path, change: Callable[[dict], object]) -> None:
    path = run / "evaluation" / "metrics.json"
    metrics = json.loads(path.read_text())
    change(metrics)
    path.write_text(json.dumps(metrics))


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
        (_remove("room/images/heldout_001.exr"), r"heldout_001\.exr.*no such picture"),
        (_remove("room/transforms.json"), r"transforms\.json"),
        (lambda data, runs: data.rename(data.with_name("moved")), "data .* gone .*room"),
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
            lambda data, runs: (data / "transforms.json").write_text(
                '{"frames": [{"file_path": "../../x.exr"}]}'
            ),
            "does not lie inside",
        ),
        (
            lambda data, runs: (data / "transforms.json").write_text('{"frames": [1]}'),
            "`frames`",
        ),
        (lambda data, runs: _edit(runs[0], lambda m: m["per_view"].append({})), "has no name"),
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


def test_a_resumed_log_draws_each_step_once_and_in_order():
    log = [{"step": s, "v": v} for s, v in ((0, 1.0), (10, 2.0), (5, 3.0), (10, 4.0))]
    log += [{"step": 11, "v": math.nan}, {"step": 12}, {"step": 13, "v": None}]
    drawn = curves.chart([log], "step", "step", lambda r: r.get("v"), False)
    assert drawn is not None
    points = re.findall(r"([\d.]+) ([\d.]+)", drawn.lines[0].path)
    across = [float(x) for x, _ in points]
    assert len(points) == 3 and across == sorted(across) and not drawn.lines[0].band


def test_many_points_are_summarised_with_a_band_inside_the_chart():
    rng = np.random.default_rng(0)
    log = [{"step": s, "v": float(v)} for s, v in enumerate(rng.lognormal(0, 2, 5000))]
    drawn = curves.chart([log, []], "step", "step", lambda r: r["v"], True)
    assert drawn is not None and len(drawn.lines) == 1
    line = drawn.lines[0]
    assert line.path.count("L") == curves.BINS - 1
    heights = [float(y) for _, y in re.findall(r"([\d.]+) ([\d.]+)", line.path + line.band)]
    assert curves.TOP <= min(heights) and max(heights) <= curves.BOTTOM
    assert len(drawn.y_ticks) > 1


@pytest.mark.parametrize("logarithmic", [False, True])
@pytest.mark.parametrize("values", [[5.0], [2.0, 2.0], [1e-9, 1e9], [0.3, 0.31], [1234567.0, 2.0]])
def test_axes_have_ticks_for_any_range(values: list[float], logarithmic: bool):
    log = [{"step": i, "v": v} for i, v in enumerate(values)]
    drawn = curves.chart([log], "step", "step", lambda r: r["v"], logarithmic)
    assert drawn is not None
    for ticks in (drawn.x_ticks, drawn.y_ticks):
        assert 2 <= len(ticks) <= 14
        assert len({tick.label for tick in ticks}) == len(ticks)


def test_a_term_that_no_run_has_draws_no_chart():
    assert curves.chart([[{"step": 1, "v": 0.0}]], "step", "step", lambda r: r["v"], True) is None
