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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import here

from small_run import prepare, start

from unbake.backend import activate

activate()  # before modules with types of Dr.Jit

from unbake.dataset.data_folder import DataFolder  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training.checkpoint import newest_progress  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
#: Seconds that a command may take to end.
_PATIENCE = 120
_STOPPED = re.compile(r"stopped at step (\d+)")
#: Commands that come to no end here, by the line with which they begin their work.
_ENDLESS = {"fit": re.compile(r"\s*\d+ %\s+step"), "view": re.compile("http://")}
_LIGHTS = """<scene version="3.0.0">
  <emitter type="constant"><rgb name="radiance" value="0.5"/></emitter>
</scene>
"""


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
    done, out = folder / "done", folder / "out"
    start([*fit, "--out", str(done), "--steps", "20"]).communicate()
    commands = _commands(folder, data, fit, done, out)
    if unknown := set(only) - commands.keys():
        raise ValueError(f"no command {', '.join(sorted(unknown))}: {', '.join(commands)}")
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


def _commands(
    folder: Path, data: Path, fit: list[str], done: Path, out: Path
) -> dict[str, list[str]]:
    """Every command by name, small, with what it needs beside a data set and a run."""
    evaluated, lights = folder / "evaluated", folder / "lights.xml"
    shutil.copytree(done, evaluated)
    start(["evaluate", str(evaluated), "--spp", "4"]).communicate()
    lights.write_text(_LIGHTS, encoding="utf-8")
    photographs = _without_scene(data, folder / "photographs")
    meshes = sorted(data.rglob("*.ply"))
    to = ["--out", str(out)]
    small = ["--views", "2", "--held-out", "1", "--resolution", "32", "--spp", "64"]
    solved = ["--views", "1", "--resolution", "16", "--spp", "4", "--final-spp", "4"]
    short = [*fit[2:4], "--steps", "50", "--evaluate-spp", "4"]
    return {
        "fit": [*fit, *to],
        "resume": ["fit", str(data), "--resume", *to, "--steps", "100000"],
        "capture": ["capture", "cornell", *to, *small],
        "import": ["import", str(photographs), *to, *_each("--mesh", meshes), "--holdout", "0"],
        "data check": ["data", "check", str(data), *to],
        "evaluate": ["evaluate", str(done), "--spp", "256"],
        "report": ["report", str(evaluated), *to],
        "export": ["export", str(done), *to, "--texels", "8"],
        "render": ["render", str(done), *to, "--spp", "64"],
        "relight": ["relight", str(done), *to, "--lights", str(lights), "--spp", "64"],
        "view": ["view", str(done), "--port", "0"],
        "solve": ["solve", "cornell", *to, "--steps", "50", "--batch", "256", *solved],
        "compare": ["compare", str(data), "--methods", "direct", *to, *short],
        "bench": ["bench", "step", "--data", str(data), *fit[2:4], "--steps", "50"],
        "degrade": ["degrade", str(data), *to, "--exposure", "0.5"],
        "reproduce": ["reproduce", "table2", "--scale", "smoke", *to],
        "doctor": ["doctor"],
    }


def _each(option: str, files: Sequence[Path]) -> list[str]:
    """An option that is given for each of several files."""
    return [word for file in files for word in (option, str(file))]


def _without_scene(data: Path, out: Path) -> Path:
    """The photographs and cameras of a data set, as another program would have written them."""
    source, copy = DataFolder(data), DataFolder(out)
    shutil.copytree(source.image("any").parent, copy.image("any").parent)
    content = source.read_transforms()
    del content["scene"]
    copy.write_transforms(content)
    return out


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
    """Seconds that a command takes; of one without an end, until it has worked for a second."""
    _clear(out)
    if "--resume" in words:
        shutil.copytree(done, out)
    begun = time.monotonic()
    process = start(words)
    if words[0] in _ENDLESS:
        assert process.stdout is not None
        while not _ENDLESS[words[0]].match(line := process.stdout.readline()) and line:
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
