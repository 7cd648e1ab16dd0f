"""How long a step takes with more processes: a model, from what is measured on this machine.

    python benchmarks/scaling.py --data DATA --out FILE.json [--presets cpu paper release]

Measured here, alone on the machine: the time of a step by the size of the batch, which is a + b
times its pixels (least squares with a and b of 0 or more, and what the line leaves of each; small
batches of the large presets, whose steps take seconds on a CPU); bytes of gradients and of states;
how long these take from Dr.Jit to NumPy and back, as the median of several times after the first
ones; and an Allreduce between two processes of this machine, which needs no network.

A step of N processes, one a machine, with the preset's batch B is then

    a + b B / N + s (d + 2 (N - 1) / N (c + 1 / w)) + 2 log2(N) t

with s the bytes that are exchanged in a step, d the seconds a byte takes to NumPy and back, c those
of the Allreduce in memory, w the bandwidth of a network and t its latency. With `--sync-every` H, s
is the bytes of a state over H. That is what a ring needs; computation and exchange do not overlap,
as in `unbake fit`. Bandwidths and latencies of networks are assumed, and told in the result.
`paying` is the largest N up to 1,024 whose efficiency is a half or more: the step of one process
over N times that of N.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import here

import numpy as np
from small_run import mpiexec

from unbake import backend
from unbake.io import write_json
from unbake.machine import machine

#: Bytes a second, and seconds of latency a message.
NETWORKS = {
    "1 Gbit/s": (125e6, 5e-5),
    "10 Gbit/s": (1.25e9, 3e-5),
    "100 Gbit/s": (12.5e9, 5e-6),
    "NVLink, 450 GB/s": (450e9, 2e-6),
}
RANKS = [2**i for i in range(11)]
SYNC_EVERY = (1, 20)
#: The least efficiency that pays.
LEAST = 0.5
#: Batches whose steps are timed, in pixels, and how often; the first steps compile.
BATCHES = dict.fromkeys(("cpu", "paper", "release"), (64, 128, 256, 512, 1024))
TIMES = {"cpu": 60, "paper": 6, "release": 6}
WARM_UP = {"cpu": 20, "paper": 4, "release": 4}
#: Copies of a state that are timed, after the first ones.
COPIES, COPIES_BEFORE = 9, 3
#: Of arrays that are exchanged between two processes of this machine.
BYTES = 1 << 26


def main() -> None:
    """Measure, work out the model, and write both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="data set")
    parser.add_argument("--presets", nargs="+", default=list(BATCHES), choices=list(BATCHES))
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--exchange", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.exchange:
        return exchange()
    if args.data is None or args.out is None:
        parser.error("--data and --out are needed")
    each = seconds_a_byte_exchanged()
    print(f"Allreduce in memory: {each * 1e9:.3f} s a GB", flush=True)
    rows = []
    backend.activate()
    for preset in args.presets:
        found = measured(args.data, preset)
        paid = paying(found, each)
        rows.append(found | {"modelled": modelled(found, each), "paying": paid})
        shown = {key: value for key, value in found.items() if key != "batches"}
        print(json.dumps(shown), flush=True)
    result = {"machine": machine(), "data": args.data.name, "seconds_a_byte_exchanged": each}
    networks = {name: {"bytes_a_second": w, "latency": t} for name, (w, t) in NETWORKS.items()}
    write_json(args.out, result | {"networks": networks, "presets": rows})
    return None


def measured(data: Path, preset_name: str) -> dict[str, Any]:
    """Times of steps by batch, their line, and bytes of gradients and states."""
    import drjit as dr

    from unbake.config import preset
    from unbake.dataset.views import Dataset
    from unbake.training.fresh_fit import begin_fit
    from unbake.training.schedule import learning_rates

    dataset, config, batches = Dataset.load(data), preset(preset_name), []
    gradients, numbers, copies = 0, 0, []
    for pixels in BATCHES[preset_name]:
        # Crops of one view are squares; the time of a step does not depend on where pixels lie.
        settings = dataclasses.replace(config, pixels=pixels, pixel_sampling="all-views")
        fit, times = begin_fit(dataset, settings), []
        for number in range(WARM_UP[preset_name] + TIMES[preset_name]):
            start = time.perf_counter()
            fit.step(fit.state, number, learning_rates(fit.config, number, 0.0))
            dr.sync_thread()
            times.append(time.perf_counter() - start)
        seconds = statistics.median(times[WARM_UP[preset_name] :])
        batches.append({"pixels": pixels, "seconds": seconds})
        print(f"{preset_name}, {pixels} pixels: {1e3 * seconds:.1f} ms a step", flush=True)
        state = fit.state
        gradients = 4 * sum(dr.width(v.array) for _, o in state.optimizers() for v in o.values())
        for number in range(COPIES_BEFORE + COPIES):
            start = time.perf_counter()
            flat = state.numbers()
            state.assign_numbers(flat)
            dr.sync_thread()
            if number >= COPIES_BEFORE:
                copies.append(time.perf_counter() - start)
            numbers = flat.nbytes
        del fit, state
    fixed, slope = line([b["pixels"] for b in batches], [b["seconds"] for b in batches])
    for batch in batches:
        batch["residual"] = batch["seconds"] - fixed - slope * batch["pixels"]
    return {
        "preset": preset_name,
        "batch": config.pixels,
        "batches": batches,
        "fixed_seconds": fixed,
        "seconds_a_pixel": slope,
        "gradient_bytes": gradients,
        "state_bytes": numbers,
        "seconds_a_byte_copied": statistics.median(copies) / numbers,
        "largest_residual": max(abs(b["residual"]) / b["seconds"] for b in batches),
    }


