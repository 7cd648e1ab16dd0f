"""The page's section on light: environment maps side by side, and the strengths of the lights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from unbake.dataset.lighting import true_environment
from unbake.dataset.views import Dataset
from unbake.imaging import pictures
from unbake.report import display
from unbake.report.runs import EvaluatedRun

#: Scores of an environment map: their format, and which is best.
NUMBERS = {
    "sh_error": (display.percent, min),
    "sh_error_aligned": (display.percent, min),
    "relight_psnr": (display.decibels, max),
    "relight_psnr_aligned": (display.decibels, max),
}


def lighting_section(runs: list[EvaluatedRun], dataset: Dataset) -> dict[str, Any] | None:
    """The contents of the section: `maps` and `emitters`, each None if no run optimized it.

    Raises:
        UserError: a map is gone, cannot be read, or has another size than the true one.
    """
    if not any(run.optimizes("environment") or run.optimizes("emission") for run in runs):
        return None
    return {"maps": _maps(runs, dataset), "emitters": _emitters(runs)}


def _maps(runs: list[EvaluatedRun], dataset: Dataset) -> dict[str, Any] | None:
    """Maps and their errors, at the exposure of the truth if it is known."""
    if not any(run.optimizes("environment") for run in runs):
        return None
    truth = true_environment(dataset.folder, allow_outside=dataset.allow_outside)
    found: list[np.ndarray | None] = []
    errors: list[np.ndarray | None] = []
    for run in runs:
        optimized = run.optimizes("environment")
        path = display.evaluated(run, run.folder.environment()) if optimized else None
        if path is None:
            found.append(None)
            errors.append(None)
            continue
        map_ = display.rgb(path)[0]
        found.append(map_)
        errors.append(None if truth is None else display.error(map_, truth, path))
    lit = [map_ for map_ in found if map_ is not None] if truth is None else [truth]
    exposure = pictures.fitting_exposure([pictures.sample(map_.mean(axis=2)) for map_ in lit])
    scale = display.error_scale([[pictures.sample(e)] for e in errors if e is not None])

    numbers = _numbers(runs)
    cells = [
        {
            "picture": None if map_ is None else display.tonemapped(map_, exposure),
            "error": None if off is None else display.painted(off, scale, np.ones(off.shape, bool)),
            "empty": "known, not optimized",
            "number": f"SH error {low['text']} %" if low["text"] != display.DASH else display.DASH,
            "best": low["best"],
            "more": "",
        }
        for map_, off, low in zip(found, errors, numbers["sh_error"], strict=True)
    ]
    height, width = lit[0].shape[:2]
    return {
        "quantity": "environment",
        "truth": None if truth is None else display.tonemapped(truth, exposure),
        "scale": scale,
        "cells": cells,
        "width": width,
        "height": height,
        "exposure": exposure,
        "rows": list(zip(*numbers.values(), strict=True)),
        "compared": any(run.metrics.get("environment") for run in runs),
    }


def _numbers(runs: list[EvaluatedRun]) -> dict[str, list[dict[str, Any]]]:
    """By score, a cell a run."""
    said = [run.metrics.get("environment") or {} for run in runs]
    return {
        key: display.marked([display.number(numbers.get(key)) for numbers in said], write, choose)
        for key, (write, choose) in NUMBERS.items()
    }


def _emitters(runs: list[EvaluatedRun]) -> list[dict[str, Any]] | None:
    """One row an emitter: its true strength, and each run's with its error."""
    if not any(run.optimizes("emission") for run in runs):
        return None
    found = [{row["name"]: row for row in run.metrics.get("emission") or ()} for run in runs]
    rows = []
    for name in dict.fromkeys(name for emitters in found for name in emitters):
        said = [emitters.get(name, {}) for emitters in found]
        truth = next((emitter["truth"] for emitter in said if emitter.get("truth")), None)
        errors = [display.number(emitter.get("emission_error")) for emitter in said]
        cells = [
            cell
            | {"strength": _colour(emitter.get("strength")), "optimized": run.optimizes("emission")}
            for cell, emitter, run in zip(
                display.marked(errors, display.percent, min), said, runs, strict=True
            )
        ]
        rows.append({"name": name, "truth": _colour(truth), "cells": cells})
    return rows


def _colour(strength: object) -> str:
    """Linear RGB with four digits of its largest channel."""
    said = [display.number(x) for x in strength] if isinstance(strength, list) else []
    values = [x for x in said if x is not None]
    if len(said) != 3 or len(values) != 3:
        return display.DASH
    largest = max(abs(x) for x in values)
    digits = 3 - math.floor(math.log10(largest)) if 0 < largest < math.inf else 2
    return "\N{EN SPACE}".join(f"{x:.{min(max(digits, 0), 6)}f}" for x in values)
