"""One self-contained HTML page that compares runs on the same data: numbers, pictures, curves."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import jinja2
import numpy as np

from unbake.errors import UserError
from unbake.imaging import pictures
from unbake.results import curves
from unbake.results.runs import Run, View, data_folder, labels, read_json, read_run, read_views

TEMPLATE = Path(__file__).with_name("report.html.jinja")
LONGEST_SIDE = 640  # pixels of an embedded picture: keeps a page of 24 views near 50 MB
SPLITS = ("heldout", "train")
QUANTITIES = ("render", "albedo", "roughness")
LOSSES = {"photometric": "Photometric loss", "prior": "Prior loss", "lhs": "LHS loss"}
VALIDATION = {"albedo_psnr": "Albedo PSNR", "roughness_psnr": "Roughness PSNR"}
AXES = {"step": "step", "seconds": "training time, seconds"}  # key in the log: title of the axis


@final
@dataclass(frozen=True)
class Display:
    """How values become colours, the same for every run and view, so that they compare."""

    exposure: float  # stops
    error: dict[str, float]  # the brightest colour, a quantity


def write_report(runs: Sequence[Path], out: Path) -> Path:
    """Write one HTML page that compares evaluated runs with the ground truth and each other.

    The page holds its pictures, styles and script itself and loads nothing from anywhere.
    Pictures of renderings and albedo are linear RGB seen through the sRGB curve; roughness is shown
    without a curve. Larger pictures than 640 pixels are averaged down; PSNRs are those of
    `evaluation/metrics.json`, from full resolution.

    Args:
        runs: run folders, all evaluated on the same data.
        out: the page's file; it appears complete or not at all.

    Returns:
        `out`.

    Raises:
        UserError: a run was not evaluated, runs differ in data, or a file is gone or malformed.
    """
    if not runs:
        raise UserError("a report needs at least one run")
    loaded = [read_run(path, label) for path, label in labels(runs)]
    data = data_folder(loaded)
    transforms = read_json(data / "transforms.json", "Give back the data that the run was fit to")
    views = read_views(data, transforms, loaded)
    display = _display(loaded, views)
    groups = [
        {
            "split": split,
            "total": sum(frame.get("split") == split for frame in transforms["frames"]),
            "views": [_view_block(view, loaded, display) for view in views if view.split == split],
        }
        for split in SPLITS
    ]
    page = (
        _environment()
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            scene=data.name,
            transforms=transforms,
            runs=loaded,
            rows=_table(loaded),
            groups=groups,
            display=display,
            longest=LONGEST_SIDE,
            magma=pictures.MAGMA,
            chart=curves,
            losses=_loss_charts(loaded),
            validation=_validation_charts(loaded),
            validated=sorted(
                {r["split"] for log in _validations(loaded) for r in log if "split" in r}
            ),
            settings=_settings(loaded),
            definitions=_definitions(loaded),
        )
    )
    out = Path(out)
    pictures.write_atomically(out, lambda path: path.write_text(page, encoding="utf-8"))
    return out


# ----------------------------------------------------------------------------------------- pictures


def _rgb(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) linear RGB and (H, W) bool, True where alpha (if any) is at least one half."""
    pixels = pictures.read_exr(path)
    if pixels.shape[2] < 3:
        pixels = pixels[..., :1].repeat(3, axis=2)
    mask = pixels[..., 3] >= 0.5 if pixels.shape[2] > 3 else np.ones(pixels.shape[:2], bool)
    return pixels[..., :3], mask


def _recovered(run: Run, view: View, quantity: str) -> Path | None:
    """Where a run's picture of a view lies; None where it was not evaluated on that view."""
    if not run.view(view.name):
        return None
    path = run.path / "evaluation" / view.split / f"{view.name}_{quantity}.exr"
    if not path.is_file():
        raise UserError(
            "an evaluated picture is gone", path, f"Run `unbake evaluate {run.path}` again"
        )
    return path