def line(x: Sequence[float], y: Sequence[float]) -> tuple[float, float]:
    """Intercept and slope by least squares, neither of them below 0; x is positive."""
    slope, intercept = np.polyfit(x, y, 1).tolist()
    if slope < 0:
        return max(statistics.mean(y), 0.0), 0.0
    if intercept < 0:
        return 0.0, max(float(np.dot(x, y) / np.dot(x, x)), 0.0)
    return intercept, slope


def modelled(found: dict[str, Any], exchanged: float) -> list[dict[str, Any]]:
    """Seconds a step by network, number of processes, and how often these share."""
    rows = []
    for network, (bandwidth, latency) in NETWORKS.items():
        for every in SYNC_EVERY:
            for ranks in RANKS:
                seconds = seconds_of_step(found, ranks, every, exchanged, bandwidth, latency)
                row = {"network": network, "sync_every": every, "ranks": ranks}
                rows.append(row | {"seconds": seconds})
    return rows


def paying(found: dict[str, Any], exchanged: float) -> list[dict[str, Any]]:
    """The largest number of processes that is half as efficient as one, or more."""
    rows = []
    for network, (bandwidth, latency) in NETWORKS.items():
        for every in SYNC_EVERY:
            one, *more = (
                seconds_of_step(found, ranks, every, exchanged, bandwidth, latency)
                for ranks in range(1, RANKS[-1] + 1)
            )
            good = [n for n, seconds in enumerate(more, 2) if one >= LEAST * n * seconds]
            row = {"network": network, "sync_every": every}
            rows.append(row | {"ranks": max(good, default=1)})
    return rows


def computing(found: dict[str, Any], ranks: int) -> float:
    """Seconds of a step without what is exchanged."""
    return found["fixed_seconds"] + found["seconds_a_pixel"] * found["batch"] / ranks


def seconds_of_step(
    found: dict[str, Any],
    ranks: int,
    every: int,
    exchanged: float,
    bandwidth: float,
    latency: float,
) -> float:
    """Seconds of a step of so many processes.

    Args:
        found: as `measured` gives it.
        ranks: processes.
        every: steps between exchanges.
        exchanged: seconds a byte of an exchange in memory.
        bandwidth: of the network, in bytes a second.
        latency: of a message, in seconds.
    """
    seconds = computing(found, ranks)
    if ranks > 1:
        size = found["gradient_bytes"] if every == 1 else found["state_bytes"] / every
        seconds += size * found["seconds_a_byte_copied"]
        seconds += seconds_to_exchange(size, ranks, exchanged, bandwidth, latency / every)
    return seconds


def seconds_to_exchange(
    size: float, ranks: int, exchanged: float, bandwidth: float, latency: float
) -> float:
    """Of an Allreduce as a ring; with the time that a byte takes in memory."""
    ring = 2 * (ranks - 1) / ranks * (exchanged + 1 / bandwidth)
    return size * ring + 2 * math.log2(ranks) * latency


def seconds_a_byte_exchanged() -> float:
    """Of an Allreduce between two processes of this machine."""
    words = [mpiexec(), "-n", "2", sys.executable, __file__, "--exchange"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    if done.returncode:
        sys.exit(done.stderr)
    return float(done.stdout)


def exchange() -> None:
    """Print the seconds a byte of an Allreduce; of one of two processes."""
    from unbake.ranks import Ranks

    ranks, times = Ranks.of_environment(), []
    array = np.ones(BYTES // 4, np.float32)
    for _ in range(12):
        start = time.perf_counter()
        ranks.mean(array)
        times.append(time.perf_counter() - start)
    if ranks.leads:
        print(statistics.median(times[2:]) / BYTES)


if __name__ == "__main__":
    main()
