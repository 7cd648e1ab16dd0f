"""The output of a running fit: a progress display and a JSONL log."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from io import FileIO
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ..errors import UserError
from ..progress import duration
from ..transport.terms import LOGGED
from .event_log import EventLog

#: Seconds between lines where there is no terminal.
QUIET_SECONDS = 10.0
#: Steps that may compile something, and as many more that tell how long one takes.
_WARM_UP = 3
#: Columns of the bar, and of what stands beside it: percentage, time left, and spaces between them.
_BAR, _BESIDE = 10, 16
#: Short names of loss terms in the line of progress.
SHORT = {"photometric": "photo", "prior_extra": "extra"}


def loss_terms(entry: Mapping[str, Any]) -> list[str]:
    """Names of the loss terms in a line of the log: the method's, then the regularizers."""
    return [k for k, v in entry.items() if isinstance(v, int | float) and k not in LOGGED]


class Monitor:
    """Shows progress and appends to the log; a context manager.

    A bar with loss terms, samples/s, time left and memory on a terminal, plain lines elsewhere.
    Lines of the log that cannot be written, on a full disk, wait for room; `failures` tells of
    those that were not written in the end.

    Args:
        log: the file to append to.
        console: where progress is shown.
        total: what `record` counts to.
        events: takes the same numbers for TensorBoard, and is closed in the end.
    """

    def __init__(
        self, log: Path, console: Console, total: float, events: EventLog | None = None
    ) -> None:
        self._events = events
        self.failures: list[UserError] = []
        self._path = log
        self._file: FileIO  # opened by `__enter__`
        self._unwritten = b""
        self._console = console
        self._total = total
        self._last_line = -QUIET_SECONDS
        self._first_step: int | None = None
        #: Step, seconds and what was done when nothing was compiled any more.
        self._warm: tuple[int, float, float] | None = None
        self._bar = Progress(
            TextColumn("{task.percentage:3.0f} %"),
            BarColumn(bar_width=_BAR),
            TimeRemainingColumn(compact=True),
            TextColumn("{task.description}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("compiling the first step …", total=total)

    def __enter__(self) -> Monitor:
        self._file = open(self._path, "ab", buffering=0)
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
        if self._events is not None:
            self._events.close()
        try:
            self._file.close()
        except OSError as error:  # disks over a network may tell only now that they are full
            self.failures.append(self._unwritable(error))

    def say(self, line: str) -> None:
        """Print a line above the bar."""
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def note(
        self, step: int, seconds: float, line: str, *, say: bool = True, verdict: bool = False
    ) -> None:
        """Log, and print, what has to be known of the fit after a step.

        Args:
            step: number of the step.
            seconds: of training.
            line: what is noted.
            say: whether it is printed, too.
            verdict: whether it is of the whole fit, and so no longer of one that goes on.
        """
        entry = {"step": step, "seconds": seconds, "note": line}
        self._write(entry | {"verdict": True} if verdict else entry)
        if say:
            self.say(f"warning: {line}")

    def record(self, done: float, entry: dict) -> None:
        """Show and log the state after a step.

        Args:
            done: in the unit of the total.
            entry: the line of the log; its loss terms are shown.
        """
        self._write(entry)
        parts = [f"step {entry['step']}"]
        parts += [f"{SHORT.get(t, t)} {_number(entry[t])}" for t in loss_terms(entry)]
        parts.append(f"{entry['samples_per_second'] / 1e3:.0f} k samples/s")
        parts.append(f"{entry['memory_mb']:.0f} MB")
        width = self._console.width
        ahead = self._ahead(done, entry["step"], entry["seconds"])
        self._bar.update(
            self._task, completed=done, description=_fitting(parts, width - _BAR - _BESIDE)
        )
        if not self._console.is_terminal and entry["seconds"] - self._last_line >= QUIET_SECONDS:
            self._last_line = entry["seconds"]
            left = "" if ahead is None else f"  {duration(ahead)} left"
            share = min(1.0, done / self._total) if self._total else 1.0
            start = f"{100 * share:3.0f} %  "
            self.say(f"{start}{_fitting(parts, width - len(start) - len(left))}{left}")

    def _ahead(self, done: float, step: int, seconds: float) -> float | None:
        """Seconds that are left at the pace since the first steps; None: that is not known yet."""
        if done >= self._total:
            return 0.0
        if self._first_step is None:
            self._first_step = step  # a run that goes on compiles again
        if self._warm is None:
            if step >= self._first_step + _WARM_UP:
                self._warm = (step, seconds, done)
            return None
        warm_step, warm_seconds, warm_done = self._warm
        if step < warm_step + _WARM_UP:
            return None
        return (seconds - warm_seconds) * (self._total - done) / (done - warm_done)

    def validation(self, entry: dict) -> None:
        """Log and print how good the materials or pictures are by now, or how strong the lights."""
        self._write(entry)
        v = entry["validation"]
        if "held_aside" in v:
            text = f"held-aside pixels, error {_number(v['held_aside'])}"
        elif "render_psnr" in v:
            text = f"photographs of held-out views, explained to {v['render_psnr']:.1f} dB"
        elif "emission" in v:
            strengths = ((name, *(f"{x:.4g}" for x in rgb)) for name, rgb in v["emission"].items())
            text = ", ".join(" ".join(words) for words in strengths)
        else:
            scores = {k.removesuffix("_psnr"): x for k, x in v.items() if k.endswith("_psnr")}
            told = ", ".join(f"{name} {score:.1f} dB" for name, score in scores.items())
            text = f"{v['split']} view, {told}"
        self.say(f"step {entry['step']}, {entry['seconds']:.0f} s: {text}")

    def _unwritable(self, error: OSError) -> UserError:
        what = f"the log cannot be written ({error.strerror})"
        return UserError(what, self._path, "Make room")

    def _write(self, entry: dict) -> None:
        if self._events is not None:
            self._events.add(entry)
        # JSON has no number for a loss that no step had.
        known = {k: v for k, v in entry.items() if not isinstance(v, float) or math.isfinite(v)}
        rounded = {k: round(v, 7) if isinstance(v, float) else v for k, v in known.items()}
        told, self.failures = self.failures, []
        self._unwritten += (json.dumps(rounded, allow_nan=False) + "\n").encode()
        try:
            while self._unwritten:  # a disk may have room for a part of it
                self._unwritten = self._unwritten[self._file.write(self._unwritten) :]
        except OSError as error:
            self.failures = [self._unwritable(error)]
            if not told:
                self.say(f"warning: {self.failures[0]}; the fit goes on")


def _number(value: float) -> str:
    """A number in three digits: 0.0912, 1.39, 26.7, 641."""
    if not math.isfinite(value):
        return str(value)
    return f"{value:.{max(0, 2 - max(-2, math.floor(math.log10(abs(value) or 1))))}f}"


def _fitting(parts: list[str], columns: int) -> str:
    """The first of some parts, as many as fit the columns; the very first one always."""
    line = parts[0]
    for part in parts[1:]:
        if len(line) + 2 + len(part) > columns:
            break
        line += "  " + part
    return line
