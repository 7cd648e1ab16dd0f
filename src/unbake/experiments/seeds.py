"""Means and standard deviations over fits that differ in their seed."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any


def spread(key: str, values: Iterable[float | None]) -> dict[str, float]:
    """Mean and sample standard deviation of the values that are known.

    Returns:
        The mean as `key` and the deviation (with n - 1 in the denominator) as `key`_sd. A single
        value has no deviation; without values there is neither.
    """
    known = [value for value in values if value is not None]
    if not known:
        return {}
    deviation = {f"{key}_sd": statistics.stdev(known)} if len(known) > 1 else {}
    return {key: statistics.mean(known)} | deviation


def across_seeds(rows: Sequence[Mapping[str, Any]], keys: Iterable[str]) -> dict[str, float]:
    """`spread` of several keys of rows, one row for each seed."""
    merged = {}
    for key in keys:
        merged |= spread(key, [row.get(key) for row in rows])
    return merged


def plus_minus(
    row: Mapping[str, Any], key: str, digits: int = 1, factor: float = 1.0
) -> str | None:
    """A mean with its standard deviation if there is one, such as "29.2 ± 0.1"; None if unknown."""
    mean, deviation = row.get(key), row.get(f"{key}_sd")
    if mean is None:
        return None
    text = f"{factor * mean:.{digits}f}"
    return text if deviation is None else f"{text} ± {factor * deviation:.{digits}f}"


def seeds_in_words(count: int) -> str:
    """What the spread of a table is of: "mean ± standard deviation over 3 seeds"."""
    return f"mean ± standard deviation over {count} seeds" if count > 1 else "one seed"
