"""Fits by one and by several ranks of MPI: the same quality, and how much faster.

    python benchmarks/ranks.py --data DATA --work FOLDER --out FILE.json
        [--ranks 1 2] [--sync-every 1 10] [--seeds 0 1 2] [--steps 600]

Each rank has one core of this machine: fits of one rank are kept to one core, too. The batch of all
ranks together is the same. Scores are PSNRs in dB of linear RGB by `unbake evaluate`, mean over
held-out views; seconds are those of training without the first steps, which compile. Runs are kept
in the folder.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
from pathlib import Path
from statistics import median

ROOT = Path(__file__).parents[1]
SRC = str(ROOT / "src")
sys.path.insert(0, SRC)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (SRC, os.environ.get("PYTHONPATH"))))

from small_run import mpiexec  # noqa: E402
from variants import SCORES  # noqa: E402

from unbake import backend  # noqa: E402
from unbake.experiments.commands import command, unbake  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

#: Steps that compile and warm up, which are not timed.
WARM_UP = 100


def main() -> None:
    """Fit, print every score and time, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sync-every", type=int, nargs="+", default=[1])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--work", type=Path, required=True, help="folder for the runs")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    rows = []
    for seed in args.seeds:
        # How often ranks share makes no difference to one.
        cases = [(n, every) for n in args.ranks for every in args.sync_every if n > 1 or every == 1]
        for ranks, every in cases:
            run = args.work / f"ranks-{ranks}-every-{every}-seed-{seed}"
            row = fit(args.data, run, ranks, every, seed, args.steps)
            rows.append({"ranks": ranks, "sync_every": every, "seed": seed} | row)
            print(", ".join(f"{key} {value:.4g}" for key, value in rows[-1].items()), flush=True)
            result = {"machine": machine(), "steps": args.steps, "warm_up": WARM_UP}
            write_json(args.out, result | {"data": args.data.name, "rows": rows})


def fit(data: Path, run: Path, ranks: int, every: int, seed: int, steps: int) -> dict[str, float]:
    """Scores, and milliseconds a step after the first ones, of a fit with one core a rank."""
    words = (sys.executable, "-m", "unbake", "fit", data, "--out", run)
    cores = ",".join(map(str, range(ranks)))
    start = ["taskset", "-c", cores] + ([mpiexec(), "-n", ranks] if ranks > 1 else [])
    run.parent.mkdir(parents=True, exist_ok=True)
    log = run.parent / "log.txt"
    command([*start, *words, "--seed", seed, "--steps", steps, "--sync-every", every], log=log)
    unbake("evaluate", run, "--train-views", 0, log=log)
    heldout = json.loads(RunFolder(run).metrics_file.read_text(encoding="utf-8"))["heldout"]
    return {key: heldout[key] for key in SCORES} | {"ms_per_step": ms_per_step(run)}


def ms_per_step(run: Path) -> float:
    """The median over the readings of the log after the warm-up."""
    log = [line for line in RunFolder(run).log() if "photometric" in line]
    late = [line for line in log if line["step"] >= WARM_UP]
    pairs = itertools.pairwise(late)
    return median(
        1e3 * (after["seconds"] - before["seconds"]) / (after["step"] - before["step"])
        for before, after in pairs
    )


if __name__ == "__main__":
    main()
