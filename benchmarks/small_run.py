"""A fit that starts fast and has small steps, for the measurements that end it early."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from unbake.quantities import QUANTITIES
from unbake.signals import STOPPING

_SETTINGS = "steps = 100000000\npixels = 64\nspp = 4\nwarm_up = 0\ncheckpoint_seconds = {}\n"
_FIELD = (
    "[{}.neural]\nwidth = 8\nhidden = 1\n"
    "[{}.neural.grid]\nlevels = 2\ntable_log2 = 8\nbase_resolution = 2\n"
)


def prepare(folder: Path, checkpoint_seconds: float = 0) -> tuple[Path, list[str]]:
    """Make a data set of two views, and a fit of it that never comes to its end.

    Args:
        folder: for both.
        checkpoint_seconds: between checkpoints; 0: one after every step, so that ends at random
            instants meet many that are being written.

    Returns:
        The data set, and the words after `unbake` that begin the fit, but for `--out`.
    """
    data, settings = folder / "data", folder / "settings.toml"
    names = [*(f"materials.{name}" for name in QUANTITIES), "radiance"]
    settings.write_text(
        _SETTINGS.format(checkpoint_seconds) + "".join(_FIELD.format(name, name) for name in names)
    )
    if not data.is_dir():
        size = {"views": 2, "held-out": 1, "resolution": 16, "spp": 8, "max-depth": 6}
        words = [word for name, value in size.items() for word in (f"--{name}", str(value))]
        start(["capture", "cornell", "--out", str(data), *words]).communicate()
    return data, ["fit", str(data), "--settings", str(settings), "--method", "direct"]


def mpiexec() -> str:
    """The program that starts several processes, beside this interpreter or in the path."""
    folder = str(Path(sys.executable).parent)
    found = shutil.which("mpiexec", path=os.pathsep.join((folder, os.environ["PATH"])))
    if found is None:
        sys.exit("mpiexec is missing: pip install unbake[mpi]")
    return found


def start(words: list[str], ranks: int = 1) -> subprocess.Popen[str]:
    """A command of `unbake`, in a process group of its own; of several ranks that of `mpiexec`."""
    several = [mpiexec(), "-n", str(ranks)] if ranks > 1 else []
    return in_group_of_its_own([*several, sys.executable, "-m", "unbake", *words])


def in_group_of_its_own(words: list[str]) -> subprocess.Popen[str]:
    """A command in a process group of its own, whose output is read, and which signals reach."""
    return subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=default_signals,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


def default_signals() -> None:
    """What a shell starts in the background ignores SIGINT, and unbake then does, too."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_DFL)
