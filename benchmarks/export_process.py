"""`unbake export` in a process of its own, and what it costs."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from unbake.errors import UserError


def export_measured(run: Path, out: Path, *words: object) -> dict[str, float]:
    """Export a run; its lines are printed.

    Args:
        run: folder of a fit.
        out: folder to write.
        words: options of the command.

    Returns:
        `seconds` on the clock, `cpu_seconds` of all threads, and `peak_mb` of memory.

    Raises:
        UserError: the command failed.
    """
    command = [sys.executable, "-m", "unbake", "export", run, "--out", out, *words]
    start = time.perf_counter()
    process = subprocess.Popen([str(word) for word in command])
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise UserError(f"the export failed (exit status {process.returncode})", run)
    return {
        "seconds": round(seconds, 1),
        "cpu_seconds": round(used.ru_utime + used.ru_stime, 1),
        "peak_mb": round(used.ru_maxrss / 1024),
    }
