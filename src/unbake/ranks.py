"""The processes of one fit, by MPI: what they tell each other, and how they end together.

`mpiexec -n 4 unbake fit …` starts four processes, which MPI calls ranks. Each takes its share of
every batch. Rank 0 leads: it alone writes, prints and decides what depends on a clock. Without
`mpiexec` there is one rank, MPI is not loaded, and nothing here does anything.

The library waits for ever, and at full load, where another rank hangs or a network is cut. So all
waiting is done here, with a limit, and leaves the processor to others.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Protocol, TypeVar

import numpy as np

from .errors import UserError, of_system
from .memory import NO_MEMORY, lacks_memory

Result = TypeVar("Result")
Job = TypeVar("Job")

#: How names of what `mpiexec` and Slurm tell a process begin.
_OF_LAUNCHERS = (
    "PMI",
    "MPI_LOCAL",
    "MPIEXEC",
    "HYDRA",
    "OMPI_",
    "MV2_COMM",
    "SLURM_STEP",
    "SLURM_PROCID",
)
#: What they tell a process: how many there are.
SIZES = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MV2_COMM_WORLD_SIZE", "SLURM_STEP_NUM_TASKS")
#: Seconds that a rank waits for the others. Kernels are compiled in the first steps, and rank 0
#: writes checkpoints and previews while the others wait.
PATIENCE = 120.0
#: Seconds that a rank other than the first waits before it ends all for what happened to it, so
#: that what happened to all is told once, by rank 0.
_AFTER_YOU = 0.5
#: Bytes of an error that other ranks are told.
_LONGEST = 4096
#: Waiting: this long without sleep, then with naps.
_AWAKE, _NAP = 2e-4, 5e-5
#: After so many seconds others are at work of their own: naps become longer.
_LONG, _LONG_NAP = 5.0, 0.05


def alone() -> dict[str, str]:
    """The environment, for a process that is not to take itself for one of several."""
    return {name: value for name, value in os.environ.items() if not name.startswith(_OF_LAUNCHERS)}


class Communicator(Protocol):
    """The part of mpi4py's communicators that is used here."""

    rank: int
    size: int

    def Iallreduce(self, sendbuf: Any, recvbuf: Any, /) -> Any:
        """Sum up arrays."""
        ...

    def Iallgather(self, sendbuf: Any, recvbuf: Any, /) -> Any:
        """Collect arrays."""
        ...

    def Ibcast(self, buf: Any, /, root: int = ...) -> Any:
        """Copy an array of one rank to all."""
        ...

    def Abort(self, status: int, /) -> Any:
        """End all processes."""
        ...


class Agreed(UserError):
    """An error that all ranks know of: rank 0 tells it, and each ends by itself."""

    @staticmethod
    def of(error: UserError, rank: int | None = None) -> Agreed:
        """The error of one rank, or the same one of all."""
        what = error.what if rank is None else f"rank {rank}: {error.what}"
        return Agreed(what, error.where, error.remedy)


