"""One JSON of numbers from comparisons that differ in the seed: python summary.py OUT FOLDER ..."""

from __future__ import annotations

import json
import statistics
import sys
from pathlib import Path

QUALITY = ("albedo_psnr", "albedo_psnr_aligned", "roughness_psnr", "render_psnr")
KEPT = ("steps", "samples", "seconds", "milliseconds_per_step", "representation", "radiance")


def main(out: Path, folders: list[Path]) -> None:
    """Write held-out quality, mean and spread over seeds, of every method."""
    found = [json.loads((folder / "compare.json").read_text()) for folder in folders]
    result = {
        "machine": found[0]["machine"],
        "unknown": found[0]["settings"]["unknown"],
        "seeds": [one["settings"]["seed"] for one in found],
        "views": next(_heldout(found[0]))["views"],
        "methods": {
            name: _method([one["methods"][name] for one in found]) for name in found[0]["methods"]
        },
        "time_to_quality": [one["time_to_quality"] for one in found],
    }
    out.write_text(json.dumps(result, indent=1) + "\n")
    for name, row in result["methods"].items():
        print(name, json.dumps({k: v for k, v in row.items() if k != "score"}))


def _heldout(comparison: dict):
    return (row["heldout"] for row in comparison["methods"].values() if "heldout" in row)


def _method(rows: list[dict]) -> dict:
    failed = [row["error"] for row in rows if "error" in row]
    if failed:
        return {"error": failed[0]}
    summary = {key: rows[0][key] for key in KEPT}
    for key in QUALITY:
        summary |= _spread(key, [row["heldout"].get(key) for row in rows])
    for key in ("sh_error", "sh_error_aligned", "relight_psnr", "relight_psnr_aligned"):
        summary |= _spread(key, [(row.get("environment") or {}).get(key) for row in rows])
    errors = [light["emission_error"] for row in rows for light in row.get("emission", ())]
    summary |= _spread("emission_error", errors)
    if len(rows) == 1 and rows[0]["score"]:
        summary["score"] = rows[0]["score"]
    return summary


def _spread(key: str, values: list) -> dict:
    known = [value for value in values if value is not None]
    if not known:
        return {}
    spread = statistics.stdev(known) if len(known) > 1 else None
    return {key: statistics.mean(known)} | ({f"{key}_sd": spread} if spread is not None else {})


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit("usage: python summary.py OUT.json FOLDER ...")
    main(Path(sys.argv[1]), [Path(name) for name in sys.argv[2:]])
