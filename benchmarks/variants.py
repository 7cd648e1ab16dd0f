"""Held-out scores of fits with several settings files, over seeds, one fit after the other.

    python benchmarks/variants.py --data DATA [DATA ...] --settings A.toml B.toml --out FILE.json
        [--seeds 0 1 2] [--steps 2400] [--methods ours]

The fits of a seed follow each other, so that all variants meet the same machine. Scores are PSNRs
in dB of `unbake evaluate`, mean over held-out views; seconds are those of training.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SRC = str(ROOT / "src")
sys.path.insert(0, SRC)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (SRC, os.environ.get("PYTHONPATH"))))

from unbake.machine import machine  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

#: What is kept of a fit's scores.
SCORES = ("albedo_psnr", "roughness_psnr", "render_psnr")


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--settings", type=Path, nargs="+", required=True, help="settings files")
    parser.add_argument("--methods", nargs="+", default=["ours"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    found: dict[tuple[str, str, str], list[dict[str, float]]] = defaultdict(list)
    for data in args.data:
        for seed in args.seeds:
            for method in args.methods:
                for settings in args.settings:
                    scores = fit(data, settings, method, seed, args.steps)
                    found[data.name, method, settings.stem].append(scores)
                    told = ", ".join(f"{key} {value:.2f}" for key, value in scores.items())
                    print(
                        f"{data.name}, {method}, {settings.stem}, seed {seed}: {told}", flush=True
                    )
    rows = [
        {"data": data, "method": method, "settings": settings} | summary(runs)
        for (data, method, settings), runs in found.items()
    ]
    result = {"machine": machine(), "steps": args.steps, "seeds": args.seeds, "rows": rows}
    args.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def fit(data: Path, settings: Path, method: str, seed: int, steps: int) -> dict[str, float]:
    """Scores and seconds of a fit."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        options = ["--settings", settings, "--method", method, "--seed", seed, "--steps", steps]
        unbake("fit", data, "--out", run, *options)
        unbake("evaluate", run)
        metrics = json.loads(RunFolder(run).metrics_file.read_text(encoding="utf-8"))
    scores = {key: metrics["heldout"][key] for key in SCORES}
    return scores | {"seconds": metrics["seconds"]}


def unbake(*words: Any) -> None:
    """Run a command of this checkout."""
    command = [sys.executable, "-m", "unbake", *map(str, words)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def summary(runs: list[dict[str, float]]) -> dict[str, float]:
    """Means, and sample standard deviations as NUMBER_sd."""
    told = {}
    for key in runs[0]:
        values = [run[key] for run in runs]
        told[key] = round(statistics.fmean(values), 3)
        if len(values) > 1:
            told[f"{key}_sd"] = round(statistics.stdev(values), 3)
    return told


if __name__ == "__main__":
    main()
