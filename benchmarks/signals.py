"""End commands by signals at random instants, from the start of the process to its end.

    python benchmarks/signals.py --each 40

Every command gets SIGINT, SIGTERM and SIGHUP so many times. It must end with status 128 + signal,
or with 0 if it was done; without a traceback; and a fit that has begun must have saved the step
that it tells. What comes before Python runs the first line of unbake is Python's own, and counted
apart: there is nothing to save yet. The exit status is 1 if a command ends in another way.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import here

from small_run import prepare, start

from unbake.backend import activate

activate()  # before modules with types of Dr.Jit

from unbake.machine import machine  # noqa: E402
from unbake.training.checkpoint import newest_progress  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Seconds that a command may take to end.
_PATIENCE = 120
_STOPPED = re.compile(r"stopped at step (\d+)")


def main() -> None:
    """Send signals, print each failure, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--each", type=int, default=40, help="instants a command and signal")
    parser.add_argument("--commands", nargs="*", default=[], help="only these")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = interrupt(Path(folder), args.each, args.seed, args.commands)
    print(json.dumps(result, indent=1))
    if args.out is not None:
        args.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    sys.exit(bool(result["failures"]))


def interrupt(folder: Path, each: int, seed: int, only: list[str]) -> dict[str, Any]:
    """Send every signal so many times to every command.

    Returns:
        How the commands ended, by command, and what failed.
    """
    chance = random.Random(seed)
    data, fit = prepare(folder)
    done, evaluated, out = folder / "done", folder / "evaluated", folder / "out"
    start([*fit, "--out", str(done), "--steps", "20"]).communicate()
    shutil.copytree(done, evaluated)
    start(["evaluate", str(evaluated), "--spp", "4"]).communicate()
    small = ["--views", "2", "--held-out", "1", "--resolution", "32", "--spp", "64"]
    short = [*fit[2:4], "--steps", "50", "--evaluate-spp", "4"]
    commands = {
        "fit": [*fit, "--out", str(out)],
        "resume": ["fit", str(data), "--resume", "--out", str(out), "--steps", "100000"],
        "capture": ["capture", "cornell", "--out", str(out), *small],
        "evaluate": ["evaluate", str(done), "--spp", "256"],
        "report": ["report", str(evaluated), "--out", str(out)],
        "compare": ["compare", str(data), "--methods", "direct", "--out", str(out), *short],
        "bench": ["bench", "step", "--data", str(data), *fit[2:4], "--steps", "50"],
        "reproduce": ["reproduce", "table2", "--scale", "smoke", "--out", str(out)],
        "doctor": ["doctor"],
    }
    found: dict[str, dict[str, int]] = {}
    failures = []
    for name, words in commands.items():
        if only and name not in only:
            continue
        ends: Counter[str] = Counter()
        whole = _seconds(words, out, done)
        for number in SIGNALS:
            for _ in range(each):
                _clear(out)
                if name == "resume":
                    shutil.copytree(done, out)
                after = chance.uniform(0, whole)
                end, failure = _one(words, number, after, out)
                ends[end] += 1
                if failure:
                    failures.append(f"{name}, {number.name} after {after:.3f} s: {failure}")
                    print(failures[-1], file=sys.stderr, flush=True)
        found[name] = dict(ends)
        print(f"{name}, {whole:.1f} s: {found[name]}", file=sys.stderr, flush=True)
    sent = sum(sum(ends.values()) for ends in found.values())
    return {"sent": sent, "ends": found, "failures": failures, "seed": seed, "machine": machine()}


def _one(words: list[str], number: signal.Signals, after: float, out: Path) -> tuple[str, str]:
    """Send a signal to a command once.

    Returns:
        How it ended, and what is wrong with that.
    """
    process = start(words)
    time.sleep(after)
    process.send_signal(number)
    try:
        said, complained = process.communicate(timeout=_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return "failed", "it does not end"
    status = process.returncode
    if status == -number or (status and "Traceback" in complained and "unbake" not in complained):
        return "before unbake", ""
    if "Traceback" in complained or "Exception ignored" in complained:
        return "failed", complained[-2000:]
    if status == 0:
        return "done", ""
    if status != 128 + number:
        return "failed", f"status {status}: {complained[-2000:]}"
    if left := [str(file) for file in out.parent.rglob(".*.tmp")]:
        return "failed", f"left {left}"
    stopped, run = _STOPPED.search(said), RunFolder(out)
    if words[0] == "fit" and stopped:
        progress = newest_progress(run)
        if progress is None or progress.step != int(stopped[1]):
            return "failed", f"told {stopped[0]}, but saved {progress}"
        return "saved", ""
    return "nothing to save", ""


def _seconds(words: list[str], out: Path, done: Path) -> float:
    """Seconds that a command takes; of a fit, until it has trained for a second."""
    _clear(out)
    if "--resume" in words:
        shutil.copytree(done, out)
    begun = time.monotonic()
    process = start(words)
    if words[0] == "fit":
        assert process.stdout is not None
        while not re.match(r"\s*\d+ %\s+step", line := process.stdout.readline()) and line:
            pass
        time.sleep(1)
        process.kill()
    complained = process.communicate()[1]
    if process.returncode not in (0, -signal.SIGKILL):
        raise RuntimeError(f"{words} fails by itself: {complained}")
    return time.monotonic() - begun


def _clear(out: Path) -> None:
    if out.is_dir():
        shutil.rmtree(out)
    out.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
