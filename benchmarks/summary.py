"""Files of results: what `unbake compare` and `unbake bench` wrote, reduced to their numbers."""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import here

from unbake.experiments.seeds import across_seeds
from unbake.imaging.metrics import mean_psnr
from unbake.training.run_folder import RunFolder

Row = dict[str, Any]

#: What tells runs apart, and what is measured of each.
KEPT = ("representation", "radiance", "estimator")
LENGTH = ("steps", "samples", "seconds", "milliseconds_per_step", "start_up_seconds")
QUALITY = (
    "albedo_psnr",
    "albedo_psnr_aligned",
    "roughness_psnr",
    "render_psnr",
    "true_render_psnr",
)
ENVIRONMENT = ("sh_error", "sh_error_aligned", "relight_psnr", "relight_psnr_aligned")


def read(file: Path) -> Row:
    """The content of a JSON file."""
    return json.loads(file.read_text(encoding="utf-8"))


def summary(folders: Sequence[Path], groups: Sequence[str] = ()) -> Row:
    """Length and held-out quality of each method from comparisons that differ in the seed.

    Args:
        folders: of the comparisons.
        groups: names of groups of held-out views, which take turns; their quality is KEY_GROUP.

    Returns:
        By method in `methods`, and of the fields before their first step in `untrained`: each
        number as its mean over seeds, with its sample standard deviation as KEY_sd if there are
        several; and `per_seed`, the numbers of each seed with its scores during the fit.
    """
    comparisons = [read(folder / "compare.json") for folder in folders]
    for folder, comparison in zip(folders, comparisons, strict=True):
        for name, row in {"untrained": comparison["untrained"], **comparison["methods"]}.items():
            if groups and "error" not in row:
                row["heldout"] |= _of_groups(RunFolder(folder / name).metrics(), groups)
    return summarized(comparisons)


def _of_groups(metrics: Row, groups: Sequence[str]) -> Row:
    """Mean quality of every group of held-out views."""
    views = [view for view in metrics["per_view"] if view["split"] == "heldout"]
    return {
        f"{key}_{group}": mean_psnr(view.get(key) for view in views[number :: len(groups)])
        for key in QUALITY
        for number, group in enumerate(groups)
    }


def summarized(comparisons: Sequence[Row]) -> Row:
    """The same of the contents of files."""
    first = comparisons[0]
    seeds = [comparison["settings"]["seed"] for comparison in comparisons]
    return {
        "machine": first["machine"],
        "unknown": first["settings"]["unknown"],
        "seeds": seeds,
        "views": next(_heldout(first))["views"],
        "untrained": _method(seeds, [comparison["untrained"] for comparison in comparisons]),
        "methods": {
            name: _method(seeds, [comparison["methods"][name] for comparison in comparisons])
            for name in first["methods"]
        },
        "time_to_quality": [comparison["time_to_quality"] for comparison in comparisons],
    }


def machine_results(files: Sequence[Path]) -> tuple[str, Row]:
    """Files of `unbake bench step` in one, with the day of the last; and its machine's name.

    Those of version 0.1.0 do not tell the day.
    """
    steps = [read(file) for file in files]
    machine = steps[0]["machine"]
    words = f"{machine['processor']} {machine['cores']} cores {machine['variant'].split('_')[0]}"
    name = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
    days = [step["made"] for step in steps if "made" in step]
    made = {"made": max(days)} if days else {}
    told = ("machine", "made")
    steps = [{key: value for key, value in step.items() if key not in told} for step in steps]
    return name, {"machine": machine, **made, "steps": steps}


def phases_of(step: Row) -> Row:
    """The phases of a file of `unbake bench step`; version 0.1.0 calls them `parts`."""
    return step["phases"] if "phases" in step else step["parts"]


def roofline_of(step: Row) -> Row | None:
    """The roofline of a file of `unbake bench step`; version 0.1.0 calls it `floor`."""
    return step["roofline"] if "roofline" in step else step["floor"]


def mean_of_known(values: Sequence[float | None]) -> float | None:
    """The mean of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    return statistics.fmean(known) if known else None


def _heldout(comparison: Row) -> Iterator[Row]:
    return (row["heldout"] for row in comparison["methods"].values() if "heldout" in row)


def _method(seeds: Sequence[int], rows: Sequence[Row]) -> Row:
    """The numbers of a method, from a row for each seed."""
    failed = [row["error"] for row in rows if "error" in row]
    if failed:
        return {"error": failed[0]}
    per_seed = [{"seed": seed} | _numbers(row) for seed, row in zip(seeds, rows, strict=True)]
    keys = dict.fromkeys(key for row in per_seed for key in row if key not in ("seed", "score"))
    kept = {key: rows[0][key] for key in KEPT if key in rows[0]}
    return kept | across_seeds(per_seed, keys) | {"per_seed": per_seed}


def _numbers(row: Row) -> Row:
    """What is measured of a run; what is not known is left out."""
    numbers = {key: row.get(key) for key in LENGTH}
    # Also of groups of views, as KEY_GROUP.
    quality = (key for key in row["heldout"] if key.startswith(QUALITY))
    numbers |= {key: row["heldout"][key] for key in quality}
    numbers |= {key: (row.get("environment") or {}).get(key) for key in ENVIRONMENT}
    errors = [light["emission_error"] for light in row.get("emission", ())]
    numbers["emission_error"] = mean_of_known(errors)
    numbers["score"] = row.get("score") or None
    return {key: value for key, value in numbers.items() if value is not None}


def scores(row: Row) -> list[list[Row]]:
    """The scores during the fits of a method, a curve for each seed that has one."""
    if "per_seed" not in row:  # written by version 0.1.0, which keeps those of single seeds
        return [row["score"]] if row.get("score") else []
    return [fit["score"] for fit in row["per_seed"] if "score" in fit]
