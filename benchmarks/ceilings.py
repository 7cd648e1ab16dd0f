"""What the fields of default settings can represent of several data sets at best.

    python benchmarks/ceilings.py --data DATA [DATA ...] --out FILE.json [--go-on]

Each data set is measured as by `unbake bench ceiling`: fields trained on the true maps of the
training views, without rendering, scored on the held-out views. The file is written after each.
With --go-on, data sets that it has already are kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import here

from rich.console import Console

from unbake import backend
from unbake.config import preset
from unbake.io import read_json, write_json
from unbake.machine import machine

#: What is kept of a measurement.
KEPT = ("train_views", "heldout_views", "steps", "seconds")


def main() -> None:
    """Measure, print every table, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--go-on", action="store_true", help="keep what the file has")
    args = parser.parse_args()
    backend.activate()
    from unbake.profiling.bench_ceiling import bench_ceiling

    there = args.go_on and args.out.is_file()
    rows = read_json(args.out)["rows"] if there else []
    console = Console(soft_wrap=True)
    for data in args.data:
        if data.name in {row["data"] for row in rows}:
            continue
        console.print(data.name, markup=False)
        found = bench_ceiling(data, preset("cpu"), None, None, console)
        row = {"data": data.name} | {key: found[key] for key in KEPT}
        for kind, scores in found["yardsticks"].items():
            row |= {f"{kind}_{key}": score for key, score in scores.items()}
        rows.append(row)
        about = {"machine": machine(), "definitions": found["definitions"]}
        write_json(args.out, about | {"rows": rows})


if __name__ == "__main__":
    main()
