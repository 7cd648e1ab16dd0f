"""Step times of two checkouts, turn by turn on one machine.

    python benchmarks/paired.py --before ../old --after . --data DATA --out FILE.json

The two are measured in turns, the order reversed in every second one, so that both meet the same
machine. Each measurement is `unbake bench step` in a process of its own. What counts is the ratio
of the medians.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any


def main() -> None:
    """Measure, print every turn, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, required=True, help="checkout to compare with")
    parser.add_argument("--after", type=Path, required=True, help="checkout that changed")
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--methods", nargs="+", default=["ours"])
    parser.add_argument("--turns", type=int, default=10)
    parser.add_argument("--steps", type=int, default=100, help="steps of a measurement")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    trees = {"before": args.before, "after": args.after}
    found: dict[str, dict[str, list[dict[str, Any]]]] = {
        method: {name: [] for name in trees} for method in args.methods
    }
    for turn in range(args.turns):
        for method in args.methods:
            for name in sorted(trees, reverse=turn % 2 == 0):
                result = measure(trees[name], args.data, method, args.steps)
                found[method][name].append(result)
                print(f"turn {turn + 1}, {method}, {name}: {result[TIME]:.2f} ms", flush=True)
    rows = {method: row(runs) for method, runs in found.items()}
    for method, told in rows.items():
        print(f"{method}: {told['before']:.2f} -> {told['after']:.2f} ms, {told['ratio']:.3f}")
    machine = found[args.methods[0]]["after"][0]["machine"]
    summary = {"machine": machine, "data": args.data.name, "steps": args.steps, "methods": rows}
    args.out.write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")


TIME = "milliseconds_per_step"


def measure(tree: Path, data: Path, method: str, steps: int) -> dict[str, Any]:
    """What `unbake bench step` of a checkout writes."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "step.json"
        separate = (tree / "src/unbake/cli/bench.py").is_file()  # `bench` was one command
        option = "--method" if separate else "--methods"
        words = ["bench", "step", "--data", data.resolve(), option, method]
        words += ["--steps", steps, "--out", out]
        subprocess.run(
            [sys.executable, "-m", "unbake", *map(str, words)],
            env=os.environ | {"PYTHONPATH": str(tree.resolve() / "src")},
            cwd=folder,
            stdout=subprocess.DEVNULL,
            check=True,
        )
        return json.loads(out.read_text(encoding="utf-8"))


def row(runs: dict[str, list[dict[str, Any]]]) -> dict[str, Any]:
    """Medians, their ratio, all times and kernel launches of a method."""
    times = {name: [run[TIME] for run in measured] for name, measured in runs.items()}
    medians = {name: statistics.median(values) for name, values in times.items()}
    return medians | {
        "ratio": medians["after"] / medians["before"],
        "milliseconds": times,
        "launches": {name: measured[-1]["launches"] for name, measured in runs.items()},
    }


if __name__ == "__main__":
    main()
