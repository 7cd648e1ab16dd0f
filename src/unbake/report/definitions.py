"""Definitions of the numbers on the page, as the evaluations of the runs tell them."""

from __future__ import annotations

from typing import Any

from unbake.report import display
from unbake.report.runs import EvaluatedRun
from unbake.report.scores import psnr_columns

#: Headings of the definitions of an evaluation.
DEFINED = {
    "psnr": "PSNR",
    "albedo_psnr_aligned": "Aligned albedo",
    "yardsticks": "Ceiling, constant, untrained",
    "colour_space": "Colour space",
    "mask": "Mask",
    "render_ssim": "SSIM",
    "render_flip": "FLIP",
}
LIGHT_DEFINED = {
    "environment": {
        "sh_error": "SH error",
        "relight_psnr": "Relighting PSNR",
        "aligned": "Aligned",
        "sh_error_seen": "Seen",
    },
    "emission": {"emission_error": "Error"},
}


def definitions(runs: list[EvaluatedRun]) -> dict[str, list[dict[str, Any]]]:
    """Definitions of the numbers in each part of the page, from the evaluations."""
    psnrs = psnr_columns(runs)
    told = {k: v for k, v in DEFINED.items() if k in psnrs or k != "albedo_psnr_aligned"}
    numbers = [_told(run, told) | _rendering(run) for run in runs]
    lighting = {
        kind: [_told(run, _of_light(run, words)) if run.optimizes(kind) else {} for run in runs]
        for kind, words in LIGHT_DEFINED.items()
    }
    cameras = [_told(run, {"camera": "Cameras"}) for run in runs]
    lacking = [_told(run, {"outliers": "Outliers"}) for run in runs]
    parts = {"numbers": numbers, "camera": cameras, "outliers": lacking} | lighting
    return {part: _grouped(runs, said) for part, said in parts.items()}


def _told(run: EvaluatedRun, names: dict[str, str]) -> dict[str, str]:
    said = run.metrics.get("definitions") or {}
    return {name: str(said[key]) for key, name in names.items() if said.get(key)}


def _of_light(run: EvaluatedRun, names: dict[str, str]) -> dict[str, str]:
    """Names of definitions; those of what is seen only where something is not."""
    numbers = run.metrics.get("environment") or {}
    return {key: name for key, name in names.items() if name != "Seen" or key in numbers}


def _rendering(run: EvaluatedRun) -> dict[str, str]:
    said = run.metrics.get("render") or {}
    spp, depth = said.get("spp", display.DASH), said.get("max_depth", display.DASH)
    told = {"Rendered with": f"{spp} samples a pixel, path depth {depth}"} if said else {}
    exposure = display.number(run.metrics.get("display_exposure"))
    return told if exposure is None else told | {"Display exposure": f"{exposure:+.1f} stops"}


def _grouped(runs: list[EvaluatedRun], said: list[dict[str, str]]) -> list[dict[str, Any]]:
    """One entry for all runs with the same definitions; none for runs without."""
    entries: list[dict[str, Any]] = []
    for run, words in zip(runs, said, strict=True):
        same = next((entry for entry in entries if entry["words"] == words), None)
        if same is not None:
            same["labels"].append(run.label)
        elif words:
            entries.append({"words": words, "labels": [run.label]})
    return entries
