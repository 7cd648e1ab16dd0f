"""How near `unbake solve` comes to a path traced reference of `demo`, and in what time.

    python benchmarks/solve_demo.py --work FOLDER --out FILE.json [--scene demo] [--steps 4800]
        [--views 4] [--resolution 64] [--final-spp 1024] [--reference-spp 1024] [--seed 0]

Both sides of the rendering equation are compared with the reference, by relMSE: as it is, and
without the noise of the reference. That of the right-hand side, of --final-spp bounces a pixel, is
in both. On a machine that is busy with other things, times of training are those of the cores that
were at work for it (`cpu_seconds`); how many other programs kept busy is written, too.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import here

import psutil

from unbake import backend

backend.activate()

from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.solver.settings import SolveSettings  # noqa: E402
from unbake.solver.solve import solve  # noqa: E402


def main() -> None:
    """Solve, print what was measured, and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="new folder for the solved field")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--steps", type=int, default=4800)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--final-spp", type=int, default=1024)
    parser.add_argument("--reference-spp", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    settings = SolveSettings(
        steps=args.steps,
        views=args.views,
        resolution=args.resolution,
        final_spp=args.final_spp,
        reference_spp=args.reference_spp,
        seed=args.seed,
    )
    before, start = psutil.cpu_times(), time.perf_counter()
    made = solve(args.scene, args.work, settings, tell=lambda line: print(line, flush=True))
    wall = time.perf_counter() - start
    found = {
        "machine": machine(),
        "scene": args.scene,
        "settings": {
            name: getattr(settings, name)
            for name in ("steps", "batch", "samples", "views", "resolution", "seed")
        },
        "wall_seconds": round(wall, 1),
        "others_cores": round(others(before, wall), 2),
        "reference_spp": args.reference_spp,
        "reference_noise": made["reference_noise"],
        "measurements": made["measurements"],
    }
    write_json(args.out, found, allow_nan=False)
    told(found)


def others(before: Any, wall: float) -> float:
    """Cores that other programs kept busy meanwhile, on average."""
    after, mine = psutil.cpu_times(), psutil.Process().cpu_times()
    idle = sum(getattr(after, k, 0) - getattr(before, k, 0) for k in ("idle", "iowait"))
    busy = wall * (psutil.cpu_count() or 1) - idle
    return max(0.0, (busy - mine.user - mine.system) / wall)


def told(found: dict[str, Any]) -> None:
    """Print the last measurement."""
    last = found["measurements"][-1]
    print(f"{last['step']} steps, {last['seconds']:.0f} s, {last['cpu_seconds']:.0f} s of CPU")
    print(f"its pictures {last['pictures_seconds']:.0f} s")
    print(f"with the reference and measurements {found['wall_seconds']:.0f} s")
    print(f"other programs kept {found['others_cores']:.2f} cores busy")
    print(f"reference: {found['reference_spp']} samples, noise {found['reference_noise']:.5f}")
    for side in ("lhs", "rhs"):
        plain, debiased = last["relmse"][side], last["relmse_debiased"][side]
        print(f"{side}: relMSE {plain:.5f}, without noise of the reference {debiased:.5f}")


if __name__ == "__main__":
    main()
