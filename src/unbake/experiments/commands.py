"""Jobs that are commands: each runs as a process of its own, with its own memory and caches.

It can therefore be stopped when the time of a call is up, and no crash ends the other jobs.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from ..errors import UserError
from ..ranks import alone
from ..signals import STOPPING
from .jobs import Job, JobRunner, Outcome, Unfinished

#: Seconds that a command has to write what it needs to continue, after SIGTERM.
_GRACE = 120.0
#: Steps after which those of a fit compile nothing any more.
_COMPILING = 3
#: Seconds between looks for a signal: one that another thread of this process received does not end
#: the wait by itself.
_LOOK = 0.5
#: Exit status of commands that were stopped: that of `unbake`, and that of the signal itself.
_STOPPED = {status for n in STOPPING for status in (128 + n, -n)}


def unbake(*words: object, until: float | None = None, log: Path | None = None) -> None:
    """Run a command of `unbake` with this interpreter; see `command`."""
    command([sys.executable, "-m", "unbake", *words], until=until, log=log)


def compile_fit(data: Path, *words: object, log: Path | None = None) -> None:
    """Take the first steps of a fit and drop them, so that its kernels are in Dr.Jit's cache.

    Else the first of several fits of a given time would pay for all.

    Args:
        words: options of `unbake fit`, but for the length.
    """
    with tempfile.TemporaryDirectory() as folder:
        unbake("fit", data, "--out", Path(folder) / "run", *words, "--steps", _COMPILING, log=log)


def command(
    words: Sequence[object], *, until: float | None = None, log: Path | None = None
) -> None:
    """Run a command to its end, or until the time is up.

    SIGINT and SIGTERM of this process stop it in the same way, with SIGTERM.

    Args:
        words: the program and its arguments.
        until: value of `time.monotonic()` at which it is stopped.
        log: file that gets what it prints, beside the standard output.

    Raises:
        UserError: the program is missing or fails.
        Unfinished: it was stopped.
        KeyboardInterrupt: this process got a signal.
    """
    words = [str(word) for word in words]
    try:
        # Not in this process group: Ctrl-C would reach the command twice, and `unbake fit` takes
        # the second time as a request to end without a checkpoint.
        process = subprocess.Popen(
            words,
            stdout=None if log is None else subprocess.PIPE,
            stderr=None if log is None else subprocess.STDOUT,
            start_new_session=True,
            env=alone(),
        )
    except OSError as error:
        raise UserError(f"the program cannot be started ({error.strerror})", words[0]) from error
    copy = threading.Thread(target=_copy, args=(process, log))
    try:
        copy.start()
        status = _wait(process, until)
    except KeyboardInterrupt:
        _stop(process)
        raise
    finally:
        if copy.ident is not None:
            copy.join()
    if status in _STOPPED:
        raise Unfinished
    if status:
        what = f"exit status {status}" if status > 0 else f"ended by signal {-status}"
        raise UserError(f"the command failed ({what})", " ".join(words[1:4]))


def _wait(process: subprocess.Popen, until: float | None) -> int:
    """Wait for the end of a process and return its status; stop it when the time is up."""
    while until is None or time.monotonic() < until:
        left = _LOOK if until is None else min(_LOOK, until - time.monotonic())
        try:
            return process.wait(max(0.0, left))
        except subprocess.TimeoutExpired:
            continue
    _stop(process)
    # It may have come to its end just then.
    return process.returncode and -signal.SIGTERM


def _stop(process: subprocess.Popen) -> None:
    process.terminate()
    try:
        process.wait(_GRACE)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        process.kill()
        process.wait()


def _copy(process: subprocess.Popen, log: Path | None) -> None:
    """Copy what a process prints to the standard output and to a file."""
    if log is None or process.stdout is None:
        return
    with process.stdout, open(log, "wb") as file:
        for line in process.stdout:
            file.write(line)
            file.flush()
            print(line.decode(errors="replace"), end="", flush=True)


# ------------------------------------------------------------------------------------------ Scripts


def call_settings(parser: argparse.ArgumentParser) -> None:
    """Add the options that scripts which run jobs have in common."""
    parser.add_argument("--plan", action="store_true", help="only show what is left to do")
    parser.add_argument("--again", action="store_true", help="repeat the jobs, also those done")
    parser.add_argument(
        "--minutes",
        type=float,
        default=os.environ.get("MINUTES") or None,
        help="time after which no further job starts, and fits, tables and figures stop; the "
        "same command continues (default: MINUTES of the environment)",
    )


def end_of_call(args: argparse.Namespace) -> float | None:
    """The value of `time.monotonic()` at which the time of this call is up."""
    return None if args.minutes is None else time.monotonic() + 60 * args.minutes


def run_jobs(
    runner: JobRunner, jobs: Sequence[Job], args: argparse.Namespace, until: float | None
) -> Outcome | None:
    """Run jobs with the options of `call_settings`, and tell what failed and what is left.

    Returns:
        How they ended; None if only the plan was wanted.
    """
    if args.again and not args.plan:
        runner.forget(jobs)
    print(runner.plan(jobs), flush=True)
    if args.plan:
        for job in runner.left(jobs):
            print(f"  {job.name}", flush=True)
        return None
    outcome = runner.run(jobs, until=until)
    if outcome.left:
        print(f"left: {' '.join(outcome.left)}; the same command continues", flush=True)
    if outcome.failed:
        print(f"failed: {' '.join(outcome.failed)}", file=sys.stderr, flush=True)
    return outcome


def main(run: Callable[[], int]) -> None:
    """Run a script: exits with 2 on bad input and with 130 if interrupted."""
    try:
        status = run()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("interrupted; the same command continues", file=sys.stderr)
        status = 130
    sys.exit(status)
