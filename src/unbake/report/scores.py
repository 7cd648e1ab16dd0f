"""The page's section on numbers: PSNRs, SSIM and FLIP, and the yardsticks beside them."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

from unbake.quantities import QUANTITIES
from unbake.report import display
from unbake.report.runs import SHOWN_SPLITS, EvaluatedRun
from unbake.report.wording import details, nothing_learned

#: PSNRs: key, quantity and heading.
PSNRS = [("render_psnr", "render", "Rendering")]
for _name, _row in QUANTITIES.items():
    PSNRS.append((f"{_name}_psnr", _name, _row.title))
    if _name == "albedo":
        PSNRS.append(("albedo_psnr_aligned", _name, "Aligned albedo"))
#: Scores of renderings beside PSNR: key, heading, and which is best.
SIMILAR: tuple[tuple[str, str, display.Choice], ...] = (
    ("render_ssim", "SSIM", max),
    ("render_flip", "FLIP", min),
)
#: What results are measured by, in the order of their rows, and what it is called.
YARDSTICKS = {
    "ceiling": "Ceiling",
    "constant": "Constant",
    "untrained": "Untrained",
}


def psnr_columns(runs: list[EvaluatedRun]) -> dict[str, str]:
    """Keys and headings of the columns: quantities that some run optimized, and aligned albedo.

    Materials without a number in any run, as where no truth is known, have none.
    """
    aligned = any("albedo_psnr_aligned" in (run.metrics.get("heldout") or {}) for run in runs)
    return {
        key: heading
        for key, quantity, heading in PSNRS
        if any(run.optimizes(quantity) for run in runs)
        and (aligned or key != "albedo_psnr_aligned")
        and (quantity == "render" or any(_has_number(run, key) for run in runs))
    }


def _has_number(run: EvaluatedRun, key: str) -> bool:
    """Whether a PSNR of any split is a number."""
    return any(
        display.number((run.metrics.get(s) or {}).get(key)) is not None for s in SHOWN_SPLITS
    )


def uneven_splits(runs: list[EvaluatedRun]) -> list[str]:
    """The splits whose means are over other views in some runs than in others."""
    found = []
    for split in SHOWN_SPLITS:
        views = [
            frozenset(row["name"] for row in run.metrics["per_view"] if row.get("split") == split)
            for run in runs
        ]
        found += [split] if len(set(views)) > 1 else []
    return found


def rendered_alike(runs: list[EvaluatedRun]) -> bool:
    """Whether all renderings have as many samples and bounces; fewer cost them decibels."""
    shown = [run.metrics.get("render") for run in runs if _has_number(run, "render_psnr")]
    return all(render == shown[0] for render in shown)


def _marked(
    values: list[float | None],
    write: Callable[[float | None], str],
    choose: display.Choice = max,
    *,
    alike: bool,
) -> list[dict[str, Any]]:
    """Means as text, the best of them marked where all are measured alike."""
    return [
        cell | {"best": cell["best"] and alike} for cell in display.marked(values, write, choose)
    ]


def score_rows(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """One row a run: for each split and quantity its mean PSNR, the best of each column marked."""
    columns, uneven, rendered = [], uneven_splits(runs), rendered_alike(runs)
    for split, key in ((split, key) for split in SHOWN_SPLITS for key in psnr_columns(runs)):
        values = [display.number((run.metrics.get(split) or {}).get(key)) for run in runs]
        tops = [_ceiling(run, key) if split == "heldout" else None for run in runs]
        alike = split not in uneven and (rendered or key != "render_psnr")
        marked = _marked(values, display.decibels, alike=alike)
        columns.append(
            [c | {"gap": _gap(*pair)} for c, *pair in zip(marked, values, tops, strict=True)]
        )
    return [
        {
            "run": run,
            "trouble": nothing_learned(run),
            "method": "untrained" if run.untrained else run.metrics["method"],
            "details": details(run),
            "steps": display.count(run.metrics.get("steps")),
            "samples": display.count(run.metrics.get("samples")),
            "seconds": display.seconds(run.metrics.get("seconds")),
            "cells": row,
        }
        for run, row in zip(runs, zip(*columns, strict=True), strict=True)
    ]


def _ceiling(run: EvaluatedRun, key: str) -> float | None:
    """The ceiling of a score; None also where photographs leave the scale of albedo open."""
    if f"{key}_aligned" in (run.metrics.get("heldout") or {}):
        return None
    found = run.metrics.get("yardsticks") or {}
    return display.number((found.get("ceiling") or {}).get(key))


def _gap(value: float | None, ceiling: float | None) -> str | None:
    """How far a PSNR is from its ceiling, with its sign; None where that is not known."""
    if value is None or ceiling is None:
        return None
    return f"{'−' if value < ceiling else '+'}{abs(value - ceiling):.2f}"


def similar_rows(runs: list[EvaluatedRun]) -> list[tuple[EvaluatedRun, list[dict[str, Any]]]]:
    """One row a run: SSIM and FLIP of each split, the best of each column marked.

    Empty where no run has them, as after an evaluation by an earlier version.
    """
    columns, uneven, rendered = [], uneven_splits(runs), rendered_alike(runs)
    for split, (key, _, choose) in product(SHOWN_SPLITS, SIMILAR):
        values = [display.number((run.metrics.get(split) or {}).get(key)) for run in runs]
        alike = rendered and split not in uneven
        columns.append(_marked(values, display.fraction, choose, alike=alike))
    if all(cell["text"] == display.DASH for column in columns for cell in column):
        return []
    return [(run, list(row)) for run, row in zip(runs, zip(*columns, strict=True), strict=True)]


def yardstick_rows(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """A row for each yardstick: its PSNRs of held-out views, and the runs it is of if not all.

    Fields before their first step have no row where there is a run of them.
    """
    rows: list[dict[str, Any]] = []
    for kind in YARDSTICKS:
        if kind == "untrained" and any(run.untrained for run in runs):
            continue
        for run in runs:
            scores = (run.metrics.get("yardsticks") or {}).get(kind) or {}
            values = [display.number(scores.get(key)) for key in psnr_columns(runs)]
            if all(value is None for value in values):
                continue
            same = next((r for r in rows if (r["kind"], r["values"]) == (kind, values)), None)
            if same is None:
                cells = ["" if v is None else display.decibels(v) for v in values]
                same = {"kind": kind, "values": values, "cells": cells, "labels": []}
                rows.append(same)
            same["labels"] += [] if run.untrained else [run.label]
    trained = [run.label for run in runs if not run.untrained]
    return [row | {"labels": [] if row["labels"] == trained else row["labels"]} for row in rows]
