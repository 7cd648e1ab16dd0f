"""Lets scripts of this folder, and commands that they start, use the `unbake` of this checkout.

A script imports this module before anything that imports `unbake`: `src` is then first on the path,
and in PYTHONPATH, which keeps what it had. So that linters keep this order, too, the module has a
section of its own in `pyproject.toml`, before all other packages.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
SRC = str(ROOT / "src")

sys.path.insert(0, SRC)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (SRC, os.environ.get("PYTHONPATH"))))
