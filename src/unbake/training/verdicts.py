"""Words for how the error on held-aside pixels went at the end of a fit. Needs no variant."""

from __future__ import annotations

from typing import Literal

Trend = Literal["improving", "plateau", "rising", "unclear"]

#: What is told of each trend.
WORDS: dict[str, str] = {
    "improving": "still improving",
    "plateau": "at a plateau",
    "rising": "getting worse",
    "unclear": "too noisy",
}


def in_units_of_noise(change: float, noise: float) -> str | None:
    """A change by its noise, where it is no share of the error; else None.

    Errors have no bias, and those of a good fit may be about zero or below.

    Args:
        change: of the error, relative to what it was.
        noise: standard error of the change, in the same unit.
    """
    if noise < 1 and change >= -1:
        return None
    times = abs(change) / max(noise, 1e-9)
    if times <= 1:
        return "changed by less than its noise"
    return f"{'rose' if change > 0 else 'fell'} by {times:.1f} times its noise"
