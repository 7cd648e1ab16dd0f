"""Watches a fit: skipped steps, a loss that explodes, and a fit that learns nothing."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from statistics import median, stdev
from typing import final

from ..errors import UserError
from ..transport.methods import PHOTOMETRIC
from ..transport.samplers import GUIDE
from .checkpoint import Progress
from .diagnosis import diagnose
from .state import Snapshot, State
from .step import TrainingStep

#: Consecutive steps without a finite loss after which a fit gives up. It also does where more than
#: half of so many steps, or of the whole fit, were skipped.
GIVE_UP_AFTER = 100
#: A loss has exploded where it is so many times as high as it was lately, in two readings of
#: `READ_EVERY` steps, one after the other. Compared are medians over the steps of a reading, in
#: which single fireflies do not count.
EXPLOSION = 30.0
#: Steps that a median has at least. A reading may have fewer, such as the last one of a fit: those
#: before it are counted as well. Nothing is said of the loss of fewer.
_FEWEST_STEPS = 5
#: Readings that say how high the loss was lately, and how many there must be.
_LATELY, _FEWEST = 25, 3
#: Readings between snapshots. The older of two is the one to go back to: at least so many readings
#: before the first one with an exploded loss.
_BETWEEN_SNAPSHOTS = 5
#: Factor on all learning rates after an explosion.
SLOWER = 0.5
#: Batches of the first steps that are looked at again in the end.
COMPARED = 8
#: Losses of those batches that are so many times that of the first one are left out.
_FAR = 10.0
#: Steps of a fit from which on it should have learned something.
LONG_ENOUGH = 200
#: Where the loss falls by less than this share, most batches must agree that it falls.
_CLEARLY, _MOST = 0.01, 0.8
#: Where the change of the loss has a standard error of more than this share, as with noisy paths,
#: nothing is said unless the loss has risen by two of them.
_NOISY, _SURE = 0.1, 2.0
#: Parameters are of the order of one: those that moved by less have not learned anything.
_STANDING = 1e-3
#: A fit is worse than none where its loss is so many times that of black pictures.
_WORSE_THAN_BLACK = 100.0
_LOOK = "Look at the learning rates, the lights and the cameras"

Reading = Mapping[str, float]


@final
class Watchdog:
    """Watches the loss and the state of a fit at each reading of the log.

    Steps without a finite loss are counted, and the first one is explained. Where the loss explodes
    or a parameter is not finite, the fit goes back to its last good state, once, and on from there
    with lower rates. In the end the batches of the first steps show whether anything was learned.

    Args:
        state: of the fit.
        step: its training step.
        progress: of the fit; what a resumed fit has to know is noted there.
        views: names of the training views.
    """

    def __init__(
        self, state: State, step: TrainingStep, progress: Progress, views: Sequence[str]
    ) -> None:
        self._state, self._step, self._progress, self._views = state, step, progress, views
        self._lately: deque[float] = deque(maxlen=_LATELY)
        self._last_losses: deque[float] = deque(maxlen=_FEWEST_STEPS)
        self._good: deque[tuple[int, Snapshot]] = deque(maxlen=2)
        self._good.append((progress.step, state.snapshot()))
        self._readings = self._suspicious = self._since = self._in_a_row = 0
        self._first = math.nan  # the loss with which this watch began
        self._cause = ""

    @property
    def trusts(self) -> bool:
        """Whether the state looks good enough to be saved."""
        return not self._suspicious

    def rates(self, rates: Mapping[str, float]) -> dict[str, float]:
        """Learning rates, lower after an explosion."""
        return {name: rate * self._progress.rate for name, rate in rates.items()}

    def read(self, readings: Sequence[Reading], *, last: bool) -> list[str]:
        """Look at the loss terms of the last steps, and act.

        Args:
            readings: of each step, as numbers.
            last: whether the fit ends with these steps.

        Returns:
            What is to be told.

        Raises:
            UserError: the fit makes no sense any more; its state is the last good one.
        """
        self._note_untrained(readings)
        told = self._count_skipped(readings, last)
        level = self._level(readings)
        broken = self._state.broken()
        enough = len(self._lately) >= _FEWEST
        known = enough or len(self._last_losses) >= _FEWEST_STEPS
        if math.isnan(self._first):
            self._first = self._beginning(readings, level if known else math.nan)
        usual = median(self._lately) if enough else self._first
        most = EXPLOSION * usual * (1 if enough else EXPLOSION)
        self._since += len(readings)
        if self._suspicious and self._since < _FEWEST_STEPS and not (broken or last):
            return told  # the median is still that of the steps that were suspicious
        if broken or (known and level > most):
            self._suspicious += 1
            self._since = 0
            if broken or last or self._suspicious > 1:
                what = f"{', '.join(broken)} has numbers that are not finite"
                if not broken:
                    what = f"the loss rose from about {usual:.3g} to {level:.3g}"
                told.append(self._go_back(what, last))
            return told
        self._suspicious = 0
        self._readings += 1
        if known and math.isfinite(level):
            self._lately.append(level)
        if self._readings % _BETWEEN_SNAPSHOTS == 0:
            self._good.append((self._progress.step, self._state.snapshot()))
        return told

    def settle(self) -> list[str]:
        """Go back to the last good state, if the present one is not trusted, in a fit that stops.

        A single reading is too little to call the fit diverged: the rates stay.

        Returns:
            What is to be told.
        """
        if self.trusts:
            return []
        number = self._restore()
        what = "the loss had risen far above what it was lately"
        return [f"step {self._progress.step}: {what}; saved is the state of step {number}"]

    def keep(self) -> None:
        """Go back no further than to the present state, as one that a search has found.

        A search is not made again, and steps leave alone what it has found.
        """
        if self.trusts:
            self._good.clear()
            self._good.append((self._progress.step, self._state.snapshot()))

    def verdict(self, rates: Mapping[str, float]) -> str | None:
        """What is wrong with a fit that has ended; None if it has learned something.

        The batches of the first steps are looked at again, with the same random numbers: what is
        noise is in both, and what differs was learned.

        Args:
            rates: Adam's learning rates at the start, of unknowns and L_θ.
        """
        before, progress = self._progress.untrained, self._progress
        if progress.step < LONG_ENOUGH:
            return None
        if not self._state.moved():
            return f"nothing was learned: no gradient ever reached the unknowns. {_LOOK}"
        # Adam moves a parameter by about its rate in a step
        path = progress.step * max(rates[key.partition(".")[0]] for key in self._state.phi)
        if path < _STANDING:
            what = f"{progress.step} steps move the unknowns by {path:.1g} at most"
            return f"nothing was learned: {what}. Raise the learning rates"
        again = self._looked_at_again(len(before) or 1)
        if PHOTOMETRIC not in again[0]:  # a method without images
            return None
        end, black = median(r[PHOTOMETRIC] for r in again), self._step.loss_of_black()
        if end > _WORSE_THAN_BLACK * black:
            return (
                f"nothing useful was learned: the loss is {end:.3g}, and of black pictures "
                f"{black:.3g}. Look at the strength of the lights, and the unit of the photographs"
            )
        if self._step.config.learns_emission:
            # L_θ begins with the light that lamps have yet to give: the loss rises before it falls.
            return None
        # With rates that are far too high, the fields are not untrained any more after one step.
        pairs = [(a, b[PHOTOMETRIC]) for a, b in zip(before, again, strict=False)]
        if progress.processes != self._step.processes:  # their batches are others
            pairs.clear()
        pairs = [(a, b) for a, b in pairs if abs(a) < _FAR * abs(before[0])]
        if not pairs:
            return None
        start, end = (sum(losses) / len(pairs) for losses in zip(*pairs, strict=True))
        fallen, better = start - end, sum(b < a for a, b in pairs)
        if fallen > _CLEARLY * abs(start) or better > _MOST * len(pairs):
            return None
        error = stdev([a - b for a, b in pairs]) / math.sqrt(len(pairs)) if len(pairs) > 1 else 0
        if error > _NOISY * abs(start) and fallen > -_SURE * error:
            return None
        return (
            "nothing was learned: the photographs are explained no better than by the untrained "
            f"fields (loss {end:.4g}, and {start:.4g} at the start). {_LOOK}"
        )

    def _level(self, readings: Sequence[Reading]) -> float:
        """How high the loss of a reading is; NaN if all its steps were skipped."""
        losses = [abs(_total(reading)) for reading in readings if not reading["skipped"]]
        self._last_losses.extend(losses)
        if not losses:
            return math.nan
        return median(losses if len(losses) >= _FEWEST_STEPS else self._last_losses)

    def _beginning(self, readings: Sequence[Reading], level: float) -> float:
        """The loss from which a fit begins, at least that of black images, or goes on.

        The first step alone does not tell: in a dim room its pixels may all be next to black.

        Args:
            readings: the first ones.
            level: how high their loss is; NaN while too few are known.
        """
        first = readings[0]
        if self._progress.step > len(readings) or PHOTOMETRIC not in first:
            return level
        return max(self._step.loss_of_black(), abs(_total(first)))

    def _note_untrained(self, readings: Sequence[Reading]) -> None:
        """Note the losses of photographs in the first steps, when next to nothing was learned.

        Others are not compared: the prior of L_θ rises as light is learned.
        """
        noted, first = self._progress.untrained, self._progress.step - len(readings)
        if first == len(noted) < COMPARED and PHOTOMETRIC in readings[0]:
            losses = [reading[PHOTOMETRIC] for reading in readings[: COMPARED - len(noted)]]
            if all(map(math.isfinite, losses)):
                self._progress.untrained = (*noted, *losses)
                self._progress.processes = self._step.processes

    def _count_skipped(self, readings: Sequence[Reading], last: bool) -> list[str]:
        progress, told = self._progress, []
        skipped = [i for i, reading in enumerate(readings) if reading["skipped"]]
        if skipped and not self._cause:
            number = progress.step - len(readings) + skipped[0]
            self._cause = diagnose(self._step, self._state, number, self._views)
            told.append(f"step {number + 1} was skipped: {self._cause}; further ones are counted")
        progress.skipped += len(skipped)
        self._in_a_row = self._in_a_row + len(skipped) if len(skipped) == len(readings) else 0
        long_enough = last or progress.step >= GIVE_UP_AFTER
        if self._in_a_row >= GIVE_UP_AFTER or (
            2 * progress.skipped > progress.step and long_enough
        ):
            raise UserError(
                f"the loss was not finite in {progress.skipped} of {progress.step} steps: "
                f"{self._cause}",
                remedy="Lower the learning rates, or look for extreme values in images and scene",
            )
        return told

    def _go_back(self, what: str, last: bool) -> str:
        """Go back to the last good state, or give up where that was done before."""
        number = self._restore()
        again = " again" if self._progress.rate < 1 else ""
        if again or last:
            raise UserError(
                f"the fit diverged{again}: {what} by step {self._progress.step}",
                remedy=f"{_LOOK}; the state of step {number} is kept",
            )
        self._progress.rate *= SLOWER
        return (
            f"step {self._progress.step}: {what}; back to the state of step {number}, with "
            f"{SLOWER:g} times the learning rates"
        )

    def _restore(self) -> int:
        """Restore the last good state; returns after which step it was."""
        number, snapshot = self._good[0]
        self._state.restore(snapshot)
        self._good.clear()
        self._good.append((number, snapshot))
        self._last_losses.clear()
        self._suspicious = 0
        return number

    def _looked_at_again(self, count: int) -> list[Reading]:
        """The loss terms of the first batches, now."""
        now, rates = self._state.snapshot(), dict.fromkeys(self._step.rate_names, 0.0)
        readings = []
        for number in range(count):
            terms = self._step(self._state, number, rates)
            readings += self._step.read([terms])
            self._state.restore(now)
        return readings


def _total(reading: Reading) -> float:
    """The loss of a step, without that of the guide: a cross-entropy, large or below zero."""
    return sum(value for term, value in reading.items() if term not in ("skipped", GUIDE))
