"""Fits by one and by several ranks of MPI: the same quality, and how much faster.

    python benchmarks/ranks.py --data DATA --work FOLDER --out FILE.json
        [--ranks 1 2] [--sync-every 1 10] [--seeds 0 1 2] [--steps 600]

Each rank has one core of this machine and one thread: fits of one rank, too (`one_process.py`). The
batch of all ranks together is the same. Scores are PSNRs in dB of linear RGB by `unbake evaluate`,
mean over held-out views; seconds are those of training without the first steps, which compile. The
loss is the photometric one, at each line of the log as `curve`, and the mean over the last fifth of
the lines as `loss`. The efficiency is the time of a step of one rank with the same seed, over that
of several times their number. `cases` has means over seeds, with their deviations. Runs are kept in
the folder.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import here

from small_run import mpiexec
from variants import SCORES

from unbake import backend
from unbake.experiments.commands import command, unbake
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.run_folder import RunFolder

#: Steps that compile and warm up, which are not timed.
WARM_UP = 100
#: Words that begin a command of one process with a thread on its core, and one of several.
ALONE = (sys.executable, str(Path(__file__).with_name("one_process.py")))
SEVERAL = (sys.executable, "-m", "unbake")


def main() -> None:
    """Fit, print every score and time, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--sync-every", type=int, nargs="+", default=[1, 10])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--work", type=Path, required=True, help="folder for the runs")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    rows: list[dict[str, Any]] = []
    for seed in args.seeds:
        # How often ranks share makes no difference to one.
        cases = [(n, every) for n in args.ranks for every in args.sync_every if n > 1 or every == 1]
        for ranks, every in cases:
            run = args.work / f"ranks-{ranks}-every-{every}-seed-{seed}"
            row = fit(args.data, run, ranks, every, seed, args.steps)
            rows.append({"ranks": ranks, "sync_every": every, "seed": seed} | row)
            rows[-1] |= efficiency(rows, rows[-1])
            told = {key: value for key, value in rows[-1].items() if key != "curve"}
            print(", ".join(f"{key} {value:.4g}" for key, value in told.items()), flush=True)
            result = {"machine": machine(), "steps": args.steps, "warm_up": WARM_UP}
            result |= {"data": args.data.name, "seeds": args.seeds}
            write_json(args.out, result | {"cases": cases_of(rows), "rows": rows})


def efficiency(rows: Sequence[dict[str, Any]], row: dict[str, Any]) -> dict[str, float]:
    """How much of the cores' work several ranks make use of, beside one; none without that one."""
    for one in rows:
        if one["ranks"] == 1 and one["seed"] == row["seed"]:
            return {"efficiency": one["ms_per_step"] / row["ranks"] / row["ms_per_step"]}
    return {}


def cases_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means and deviations over seeds, by the number of ranks and how often they share."""
    keys = (*SCORES, "loss", "ms_per_step", "efficiency")
    found: dict[tuple[int, int], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["ranks"], row["sync_every"]), []).append(row)
    return [
        {"ranks": ranks, "sync_every": every, "seeds": len(own)} | across_seeds(own, keys)
        for (ranks, every), own in found.items()
    ]


def fit(data: Path, run: Path, ranks: int, every: int, seed: int, steps: int) -> dict[str, Any]:
    """Scores, loss, and milliseconds a step after the first ones, of a fit with one core a rank."""
    words = (*(ALONE if ranks == 1 else SEVERAL), "fit", data, "--out", run)
    cores = ",".join(map(str, range(ranks)))
    start = ["taskset", "-c", cores] + ([mpiexec(), "-n", ranks] if ranks > 1 else [])
    run.parent.mkdir(parents=True, exist_ok=True)
    log = run.parent / "log.txt"
    command([*start, *words, "--seed", seed, "--steps", steps, "--sync-every", every], log=log)
    unbake("evaluate", run, "--train-views", 0, log=log)
    heldout = json.loads(RunFolder(run).metrics_file.read_text(encoding="utf-8"))["heldout"]
    curve = [[line["step"], line["photometric"]] for line in photometric(run)]
    last = [loss for _, loss in curve[-max(len(curve) // 5, 1) :]]
    found = {"ms_per_step": ms_per_step(run), "loss": mean(last), "curve": curve}
    return {key: heldout[key] for key in SCORES} | found


def photometric(run: Path) -> list[dict[str, Any]]:
    """The lines of a log that have the photometric loss."""
    return [line for line in RunFolder(run).log() if "photometric" in line]


def ms_per_step(run: Path) -> float:
    """The median over the readings of the log after the warm-up."""
    late = [line for line in photometric(run) if line["step"] >= WARM_UP]
    pairs = itertools.pairwise(late)
    return median(
        1e3 * (after["seconds"] - before["seconds"]) / (after["step"] - before["step"])
        for before, after in pairs
    )


if __name__ == "__main__":
    main()
