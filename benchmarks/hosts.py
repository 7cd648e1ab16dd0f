"""Fits over a network, by two emulated hosts: how long exchanges and steps take, and cut cables.

    python benchmarks/hosts.py exchange|steps|cuts --out FILE.json
        [--data DATA --work FOLDER --rounds 3 --steps 400] [--times 10]

The hosts are namespaces of this machine (`two_hosts.py`), joined by a virtual cable, whose rate is
limited; its counters tell what went through. The kernel's delay is not lengthened.

`exchange` times an Allreduce of the bytes that fits exchange, beside what the model of `scaling.py`
says. `steps` times fits of a data set by one process and by one on each host, in turns, with a core
and a thread each, beside what that model makes of the measured step of one process. `cuts` pulls
the cable of small fits, and stops processes of others, at random instants: all processes must end
by themselves, on both hosts, with a message and a status, and the next fit must go on at the newest
checkpoint. The exit status is 1 if one does not.

Each writes its part of the file. Root's rights on Linux are needed.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from here import ROOT

import numpy as np
import psutil
from kill import GOES_ON, last_logged, until
from ranks import ALONE, SEVERAL, WARM_UP, ms_per_step
from scaling import (
    NETWORKS,
    computing,
    seconds_a_byte_exchanged,
    seconds_of_step,
    seconds_to_exchange,
)
from small_run import mpiexec, prepare
from two_hosts import TwoHosts, why_not

from unbake.io import write_json
from unbake.machine import machine
from unbake.training.checkpoint import newest_progress
from unbake.training.run_folder import RunFolder

SCALING = ROOT / "benchmarks" / "results" / "scaling.json"
#: Bits a second of the cable; None: as many as the machine can.
RATES = {"not limited": None, "10 Gbit/s": 1e10, "1 Gbit/s": 1e9, "100 Mbit/s": 1e8}
#: That of the fits that are timed.
RATE = "1 Gbit/s"
#: An exchange is timed for so many seconds, or so many times.
SECONDS, FEWEST, MOST = 8.0, 5, 40
#: Small messages, each after the one before, that are timed together.
MESSAGES = 100
#: Training time, in seconds, that cuts fall into, and seconds after which a process hangs.
_TRAINING, _HANGS = 3.0, 240.0
_TOLD = re.compile(
    r"^process \d+: the other processes have not answered for \d+ s\..*--resume$", re.M
)


def main() -> None:
    """Measure one of the three, print it, and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["exchange", "steps", "cuts", "allreduce"])
    parser.add_argument("sizes", type=int, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--data", type=Path, help="data set, of steps")
    parser.add_argument("--work", type=Path, help="folder for the runs, of steps")
    parser.add_argument("--rounds", type=int, default=3, help="fits of each kind, of steps")
    parser.add_argument("--steps", type=int, default=400, help="of a fit")
    parser.add_argument("--times", type=int, default=10, help="cuts, and as many stops, of cuts")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    args = parser.parse_args()
    if args.what == "allreduce":
        return allreduce(args.sizes)
    if reason := why_not():
        sys.exit(reason)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the hosts end with this process
    with TwoHosts() as hosts:
        if args.what == "exchange":
            found = exchange(hosts)
        elif args.what == "steps":
            if args.data is None or args.work is None:
                parser.error("--data and --work are needed")
            found = steps(hosts, args.data, args.work, args.rounds, args.steps)
        else:
            with tempfile.TemporaryDirectory() as folder:
                found = cuts(hosts, Path(folder), args.times)
    print(json.dumps(found, indent=1))
    if args.out is not None:
        before = json.loads(args.out.read_text()) if args.out.exists() else {}
        write_json(args.out, before | {"machine": machine(), args.what: found})
    sys.exit(args.what == "cuts" and found["well"] != found["times"])


# ------------------------------------------------------------------------------------- exchanges


def exchange(hosts: TwoHosts) -> dict[str, Any]:
    """Seconds of an Allreduce by bytes and rate of the cable, and those of the model."""
    presets = json.loads(SCALING.read_text(encoding="utf-8"))["presets"]
    sizes = {row["preset"]: row["gradient_bytes"] for row in presets if row["preset"] != "release"}
    in_memory, rows = seconds_a_byte_exchanged(), []
    for name, rate in RATES.items():
        hosts.shape(rate)
        before = hosts.sent()
        words = ("allreduce", *map(str, sizes.values()))
        told = json.loads(_done(hosts.start(sys.executable, __file__, *words)))
        sent = sum(hosts.sent()) - sum(before)
        exchanged = sum(size * len(told[str(size)]) for size in sizes.values())
        told = {name: times[2:] for name, times in told.items()}  # the first ones connect
        latency = statistics.median(told["latency"])
        for preset, size in sizes.items():
            row = {"network": name, "preset": preset, "bytes": size, "latency": latency}
            row |= {"seconds": statistics.median(told[str(size)])}
            row |= {"shortest": min(told[str(size)]), "longest": max(told[str(size)])}
            if rate is not None:
                row["modelled"] = seconds_to_exchange(size, 2, in_memory, rate / 8, latency)
            # All but what MPI says beside: each host sends all bytes once.
            rows.append(row | {"through_cable": sent / (2 * exchanged)})
            print(json.dumps(rows[-1]), flush=True)
    hosts.shape(None)
    return {"seconds_a_byte_in_memory": in_memory, "rows": rows}


def allreduce(sizes: list[int]) -> None:
    """Print seconds of exchanges; of one of two processes."""
    from unbake.ranks import Ranks

    ranks = Ranks.of_environment()
    assert ranks.here == 1

    def timed(what: Callable[[], object]) -> list[float]:
        times: list[float] = []
        while len(times) < FEWEST or (ranks.of_first(sum(times)) < SECONDS and len(times) < MOST):
            start = time.perf_counter()
            what()
            times.append(time.perf_counter() - start)
        return times

    def small() -> None:
        for _ in range(MESSAGES):
            ranks.any(True)

    found = {"latency": [seconds / MESSAGES for seconds in timed(small)]}
    for size in sizes:
        array = np.ones(size // 4, np.float32)
        found[str(size)] = timed(lambda array=array: ranks.mean(array))
    if ranks.leads:
        print(json.dumps(found))


# ------------------------------------------------------------------------------------------ steps


def steps(hosts: TwoHosts, data: Path, work: Path, rounds: int, length: int) -> dict[str, Any]:
    """Milliseconds a step of one process, and of one on each host, with one core each."""
    presets = json.loads(SCALING.read_text(encoding="utf-8"))["presets"]
    (preset,) = (row for row in presets if row["preset"] == "cpu")
    in_memory = seconds_a_byte_exchanged()
    work.mkdir(parents=True, exist_ok=True)
    times: dict[str, list[float]] = {}
    cases = {
        "one process": (1, 1, None),
        "two processes of a host": (2, 1, None),
        "two hosts, not limited": (0, 1, None),
        f"two hosts, {RATE}": (0, 1, RATES[RATE]),
        f"two hosts, {RATE}, --sync-every 10": (0, 10, RATES[RATE]),
    }
    for number, (name, (local, every, rate)) in itertools.product(range(rounds), cases.items()):
        with tempfile.TemporaryDirectory(dir=work) as folder:
            run = Path(folder) / "run"
            words = [*(ALONE if local == 1 else SEVERAL), "fit", str(data), "--out", str(run)]
            words += ["--steps", str(length), "--sync-every", str(every), "--seed", str(number)]
            if local:
                start = [mpiexec(), "-n", "2"] if local > 1 else []
                cores = ",".join(map(str, range(local)))
                _done(_started(["taskset", "-c", cores, *start, *words]))
            else:
                hosts.shape(rate)
                _done(hosts.start(*words, core_each=True))
            times.setdefault(name, []).append(ms_per_step(run))
        print(f"{name}: {times[name][-1]:.1f} ms a step", flush=True)
    hosts.shape(None)
    one = times["one process"]
    rows = []
    for name, found in times.items():
        # Fits of a round ran one after the other, under about the same load of the machine.
        ratios = [a / b for a, b in zip(one, found, strict=True)]
        row = {"case": name, "ms_per_step": statistics.median(found), "all": found}
        row |= {"times_one": statistics.median(ratios)}
        local, every, rate = cases[name]
        row["efficiency"] = row["times_one"] / (local or 2)
        if rate is not None:
            latency = NETWORKS[RATE][1]
            alone, several = (
                seconds_of_step(preset, ranks, every, in_memory, rate / 8, latency)
                for ranks in (1, 2)
            )
            # What cores compute is as long as measured here: the model is of two cores together.
            compute = computing(preset, 2)
            row["modelled"] = statistics.median(one) * compute / alone + 1e3 * (several - compute)
        rows.append(row)
    return {"data": data.name, "steps": length, "warm_up": WARM_UP, "rounds": rounds, "rows": rows}


# ------------------------------------------------------------------------------------------- cuts


def cuts(hosts: TwoHosts, folder: Path, times: int) -> dict[str, Any]:
    """Pull the cable of a fit so many times, and stop one of its processes as often."""
    data, words = prepare(folder, checkpoint_seconds=1)
    run, chance, rows = RunFolder(folder / "run"), random.Random(0), []
    resume, pending = ["fit", str(data), "--resume"], None
    for number in range(2 * times + 1):  # the last one shows that the one before went well
        expected = newest_progress(run)
        logged = last_logged(run) if expected else 0
        command = (sys.executable, "-m", "unbake", *words, "--out", str(run.path))
        words, process = resume, hosts.start(*command)
        text = until(process, "step ")
        while newest_progress(run) is None:
            time.sleep(0.1)
        if pending is not None:
            told = GOES_ON.search(text)
            pending["went_on"] = (
                told is not None and expected is not None and int(told[1]) == expected.step
            )
            pending["steps_lost"] = logged - int(told[1]) if told else None
            rows.append(pending)
            print(json.dumps(pending), flush=True)
        if number == 2 * times:
            break
        time.sleep(chance.uniform(0, _TRAINING))
        what = ("cut", "stop of the first", "cut", "stop of the second")[number % 4]
        pending = {"what": what} | _after(hosts, process, what)
    well = [row for row in rows if all(row[key] for key in ("ended", "status", "told", "went_on"))]
    found: dict[str, Any] = {"times": len(rows), "well": len(well)}
    for kind in ("cut", "stop"):
        seconds = [row["seconds"] for row in rows if row["what"].startswith(kind)]
        found[f"{kind}s"] = len(seconds)
        found[f"seconds_after_{kind}"] = statistics.median(seconds)
        found[f"most_seconds_after_{kind}"] = max(seconds)
    return found | {"rows": rows}


def _after(hosts: TwoHosts, process: subprocess.Popen[str], what: str) -> dict[str, Any]:
    """Do it, and wait until nothing runs on either host any more."""
    begun = time.monotonic()
    if what == "cut":
        hosts.cut()
    else:
        ranks_of(hosts)[what.endswith("second")].suspend()
    left = wait_for_end(hosts, _HANGS)
    seconds = time.monotonic() - begun
    for one in left:
        one.kill()
    text = process.communicate()[1]
    hosts.join()
    told = len(_TOLD.findall(text)) == 1 and "Traceback" not in text
    row = {"seconds": seconds, "ended": not left, "told": told, "status": process.returncode}
    return row | ({} if told else {"text": text})


def ranks_of(hosts: TwoHosts) -> list[psutil.Process]:
    """The processes of `unbake`, one on each host."""
    every = [process for number in (0, 1) for process in hosts.running(number)]
    return [process for process in every if process.cmdline()[1:3] == ["-m", "unbake"]]


def wait_for_end(hosts: TwoHosts, seconds: float) -> list[psutil.Process]:
    """Wait until all processes of both hosts have ended; those that have not."""
    end = time.monotonic() + seconds
    while (left := hosts.running(0) + hosts.running(1)) and time.monotonic() < end:
        time.sleep(0.05)
    return left


# ------------------------------------------------------------------------------------ subprocesses


def _started(words: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _done(process: subprocess.Popen[str]) -> str:
    """What a process prints, when it has ended well."""
    text, errors = process.communicate()
    if process.returncode:
        sys.exit(errors)
    return text


if __name__ == "__main__":
    main()
