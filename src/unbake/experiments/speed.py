"""How fast this machine is, for estimates of how long jobs take."""

from __future__ import annotations

import statistics
import time

import drjit as dr
import mitsuba as mi

#: Seconds that the probe took where the estimates come from: two cores of an AMD EPYC.
REFERENCE = 0.145


def slowness() -> float:
    """Time that rendering takes here, relative to the reference machine."""
    scene = mi.load_dict(mi.cornell_box())
    sensor, integrator = scene.sensors()[0], mi.load_dict({"type": "path", "max_depth": 8})
    seconds = []
    for seed in range(4):
        start = time.perf_counter()
        dr.eval(mi.render(scene, sensor=sensor, integrator=integrator, spp=8, seed=seed))
        dr.sync_thread()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:]) / REFERENCE


def capture_seconds(samples: int) -> float:
    """Time to render a data set of so many camera samples on the reference machine."""
    return 5 + samples / 600_000
