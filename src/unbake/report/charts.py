"""Small charts of a run's log: what to draw, in the coordinates of an SVG picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np

WIDTH, HEIGHT = 400, 250
LEFT, RIGHT, TOP, BOTTOM = 50, 388, 10, 212  # the plotting area inside it
BINS = 120  # more points than this are summarised, one point a bin
TICKS = 6  # wanted on a linear axis
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@final
@dataclass(frozen=True)
class Tick:
    """A labelled place on an axis, in SVG units."""

    at: float
    label: str


@final
@dataclass(frozen=True)
class Line:
    """One run's curve: an SVG path, a band around it (empty where nothing was summarised)."""

    run: int
    path: str
    band: str
    end: tuple[float, float]


@final
@dataclass(frozen=True)
class Chart:
    """Axes and curves of one quantity for all runs."""

    x_title: str
    x_ticks: list[Tick]
    y_ticks: list[Tick]
    lines: list[Line]


@final
@dataclass(frozen=True)
class _Series:
    """Points of one run, with a lower and an upper edge where several were summarised."""

    run: int
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None


Record = dict[str, Any]


def chart(
    logs: Sequence[list[Record]],
    x_key: str,
    x_title: str,
    y_of: Callable[[Record], object],
    logarithmic: bool,
) -> Chart | None:
    """Lay out one quantity of several logs over steps or seconds.

    More than 120 points of a run are summarised in equal intervals of x: the line is their mean
    (geometric on a logarithmic axis), the band reaches from their 10th to their 90th percentile.

    Args:
        logs: one list of log records a run.
        x_key: the key of the x value in a record.
        x_title: the x axis' title with its unit.
        y_of: gives a record's value; what is no finite number is left out.
        logarithmic: whether y is logarithmic; values that are not positive are then left out.

    Returns:
        None where no run has a value.
    """
    series = []
    for run, log in enumerate(logs):
        x, y = _points(log, x_key, y_of, logarithmic)
        if len(x):
            series.append(_summarise(run, x, y))
    if not series:
        return None
    x_low = min(0.0, min(float(s.x.min()) for s in series))
    x_high = max(float(s.x.max()) for s in series)
    x_high = x_high if x_high > x_low else x_low + 1
    y_low, y_high = _padded(
        min(float(s.y.min()) for s in series), max(float(s.y.max()) for s in series)
    )

    def place(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        across = LEFT + (x - x_low) / (x_high - x_low) * (RIGHT - LEFT)
        up = BOTTOM - np.clip((y - y_low) / (y_high - y_low), 0, 1) * (BOTTOM - TOP)
        return across, up

    x_values = _round_values(x_low, x_high, TICKS)
    x_at = place(np.array(x_values), np.zeros(len(x_values)))[0]
    y_marks = _decades(y_low, y_high) if logarithmic else _plain(y_low, y_high)
    y_at = place(np.zeros(len(y_marks)), np.array([value for value, _ in y_marks]))[1]
    return Chart(
        x_title,
        [
            Tick(round(float(at), 1), _short(value))
            for value, at in zip(x_values, x_at, strict=True)
        ],
        [Tick(round(float(at), 1), text) for (_, text), at in zip(y_marks, y_at, strict=True)],
        [_line(s, place) for s in series],
    )


def _points(
    log: list[Record], x_key: str, y_of: Callable[[Record], object], logarithmic: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Finite points in the order of x (y as log10 where asked for).

    A run that went on from a checkpoint repeats steps: the last record of an x counts.
    """
    points: dict[float, float] = {}
    for record in log:
        x, y = record.get(x_key), y_of(record)
        if not (isinstance(x, int | float) and isinstance(y, int | float)):
            continue
        if math.isfinite(x) and math.isfinite(y) and (y > 0 or not logarithmic):
            points[float(x)] = math.log10(y) if logarithmic else float(y)
    ordered = sorted(points.items())
    return np.array([x for x, _ in ordered]), np.array([y for _, y in ordered])


def _summarise(run: int, x: np.ndarray, y: np.ndarray) -> _Series:
    if len(x) <= BINS:
        return _Series(run, x, y, None, None)
    edges = np.linspace(x[0], x[-1], BINS + 1)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, BINS - 1)
    groups = [index == i for i in np.unique(index)]
    low, high = np.array([np.percentile(y[group], (10, 90)) for group in groups]).T
    return _Series(
        run,
        np.array([x[group].mean() for group in groups]),
        np.array([y[group].mean() for group in groups]),
        low,
        high,
    )


def _line(
    series: _Series, place: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> Line:
    x, y = place(series.x, series.y)
    band = ""
    if series.low is not None and series.high is not None:
        upper, lower = place(series.x, series.high)[1], place(series.x, series.low)[1]
        band = _path(np.concatenate([x, x[::-1]]), np.concatenate([upper, lower[::-1]])) + "Z"
    return Line(series.run, _path(x, y), band, (round(float(x[-1]), 1), round(float(y[-1]), 1)))


def _path(x: np.ndarray, y: np.ndarray) -> str:
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True))


def _padded(low: float, high: float) -> tuple[float, float]:
    margin = 0.05 * (high - low) if high > low else 0.5
    return low - margin, high + margin


def _round_values(low: float, high: float, about: int) -> list[float]:
    """Multiples of 1, 2 or 5 times 10^n between low and high, some `about` of them."""
    rough = (high - low) / about
    decade = 10.0 ** math.floor(math.log10(rough))
    step = next(m * decade for m in (1, 2, 5, 10) if m * decade >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(i * step, 12) for i in range(first, last + 1)]


def _plain(low: float, high: float) -> list[tuple[float, str]]:
    return [(value, _short(value)) for value in _round_values(low, high, TICKS)]


def _decades(low: float, high: float) -> list[tuple[float, str]]:
    """Ticks of a log10 axis: powers of ten, and 2 and 5 times them where few fit."""
    span = high - low
    factors = (1,) if span > 2 else (1, 2, 5) if span > 0.7 else (1, 1.5, 2, 3, 4, 5, 6, 7, 8, 9)
    every = max(1, math.ceil(span / 6))
    marks = []
    for exponent in range(math.floor(low), math.ceil(high) + 1):
        for factor in factors:
            at = exponent + math.log10(factor)
            if low <= at <= high and exponent % every == 0:
                marks.append((at, _power(factor, exponent)))
    return marks if len(marks) > 1 else [(at, _short(10**at)) for at in (low, high)]


def _power(factor: float, exponent: int) -> str:
    if -3 <= exponent <= 3:
        return f"{factor * 10.0**exponent:g}"
    power = "10" + str(exponent).translate(SUPERSCRIPTS)
    return power if factor == 1 else f"{factor:g}·{power}"


def _short(value: float) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g} M"
    text = f"{value:g}" if abs(value) < 1e4 else f"{value:,.0f}".replace(",", "\u202f")
    return text.replace("-", "−")
