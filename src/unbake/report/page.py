"""One self-contained HTML page that compares runs on the same data: numbers, images, charts."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2

from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation.convergence import WINDOW
from unbake.imaging.pictures import MAGMA
from unbake.io import write_text
from unbake.quantities import QUANTITIES
from unbake.report import charts, curves, display, scores, wording
from unbake.report.cameras import camera_section
from unbake.report.definitions import definitions
from unbake.report.lighting import lighting_section
from unbake.report.outliers import outlier_section
from unbake.report.pictures import UNITS, view_groups
from unbake.report.relit import relit_sections
from unbake.report.runs import EvaluatedRun, data_folder, labels, read_run, read_views
from unbake.report.sheets import texture_sections

TEMPLATE = Path(__file__).with_name("report.html.jinja")


def write_report(
    runs: str | Path | Sequence[str | Path],
    out: str | Path,
    failed: Mapping[str, str] | None = None,
    *,
    exported: str | Path | Sequence[str | Path] = (),
    relit: str | Path | Sequence[str | Path] = (),
    allow_outside: bool = False,
) -> Path:
    """Write one HTML page that compares evaluated runs with the ground truth and each other.

    The page contains its images, styles and script and loads nothing from elsewhere.
    Pictures of renderings and colours are linear RGB seen through the sRGB curve; other quantities
    are shown without a curve. Larger pictures than 640 pixels are averaged down; PSNRs are those of
    the evaluation, from full resolution.

    Args:
        runs: run folders, all evaluated on the same data; or one.
        out: the page's file; it appears complete or not at all.
        failed: further runs that failed: name to reason.
        exported: folders of `export`, with textures, whose sheets are shown; or one.
        relit: folders of `relight` or `render`, whose pictures are shown; or one.
        allow_outside: read files of the data set that lie outside of its folder.

    Returns:
        `out`.

    Raises:
        UserError: a run was not evaluated, runs differ in data, a file is gone or malformed, or a
            folder was made of another run.
    """
    out, folders = Path(out), _listed(runs)
    if not folders:
        raise UserError("a report needs at least one run")
    loaded = [read_run(path, label) for path, label in labels(folders)]
    data = data_folder(loaded)
    dataset = Dataset.load(data, allow_outside=allow_outside)
    context = _context(loaded, dataset, _listed(exported), _listed(relit))
    context |= {"scene": data.name, "failed": failed or {}}
    template = _environment().from_string(TEMPLATE.read_text(encoding="utf-8"))
    write_text(out, template.render(context))
    return out


def _listed(folders: str | Path | Sequence[str | Path]) -> list[Path]:
    """One folder or several, as a list."""
    return [Path(x) for x in ([folders] if isinstance(folders, str | os.PathLike) else folders)]


def _context(
    runs: list[EvaluatedRun],
    dataset: Dataset,
    exported: Sequence[Path],
    relit: Sequence[Path],
) -> dict[str, Any]:
    """What the template shows of the runs, by its names."""
    context = _views(runs, dataset)
    context |= _sections(runs, dataset, exported, relit)
    context |= _numbers(runs)
    context |= _words(runs, lit=context["light"] is not None)
    context |= _curves(runs)
    return context | {"dataset": dataset, "runs": runs, "settings": _settings(runs)}


def _views(runs: list[EvaluatedRun], dataset: Dataset) -> dict[str, Any]:
    """Pictures of the views, and what they are drawn with."""
    views = read_views(dataset, runs)
    groups, scales = view_groups(dataset, views, runs)
    return {
        "groups": groups,
        "scales": scales,
        "known": any(name in view.truth for view in views for name in QUANTITIES),
        "units": UNITS,
        "longest": display.LONGEST_SIDE,
        "magma": MAGMA,
    }


def _sections(
    runs: list[EvaluatedRun],
    dataset: Dataset,
    exported: Sequence[Path],
    relit: Sequence[Path],
) -> dict[str, Any]:
    """Sections that only some runs or folders have; each is empty or None without them."""
    return {
        "light": lighting_section(runs, dataset),
        "textures": texture_sections(exported, runs),
        "strips": relit_sections(relit, runs, dataset.allow_outside),
        "cameras": camera_section(runs),
        "outliers": outlier_section(runs),
    }


def _numbers(runs: list[EvaluatedRun]) -> dict[str, Any]:
    """Scores, yardsticks and their definitions."""
    return {
        "psnrs": scores.psnr_columns(runs).values(),
        "rows": scores.score_rows(runs),
        "yardsticks": scores.yardstick_rows(runs),
        "measures": scores.YARDSTICKS,
        "similar": scores.similar_rows(runs),
        "uneven": scores.uneven_splits(runs),
        "rendered_alike": scores.rendered_alike(runs),
        "several_machines": curves.several_machines(runs),
        "definitions": definitions(runs),
    }


def _words(runs: list[EvaluatedRun], *, lit: bool) -> dict[str, Any]:
    """What the page's sentences say of the runs; `lit` is whether some run optimized light."""
    materials = wording.materials(runs)
    colours = ["renderings", *wording.words(materials, "colour")]
    return {
        "optimized": wording.optimized(runs),
        "materials": bool(materials),
        "recovered": wording.listed([*wording.words(materials), *(["light"] if lit else [])]),
        "colours": wording.listed(colours).capitalize(),
        "data": wording.words(materials, "data"),
        "names": wording.NAMES | {"environment": "Environment map"},
        "listed": wording.listed,
    }


def _curves(runs: list[EvaluatedRun]) -> dict[str, Any]:
    """Charts of the logs, and times to a quality."""
    validations = curves.validations(runs)
    return {
        "charts": charts,
        "losses": curves.loss_charts(runs),
        "scores": curves.score_charts(runs),
        "race": curves.race(runs),
        "window": WINDOW,
        "trained": [i for i, run in enumerate(runs) if not run.untrained],
        "validation": curves.validation_charts(runs),
        "validated": sorted({r["split"] for log in validations for r in log if "split" in r}),
    }


def _settings(runs: list[EvaluatedRun]) -> dict[str, list[tuple[str, list[str]]]]:
    """Settings that differ between runs, and those that all share."""
    keys = list(dict.fromkeys(key for run in runs for key in run.config))
    rows = [(key, [_setting(run.setting(key)) for run in runs]) for key in keys]
    return {
        "differing": [row for row in rows if len(set(row[1])) > 1],
        "shared": [row for row in rows if len(set(row[1])) == 1],
    }


def _setting(value: object) -> str:
    if value is None:
        return display.DASH
    return str(value).lower() if isinstance(value, bool) else str(value)


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
