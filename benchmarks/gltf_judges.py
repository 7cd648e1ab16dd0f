"""What other programs say of an exported glTF file: Khronos' validator, and three.js in a browser.

They are packages of npm: `npm ci --prefix benchmarks/gltf`. The browser is Chromium.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import shutil
import signal
import subprocess
import tempfile
import threading
import time
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
    "--force-device-scale-factor=1",
)  # fmt: skip

#: A browser takes no longer to load and draw a scene.
_SECONDS = 300.0


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
        page = _Page(folder)
        words = [
            str(_browser()), *_FLAGS, f"--user-data-dir={folder}/profile",
            f"--window-size={camera.width},{camera.height}", page.url,
        ]  # fmt: skip
        try:
            kept = subprocess.DEVNULL
            with subprocess.Popen(words, stdout=kept, stderr=kept, start_new_session=True) as done:
                try:
                    (site / "picture.png").write_bytes(page.picture(done, _SECONDS))
                finally:
                    os.killpg(done.pid, signal.SIGKILL)
        finally:
            page.close()
        return read_png(site / "picture.png")[..., :3]


def _described(camera: Camera) -> dict[str, Any]:
    return {
        "to_world": camera.to_world.tolist(),
        "fov_y": math.degrees(2 * math.atan(0.5 * camera.height / camera.fl_y)),
        "width": camera.width,
        "height": camera.height,
        "near": 0.01,
        "far": 1000.0,
    }


class _Page:
    """A folder served to a browser of this machine, which answers with a picture.

    A screenshot by the browser itself is of an unknown moment: of an empty page where textures are
    large and the machine is busy.

    Args:
        folder: with index.html.
    """

    def __init__(self, folder: str) -> None:
        answers: queue.Queue[tuple[str, bytes]] = queue.Queue()

        class Handler(SimpleHTTPRequestHandler):
            def __init__(self, *args: Any) -> None:
                super().__init__(*args, directory=folder)

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                self.send_response(204)
                self.end_headers()
                answers.put((self.path.strip("/"), body))

            def log_message(self, format: str, *args: object) -> None:
                """Tell nothing."""

        self._answers = answers
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}/index.html"
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def picture(self, browser: subprocess.Popen[bytes], seconds: float) -> bytes:
        """What the page sends, as PNG.

        Raises:
            RuntimeError: it tells of an error, or the browser ends or takes too long.
        """
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(queue.Empty):
                kind, body = self._answers.get(timeout=0.2)
                if kind != "picture":
                    raise RuntimeError(f"the page says: {body.decode(errors='replace')}")
                return body
            if browser.poll() is not None:
                raise RuntimeError(f"the browser ended by itself, with {browser.returncode}")
        raise RuntimeError(f"the page showed nothing in {seconds:g} s")

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
