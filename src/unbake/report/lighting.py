"""The page's section on light: environment maps side by side, and the strengths of the lights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from unbake.dataset.lighting import true_environment
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.imaging import pictures
from unbake.imaging.coded import read_picture
from unbake.report import display
from unbake.report.runs import EvaluatedRun

#: Headings of the scores of an environment map: their unit, how they are written, which is best.
SCORES = {
    "sh_error": ("SH error", "%", display.percent, min),
    "relight_psnr": ("Relighting PSNR", "dB", display.decibels, max),
}
#: Columns of each: what is added to its name.
KINDS = {"Plain": "", "Aligned": "_aligned", "Seen": "_seen"}


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
    errors: list[tuple[np.ndarray, np.ndarray] | None] = []  # and where the map is known
    for run in runs:
        optimized = run.optimizes("environment")
        path = display.evaluated(run, run.folder.environment()) if optimized else None
        if path is None:
            found.append(None)
            errors.append(None)
            continue
        map_ = display.rgb(path)[0]
        found.append(map_)
        off = None if truth is None else display.error(map_, truth, path)
        errors.append(None if off is None else (off, ~_unobserved(run, map_)))
    lit = [map_ for map_ in found if map_ is not None] if truth is None else [truth]
    exposure = pictures.fitting_exposure([pictures.sample(map_.mean(axis=2)) for map_ in lit])
    told = [off[known] for off, known in filter(None, errors) if known.any()]
    scale = display.error_scale([[pictures.sample(values)] for values in told])

    scores = _columns(runs)
    plain = scores[0]["columns"]["Plain"]
    cells = [
        {
            "picture": None if map_ is None else display.tonemapped(map_, exposure),
            "error": None if pair is None else display.painted(pair[0], scale, pair[1]),
            "empty": "known, not optimized",
            "number": f"SH error {low['text']} %" if low["text"] != display.DASH else display.DASH,
            "best": low["best"],
            "more": "",
        }
        for map_, pair, low in zip(found, errors, plain, strict=True)
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
        "scores": scores,
        "notes": _notes(runs),
        "compared": any(run.metrics.get("environment") for run in runs),
    }


def _unobserved(run: EvaluatedRun, like: np.ndarray) -> np.ndarray:
    """Where nothing is known of a map, bool, shape (h, w)."""
    path = run.folder.unobserved_environment()
    if not path.is_file():
        return np.zeros(like.shape[:2], bool)
    found = read_picture(path)[..., 0] > 0
    if found.shape != like.shape[:2]:
        what = "has another size than the map beside it"
        raise UserError(what, path, f"{run.folder.evaluate_again} again")
    return found


def _notes(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """Of which share of the environment nothing is known, a line a run that says so."""
    found = []
    for number, run in enumerate(runs):
        share = display.number(run.metrics.get("environment_seen_share"))
        if share is not None and run.folder.unobserved_environment().is_file():
            told = f"Nothing is known of {100 * (1 - share):.0f} % of the environment"
            found.append({"run": number, "text": f"{told}, which lights nothing in view"})
    return found


def _columns(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """By score, its heading and its columns: names, and a cell a run."""
    said = [run.metrics.get("environment") or {} for run in runs]
    kinds = {
        name: end
        for name, end in KINDS.items()
        if name != "Seen" or any(f"{key}{end}" in numbers for key in SCORES for numbers in said)
    }
    return [
        {
            "title": title,
            "unit": unit,
            "columns": {
                name: display.marked(
                    [display.number(numbers.get(f"{key}{end}")) for numbers in said], write, choose
                )
                for name, end in kinds.items()
            },
        }
        for key, (title, unit, write, choose) in SCORES.items()
    ]


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
