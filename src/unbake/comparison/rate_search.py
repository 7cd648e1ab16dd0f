"""The search for learning rates of a method: which trials it makes, and which one it takes.

It knows no fits: whoever calls it scores the trials.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import final

from ..config import ChosenEstimator

#: Ratio of neighbouring rates.
STEP = 2.5
#: Differences of scores that are not smaller count, in dB.
MARGIN = 0.2
#: Score of a trial that failed.
LEAST = -1000.0
#: The unknowns are gone through this often at most.
ROUNDS = 2


@final
@dataclass(frozen=True)
class Trial:
    """Settings to be tried.

    Args:
        unknowns: names of the unknowns.
        powers: for each unknown, n where its rate is 2.5ⁿ times that of its field.
        estimator: of gradients.
    """

    unknowns: tuple[str, ...]
    powers: tuple[int, ...]
    estimator: ChosenEstimator

    @property
    def factors(self) -> dict[str, float]:
        """Multiples of the fields' own rates, by unknown."""
        pairs = zip(self.unknowns, self.powers, strict=True)
        return {name: float(f"{STEP**power:.6g}") for name, power in pairs}

    def moved(self, unknown: str, by: int) -> Trial:
        """The same with another rate of one unknown."""
        pairs = zip(self.unknowns, self.powers, strict=True)
        return replace(self, powers=tuple(n + by * (name == unknown) for name, n in pairs))


def best_trial(
    unknowns: Sequence[str], estimators: Sequence[ChosenEstimator], score: Callable[[Trial], float]
) -> Trial:
    """Search the rates of one unknown after the other, then the estimator, and once again.

    From the best rate so far, a factor of 2.5 is tried in both directions, and further on in the
    better one for as long as that improves the score: each unknown has three rates at least, and
    the best one is between two others. What is less than `MARGIN` better does not count, so that
    rates stay where they are unless that matters.

    Args:
        unknowns: whose rates are searched, in this order.
        estimators: to choose from, the published one first; it is taken unless another is better.
        score: of a trial in dB, higher is better; `LEAST` if it failed. It is asked for some trials
            more than once.
    """
    best = Trial(tuple(unknowns), (0,) * len(unknowns), estimators[0])
    for _ in range(ROUNDS):
        before = best
        for unknown in unknowns:
            best = _along(unknown, best, score)
        others = [replace(best, estimator=name) for name in estimators if name != best.estimator]
        best = _better(best, others, score)
        if best == before:
            break
    return best


def beats(first: Sequence[float], second: Sequence[float]) -> bool:
    """Whether scores are better than others by `MARGIN`, and by more than seeds differ.

    Fits of one seed begin alike, so that the difference is taken seed by seed.

    Args:
        first: in dB, one for each seed.
        second: those of other settings, with the same seeds.
    """
    gains = [a - b for a, b in zip(first, second, strict=True)]
    spread = statistics.stdev(gains) if len(gains) > 1 else 0.0
    return statistics.fmean(gains) >= max(MARGIN, spread)


def _along(unknown: str, start: Trial, score: Callable[[Trial], float]) -> Trial:
    """The best rate of one unknown, from a trial on."""
    sides = {step: start.moved(unknown, step) for step in (-1, 1)}
    best = _better(start, list(sides.values()), score)
    step = next((step for step, trial in sides.items() if trial == best), 0)
    while best != start:
        start, best = best, _better(best, [best.moved(unknown, step)], score)
    return best


def _better(best: Trial, others: Sequence[Trial], score: Callable[[Trial], float]) -> Trial:
    """The best of the others if it is better by the margin."""
    first = score(best)
    scores = {trial: score(trial) for trial in others}
    top = max(scores, key=lambda trial: scores[trial], default=best)
    return top if scores.get(top, first) - first >= MARGIN else best
