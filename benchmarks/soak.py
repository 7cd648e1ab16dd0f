"""A long fit in one process, watched for memory, files, threads and Dr.Jit variables that grow.

    python benchmarks/soak.py --steps 20000
    python benchmarks/soak.py --hours 2 --out FILE.json

It fits a small data set of the demo, with checkpoints, previews and scores at short intervals, and
takes a sample every 500 steps or 30 seconds. The result is written anew at every sample, so that
nothing is lost when the process is ended. The exit status is 1 where resident memory rises by more
than 1 MB in 1,000 steps, or the number of open files, threads or variables rises at all.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from here import ROOT

import numpy as np
import psutil
from rich.console import Console

from unbake import backend

backend.activate()

import drjit as dr  # noqa: E402

from unbake.acquisition.capture import capture  # noqa: E402
from unbake.acquisition.settings import CaptureSettings  # noqa: E402
from unbake.config import FitConfig  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.loop import fit  # noqa: E402
from unbake.training.memory import memory_mb  # noqa: E402
from unbake.training.monitor import Monitor  # noqa: E402

RESULT = ROOT / "benchmarks" / "results" / "soak.json"
SAMPLE_STEPS, SAMPLE_SECONDS = 500, 30
#: Resident memory may rise by so much in 1,000 steps, MB.
MOST_GROWTH = 1.0
#: The share of the samples in which caches and pools may still fill.
WARM_UP = 0.2
#: What must not rise at all.
COUNTED = ("files", "threads", "variables")


def main() -> int:
    """Fit, and print and write what grew."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    length = parser.add_mutually_exclusive_group(required=True)
    length.add_argument("--steps", type=int, help="length of the fit in steps")
    length.add_argument("--hours", type=float, help="length of the fit in hours of training")
    parser.add_argument("--resolution", type=int, default=64, help="pixels along an edge of a view")
    parser.add_argument("--batch", type=int, default=256, help="pixels in a step")
    parser.add_argument("--every", type=int, default=SAMPLE_STEPS, help="steps between samples")
    parser.add_argument("--out", type=Path, default=RESULT, help="JSON file to write")
    args = parser.parse_args()
    config = FitConfig(
        steps=args.steps or 1,
        seconds=3600 * (args.hours or 0),
        pixels=args.batch,
        checkpoint_seconds=20,
        preview_seconds=60,
        score_seconds=120,
    )
    asked = {"steps": args.steps, "hours": args.hours, "commit": commit(), "machine": machine()}
    watch = Watch(args.out, asked, args.every)
    with tempfile.TemporaryDirectory() as folder, watch.attached():
        data, run = Path(folder) / "data", Path(folder) / "run"
        small = CaptureSettings(views=6, held_out=2, resolution=args.resolution, spp=32)
        capture("demo", data, small, tell=print)
        progress = fit(data, run, config, console=Console(width=200, highlight=False))
    complete = progress.step >= args.steps if args.steps else progress.seconds >= config.seconds
    result = watch.write(complete=complete)
    print({key: value for key, value in result.items() if key != "samples"})
    for problem in result["problems"]:
        print(f"soak: {problem}")
    return 1 if result["problems"] else 0


@dataclass(frozen=True)
class Sample:
    """What the process holds after a step."""

    step: int
    seconds: float  #: since the watch began
    memory_mb: float
    files: int
    threads: int
    variables: int


