"""How the program ends when it is told to: by a signal, or because nobody reads its output.

SIGINT (Ctrl-C), SIGTERM and SIGHUP ask the program to end; so does a closed pipe, as in
`unbake fit … | head`. A training loop looks for that between steps and saves its state
(`deferred`). Everything else ends at once with `Interrupted`, and leaves no half-written file under
the name of a whole one. A second signal ends the process without another line of Python.

The exit status is 128 plus the number of the signal: 130 (SIGINT), 143 (SIGTERM), 129 (SIGHUP),
141 (closed pipe).

This module imports nothing heavy: signals are handled before Mitsuba and NumPy are loaded.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

#: The signals that ask the program to end, of those that this system has.
STOPPING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
_CLOSED_PIPE = 13  # the number of SIGPIPE, which Windows lacks


class Interrupted(KeyboardInterrupt):
    """A signal asked the program to end."""


class _Program:
    """What this process was told."""

    is_ours = False  #: whether the process is the command line, and may be ended at once
    started = False  #: whether a command runs; before, there is nothing to clean up
    received: int | None = None  #: number of the first signal
    stop: list[int] | None = None  #: of the training loop that runs


def received() -> bool:
    """Whether the program was told to end."""
    return _Program.received is not None


def status() -> int:
    """The exit status of a program that was told to end; that of Ctrl-C if it was not."""
    return 128 + (_Program.received or signal.SIGINT)


def begin() -> None:
    """A command begins: signals from now on raise `Interrupted`, so that it can clean up."""
    _Program.started, _Program.received = True, None


def interrupt(number: int, frame: object = None) -> None:
    """The handler of a signal that ends what runs with `Interrupted`."""
    if _Program.is_ours and (_Program.received is not None or not _Program.started):
        os._exit(128 + number)
    _Program.received = _Program.received or number
    raise Interrupted


@contextmanager
def deferred() -> Iterator[list[int]]:
    """A list that fills on a signal or a closed pipe, for loops that end where it suits them.

    A second signal ends the program at once; in a process that is not the command line's it raises
    `KeyboardInterrupt`. In another thread than the main one signals cannot be handled.
    """
    stop: list[int] = []

    def handler(number: int, frame: object) -> None:
        if stop and _Program.is_ours:
            os._exit(128 + number)
        if stop:
            raise KeyboardInterrupt
        _Program.received = number
        stop.append(number)

    outer, _Program.stop = _Program.stop, stop
    main = threading.current_thread() is threading.main_thread()
    wanted = [s for s in STOPPING if main and signal.getsignal(s) is not signal.SIG_IGN]
    previous = {s: signal.signal(s, handler) for s in wanted}
    try:
        yield stop
    finally:
        for number, old in previous.items():
            signal.signal(number, old)
        _Program.stop = outer


def run_program(command: Callable[[], object]) -> None:
    """Run the command line in this process, with signals and closed pipes handled.

    Args:
        command: exits with `SystemExit`.
    """
    _Program.is_ours = True
    for number in STOPPING:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, interrupt)
    sys.unraisablehook = _unraisable
    sys.stdout, sys.stderr = _guarded(sys.stdout), _guarded(sys.stderr)
    try:
        try:
            command()
        finally:
            # The work is done. The interpreter's own end must not be disturbed.
            for number in STOPPING:
                signal.signal(number, signal.SIG_IGN)
    except SystemExit:
        raise
    except BaseException:
        # Whatever an interruption became on its way through native code, it was one.
        if not received():
            raise
        _leave()


def _leave() -> NoReturn:
    """End the process without the interpreter's clean-up, which waits for kernels that run."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError, AttributeError):
            continue
    os._exit(status())


def _unraisable(about: Any) -> None:
    """An interruption that came in a destructor or a callback of native code, and would be lost."""
    if issubclass(about.exc_type, Interrupted):
        _leave()
    sys.__unraisablehook__(about)


# ------------------------------------------------------------------------------ Standard streams


class _Guarded(io.FileIO):
    """A standard stream whose reader may go away: the program is then told to end, once."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError:
            _output_closed()
            return len(data)


def _guarded(stream: Any) -> Any:
    try:
        raw = _Guarded(stream.fileno(), "w", closefd=False)
    except (AttributeError, OSError, ValueError):  # closed from the start, or not a file
        return stream
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding=stream.encoding,
        errors=stream.errors,
        newline=None,
        line_buffering=True,
    )


def _output_closed() -> None:
    if received():
        return
    _Program.received = _CLOSED_PIPE
    if _Program.stop is not None:
        _Program.stop.append(_CLOSED_PIPE)
    elif _Program.started and threading.current_thread() is threading.main_thread():
        raise Interrupted
