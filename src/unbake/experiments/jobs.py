"""Jobs that are done once: a file keeps what each one finds, so that a stopped run continues.

A job is done if its file has its settings and findings, and if the files that it writes exist.
This module knows neither Mitsuba nor Dr.Jit.
"""

from __future__ import annotations

import hashlib
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from rich.console import Console

from ..errors import UserError
from ..io import write_json
from ..memory import lack_told
from ..ranks import Ranks
from ..signals import cleaned_up, interrupt

#: What a job finds. It must be serializable as JSON.
Findings = dict[str, Any]
#: What a job's file holds: `settings`, `machine`, `seconds`, and `findings` or `error`.
Record = dict[str, Any]


class Unfinished(Exception):
    """A job was stopped before its end. The next call continues it."""


@final
@dataclass(frozen=True)
class Job:
    """A unit of work with findings that are kept.

    Args:
        name: file name of its record, unique within a run.
        settings: everything that its findings depend on. A job whose settings change is repeated.
        work: does the job. It raises `UserError` if the job fails, and `Unfinished` if it was
            stopped.
        seconds: computing time on the machine of `speed.REFERENCE`; None if it was not measured.
        waits: seconds that do not depend on the machine, such as a fit of a given duration.
        files: files that it writes. Without them the job is repeated.
        group: jobs of one group need each other's files, or the whole machine: one process does
            them, in order. Several processes may do those of several groups at the same time.
    """

    name: str
    settings: Mapping[str, Any]
    work: Callable[[], Findings]
    seconds: float | None = None
    waits: float = 0.0
    files: Sequence[Path] = ()
    group: str = ""


@final
@dataclass(frozen=True)
class Outcome:
    """How the jobs of a run ended.

    Args:
        records: of the jobs that are done, by name.
        failed: errors of the jobs that failed, by name.
        left: names of the jobs that the next call continues.
    """

    records: Mapping[str, Record]
    failed: Mapping[str, UserError]
    left: Sequence[str]

    @property
    def findings(self) -> dict[str, Findings]:
        """Findings of the jobs that are done, by name."""
        return {name: record["findings"] for name, record in self.records.items()}