def _error(image: np.ndarray, reference: np.ndarray, path: Path) -> np.ndarray:
    if image.shape != reference.shape:
        raise UserError(
            f"the picture has {image.shape[1]} x {image.shape[0]} pixels, "
            f"its ground truth {reference.shape[1]} x {reference.shape[0]}",
            path,
            "Evaluate the run again",
        )
    return pictures.absolute_error(image, reference)


def _display(runs: list[Run], views: list[View]) -> Display:
    """Exposure and error scales that suit all pictures of the page at once.

    The exposure brings the ground truth's 95th percentile to 0.8, in half stops. The scale of an
    error is rounded up to 1, 2 or 5 times 10^n from the best run's 97th percentile, so that a bad
    run does not turn all others black.
    """
    light: list[np.ndarray] = []
    errors: dict[str, list[list[np.ndarray]]] = {q: [[] for _ in runs] for q in QUANTITIES}
    for view in views:
        for quantity, path in view.truth.items():
            reference, mask = _rgb(path)
            if quantity == "render":
                light.append(_sample(reference.mean(axis=2)[mask]))
            for run, parts in zip(runs, errors[quantity], strict=True):
                recovered = _recovered(run, view, quantity)
                if recovered is not None:
                    error = _error(_rgb(recovered)[0], reference, recovered)
                    parts.append(_sample(error[mask]))
    bright = _percentile(light, 95)
    exposure = round(2 * math.log2(0.8 / bright)) / 2 if bright > 0 else 0.0
    return Display(exposure, {quantity: _error_scale(errors[quantity]) for quantity in QUANTITIES})


def _error_scale(errors: list[list[np.ndarray]]) -> float:
    high = np.array([_percentile(parts, 97) for parts in errors])
    high = high[high > 1e-6]  # a run that agrees up to rounding needs no scale
    return _round_up(float(high.min())) if len(high) else 0.01


