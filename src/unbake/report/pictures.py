"""The page's section on views: pictures and errors of each quantity, on shared scales."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from unbake.dataset.views import Dataset, read_photograph, read_view
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


def shared_scales(runs: list[EvaluatedRun], views: list[ShownView]) -> Scales:
    """Exposure and error scales from all pictures of the page."""
    radiance: list[np.ndarray] = []
    errors: dict[str, list[list[np.ndarray]]] = {q: [[] for _ in runs] for q in NAMES}
    for view in views:
        for quantity, (reference, mask) in _references(view).items():
            if quantity == "render":
                radiance.append(pictures.sample(reference.mean(axis=2)[mask]))
            for run, parts in zip(runs, errors[quantity], strict=True):
                recovered = _recovered(run, view, quantity)
                if recovered is not None:
                    error = display.error(display.rgb(recovered)[0], reference, recovered)
                    parts.append(pictures.sample(error[mask]))
    error_scales = {q: display.error_scale(errors[q]) for q in NAMES}
    return Scales(pictures.fitting_exposure(radiance), error_scales)


def view_groups(
    dataset: Dataset, views: Sequence[ShownView], runs: list[EvaluatedRun], scales: Scales
) -> list[dict[str, Any]]:
    """The pictures of each split, view by view, and of how many views they are."""
    names = {row["name"] for run in runs for row in run.metrics["per_view"]}
    groups = []
    for split in SHOWN_SPLITS:
        every = [view.name for view in dataset.views if view.split == split]
        blocks = [_view_block(view, runs, scales) for view in views if view.split == split]
        # Training views were chosen so by the evaluation.
        spaced = split == "train" or len(blocks) < len(names.intersection(every))
        groups.append({"split": split, "total": len(every), "views": blocks, "spaced": spaced})
    return groups


def _view_block(view: ShownView, runs: list[EvaluatedRun], scales: Scales) -> dict[str, Any]:
    """A view's images for the template: a column a quantity with truth and runs."""
    references = _references(view)
    height, width = references["render"][0].shape[:2]
    quantities = [q for q in NAMES if any(run.optimizes(q) for run in runs)]
    columns = [_column(view, runs, q, references.get(q), scales) for q in quantities]
    return {"name": view.name, "width": width, "height": height, "columns": columns}


def _column(
    view: ShownView,
    runs: list[EvaluatedRun],
    quantity: str,
    truth: tuple[np.ndarray, np.ndarray] | None,
    scales: Scales,
) -> dict[str, Any]:
    """A quantity of a view: its truth, and a cell a run with its picture, error and PSNR.

    `truth` is as from `_references`, None where it is not known.
    """

    def paint(linear: np.ndarray) -> str:
        if quantity in QUANTITIES and QUANTITIES[quantity].display == "data":
            small = pictures.shrink(linear, display.LONGEST_SIDE)
            return pictures.png_data_uri(pictures.to_bytes(small))
        return display.tonemapped(linear, scales.exposure if quantity == "render" else 0.0)

    values = [display.number(run.view(view.name).get(f"{quantity}_psnr")) for run in runs]
    alike = quantity != "render" or rendered_alike(runs)
    scale = scales.error[quantity]
    reference, mask = truth or (None, None)
    cells = []
    for run, psnr in zip(runs, display.marked(values, display.decibels), strict=True):
        path = _recovered(run, view, quantity)
        empty = "not evaluated" if run.optimizes(quantity) else "known, not optimized"
        cell: dict[str, Any] = {"picture": None, "error": None, "empty": empty}
        cell["trouble"] = nothing_learned(run) if run.optimizes(quantity) else None
        if path is not None:
            image = display.rgb(path)[0]
            cell["picture"] = paint(image)
            if reference is not None and mask is not None:
                cell["error"] = display.painted(display.error(image, reference, path), scale, mask)
        unit = "" if psnr["text"] == display.DASH else " dB"
        more = display.similar(run.view(view.name)) if quantity == "render" else ""
        cells.append(
            cell | {"number": psnr["text"] + unit, "best": psnr["best"] and alike, "more": more}
        )
    shown = None if reference is None else paint(reference)
    return {"quantity": quantity, "truth": shown, "scale": scale, "cells": cells}


def _recovered(run: EvaluatedRun, view: ShownView, quantity: str) -> Path | None:
    """A run's image of a view; None if it was not evaluated or the quantity not optimized."""
    if not run.view(view.name) or not run.optimizes(quantity):
        return None
    return display.evaluated(run, run.folder.picture(view.split, view.name, quantity))


def _references(view: ShownView) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The truth of each quantity, (H, W, 3), and the pixels whose errors count, (H, W) bool.

    Photographs are not masked, and show what is unknown where the data set tells that. From the
    value on at which they are clipped they are limited, as renderings are.
    """
    photograph = read_photograph(view.source, clip_negative=True)
    maps = {name: read_view(path, view.source) for name, path in view.source.truth.items()}
    known = {name: pixels[..., 3] >= 0.5 for name, pixels in maps.items()}
    counted = np.logical_and.reduce([photograph[..., 3] >= 0.5, *known.values()])
    found = {name: (pixels[..., :3], known[name]) for name, pixels in maps.items()}
    limited = view.source.readable(photograph[..., :3])
    return {"render": (limited, counted)} | found
