"""Files of results: what `unbake compare` and `unbake bench` wrote, reduced to their numbers."""

from __future__ import annotations

import json
import re
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]

KEPT = ("steps", "samples", "seconds", "milliseconds_per_step", "representation", "radiance")
QUALITY = ("albedo_psnr", "albedo_psnr_aligned", "roughness_psnr", "render_psnr")
ENVIRONMENT = ("sh_error", "sh_error_aligned", "relight_psnr", "relight_psnr_aligned")


def read(file: Path) -> Row:
    """The content of a JSON file."""
    return json.loads(file.read_text(encoding="utf-8"))


def summary(folders: Sequence[Path]) -> Row:
    """Held-out quality of each method from comparisons that differ in the seed: mean and spread."""
    comparisons = [read(folder / "compare.json") for folder in folders]
    first = comparisons[0]
    return {
        "machine": first["machine"],
        "unknown": first["settings"]["unknown"],
        "seeds": [comparison["settings"]["seed"] for comparison in comparisons],
        "views": next(_heldout(first))["views"],
        "methods": {
            name: _method([comparison["methods"][name] for comparison in comparisons])
            for name in first["methods"]
        },
        "time_to_quality": [comparison["time_to_quality"] for comparison in comparisons],
    }


def machine_results(files: Sequence[Path]) -> tuple[str, Row]:
    """Files of `unbake bench step` in one; and its name, which is that of the machine."""
    steps = [read(file) for file in files]
    machine = steps[0]["machine"]
    words = f"{machine['processor']} {machine['cores']} cores {machine['variant'].split('_')[0]}"
    name = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
    steps = [{key: value for key, value in step.items() if key != "machine"} for step in steps]
    return name, {"machine": machine, "steps": steps}


def phases_of(step: Row) -> Row:
    """The phases of a file of `unbake bench step`; version 0.1.0 calls them `parts`."""
    return step["phases"] if "phases" in step else step["parts"]


def roofline_of(step: Row) -> Row | None:
    """The roofline of a file of `unbake bench step`; version 0.1.0 calls it `floor`."""
    return step["roofline"] if "roofline" in step else step["floor"]


def _heldout(comparison: Row) -> Iterator[Row]:
    return (row["heldout"] for row in comparison["methods"].values() if "heldout" in row)


def _method(rows: list[Row]) -> Row:
    """The numbers of a method, a row for each seed."""
    failed = [row["error"] for row in rows if "error" in row]
    if failed:
        return {"error": failed[0]}
    numbers = {key: rows[0][key] for key in KEPT}
    for key in QUALITY:
        numbers |= _spread(key, [row["heldout"].get(key) for row in rows])
    for key in ENVIRONMENT:
        numbers |= _spread(key, [(row.get("environment") or {}).get(key) for row in rows])
    errors = [light["emission_error"] for row in rows for light in row.get("emission", ())]
    numbers |= _spread("emission_error", errors)
    if len(rows) == 1 and rows[0]["score"]:
        numbers["score"] = rows[0]["score"]
    return numbers


def _spread(key: str, values: list[float | None]) -> Row:
    """Mean and standard deviation of the known values."""
    known = [value for value in values if value is not None]
    if not known:
        return {}
    spread = statistics.stdev(known) if len(known) > 1 else None
    return {key: statistics.mean(known)} | ({f"{key}_sd": spread} if spread is not None else {})