def _sample(values: np.ndarray, limit: int = 4096) -> np.ndarray:
    values = values[np.isfinite(values)]
    return values[:: max(1, len(values) // limit)]


def _percentile(parts: list[np.ndarray], percent: float) -> float:
    values = np.concatenate([np.zeros(0), *parts])
    return float(np.percentile(values, percent)) if len(values) else 0.0


def _round_up(value: float) -> float:
    decade = 10.0 ** math.floor(math.log10(value))
    return next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * (1 - 1e-9))


def _view_block(view: View, runs: list[Run], display: Display) -> dict[str, Any]:
    """A view's pictures for the template: a column a quantity, in it truth and runs."""
    height, width = _rgb(view.truth["render"])[0].shape[:2]
    columns = [_column(view, runs, quantity, display) for quantity in QUANTITIES]
    return {"name": view.name, "width": width, "height": height, "columns": columns}


def _column(view: View, runs: list[Run], quantity: str, display: Display) -> dict[str, Any]:
    def paint(linear: np.ndarray) -> str:
        small = pictures.shrink(linear, LONGEST_SIDE)
        if quantity == "roughness":
            return pictures.png_data_uri(pictures.to_bytes(small))
        exposure = display.exposure if quantity == "render" else 0.0
        return pictures.png_data_uri(pictures.tonemap(small, exposure))

    values = [_number(run.view(view.name).get(f"{quantity}_psnr")) for run in runs]
    best = _best(values)
    reference, mask = _rgb(view.truth[quantity]) if quantity in view.truth else (None, None)
    cells = []
    for run, value in zip(runs, values, strict=True):
        path = _recovered(run, view, quantity)
        cell: dict[str, Any] = {"picture": None, "error": None}
        if path is not None:
            image = _rgb(path)[0]
            cell["picture"] = paint(image)
            if reference is not None and mask is not None:
                error = pictures.shrink(_error(image, reference, path), LONGEST_SIDE)
                inside = pictures.shrink(mask, LONGEST_SIDE) >= 0.5
                cell["error"] = pictures.png_data_uri(
                    pictures.false_colour(error, display.error[quantity], inside)
                )
        cells.append(cell | {"psnr": _decibels(value), "best": value is not None and value == best})
    truth = None if reference is None else paint(reference)
    return {"quantity": quantity, "truth": truth, "cells": cells}


# ------------------------------------------------------------------------------------------ numbers


def _number(value: object) -> float | None:
    """A number that can be shown, or None for null and not-a-number."""
    good = isinstance(value, int | float) and not math.isnan(value)
    return float(value) if good else None


def _best(values: Iterable[float | None]) -> float | None:
    """The highest value, or None where there is nothing to choose between."""
    known = [value for value in values if value is not None]
    return max(known) if len(known) > 1 else None


def _decibels(value: float | None) -> str:
    if value is None:
        return "—"
    text = "∞" if math.isinf(value) else f"{abs(value):.2f}"
    return f"−{text}" if value < 0 else text


def _table(runs: list[Run]) -> list[dict[str, Any]]:
    """One row a run: for each split and quantity its mean PSNR, the best of each column marked."""
    keys = [(split, f"{quantity}_psnr") for split in SPLITS for quantity in QUANTITIES]
    cells: list[list[dict[str, Any]]] = [[] for _ in runs]
    for split, key in keys:
        values = [_number((run.metrics.get(split) or {}).get(key)) for run in runs]
        best = _best(values)
        for row, value in zip(cells, values, strict=True):
            row.append({"text": _decibels(value), "best": value is not None and value == best})
    return [
        {
            "run": run,
            "steps": _count(run.metrics.get("steps")),
            "samples": _count(run.metrics.get("samples")),
            "seconds": _seconds(run.metrics.get("seconds")),
            "cells": row,
        }
        for run, row in zip(runs, cells, strict=True)
    ]


def _count(value: object) -> str:
    number = _number(value)
    if number is None:
        return "—"
    for unit, size in (("G", 1e9), ("M", 1e6)):
        if number >= size:
            return f"{number / size:.3g}\N{NO-BREAK SPACE}{unit}"
    return f"{number:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _seconds(value: object) -> str:
    number = _number(value)
    if number is None:
        return "—"
    return f"{number:.1f}" if number < 100 else _count(round(number))


def _definitions(runs: list[Run]) -> list[dict[str, Any]]:
    """What the numbers mean, as each evaluation says; one entry for runs that say the same."""
    entries: list[dict[str, Any]] = []
    for run in runs:
        said = {
            "definitions": run.metrics.get("definitions") or {},
            "render": run.metrics.get("render") or {},
        }
        same = next((e for e in entries if all(e[key] == said[key] for key in said)), None)
        if same is None:
            entries.append(said | {"labels": [run.label]})
        else:
            same["labels"].append(run.label)
    return entries


def _settings(runs: list[Run]) -> dict[str, list[tuple[str, list[str]]]]:
    """Settings that differ between runs, and those that all share."""
    keys = list(dict.fromkeys(key for run in runs for key in run.config))
    rows = [(key, [_setting(run.config.get(key)) for run in runs]) for key in keys]
    return {
        "differing": [row for row in rows if len(set(row[1])) > 1],
        "shared": [row for row in rows if len(set(row[1])) == 1],
    }


def _setting(value: object) -> str:
    if value is None:
        return "—"
    return str(value).lower() if isinstance(value, bool) else str(value)


# ------------------------------------------------------------------------------------------- curves


def _loss_charts(runs: list[Run]) -> list[dict[str, Any]]:
    logs = [run.log for run in runs]
    return [
        {"title": title, "unit": "relative L2, no unit", "chart": drawn}
        for x_key, x_title in AXES.items()
        for key, title in LOSSES.items()
        if (drawn := curves.chart(logs, x_key, x_title, lambda r, k=key: r.get(k), True))
    ]


def _validation_charts(runs: list[Run]) -> list[dict[str, Any]]:
    logs = _validations(runs)
    return [
        {"title": title, "unit": "dB", "chart": drawn}
        for x_key, x_title in AXES.items()
        for key, title in VALIDATION.items()
        if (drawn := curves.chart(logs, x_key, x_title, lambda r, k=key: r.get(k), False))
    ]


def _validations(runs: list[Run]) -> list[list[dict[str, Any]]]:
    """For each run its log records that hold a validation, with its numbers lifted up."""
    return [[r | r["validation"] for r in run.log if r.get("validation")] for run in runs]


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
