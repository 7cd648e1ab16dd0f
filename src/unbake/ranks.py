"""The processes of one fit, by MPI: what they tell each other, and how they end together.

`mpiexec -n 4 unbake fit …` starts four processes, which MPI calls ranks. Each takes its share of
every batch. Rank 0 leads: it alone writes, prints and decides what depends on a clock. Without
`mpiexec` there is one rank, MPI is not loaded, and nothing here does anything.

The library waits for ever, and at full load, where another rank hangs or a network is cut. So all
waiting is done here, with a limit, and leaves the processor to others. The limit is short within a
step, and long where a rank may have something else to do. Rank 0 tells the others that it lives
while they wait for what it does by itself, however long that takes.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import sys
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NoReturn, Protocol, TypeVar

import numpy as np

from .errors import UserError, of_system
from .memory import NO_MEMORY, lacks_memory

Result = TypeVar("Result")
Job = TypeVar("Job")

_GO_ON = "See whether one of them hangs or its network is cut; go on with --resume"
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
#: What Slurm tells each process that `srun` starts: how many there are.
_OF_STEP = "SLURM_STEP_NUM_TASKS"
#: What all of them tell a process: how many there are.
SIZES = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MV2_COMM_WORLD_SIZE", _OF_STEP)
#: Seconds that a rank waits for the others while they read input, in the first steps, which compile
#: kernels, and where rank 0 writes and measures.
PATIENCE = 120.0
#: Within later steps: so many times the longest of the last ones, and no less than so many seconds,
#: which a network that fails for some seconds and a machine at its limits may need.
_TIMES, LEAST = 10.0, 20.0
#: Steps that count as the first ones, and as the last ones.
_FIRST, _LAST = 10, 100
#: Seconds between signs of life of a rank that does something by itself, and their tags.
_BEAT, _ALIVE, _APART = 1.0, 77, 78
#: Longer between two looks, in seconds, this process itself was stopped, which is no waiting.
_PAUSE = 1.0
#: Seconds in which MPI must end a process; after that the system does.
_LAST_RESORT = 10
#: Seconds in which MPI must let rank 0 go when its work is done, and that of all others.
_LEAVE = 60
#: Seconds that a rank other than the first waits before it ends all for what happened to it, so
#: that what happened to all is told once, by rank 0.
_AFTER_YOU = 0.5
#: Seconds in which `mpiexec` passes on what a rank prints before it ends it: else that may be lost.
_PASSED_ON = 0.3
#: Bytes of an error that other ranks are told.
_LONGEST = 4096
#: Waiting: this long without sleep, then with naps.
_AWAKE, _NAP = 2e-4, 5e-5
#: After so many seconds others are at work of their own: naps become longer.
_LONG, _LONG_NAP = 5.0, 0.05


def alone() -> dict[str, str]:
    """The environment, for a process that is not to take itself for one of several."""
    return {name: value for name, value in os.environ.items() if not name.startswith(_OF_LAUNCHERS)}


def started() -> int:
    """How many processes `mpiexec` or Slurm started together with this one, as they tell it."""
    told = {name: os.environ.get(name, "") for name in SIZES}
    sizes = {name: int(size) for name, size in told.items() if size.isdecimal()}
    of_step = sizes.pop(_OF_STEP, 1)  # where mpiexec starts processes by srun, these are fewer
    several = max(sizes.values(), default=1)
    if several > 1:
        return several
    # A shell of `srun --pty` is alone, however many tasks its step has.
    return 1 if sys.stdin is not None and sys.stdin.isatty() else of_step


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

    def Isend(self, buf: Any, dest: int, tag: int = ...) -> Any:
        """Send an array to one rank."""
        ...

    def Iprobe(self, source: int = ..., tag: int = ...) -> bool:
        """Whether an array of one rank can be received."""
        ...

    def Recv(self, buf: Any, source: int = ..., tag: int = ...) -> Any:
        """Wait for an array of one rank."""
        ...

    def Irecv(self, buf: Any, source: int = ..., tag: int = ...) -> Any:
        """Receive an array of one rank."""
        ...

    def Abort(self, status: int, /) -> Any:
        """End all processes."""
        ...


class Agreed(UserError):
    """An error that is raised on every rank; only rank 0 prints it."""

    @staticmethod
    def of(error: UserError, rank: int | None = None) -> Agreed:
        """The error of one rank, or the same one of all."""
        what = error.what if rank is None else f"process {rank}: {error.what}"
        return Agreed(what, error.where, error.remedy)


class Ranks:
    """Cooperating processes of MPI; without a communicator there is one.

    Args:
        communicator: of mpi4py; None: this process is alone.
        here: how many of them are on this machine.
        patience: seconds to wait for the others where some may take long.
        beats: whether a thread may tell others that this rank lives.
    """

    def __init__(
        self,
        communicator: Communicator | None = None,
        here: int = 1,
        patience: float = PATIENCE,
        beats: bool = False,
    ) -> None:
        self._communicator, self.here, self._patience = communicator, here, patience
        self._beats = beats
        self._beating: tuple[threading.Thread, threading.Event] | None = None
        # Signs of life, by tag and rank: how many were sent, and how many have arrived
        self._sent: Counter[tuple[int, int]] = Counter()
        self._arrived: Counter[tuple[int, int]] = Counter()
        self._steps: deque[float] = deque(maxlen=_LAST)  # seconds of the last steps
        self._first_steps, self._step_began = _FIRST, math.nan
        self._announced: float | None = None  # when it was told that some rank may take long
        self.rank = 0 if communicator is None else communicator.rank
        self.size = 1 if communicator is None else communicator.size

    @staticmethod
    def of_environment() -> Ranks:
        """The ranks that `mpiexec` or Slurm started.

        Raises:
            UserError: there are several, and mpi4py is missing, or does not know of the others.
        """
        several = started()
        if several < 2:
            return Ranks()
        try:
            with warnings.catch_warnings():  # mpi4py 4.1 warns of another mpiexec, as is told here
                warnings.simplefilter("ignore", RuntimeWarning)
                from mpi4py import MPI
        except (ImportError, RuntimeError) as error:
            what = f"several processes were started, and mpi4py cannot be loaded ({error})"
            raise UserError(what, remedy="Install it: pip install unbake[mpi]") from None
        if MPI.COMM_WORLD.size < several:  # each would do all of the work by itself
            library, known = MPI.get_vendor()[0], MPI.COMM_WORLD.size
            what = f"{several} processes were started, but {library} of mpi4py knows of {known}"
            own = f"Start them by the mpiexec of {library} or by srun --mpi=pmi2"
            raise UserError(what, remedy=f"{own}, or build mpi4py for the MPI of this machine")
        here = MPI.COMM_WORLD.Split_type(MPI.COMM_TYPE_SHARED).size
        return Ranks(MPI.COMM_WORLD, here, beats=MPI.Query_thread() == MPI.THREAD_MULTIPLE)

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
        own = np.ascontiguousarray(numbers)
        self._exchange(lambda all_: all_.Iallreduce(own, total))
        return total / np.float32(self.size)

    def any(self, *told: bool) -> tuple[bool, ...]:
        """For each answer, whether any rank says so; asked once a step."""
        if self._communicator is None:
            return told
        total = np.empty(len(told), np.int32)
        own = np.array(told, np.int32)
        self._exchange(lambda all_: all_.Iallreduce(own, total))
        self._note_step()
        return tuple(bool(count) for count in total)

    def of_first(self, number: float) -> float:
        """The number that rank 0 has."""
        if self._communicator is None:
            return number
        return float(self.as_first(np.array([number], np.float64))[0])

    def as_first(self, numbers: np.ndarray) -> np.ndarray:
        """The array that rank 0 has; of the same type and shape on each."""
        if self._communicator is None:
            return numbers
        array = np.array(numbers)
        self._exchange(lambda all_: all_.Ibcast(array, root=0))
        return array

    def mine(self, jobs: Sequence[Job]) -> Sequence[Job]:
        """The jobs of this rank, of a list that all have: every so many, dealt like cards."""
        return jobs[self.rank :: self.size]

    def gather(self, own: object) -> list[Any]:
        """What each rank gives, in their order, on all; it waits for as long as that takes.

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
                faults.append(f"other {name} on process {', '.join(map(str, others))}")
        if faults:
            what = f"the processes do not work on the same: {'; '.join(faults)} than on process 0"
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
        parts = [] if error is None else [part or "" for part in error.parts]
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
        rows = np.empty((self.size, *array.shape), array.dtype)
        own = np.ascontiguousarray(array)
        self._exchange(lambda all_: all_.Iallgather(own, rows), patience)
        return rows

    # --------------------------------------------------------------------- how long a rank waits

    def announce(self) -> None:
        """Tell that some rank may take long until all meet again; all ranks call this.

        They are patient then, and more so with rank 0: a thread sends its signs of life.
        """
        if self.size == 1 or self._announced is not None:
            return
        self._announced, self._step_began = time.monotonic(), math.nan  # this is no step
        if self.leads and self._beats:
            stop = threading.Event()
            thread = threading.Thread(target=self._beat, args=(stop,), daemon=True)
            self._beating = thread, stop
            thread.start()

    def _beat(self, stop: threading.Event) -> None:
        """Send signs of life. The main thread leaves the library alone meanwhile."""
        assert self._communicator is not None
        sign, sent = np.zeros(1, np.uint8), []
        with suppress(RuntimeError):  # where the library fails, the main thread finds out, too
            while not stop.wait(_BEAT):
                sent = [request for request in sent if not request.Test()]
                for rank in () if sent else range(1, self.size):
                    sent.append(self._communicator.Isend(sign, dest=rank, tag=_ALIVE))
                    self._sent[_ALIVE, rank] += 1
            for request in sent:
                request.Test()

    @contextmanager
    def apart(self) -> Iterator[None]:
        """A block in which each rank works by itself, as long as it likes, until all meet.

        A thread of each tells rank 0 that it lives, and hears so of it. It ends all where nothing
        is heard any more: a rank that waits in `gather` would not notice.
        """
        if self._communicator is None or not self._beats:
            yield
            return
        stop = threading.Event()
        thread = threading.Thread(target=self._watch, args=(stop,), daemon=True)
        thread.start()
        together = True
        try:
            yield
        except BaseException as error:
            together = isinstance(error, Agreed)  # which all ranks raise
            raise
        finally:
            stop.set()
            thread.join(_LAST_RESORT)
            if together:
                self._receive_rest(_APART)

    def _watch(self, stop: threading.Event) -> None:
        """End all where one rank is not heard of any more."""
        assert self._communicator is not None
        try:
            self._listen(stop)
        except (UserError, RuntimeError) as error:  # the library may know first
            print(f"process {self.rank}: {_told(error)}", file=sys.stderr)
            _end_by(self._communicator)

    def _listen(self, stop: threading.Event) -> None:
        """Send signs of life, and receive them, until one does not come for too long."""
        assert self._communicator is not None
        sign, others = np.zeros(1, np.uint8), range(1, self.size) if self.leads else [0]
        sent: dict[int, Any] = {}
        silent, before = dict.fromkeys(others, 0.0), time.monotonic()
        while not stop.wait(_BEAT):
            now = time.monotonic()
            passed, before = min(now - before, _PAUSE + _BEAT), now
            for rank in others:
                if rank not in sent or sent[rank].Test():
                    sent[rank] = self._communicator.Isend(sign, dest=rank, tag=_APART)
                    self._sent[_APART, rank] += 1
                silent[rank] += passed
                if self._has_arrived(_APART, rank):
                    silent[rank] = 0.0
                if silent[rank] > self._patience:
                    what = f"process {rank} has not been heard of for {self._patience:.0f} s"
                    remedy = "See whether its network is cut; the same command goes on"
                    raise UserError(what, remedy=remedy)

    def _alone_with(self) -> Communicator:
        """The communicator, which no thread uses any more."""
        assert self._communicator is not None
        if self._beating is not None:
            thread, stop = self._beating
            stop.set()
            thread.join(_LAST_RESORT)
            self._beating = None
        return self._communicator

    def _exchange(
        self, begin: Callable[[Communicator], Any], patience: float | None = None
    ) -> None:
        """Begin to exchange something, and wait until that is done.

        Args:
            patience: seconds to wait for the others; None: as this moment needs.
        """
        try:
            request = begin(self._alone_with())
            self._wait(request, self._limit() if patience is None else patience)
        except RuntimeError as error:  # the library knows that a rank is gone
            what = f"the connection to the other processes is lost ({error})"
            raise UserError(" ".join(what.split()), remedy=_GO_ON) from None
        if self._announced is not None:
            self._announced = None
            if self._beats:
                self._receive_rest(_ALIVE)

    def _limit(self) -> float:
        """Seconds to wait for the others at this moment."""
        if not self._steps:
            return self._patience
        step = max(min(LEAST, self._patience), _TIMES * max(self._steps))
        if self._announced is None:
            return step
        if self.leads:  # it is done itself, and the others had less to do
            own = _TIMES * (time.monotonic() - self._announced)
            return max(step, min(own, self._patience))
        return max(step, self._patience)

    def _is_alive(self) -> bool:
        """Whether rank 0 has told so since this was asked the last time."""
        if self._communicator is None or self.leads or not self._beats:
            return False
        return self._has_arrived(_ALIVE, 0)

    def _has_arrived(self, tag: int, rank: int) -> bool:
        """Whether a rank has sent signs of life since this was asked the last time."""
        assert self._communicator is not None
        before = self._arrived[tag, rank]
        while self._communicator.Iprobe(source=rank, tag=tag):
            self._communicator.Recv(np.empty(1, np.uint8), source=rank, tag=tag)
            self._arrived[tag, rank] += 1
        return self._arrived[tag, rank] > before

    def _note_step(self) -> None:
        """A step has ended on all ranks."""
        began, self._step_began = self._step_began, time.monotonic()
        if math.isnan(began):
            return
        if self._first_steps:
            self._first_steps -= 1
        else:
            self._steps.append(self._step_began - began)

    def _wait(self, request: Any, patience: float) -> None:
        """Wait for the others, for so many seconds.

        Raises:
            UserError: they do not answer.
        """
        before, waited = time.monotonic(), 0.0
        while not request.Test():
            now = time.monotonic()
            waited, before = waited + min(now - before, _PAUSE), now
            if waited > _LONG and self._is_alive():
                waited = _LONG
            if waited > patience:
                what = f"the other processes have not answered for {patience:.0f} s"
                raise UserError(what, remedy=_GO_ON)
            if waited > _AWAKE:
                time.sleep(_NAP if waited < _LONG else _LONG_NAP)

    def _receive_rest(self, tag: int) -> None:
        """Receive all signs of life that were sent; all ranks call this.

        None counts for a later wait then. With MPICH 5 between hosts, one that nobody receives lets
        `MPI_Finalize` wait for ever on the rank that sent it.
        """
        own = np.array([self._sent[tag, rank] for rank in range(self.size)], np.int64)
        sign = np.empty(1, np.uint8)
        for rank, sent in enumerate(self._gathered(own)[:, self.rank].tolist()):
            while self._arrived[tag, rank] < sent:
                self._exchange(lambda all_, rank=rank: all_.Irecv(sign, source=rank, tag=tag))
                self._arrived[tag, rank] += 1

    # --------------------------------------------------------------------------- how all are ended

    def leave(self) -> None:
        """Let the system end rank 0 after a minute; for a program whose work is done on all ranks.

        MPI waits for the others then: the last resort, should that not end.
        """
        if self.size > 1 and self.leads:
            _end_after(_LEAVE)

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
                self.leave()
                raise
            sys.exit(2)
        except BaseException as error:
            if isinstance(error, SystemExit) and not error.code:
                raise
            if not self.leads:
                time.sleep(_AFTER_YOU)
            say(f"process {self.rank}: {_told(error)}")
            _end_by(self._alone_with())


def _end_by(communicator: Communicator) -> NoReturn:
    """End all ranks, and in any case this one; of any thread.

    MPI may return, and then waits for ever for ranks that do not end, or that a cut network hides.
    """
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    time.sleep(_PASSED_ON)
    _end_after(_LAST_RESORT)
    communicator.Abort(2)
    os._exit(2)


def _end_after(seconds: int) -> None:
    """Let the system end this process after so many seconds, where it can."""
    if hasattr(signal, "SIGALRM"):
        signal.alarm(seconds)


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
