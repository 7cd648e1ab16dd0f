"""Step times and time to quality of runs, from their logs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import numpy as np

from ..quantities import DEFAULT_QUANTITIES

#: The first steps trace and compile; intervals of the log that begin before are left out.
WARM_UP = 4

Log = Sequence[Mapping[str, Any]]


@final
@dataclass(frozen=True)
class Target:
    """A score, and the time from which each run stays at or above it."""

    run: str  #: the run whose last score this is
    albedo_psnr: float  #: dB, over all held-out views
    seconds: dict[str, float | None]  #: of training by run; None: never


def milliseconds_per_step(log: Log) -> float | None:
    """Median time of a step after warm-up, in ms; None if the log is too short."""
    at = {r["step"]: r["seconds"] for r in log if _timed(r)}
    marks = sorted(at.items())
    spent, steps = [], []
    for (first, start), (last, end) in pairwise(marks):
        if first >= WARM_UP:
            spent.append(1e3 * (end - start) / (last - first))
            steps.append(last - first)
    # The median is over steps: intervals of the log differ in length.
    return float(np.median(np.repeat(spent, steps))) if spent else None


def score_curve(log: Log) -> list[dict[str, float | None]]:
    """The scores of a log in order: `seconds`, `step`, and PSNRs such as `albedo_psnr` in dB."""
    found = {r["step"]: r for r in log if _timed(r) and isinstance(r.get("score"), Mapping)}
    scored = [key for r in found.values() for key in r["score"] if key.endswith("_psnr")]
    keys = dict.fromkeys([*(f"{name}_psnr" for name in DEFAULT_QUANTITIES), *scored])
    return [
        {"seconds": r["seconds"], "step": step} | {key: r["score"].get(key) for key in keys}
        for step, r in sorted(found.items())
    ]


def seconds_to(curve: Sequence[Mapping[str, Any]], target: float) -> float | None:
    """The time from which a score curve stays at or above a target: its last upward crossing.

    Scores are interpolated linearly.

    Args:
        curve: as `score_curve` gives it.
        target: albedo PSNR in dB.

    Returns:
        Seconds of training, None if the curve ends below the target.
    """
    points = _points(curve)
    below = [i for i, (_, value) in enumerate(points) if value < target]
    if not points or below[-1:] == [len(points) - 1]:
        return None
    if not below:
        return points[0][0]
    (t0, v0), (t1, v1) = points[below[-1]], points[below[-1] + 1]
    return t0 + (t1 - t0) * (target - v0) / (v1 - v0)


def time_to_quality(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Target]:
    """A target for the last score of each run.

    Args:
        curves: score curve of each run by name; a run without scores sets no target.
    """
    ends = {name: points[-1][1] for name, c in curves.items() if (points := _points(c))}
    return [
        Target(run, end, {name: seconds_to(curve, end) for name, curve in curves.items()})
        for run, end in ends.items()
    ]


def _points(curve: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    scored = [(point["seconds"], point.get("albedo_psnr")) for point in curve]
    return [(t, v) for t, v in scored if isinstance(v, int | float) and math.isfinite(v)]


def _timed(record: Mapping[str, Any]) -> bool:
    return all(isinstance(record.get(key), int | float) for key in ("step", "seconds"))