@final
@dataclass(frozen=True)
class JobRunner:
    """Runs jobs one after the other and keeps a record of each.

    Several ranks share them by group; their records are files that all see.

    Args:
        folder: for the records, FOLDER/NAME.json.
        console: shows progress.
        machine: describes the machine, for the records.
        slowness: time that a computation takes here, relative to the machine of the estimates.
        release: frees memory after each job.
        ranks: of MPI, which all run the same jobs.
    """

    folder: Path
    console: Console
    machine: Callable[[], Mapping[str, Any]] = dict
    slowness: Callable[[], float] = lambda: 1.0
    release: Callable[[], None] = lambda: None
    ranks: Ranks = field(default_factory=Ranks)

    def record(self, job: Job) -> Record:
        """What is kept of a job with these settings; empty if there is nothing.

        `findings` is a key of it only if the job is done.
        """
        try:
            record = json.loads(self._file(job).read_text(encoding="utf-8"))
            if record["settings"] != _as_json(job.settings):
                return {}
            if "found" in record:  # written by unbake 0.1.0 and older
                record["findings"] = record.pop("found")
            if "findings" in record and not all(file.is_file() for file in job.files):
                return {}
            return record
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return {}

    def left(self, jobs: Sequence[Job]) -> list[Job]:
        """The jobs that are not done."""
        return [job for job in jobs if "findings" not in self.record(job)]

    def forget(self, jobs: Sequence[Job]) -> None:
        """Remove the records of jobs, so that they run again."""
        for job in jobs:
            self._file(job).unlink(missing_ok=True)

    def plan(self, jobs: Sequence[Job]) -> str:
        """How many jobs are left, and how long they take on this machine."""
        left = self.left(jobs)
        if not left:
            return f"all {len(jobs)} jobs are done"
        done = f"{len(jobs) - len(left)} of {len(jobs)} jobs are done"
        known = [job for job in left if job.seconds is not None]
        if not known:
            return f"{done}; no estimate for the others at this scale"
        seconds = sum(job.seconds or 0.0 for job in known) * self.slowness()
        takes = f"about {duration(seconds + sum(job.waits for job in known))} on this machine"
        if len(known) == len(left):
            return f"{done}, the others take {takes}"
        return f"{done}, {len(known)} of the others take {takes}; no estimate for the rest"

    def run(self, jobs: Sequence[Job], *, until: float | None = None) -> Outcome:
        """Run the jobs that are not done.

        A job that fails or is stopped does not keep the others from running. All ranks return the
        same.

        Args:
            until: value of `time.monotonic()` after which no further job starts. One always does,
                so that calls come to an end.

        Raises:
            KeyboardInterrupt: SIGINT or SIGTERM arrived. Finished jobs are kept.
            UserError: a record cannot be written.
            ValueError: two jobs have the same name.
        """
        if len({job.name for job in jobs}) < len(jobs):
            raise ValueError("two jobs have the same name")
        with self.ranks.apart():
            return self._shared(jobs, until)

    def _shared(self, jobs: Sequence[Job], until: float | None) -> Outcome:
        """Run this rank's share, and return what all found."""
        failed: dict[str, UserError] = {}
        mine = self._mine(jobs)
        with _interrupted_by_sigterm():
            for number, job in enumerate(mine):
                if number and until is not None and time.monotonic() >= until:
                    break
                self.console.rule(job.name, align="left")
                try:
                    self._run(job)
                except UserError as error:
                    failed[job.name] = error
                    self.console.print(f"error: {error}", markup=False, soft_wrap=True)
                except Unfinished:
                    self.console.print(f"{job.name} is not finished; the same command continues it")
        records = {job.name: self.record(job) for job in jobs}
        records |= self._found(mine, records, failed)
        done = {name: record for name, record in records.items() if "findings" in record}
        left = [job.name for job in jobs if job.name not in done and job.name not in failed]
        return Outcome(done, failed, left)

    def _mine(self, jobs: Sequence[Job]) -> list[Job]:
        """The jobs of this rank, of those that rank 0 finds not done."""
        left = self.ranks.gather([job.name for job in self.left(jobs)])[0]
        every = [job for job in jobs if job.name in left]
        groups = self.ranks.mine(list(dict.fromkeys(job.group for job in every)))
        return [job for job in every if job.group in groups]

    def _found(
        self, mine: Sequence[Job], records: Mapping[str, Record], failed: dict[str, UserError]
    ) -> dict[str, Record]:
        """The records of the jobs that all ranks ran; their errors go to `failed`."""
        parts = {name: error.parts for name, error in failed.items()}
        own = {"records": {job.name: records[job.name] for job in mine}, "failed": parts}
        every = self.ranks.gather(own)
        others = {name: UserError(*e) for one in every for name, e in one["failed"].items()}
        for name in others.keys() - failed.keys():
            line = f"{name}: error: {others[name]}"
            self.console.print(line, markup=False, soft_wrap=True)
        failed |= others
        return {name: record for one in every for name, record in one["records"].items()}

    def _run(self, job: Job) -> None:
        """Run a job and write its record, which of a stopped one has the time spent so far."""
        kept, start = self.record(job), time.perf_counter()
        before = 0.0 if "error" in kept else kept.get("seconds", 0.0)
        record: Record = {"settings": dict(job.settings), "machine": dict(self.machine())}

        def keep() -> None:
            record["seconds"] = round(before + time.perf_counter() - start, 2)
            write_json(self._file(job), record)
            self.release()

        with cleaned_up(keep):
            try:
                with lack_told():
                    record["findings"] = job.work()
            except UserError as error:
                record["error"] = str(error)
                raise

    def _file(self, job: Job) -> Path:
        return self.folder / f"{job.name}.json"


def duration(seconds: float) -> str:
    """A duration in words."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


def digest(settings: Mapping[str, Any]) -> str:
    """Eight characters that identify settings, for names of folders."""
    text = json.dumps(settings, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _as_json(settings: Mapping[str, Any]) -> Any:
    """Settings as they are read back from a file: tuples become lists."""
    return json.loads(json.dumps(dict(settings)))


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, as SIGINT does."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
