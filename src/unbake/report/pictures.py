"""The page's section on views: pictures and errors of each quantity, on shared scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from unbake.dataset.ground_truth import GroundTruth, counted_pixels
from unbake.dataset.views import Dataset, read_photograph
from unbake.imaging import pictures
from unbake.quantities import QUANTITIES
from unbake.report import display
from unbake.report.runs import SHOWN_SPLITS, EvaluatedRun, ShownView
from unbake.report.scores import rendered_alike
from unbake.report.wording import NAMES, nothing_learned

#: Captions of the scales beside pictures.
UNITS = {"render": "linear radiance", "environment": "linear radiance"} | {
    name: f"{row.title.lower()}, {row.lower:.0f} to {row.upper:.0f}"
    for name, row in QUANTITIES.items()
}


@final
@dataclass(frozen=True)
class Scales:
    """How values become colours, the same for all runs and views."""

    exposure: float  #: stops
    error: dict[str, float]  #: by quantity, the error that has the brightest colour


@final
@dataclass(frozen=True, eq=False)
class _Reference:
    """What a picture is compared with."""

    values: np.ndarray  # (H, W, 3), linear
    counted: np.ndarray  # (H, W) bool: pixels that scores count
    of_material: bool  # also that a run must see a material there, and nothing else


@final
class _Errors:
    """Errors of runs, which get colours once those of all runs and views are known."""

    def __init__(self, runs: int) -> None:
        self._samples: dict[str, list[list[np.ndarray]]] = {
            quantity: [[] for _ in range(runs)] for quantity in NAMES
        }
        self._unpainted: list[tuple[dict[str, Any], str, np.ndarray, np.ndarray]] = []

    def add(
        self, cell: dict[str, Any], run: int, quantity: str, error: np.ndarray, counted: np.ndarray
    ) -> None:
        """Take errors of a view, (H, W), whose picture goes into a cell of the page."""
        self._samples[quantity][run].append(pictures.sample(error[counted]))
        self._unpainted.append((cell, quantity, *display.shrunk(error, counted)))

    def paint(self) -> dict[str, float]:
        """Paint all of them; returns the scale of each quantity."""
        scales = {quantity: display.error_scale(parts) for quantity, parts in self._samples.items()}
        for cell, quantity, error, counted in self._unpainted:
            cell["error"] = display.painted(error, scales[quantity], counted)
        return scales


def view_groups(
    dataset: Dataset, views: Sequence[ShownView], runs: list[EvaluatedRun]
) -> tuple[list[dict[str, Any]], Scales]:
    """The pictures of each split, view by view, and of how many views they are; and their scales.

    Pictures of runs are read once. Photographs are read before, too: their exposure is that of all.
    """
    exposure, errors = _exposure(views), _Errors(len(runs))
    names = {row["name"] for run in runs for row in run.metrics["per_view"]}
    groups = []
    for split in SHOWN_SPLITS:
        every = [view.name for view in dataset.views if view.split == split]
        blocks = [
            _view_block(view, runs, exposure, errors) for view in views if view.split == split
        ]
        # Training views were chosen so by the evaluation.
        spaced = split == "train" or len(blocks) < len(names.intersection(every))
        groups.append({"split": split, "total": len(every), "views": blocks, "spaced": spaced})
    scales = errors.paint()
    for block in (column for g in groups for view in g["views"] for column in view["columns"]):
        block["scale"] = scales[block["quantity"]]
    return groups, Scales(exposure, scales)


def _exposure(views: Sequence[ShownView]) -> float:
    """The exposure in stops that suits the photographs of views, where these count."""
    radiance = []
    for view in views:
        render = _references(view)["render"]
        radiance.append(pictures.sample(render.values.mean(axis=2)[render.counted]))
    return pictures.fitting_exposure(radiance)


def _view_block(
    view: ShownView, runs: list[EvaluatedRun], exposure: float, errors: _Errors
) -> dict[str, Any]:
    """A view's images for the template: a column a quantity with truth and runs."""
    references = _references(view)
    height, width = references["render"].values.shape[:2]
    quantities = [q for q in NAMES if any(run.optimizes(q) for run in runs)]
    columns = [_column(view, runs, q, references.get(q), exposure, errors) for q in quantities]
    return {"name": view.name, "width": width, "height": height, "columns": columns}


def _column(
    view: ShownView,
    runs: list[EvaluatedRun],
    quantity: str,
    truth: _Reference | None,
    exposure: float,
    errors: _Errors,
) -> dict[str, Any]:
    """A quantity of a view: its truth, and a cell a run with its picture, error and PSNR.

    Errors go to `errors`, and have no colours yet. `truth` is None where it is not known.
    """

    def paint(linear: np.ndarray) -> str:
        if quantity in QUANTITIES and QUANTITIES[quantity].display == "data":
            small = pictures.shrink(linear, display.LONGEST_SIDE)
            return pictures.png_data_uri(pictures.to_bytes(small))
        return display.tonemapped(linear, exposure if quantity == "render" else 0.0)

    values = [display.number(run.view(view.name).get(f"{quantity}_psnr")) for run in runs]
    alike = quantity != "render" or rendered_alike(runs)
    cells = []
    for number, psnr in enumerate(display.marked(values, display.decibels)):
        run = runs[number]
        path = _recovered(run, view, quantity)
        empty = "not evaluated" if run.optimizes(quantity) else "known, not optimized"
        cell: dict[str, Any] = {"picture": None, "error": None, "empty": empty}
        cell["trouble"] = nothing_learned(run) if run.optimizes(quantity) else None
        unit = "" if psnr["text"] == display.DASH else " dB"
        more = display.similar(run.view(view.name)) if quantity == "render" else ""
        cell |= {"number": psnr["text"] + unit, "best": psnr["best"] and alike, "more": more}
        cells.append(cell)
        if path is not None:
            image, covered = display.rgb(path)
            cell["picture"] = paint(image)
            if truth is not None:
                error = display.error(image, truth.values, path)
                counted = truth.counted & covered if truth.of_material else truth.counted
                errors.add(cell, number, quantity, error, counted)
    shown = None if truth is None else paint(truth.values)
    return {"quantity": quantity, "truth": shown, "cells": cells}


def _recovered(run: EvaluatedRun, view: ShownView, quantity: str) -> Path | None:
    """A run's image of a view; None if it was not evaluated or the quantity not optimized."""
    if not run.view(view.name) or not run.optimizes(quantity):
        return None
    return display.evaluated(run, run.folder.picture(view.split, view.name, quantity))


def _references(view: ShownView) -> dict[str, _Reference]:
    """The truth of each quantity, and the pixels that scores count.

    From the value on at which photographs are clipped they are limited, as renderings are.
    """
    photograph = read_photograph(view.source, clip_negative=True)
    truth = GroundTruth.of(view.source)
    limited = view.source.readable(photograph[..., :3])
    if truth is None:
        return {"render": _Reference(limited, counted_pixels(photograph, None), False)}
    found = {"render": _Reference(limited, counted_pixels(photograph, truth.known), True)}
    for name, values in truth.values.items():
        rgb = np.broadcast_to(values, (*values.shape[:2], 3))
        found[name] = _Reference(rgb, truth.known, True)
    return found