class Ranks:
    """The ranks of a fit; without a communicator there is one.

    Args:
        communicator: of mpi4py; None: this process is alone.
        here: how many of them are on this machine.
        patience: seconds to wait for the others.
    """

    def __init__(
        self,
        communicator: Communicator | None = None,
        here: int = 1,
        patience: float = PATIENCE,
    ) -> None:
        self._communicator, self.here, self._patience = communicator, here, patience
        self.rank = 0 if communicator is None else communicator.rank
        self.size = 1 if communicator is None else communicator.size

    @staticmethod
    def of_environment() -> Ranks:
        """The ranks that `mpiexec` or Slurm started.

        Raises:
            UserError: there are several, and mpi4py is missing.
        """
        sizes = (os.environ.get(name, "") for name in SIZES)
        if max((int(size) for size in sizes if size.isdecimal()), default=1) < 2:
            return Ranks()
        try:
            from mpi4py import MPI
        except (ImportError, RuntimeError) as error:
            what = f"several processes were started, and mpi4py cannot be loaded ({error})"
            raise UserError(what, remedy="Install it: pip install unbake[mpi]") from None
        here = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED).size
        return Ranks(MPI.COMM_WORLD, here)

    @property
    def leads(self) -> bool:
        """Whether this is the rank that writes and prints."""
        return self.rank == 0

    # ---------------------------------------------------------------------- what all come to know

    def mean(self, numbers: np.ndarray) -> np.ndarray:
        """The mean over all ranks, the same bits on each.

        Args:
            numbers: floating point, as many on each rank.
        """
        if self._communicator is None:
            return numbers
        total = np.empty_like(numbers)
        self._wait(self._communicator.Iallreduce(np.ascontiguousarray(numbers), total))
        return total / np.float32(self.size)

    def any(self, *told: bool) -> tuple[bool, ...]:
        """For each answer, whether any rank says so."""
        if self._communicator is None:
            return told
        total = np.empty(len(told), np.int32)
        self._wait(self._communicator.Iallreduce(np.array(told, np.int32), total))
        return tuple(bool(count) for count in total)

    def of_first(self, number: float) -> float:
        """The number that rank 0 has."""
        if self._communicator is None:
            return number
        array = np.array([number], np.float64)
        self._wait(self._communicator.Ibcast(array, root=0))
        return float(array[0])

    def mine(self, jobs: Sequence[Job]) -> Sequence[Job]:
        """The jobs of this rank, of a list that all have: every so many, dealt like cards."""
        return jobs[self.rank :: self.size]

    def told(self, own: object) -> list[Any]:
        """What each rank tells, in their order, on all; it waits for as long as that takes.

        Args:
            own: serializable as JSON.
        """
        if self._communicator is None:
            return [own]
        text = np.frombuffer(json.dumps(own).encode(), np.uint8)
        return [json.loads(row.tobytes()) for row in self._parts(text, math.inf)]

    def joined(self, work: Callable[[], np.ndarray]) -> np.ndarray:
        """The rows that each rank finds, one after the other in their order, on all.

        Args:
            work: finds rows, as many as it likes, of the same kind and shape on each rank.

        Raises:
            Agreed: it failed on some rank.
        """
        rows = self.together(work)
        return rows if self._communicator is None else np.concatenate(self._parts(rows))

    def require_same(self, told: Mapping[str, str]) -> None:
        """Check that all ranks have the same.

        Args:
            told: texts by what they are of, with the same names on each rank.

        Raises:
            Agreed: some rank has another one; all are named.
        """
        if self._communicator is None:
            return
        digests = [hashlib.sha256(text.encode()).digest() for text in told.values()]
        rows = self._gathered(np.frombuffer(b"".join(digests), np.uint8))
        rows = rows.reshape(self.size, len(told), -1)
        faults = []
        for number, name in enumerate(told):
            others = np.flatnonzero((rows[:, number] != rows[0, number]).any(-1))
            if len(others):
                faults.append(f"other {name} on rank {', '.join(map(str, others))}")
        if faults:
            what = f"the ranks do not work on the same: {'; '.join(faults)} than on rank 0"
            raise Agreed(what, remedy="Start all with the same version, options and data set")

    def together(self, work: Callable[[], Result], patience: float | None = None) -> Result:
        """Do something on each rank that may fail on some of them.

        In such work ranks may tell each other something, if they begin that by this method or by
        `joined`: one that failed before is then found out there.

        Args:
            work: to do.
            patience: seconds to wait for the others; None: as long as this object always waits.

        Raises:
            Agreed: it failed on some rank; the message is that of the first one.
        """
        if self._communicator is None:
            return work()
        error, result = None, None
        try:
            result = work()
        except Agreed:
            raise
        except UserError as caught:
            error = caught
        failed = np.array([error is not None], np.uint8)
        failures = np.flatnonzero(self._gathered(failed, patience)[:, 0])
        if not len(failures):
            return result  # pyright: ignore[reportReturnType]
        parts = [] if error is None else [error.what, error.where or "", error.remedy or ""]
        text = "\0".join(parts).encode()[:_LONGEST].ljust(_LONGEST, b"\0")
        texts = self._gathered(np.frombuffer(text, np.uint8))
        what, where, remedy = (*_text(texts[failures[0]]).split("\0"), "", "")[:3]
        alone = None if len(failures) == self.size else int(failures[0])
        raise Agreed.of(UserError(what, where or None, remedy or None), alone)

    def _parts(self, own: np.ndarray, patience: float | None = None) -> list[np.ndarray]:
        """The arrays of all ranks, which may have other numbers of rows."""
        lengths = self._gathered(np.array([len(own)], np.int64), patience)[:, 0]
        padded = np.zeros((int(lengths.max()), *own.shape[1:]), own.dtype)
        padded[: len(own)] = own
        rows = self._gathered(padded, patience)
        return [part[:length] for part, length in zip(rows, lengths, strict=True)]

    def _gathered(self, array: np.ndarray, patience: float | None = None) -> np.ndarray:
        """The arrays of all ranks, one a row."""
        assert self._communicator is not None
        rows = np.empty((self.size, *array.shape), array.dtype)
        self._wait(self._communicator.Iallgather(np.ascontiguousarray(array), rows), patience)
        return rows

    def _wait(self, request: Any, patience: float | None = None) -> None:
        """Wait for the others.

        Args:
            patience: for how many seconds; None: as long as this object always waits.

        Raises:
            UserError: they do not answer.
        """
        start, patience = time.monotonic(), self._patience if patience is None else patience
        while not request.Test():
            waited = time.monotonic() - start
            if waited > patience:
                what = f"the other ranks have not answered for {patience:.0f} s"
                remedy = "See whether one of them hangs or its network is cut; go on with --resume"
                raise UserError(what, remedy=remedy)
            if waited > _AWAKE:
                time.sleep(_NAP if waited < _LONG else _LONG_NAP)

    # --------------------------------------------------------------------------- how all are ended

    @contextmanager
    def guarded(self, say: Callable[[str], object]) -> Iterator[None]:
        """A block in which all ranks end where one fails.

        What all know of is raised on rank 0, and ends the others with status 2.

        Args:
            say: prints the error of one rank.
        """
        if self._communicator is None:
            yield
            return
        try:
            yield
        except Agreed:
            if self.leads:
                raise
            sys.exit(2)
        except BaseException as error:
            if isinstance(error, SystemExit) and not error.code:
                raise
            if not self.leads:
                time.sleep(_AFTER_YOU)
            say(f"rank {self.rank}: {_told(error)}")
            sys.stderr.flush()
            self._communicator.Abort(2)
            sys.exit(2)  # where MPI returns, because another rank does not end


def _told(error: BaseException) -> str:
    """What ends a rank, on one line, as the command line of one process tells it."""
    if isinstance(error, UserError):
        return str(error)
    if isinstance(error, KeyboardInterrupt):
        return "stopped"
    if lacks_memory(error):
        return NO_MEMORY
    if isinstance(error, OSError):
        return of_system(error)
    return f"{type(error).__name__}: {error}".rstrip(": ")


def _text(row: np.ndarray) -> str:
    return row.tobytes().rstrip(b"\0").decode("utf-8", "replace")
