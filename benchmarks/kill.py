"""Kill a fit with `kill -9` at random instants, and go on each time.

    python benchmarks/kill.py --kills 200 [--ranks 2]

With several ranks of MPI one of them is killed, by chance, and the others must end by themselves.

Each kill is followed by `unbake fit --resume`, which is killed in its turn: a quarter while it
starts, the others while it trains and saves. A kill counts as survived if the next fit that comes
so far goes on at the newest checkpoint that the killed one had written, at most one interval (here
one step) before the last line of its log. The exit status is 1 if one is not.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import re
import selectors
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import here

import psutil
from small_run import prepare, start

from unbake.backend import activate

activate()  # before modules with types of Dr.Jit

from unbake.machine import machine  # noqa: E402
from unbake.training.checkpoint import newest_progress  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

#: Training time, in seconds, that most kills fall into.
_TRAINING = 1.5
#: Share of the kills that come before the first step.
_EARLY = 0.25
GOES_ON = re.compile(r"going on after step (\d+)")


def main() -> None:
    """Kill, print each failure, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--ranks", type=int, default=1, help="processes of a fit")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = kill(Path(folder), args.kills, args.seed, args.ranks)
    print(json.dumps(result, indent=1))
    if args.out is not None:
        args.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    sys.exit(result["survived"] != result["kills"])


@dataclass
class _Tally:
    kills: int = 0
    survived: int = 0
    while_starting: int = 0
    while_saving: int = 0
    most_steps_lost: int = 0
    seconds_to_end: float = 0.0  # of the other ranks, at most
    failures: list[str] = field(default_factory=list)


def kill(folder: Path, kills: int, seed: int, ranks: int = 1) -> dict[str, Any]:
    """Kill a fit, or one of its ranks, so many times.

    Returns:
        How many kills were survived, how many came while a checkpoint was written, the most steps
        that one cost, the most seconds that other ranks lived on, and what failed.
    """
    data, words = prepare(folder)
    run, chance, tally = RunFolder(folder / "run"), random.Random(seed), _Tally()
    # The first fit compiles.
    start_up = _one(words, run, chance, 1.0, True, ranks)[1]
    before = newest_progress(run)
    resume = ["fit", str(data), "--resume"]
    pending = 1  # kills that no start has gone on after, yet
    while tally.kills < kills:
        logged, expected = last_logged(run), before
        late = chance.random() > _EARLY or tally.kills + pending >= kills
        told, start_up, lived = _one(resume, run, chance, start_up, late, ranks)
        tally.seconds_to_end = max(tally.seconds_to_end, lived)
        before = newest_progress(run)
        tally.while_saving += any(run.checkpoints.glob(".*.tmp"))
        if told is None:  # killed before it told; the next one does
            tally.while_starting += 1
            pending += 1
            continue
        lost = logged - told
        tally.most_steps_lost = max(tally.most_steps_lost, lost)
        tally.kills += pending
        if expected is not None and told == expected.step and lost <= 1:
            tally.survived += pending
        else:
            tally.failures.append(f"after kill {tally.kills}: {expected=}, {told=}, {logged=}")
            print(tally.failures[-1], file=sys.stderr, flush=True)
        pending = 1
    return {**vars(tally), "ranks": ranks, "seed": seed, "machine": machine()}


def _one(
    words: list[str],
    run: RunFolder,
    chance: random.Random,
    start_up: float,
    late: bool,
    ranks: int,
) -> tuple[int | None, float, float]:
    """Start a fit and kill it.

    Args:
        start_up: seconds from the start to the first step, of the fit before.
        late: kill it while it trains, else before.

    Returns:
        The step that it told to go on after, its seconds to the first step, and how many other
        ranks lived on.
    """
    process = start([*words, "--out", str(run.path)], ranks)
    begun, told, lived = time.monotonic(), None, 0.0
    try:
        if late:
            text = until(process, "step ")
            start_up = time.monotonic() - begun
            time.sleep(chance.uniform(0, _TRAINING))
        else:
            time.sleep(chance.uniform(0, start_up))
            text = ""
        if ranks > 1:
            lived = _kill_one_of(process, chance)
    finally:
        process.kill()
        text += process.communicate()[0]
    if found := GOES_ON.search(text):
        told = int(found[1])
    return told, start_up, lived


def _kill_one_of(process: subprocess.Popen[str], chance: random.Random) -> float:
    """Kill one of the ranks that `mpiexec` started; the seconds until all others are gone."""
    every = []
    for child in psutil.Process(process.pid).children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            every += [child] if "unbake" in child.cmdline() else []
    if not every:  # not started yet
        return 0.0
    chance.choice(every).kill()
    killed = time.monotonic()
    _, left = psutil.wait_procs(every, timeout=60)
    if left:
        raise RuntimeError(f"{len(left)} ranks live on, 60 s after another was killed")
    return time.monotonic() - killed


def until(process: subprocess.Popen[str], word: str) -> str:
    """What a process prints up to a line with a word in it."""
    assert process.stdout is not None and process.stderr is not None
    text = ""
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while selector.select(timeout=120):
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(f"the fit ended by itself: {text}{process.stderr.read()}")
            text += line
            if re.match(rf"\s*\d+ %\s+{word}", line):
                return text
    raise RuntimeError(f"the fit does not train: {text}")


def last_logged(run: RunFolder) -> int:
    """The last step in the log of a run; 0 without one."""
    return max((line["step"] for line in run.log()), default=0)


if __name__ == "__main__":
    main()
