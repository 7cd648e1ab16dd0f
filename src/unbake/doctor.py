"""`unbake doctor`: the libraries of this machine, whether kernels run, and remedies."""

from __future__ import annotations

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import psutil
from rich.console import Console
from rich.table import Table
from rich.text import Text

from unbake import backend
from unbake.threads import usable_cores

_GIB = 1024**3
_PROBE_SECONDS = 180
"""A cold kernel cache takes about two seconds; a GPU's first OptiX start may take a minute."""


@dataclass(frozen=True)
class Row:
    """One line of a diagnosis; `remedy` is empty where nothing is to be done."""

    name: str
    value: str
    ok: bool = True
    remedy: str = ""


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and whether unbake can work on this machine."""

    rows: tuple[Row, ...]
    usable: bool


def doctor() -> Diagnosis:
    """Examine the machine without importing Mitsuba: kernels run in a process of their own."""
    kernels, variant = _kernels()
    rows = (
        *_versions(),
        Row("variant", variant or "none", bool(variant)),
        kernels,
        _llvm(needed=variant != backend.CUDA_VARIANT),
        _gpu(),
        *_resources(),
    )
    return Diagnosis(rows, usable=kernels.ok)


def print_doctor(console: Console) -> int:
    """Print the diagnosis; return 0 where unbake can work on this machine, else 1."""
    diagnosis = doctor()
    table = Table(show_header=False, box=None, padding=(0, 1), pad_edge=False)
    for row in diagnosis.rows:
        mark = Text("ok", "green") if row.ok else Text("!!", "bold red")
        # Text, not str: a path in square brackets is no markup.
        table.add_row(mark, Text(row.name, "bold"), Text(row.value, overflow="fold"))
        if row.remedy:
            table.add_row("", "", Text(f"-> {row.remedy}", "yellow", overflow="fold"))
    console.print(table)
    if diagnosis.usable:
        console.print("\nunbake can work on this machine.", style="green")
        return 0
    console.print("\nunbake cannot work on this machine yet: see the lines marked !!", style="red")
    return 1


def main() -> int:
    """Print the diagnosis to standard output; the return value is the exit status."""
    return print_doctor(Console(highlight=False))


def _versions() -> tuple[Row, ...]:
    rows = [Row("python", f"{platform.python_version()} ({sys.executable})")]
    for name in ("unbake", "mitsuba", "drjit", "numpy"):
        try:
            rows.append(Row(name, metadata.version(name)))
        except metadata.PackageNotFoundError:
            # unbake itself may run from a checkout on the module path.
            ok = name == "unbake"
            remedy = "" if ok else f"pip install {name}"
            rows.append(Row(name, "not installed as a package", ok, remedy))
    return tuple(rows)


def _kernels() -> tuple[Row, str]:
    """Run the probe; return its row and the variant it ran on, empty where it did not."""
    command = [sys.executable, "-m", "unbake.probe"]
    source = str(Path(__file__).parents[1])
    path = os.pathsep.join(filter(None, [source, os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "PYTHONPATH": path}
    try:
        run = subprocess.run(
            command, capture_output=True, text=True, timeout=_PROBE_SECONDS, env=environment
        )
    except subprocess.TimeoutExpired:
        late = f"did not finish in {_PROBE_SECONDS} s"
        return Row("kernels", late, False, "Try again: the first run compiles"), ""
    report = _last_json(run.stdout)
    if run.returncode == 0 and "variant" in report:
        ran = f"network and rays ran on {report['device']} in {report['seconds']:.1f} s"
        return Row("kernels", ran), report["variant"]
    if "error" in report:
        # The line about LLVM tells the same at length.
        known = report["error"] == str(backend.llvm_problem())
        return Row("kernels", "not tried" if known else report["error"], False), ""
    return Row("kernels", _death(run), False, "Update LLVM or the GPU driver"), ""


def _last_json(output: str) -> dict:
    for line in reversed(output.splitlines()):
        try:
            value = json.loads(line)
        except ValueError:
            continue
        if isinstance(value, dict):
            return value
    return {}


def _death(run: subprocess.CompletedProcess[str]) -> str:
    """How the probe ended, where it printed no result."""
    lines = [line for line in run.stderr.splitlines() if line.strip()]
    last = f": {lines[-1].strip()}" if lines else ""
    if run.returncode < 0:
        return f"a test kernel stopped its process ({signal.Signals(-run.returncode).name}){last}"
    return f"a test kernel failed (status {run.returncode}){last}"


def _llvm(needed: bool) -> Row:
    problem = backend.llvm_problem()
    if problem is None:
        return Row("LLVM", str(backend.find_llvm()))
    value = problem.what if problem.where is None else f"{problem.where}: {problem.what}"
    if not needed:
        return Row("LLVM", f"{value}; the GPU is used")
    return Row("LLVM", value, False, problem.remedy or "")


def _gpu() -> Row:
    if not backend.cuda_driver():
        return Row("GPU", "no NVIDIA driver; the CPU is used")
    if backend.optix():
        return Row("GPU", "NVIDIA driver with OptiX")
    remedy = "In a container, set NVIDIA_DRIVER_CAPABILITIES=all"
    return Row("GPU", "NVIDIA driver without OptiX; the CPU is used", False, remedy)


def _resources() -> tuple[Row, ...]:
    cores = usable_cores()
    free = shutil.disk_usage(Path.cwd()).free
    return (
        Row("cores", f"{cores} ({platform.machine()})"),
        _memory(),
        Row(
            "disk",
            f"{free / _GIB:.1f} GiB free here",
            ok=free > _GIB,
            remedy="" if free > _GIB else "A run with its pictures takes up to 1 GiB",
        ),
    )


def _memory() -> Row:
    total = psutil.virtual_memory().total
    enough = total > 2 * _GIB
    remedy = "" if enough else "Use a smaller batch"
    return Row("memory", f"{total / _GIB:.1f} GiB", enough, remedy)
