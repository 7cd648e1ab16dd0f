"""When a running fit saves its state, and what happens where it cannot."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, final

from ..errors import UserError
from .checkpoint import Progress, save_checkpoint
from .run_folder import RunFolder
from .run_lock import RunLock
from .state import State

#: Training time before the first checkpoint of a fit, or of a resumed one, in seconds.
FIRST = 10.0
#: The most of a fit's time that its checkpoints take.
SHARE = 0.01


@final
class Saving:
    """Saves a fit at intervals: soon at first, then so that it costs little.

    A checkpoint that cannot be written is told, and the fit goes on: room on a full disk may be
    made before the next one. Only the last one must succeed.

    Args:
        run: the run.
        lock: the lock of its folder, held; None: nothing is saved, as on ranks that do not lead.
        about: what manifests say of the run; see `save_checkpoint`.
        every: training time between checkpoints in seconds; it is longer where a checkpoint would
            cost more than `SHARE` of it. 0: as often as possible, whatever it costs.
        seconds: training time at the start.
    """

    def __init__(
        self,
        run: RunFolder,
        lock: RunLock | None,
        about: Mapping[str, Any],
        every: float,
        seconds: float,
    ) -> None:
        self._run, self._lock, self._about = run, lock, about
        self._every = every
        self._next = seconds + min(every, FIRST)

    def due(self, seconds: float) -> bool:
        """Whether it is time for a checkpoint, after so much training time."""
        return self._lock is not None and seconds >= self._next

    def require_held(self) -> None:
        """Check that the folder is still the one that was locked, if anything is saved in it.

        Raises:
            UserError: it is not.
        """
        if self._lock is not None:
            self._lock.require_held()

    def save(self, state: State, progress: Progress) -> list[UserError]:
        """Write a checkpoint, or return why it cannot be written.

        Raises:
            UserError: the folder of the run is gone, and nothing more can be saved in it.
        """
        if self._lock is None:
            return []
        self._lock.require_held()
        start, failures = time.perf_counter(), []
        try:
            save_checkpoint(self._run, state, progress, self._about)
        except UserError as error:
            failures.append(error)
        cost = time.perf_counter() - start
        self._next = progress.seconds + (max(self._every, cost / SHARE) if self._every else 0.0)
        return failures