class Watch:
    """Takes samples of this process while a fit runs in it.

    Args:
        out: the JSON file, written at every sample.
        facts: what else it should hold.
        every: steps between samples.
    """

    def __init__(self, out: Path, facts: dict[str, Any], every: int) -> None:
        self._out, self._facts, self._every = out, facts, every
        self._samples: list[Sample] = []
        self._start = time.monotonic()
        self._skipped = 0

    @contextlib.contextmanager
    def attached(self) -> Iterator[None]:
        """Look at every line of the log, which is written between two steps."""
        record = Monitor.record

        def watched(monitor: Monitor, done: float, entry: dict) -> None:
            record(monitor, done, entry)
            self._skipped += int(entry.get("skipped", 0))
            self._look(int(entry["step"]))

        with patch.object(Monitor, "record", watched):
            yield

    def _look(self, step: int) -> None:
        now = time.monotonic() - self._start
        if self._samples:
            last = self._samples[-1]
            if step - last.step < self._every and now - last.seconds < SAMPLE_SECONDS:
                return
        process = psutil.Process()
        variables = dr.whos(as_string=True).count("\n")
        self._samples.append(
            Sample(step, now, memory_mb(), process.num_fds(), process.num_threads(), variables)
        )
        self.write(complete=False)

    def write(self, *, complete: bool) -> dict[str, Any]:
        """Write the result so far, and return it."""
        found = growth(self._samples)
        last = self._samples[-1]
        result = {
            **self._facts,
            "complete": complete,
            "taken_steps": last.step,
            "taken_hours": last.seconds / 3600,
            "skipped_steps": self._skipped,
            **found,
            "problems": problems(found),
            "samples": [asdict(sample) for sample in self._samples],
        }
        write_json(self._out, result)
        return result


def growth(samples: Sequence[Sample]) -> dict[str, Any]:
    """How memory and counts rose after the warm-up.

    Returns:
        `slope`, MB in 1,000 steps, with `slope_range` that holds it at 95 %; and by name of
        `COUNTED` the numbers `before` (the most in the first quarter) and `after` (the least in the
        last). What leaks never falls back, what only comes and goes does.
    """
    kept = samples[int(WARM_UP * len(samples)) :]
    slope, error = _slope([s.step for s in kept], [s.memory_mb for s in kept])
    quarter = max(1, len(kept) // 4)
    counts = {
        name: {
            "before": max(getattr(s, name) for s in kept[:quarter]),
            "after": min(getattr(s, name) for s in kept[-quarter:]),
        }
        for name in COUNTED
    }
    return {
        "slope_mb_per_1000_steps": slope,
        "slope_range": [slope - 1.96 * error, slope + 1.96 * error] if slope is not None else None,
        "memory_mb": {"before": kept[0].memory_mb, "after": kept[-1].memory_mb},
        **counts,
    }


def problems(found: dict[str, Any]) -> list[str]:
    """What rose too much; one line each."""
    told = []
    slope = found["slope_mb_per_1000_steps"]
    if slope is None:
        told.append("too few samples to tell whether memory rises: take more steps")
    elif slope > MOST_GROWTH:
        told.append(f"memory rises by {slope:.2f} MB in 1,000 steps, more than {MOST_GROWTH:g}")
    for name in COUNTED:
        before, after = found[name]["before"], found[name]["after"]
        if after > before:
            told.append(f"{name} rise from {before} to {after}")
    return told


def _slope(steps: Sequence[int], megabytes: Sequence[float]) -> tuple[float | None, float]:
    """Slope of a straight line per 1,000 steps, and its standard error.

    Neighbouring samples resemble each other: they count as fewer, by the autocorrelation of what
    the line leaves over.
    """
    x, y = np.array(steps, float) / 1000, np.array(megabytes, float)
    if len(x) < 5 or np.ptp(x) == 0:
        return None, math.nan
    slope, start = np.polyfit(x, y, 1)
    rest = y - (start + slope * x)
    power = float(rest @ rest)
    alike = min(max(float(rest[1:] @ rest[:-1]) / power, 0.0), 0.95) if power else 0.0
    independent = max(len(x) * (1 - alike) / (1 + alike), 3.0)
    variance = power / len(x) * independent / (independent - 2)
    spread = float(((x - x.mean()) ** 2).mean()) * independent
    return float(slope), math.sqrt(variance / spread)


def commit() -> str:
    """The commit of this checkout, with a + where files differ from it."""
    told = subprocess.run(
        ["git", "describe", "--always", "--abbrev=40", "--dirty=+"],
        cwd=ROOT,
        env=os.environ | {"LC_ALL": "C"},
        capture_output=True,
        text=True,
        check=False,
    )
    return told.stdout.strip() or "unknown"


if __name__ == "__main__":
    sys.exit(main())
