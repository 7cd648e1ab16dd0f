"""What other programs say of an exported glTF file: Khronos' validator, and three.js in a browser.

They are packages of npm: `npm ci --prefix benchmarks/gltf`. The browser is Chromium.
"""

from __future__ import annotations

import functools
import json
import math
import shutil
import subprocess
import tempfile
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np

from unbake.dataset.camera import Camera
from unbake.imaging.pictures import read_png

FOLDER = Path(__file__).parent / "gltf"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--use-gl=angle",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars",
    "--force-device-scale-factor=1", "--virtual-time-budget=60000",
)  # fmt: skip


def validator_lacks() -> str | None:
    """Why the validator cannot run here; None if it can."""
    if shutil.which("node") is None:
        return "node is not installed"
    return _package("gltf-validator")


def browser_lacks() -> str | None:
    """Why no browser can show a file here; None if one can."""
    if _browser() is None:
        return f"none of the browsers {', '.join(BROWSERS)} is installed"
    return _package("three")


def _package(name: str) -> str | None:
    if (FOLDER / "node_modules" / name).is_dir():
        return None
    return f"{name} is not installed: npm ci --prefix benchmarks/gltf"


def _browser() -> str | None:
    return next(filter(None, map(shutil.which, BROWSERS)), None)


def validated(file: Path) -> dict[str, Any]:
    """What the validator says: its version, numbers of errors and warnings, and messages."""
    words = ["node", "validate.mjs", str(file.resolve())]
    done = subprocess.run(words, cwd=FOLDER, capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def shown(file: Path, camera: Camera) -> np.ndarray:
    """The base colour of a file without light, as three.js shows it.

    Args:
        file: binary glTF.
        camera: with square pixels, and its principal point in the middle.

    Returns:
        (height, width, 3) uint8 sRGB; black where there is nothing.
    """
    with tempfile.TemporaryDirectory() as folder:
        site = Path(folder)
        shutil.copy(FOLDER / "page.html", site / "index.html")
        shutil.copy(file, site / "scene.glb")
        (site / "node_modules").symlink_to((FOLDER / "node_modules").resolve())
        (site / "camera.json").write_text(json.dumps(_described(camera)))
        handler = functools.partial(_Quiet, directory=folder)
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            thread = threading.Thread(target=server.serve_forever)
            thread.start()
            picture = site / "picture.png"
            words = [
                str(_browser()), *_FLAGS, f"--user-data-dir={folder}/profile",
                f"--window-size={camera.width},{camera.height}", f"--screenshot={picture}",
                f"http://127.0.0.1:{server.server_port}/index.html",
            ]  # fmt: skip
            try:
                subprocess.run(words, capture_output=True, timeout=300, check=True)
            finally:
                server.shutdown()
                thread.join()
        return read_png(picture)[..., :3]


def _described(camera: Camera) -> dict[str, Any]:
    return {
        "to_world": camera.to_world.tolist(),
        "fov_y": math.degrees(2 * math.atan(0.5 * camera.height / camera.fl_y)),
        "width": camera.width,
        "height": camera.height,
        "near": 0.01,
        "far": 1000.0,
    }


class _Quiet(SimpleHTTPRequestHandler):
    """Serves files, and prints nothing."""

    def log_message(self, format: str, *args: object) -> None:
        """Tell nothing."""
