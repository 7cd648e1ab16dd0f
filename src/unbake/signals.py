"""How the program ends when it is told to: by a signal, or because nobody reads its output.

SIGINT (Ctrl-C), SIGTERM and SIGHUP ask the program to end; so does a closed pipe, as in
`unbake fit … | head`. A training loop looks for that between steps and saves its state
(`deferred`). Everything else ends at once, after it has removed what is unfinished (`cleaned_up`).
No exception is raised for that: one that goes through native code may be lost there, or end the
process in another way. A second signal ends the process without another word.

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
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

#: The signals that ask the program to end, of those that this system has.
STOPPING = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
_CLOSED_PIPE = 13  # the number of SIGPIPE, which Windows lacks
_SHOW_CURSOR = b"\x1b[?25h"  # a progress bar hides it


class _Program:
    """What this process was told."""

    is_ours = False  #: whether the process is the command line, and may be ended
    received: int | None = None  #: number of the first signal
    stop: list[int] | None = None  #: of the training loop that runs
    told = False  #: whether it was told that output is lost
    unfinished: list[Callable[[], object]] = []  #: what removes it  # noqa: RUF012


def received() -> bool:
    """Whether the program was told to end, and a training loop has therefore ended early."""
    return _Program.received is not None


def status() -> int:
    """The exit status of a program that was told to end; that of Ctrl-C if it was not."""
    return 128 + (_Program.received or signal.SIGINT)


def interrupt(number: int, frame: object = None) -> None:
    """The handler of a signal that ends what runs.

    It raises `KeyboardInterrupt` in a process that is not the command line's.
    """
    if not _Program.is_ours:
        raise KeyboardInterrupt
    if received():
        os._exit(128 + number)
    _end(number)


@contextmanager
def cleaned_up(clean_up: Callable[[], object]) -> Iterator[None]:
    """Call `clean_up` at the end of a block, and where a signal ends the process in it.

    Where the signal comes at the end of the block, it is called twice.
    """
    _Program.unfinished.append(clean_up)
    try:
        yield
    finally:
        try:
            clean_up()
        finally:
            _Program.unfinished.remove(clean_up)


@contextmanager
def deferred() -> Iterator[list[int]]:
    """A list that fills on a signal or a closed pipe, for loops that end where it suits them.

    A second signal ends the program at once; in a process that is not the command line's it raises
    `KeyboardInterrupt`. In another thread than the main one signals cannot be handled.
    """
    stop: list[int] = []

    def handler(number: int, frame: object) -> None:
        if stop:
            interrupt(number)
        _ask_to_stop(stop, number)

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
    _handle(interrupt)
    sys.stdout, sys.stderr = _guarded(sys.stdout), _guarded(sys.stderr)
    try:
        command()
    finally:
        # The work is done. The interpreter's own end must not be disturbed.
        _handle(signal.SIG_IGN)


def _handle(handler: Any) -> None:
    for number in STOPPING:
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup
            signal.signal(number, handler)


def _ask_to_stop(stop: list[int], number: int) -> None:
    stop.append(number)
    if _Program.is_ours:
        _Program.received = number


def _end(number: int) -> NoReturn:
    """Remove what is unfinished and end the process, whatever it does."""
    _Program.received = number
    for clean_up in reversed(_Program.unfinished):
        with suppress(Exception):
            clean_up()
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # the signal may have come while it was written to
            stream.flush()
    with suppress(OSError):
        os.write(2, (_SHOW_CURSOR if os.isatty(2) else b"") + b"interrupted\n")
    os._exit(128 + number)


# ------------------------------------------------------------------------------ Standard streams


class _Guarded(io.FileIO):
    """A standard stream whose reader may go away: the program is then told to end, once.

    What cannot be written for another reason is lost, which is told once: the work goes on.
    """

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            _output_closed()
        except OSError as error:  # such as a full disk
            _output_lost(error)
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
        line_buffering=True,
    )


def _output_lost(error: OSError) -> None:
    if _Program.told:
        return
    _Program.told = True
    line = f"warning: what this program prints cannot be written ({error.strerror}); it goes on\n"
    with suppress(OSError):
        os.write(2, line.encode())


def _output_closed() -> None:
    if received():
        return
    if _Program.stop is not None:
        _ask_to_stop(_Program.stop, _CLOSED_PIPE)
    elif threading.current_thread() is threading.main_thread():
        _end(_CLOSED_PIPE)
