"""Step times and time to quality of runs, from their logs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, final

import numpy as np

from ..quantities import ALIGNED, DEFAULT_QUANTITIES

#: How far below the end of a run further targets are, in dB.
BELOW = (0.0, 1.0, 2.0)
#: Scores that a running median is taken over. A curve with fewer is left as it is.
WINDOW = 5
#: What the score of aligned albedo is of.
ALIGNED_ALBEDO = "aligned albedo"
#: The first steps trace and compile; intervals of the log that begin before are left out.
WARM_UP = 4

Log = Sequence[Mapping[str, Any]]


@final
@dataclass(frozen=True)
class Target:
    """A score, and the time after which each run has it."""

    run: str  #: the run whose end sets it
    quantity: str  #: what is scored: `albedo`, `roughness`, or `aligned albedo`
    below: float  #: dB below that end
    psnr: float  #: dB, over all held-out views
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
    """The scores of a log in order: `seconds`, `step`, and PSNRs such as `albedo_psnr` in dB.

    Where photographs leave the scale of albedo open, `albedo_psnr_aligned` is one of them.
    """
    found = {r["step"]: r for r in log if _timed(r) and isinstance(r.get("score"), Mapping)}
    scored = [key for r in found.values() for key in r["score"] if _is_score(key)]
    keys = dict.fromkeys([*(f"{name}_psnr" for name in DEFAULT_QUANTITIES), *scored])
    return [
        {"seconds": r["seconds"], "step": step} | {key: r["score"].get(key) for key in keys}
        for step, r in sorted(found.items())
    ]


def smoothed(values: Sequence[float]) -> list[float]:
    """The running median of a score curve, over `WINDOW` scores.

    A single score off the curve has no weight. Windows are shorter at the ends: the first score,
    before any training, is kept; its neighbour and the last two have the median of three.

    Args:
        values: scores in dB, in order; fewer than `WINDOW` are returned as they are.
    """
    count = len(values)
    if count < WINDOW:
        return list(values)
    centres = [min(i, count - 2) for i in range(count)]
    reaches = [min(WINDOW // 2, i, count - 1 - i) for i in centres]
    return [
        float(np.median(values[i - reach : i + reach + 1]))
        for i, reach in zip(centres, reaches, strict=True)
    ]


def seconds_to(
    curve: Sequence[Mapping[str, Any]], target: float, quantity: str = "albedo"
) -> float | None:
    """The time after which a score curve, smoothed by a running median, first has a target.

    The smoothed scores are interpolated linearly.

    Args:
        curve: as `score_curve` gives it.
        target: PSNR in dB.
        quantity: what is scored.

    Returns:
        Seconds of training, None if the curve never gets there.
    """
    points = _points(curve, quantity)
    reached = next((i for i, (_, value) in enumerate(points) if value >= target), None)
    if reached is None:
        return None
    if reached == 0:
        return points[0][0]
    (t0, v0), (t1, v1) = points[reached - 1], points[reached]
    return t0 + (t1 - t0) * (target - v0) / (v1 - v0)


def time_to_quality(curves: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Target]:
    """Targets for every scored quantity: the end of each run's smoothed curve, and below it.

    A run sets no target below its end that it has before its first step. A run that leaves the
    scale of albedo open races with its aligned albedo alone: how far off the scale is, is chance.

    Args:
        curves: score curve of each run by name; a run without scores sets no target.

    Returns:
        By quantity, then by run, then from the highest to the lowest.
    """
    targets = []
    for quantity in _scored(curves.values()):
        for run, curve in curves.items():
            if not (points := _points(curve, quantity)):
                continue
            (_, first), (_, last) = points[0], points[-1]
            for below in BELOW:
                if below and last - below <= first:
                    break
                psnr = last - below
                times = {name: seconds_to(c, psnr, quantity) for name, c in curves.items()}
                targets.append(Target(run, quantity, below, psnr, times))
    return targets


def _scored(curves: Iterable[Sequence[Mapping[str, Any]]]) -> list[str]:
    """The quantities that score curves have, in the order of their appearance."""
    keys = dict.fromkeys(key for curve in curves for point in curve for key in point)
    return [_quantity(key) for key in keys if _is_score(key)]


def _is_score(key: str) -> bool:
    return key.endswith("_psnr") or key == ALIGNED


def _quantity(key: str) -> str:
    """What a score is of."""
    return ALIGNED_ALBEDO if key == ALIGNED else key.removesuffix("_psnr")


def _points(curve: Sequence[Mapping[str, Any]], quantity: str) -> list[tuple[float, float]]:
    """Seconds and smoothed scores; none of plain albedo where that has no scale of its own."""
    if quantity == "albedo" and any(point.get(ALIGNED) is not None for point in curve):
        return []
    key = ALIGNED if quantity == ALIGNED_ALBEDO else f"{quantity}_psnr"
    pairs = [(point["seconds"], point.get(key)) for point in curve]
    scored = [(t, v) for t, v in pairs if isinstance(v, int | float) and math.isfinite(v)]
    return list(zip([t for t, _ in scored], smoothed([v for _, v in scored]), strict=True))


def _timed(record: Mapping[str, Any]) -> bool:
    return all(isinstance(record.get(key), int | float) for key in ("step", "seconds"))
