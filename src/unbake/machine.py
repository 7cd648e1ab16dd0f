"""A description of the machine, to go with measurements."""

from __future__ import annotations

import os
import platform
from pathlib import Path

import drjit as dr
import mitsuba as mi


def machine() -> dict:
    """Processor, number of cores, Mitsuba's variant, and versions."""
    model = platform.processor()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(x.split(":", 1)[1].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        pass
    return {
        "processor": model,
        "cores": os.cpu_count(),
        "variant": mi.variant(),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
    }
