"""A description of the machine, to go with measurements."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any


def machine() -> dict[str, Any]:
    """Processor, number of cores and of threads that compute, Mitsuba's variant, and versions."""
    # Here, for records are compared without them.
    import drjit as dr
    import mitsuba as mi

    model = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(x.split(":", 1)[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "processor": model,
        "cores": os.cpu_count(),
        # A process may have fewer: `taskset`, or others that share the machine.
        "threads": dr.thread_count(),
        "variant": mi.variant(),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
    }


def today() -> str:
    """The day, UTC, on which a measurement is made."""
    return datetime.now(timezone.utc).date().isoformat()


def same_machine(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two records of `machine` agree in what both tell; earlier versions told less."""
    return all(one[key] == other[key] for key in one.keys() & other.keys())


def distinct_machines(records: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The different machines among records of `machine`, of each the one that tells most."""
    found: list[Mapping[str, Any]] = []
    for record in sorted(records, key=len, reverse=True):
        if not any(same_machine(record, known) for known in found):
            found.append(record)
    return found
