"""Damaged files of every format: each is read, or refused in one line.

    python benchmarks/fuzz.py [--count 10000] [--formats NAME ...] [--seed N]

The table of formats is `tests/fuzzing/formats.py`. What fails is told and kept in
`tests/data/corpus`, whose files are read first, and by the tests. The exit status is 1 if anything
failed. The result goes to `benchmarks/results/fuzz.json`.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from here import ROOT

sys.path.insert(0, str(ROOT / "tests"))

from fuzzing.engine import CORPUS, Campaign, Worker, shares
from fuzzing.formats import FORMATS

from unbake import backend
from unbake.io import write_json

RESULT = ROOT / "benchmarks" / "results" / "fuzz.json"


def main() -> int:
    """Read damaged files, and print and write what became of them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=10_000, help="damaged files in all")
    parser.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    parser.add_argument("--seed", type=int, default=0, help="the same seed damages the same way")
    parser.add_argument("--out", type=Path, default=RESULT, help="JSON file to write")
    parser.add_argument("--corpus", type=Path, default=CORPUS, help="folder of what has failed")
    args = parser.parse_args()
    backend.activate()
    from unbake.machine import machine

    start = time.perf_counter()
    with Worker() as worker:
        campaign = Campaign(worker, watch=_tell)
        campaign.replay(args.corpus)
        replayed = campaign.total
        for name, count in shares(args.count, args.formats).items():
            campaign.mutate(name, count, args.seed)
            print(f"{name}: {campaign.counts[name]}", flush=True)
    for failure in campaign.failures.values():
        file = failure.keep(args.corpus)
        print(f"{failure.format}: {failure.count} x {failure.told}; kept as {file.name}")
    result = {
        "machine": machine(),
        "seed": args.seed,
        "inputs": campaign.total - replayed,
        "replayed": replayed,
        "seconds": time.perf_counter() - start,
        "slowest_seconds": campaign.slowest,
        "failed": sum(failure.count for failure in campaign.failures.values()),
        "workers": worker.starts,
        "formats": campaign.counts,
        "failures": [
            {"format": f.format, "kind": f.kind, "count": f.count}
            for f in campaign.failures.values()
        ],
    }
    write_json(args.out, result)
    print(f"{campaign.total} inputs, {result['failed']} failed, {result['seconds']:.0f} s")
    return 1 if campaign.failures else 0


def _tell(campaign: Campaign) -> None:
    if campaign.total % 1000 == 0:
        print(f"{campaign.total} inputs, {len(campaign.failures)} kinds of failure", flush=True)


if __name__ == "__main__":
    sys.exit(main())
