"""The page, made by viser: the scene, frusta of cameras, and a panel. It reads no files.

The page is served to this machine alone: the socket is that of 127.0.0.1, web sites that are open
in the same browser are refused, and nothing can be shared through the servers of viser's authors.
Names come from files of others: they are text on the page, never markup.
"""

from __future__ import annotations

import html
import math
import queue
import re
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import rich
import viser
import websockets.asyncio.server
from viser import transforms

from ..dataset.camera import Camera
from ..errors import UserError, printable
from ..imaging.pictures import png_data_uri
from .viewed import Picture

HOST = "127.0.0.1"
#: viser tries the ports after one that is taken.
LAST_PORT = 65000
#: Pages that may connect: this one, also through a tunnel to another port.
_OWN_PAGES = re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?")
#: Colours of frusta, 8-bit sRGB: training views, held-out ones, and the one that is chosen.
TRAIN, HELDOUT, CHOSEN = (70, 110, 200), (225, 120, 40), (20, 160, 90)
#: Of the diagonal of the scene: how long frusta are.
_FRUSTUM = 0.03
_STEPS = ("previous", "go there", "next")


@dataclass(frozen=True)
class Event:
    """What somebody did on the page.

    Args:
        kind: `choice` (a title), `exposure` (stops), `view` (its number), `step` (-1 or 1), `there`
            (none), `checkpoint` (its number, the oldest is 1) or `eye` (a position).
        value: see `kind`.
        client: the tab of a browser that it was done in, for the page alone.
    """

    kind: str
    value: Any = None
    client: Any = None


class _Server(viser.ViserServer):
    """The server, without the tunnel to the world that any page could ask for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """None: nothing is shared."""
        return None


class Page:
    """A page that is served until it is closed; a context manager.

    Args:
        title: of the page.
        port: 0: any that is free.
        choices: titles of what surfaces can show.
        views: names of views, and whether each is a training view.
        cameras: of these views.
        overview: as of `ViewedData.overview`.
        has_checkpoints: whether there is a slider of them, and a log.

    Raises:
        UserError: the port is taken or cannot be used.
    """

    def __init__(
        self,
        title: str,
        port: int,
        choices: Sequence[str],
        views: Sequence[tuple[str, bool]],
        cameras: Sequence[Camera],
        overview: tuple[np.ndarray, np.ndarray, np.ndarray, float],
        *,
        has_checkpoints: bool,
    ) -> None:
        #: What was done on the page, the oldest first.
        self.events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._names = [printable(name) for name, _ in views]
        self._train = [train for _, train in views]
        self._cameras = list(cameras)
        self._chosen = 0
        self._console, self._was_quiet = rich.get_console(), rich.get_console().quiet
        self._console.quiet = True  # viser prints where it listens, and that it has ended
        try:
            self._server = _started(printable(title), port)
        except BaseException:
            self._console.quiet = self._was_quiet
            raise
        try:
            self._set_up(overview)
            self._panel(choices, has_checkpoints)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the server."""
        self._server.stop()
        self._console.quiet = self._was_quiet

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._server.get_port()

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.port}"

    def _tell(self, kind: str, value: Any = None, client: Any = None) -> None:
        self.events.put(Event(kind, value, client))

    # ---------------------------------------------------------------------------- the scene

    def _set_up(self, overview: tuple[np.ndarray, np.ndarray, np.ndarray, float]) -> None:
        server, (eye, centre, up, diagonal) = self._server, overview
        server.scene.set_up_direction(tuple(up))
        server.initial_camera.position = tuple(eye)
        server.initial_camera.look_at = tuple(centre)
        server.initial_camera.up = tuple(up)
        self._surface: viser.GlbHandle | None = None
        self._frusta = [
            self._frustum(number, camera, _FRUSTUM * diagonal)
            for number, camera in enumerate(self._cameras)
        ]

        @server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            client.camera.on_update(
                lambda camera: self._tell("eye", np.array(camera.position), client)
            )

    def _frustum(self, number: int, camera: Camera, size: float) -> viser.CameraFrustumHandle:
        handle = self._server.scene.add_camera_frustum(
            f"/cameras/{number}",
            fov=_field_of_view(camera),
            aspect=camera.width * camera.fl_y / (camera.height * camera.fl_x),
            scale=size,
            thickness=0.05 * size,
            color=self._colour(number),
            wxyz=_orientation(camera),
            position=tuple(camera.origin),
            cast_shadow=False,
            receive_shadow=False,
        )

        @handle.on_click
        def _(event: Any) -> None:
            self._tell("view", number, event.client)
            self._tell("there", None, event.client)

        return handle

    def _colour(self, number: int) -> tuple[int, int, int]:
        if number == self._chosen:
            return CHOSEN
        return TRAIN if self._train[number] else HELDOUT

    def show_surface(self, content: bytes) -> None:
        """Show a mesh, as binary glTF, in the place of the one before."""
        if self._surface is None:
            self._surface = self._server.scene.add_glb(
                "/surface", content, cast_shadow=False, receive_shadow=False
            )
        else:
            self._surface.glb_data = content

    def choose(self, number: int) -> None:
        """Mark a view as the one that is shown."""
        before, self._chosen = self._chosen, number
        for each in {before, number}:
            self._frusta[each].color = self._colour(each)
        self._views.value = self._views.options[number]

    def go_to(self, number: int, client: viser.ClientHandle | None) -> None:
        """Look through the camera of a view, in one tab or in all."""
        camera = self._cameras[number]
        clients = [client] if client is not None else self._server.get_clients().values()
        for each in clients:
            with each.atomic():
                each.camera.fov = _field_of_view(camera)
                each.camera.wxyz = np.array(_orientation(camera))
                each.camera.position = camera.origin

    # ---------------------------------------------------------------------------- the panel

    def _panel(self, choices: Sequence[str], has_checkpoints: bool) -> None:
        gui = self._server.gui
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._facts = gui.add_html("")
        self._choices = gui.add_dropdown("Surfaces", tuple(choices))
        self._choices.on_update(lambda event: self._tell("choice", event.target.value))
        exposure = gui.add_slider("Exposure", -5.0, 5.0, 0.5, 0.0, hint="In stops")
        exposure.on_update(lambda event: self._tell("exposure", event.target.value))
        with gui.add_folder("View"):
            kinds = ("held-out", "training")
            names = [f"{n} ({kinds[t]})" for n, t in zip(self._names, self._train, strict=True)]
            self._views = gui.add_dropdown("View", tuple(names))
            self._views.on_update(self._picked)
            steps = gui.add_button_group("Camera", _STEPS)
            steps.on_click(self._stepped)
            self._note, self._pictures = gui.add_html(""), gui.add_html("")
        self._checkpoints: Any = None
        if has_checkpoints:
            with gui.add_folder("Checkpoint"):
                self._checkpoints = gui.add_slider("Which", 1, 2, 1, 1, visible=False)
                self._checkpoints.on_update(self._slid)
                self._checkpoint = gui.add_html("")
            with gui.add_folder("Log"):
                self._log = gui.add_html("")

    def _picked(self, event: Any) -> None:
        if event.client is not None:  # else it is `choose` that changed it
            self._tell("view", event.target.options.index(event.target.value), event.client)

    def _slid(self, event: Any) -> None:
        if event.client is not None:  # else it is `show_checkpoints` that moved it
            self._tell("checkpoint", int(event.target.value))

    def _stepped(self, event: Any) -> None:
        step = {_STEPS[0]: -1, _STEPS[2]: 1}.get(event.target.value)
        if step is None:
            self._tell("there", None, event.client)
        else:
            self._tell("step", step, event.client)

    def show_facts(self, facts: Mapping[str, str]) -> None:
        """Show facts at the top of the panel."""
        self._facts.content = _table(facts)

    def show_pictures(self, rows: Sequence[Sequence[Picture]]) -> None:
        """Show pictures below each other and side by side."""
        self._note.content = ""
        self._pictures.content = "".join(map(_side_by_side, rows))

    def say(self, text: str) -> None:
        """Say something above the pictures, such as what is wrong with them."""
        self._note.content = _line(text)

    def show_checkpoints(self, count: int, number: int, text: str) -> None:
        """Show how many checkpoints there are and which one is shown.

        Args:
            count: of checkpoints.
            number: of the one that is shown, the oldest is 1.
            text: about it.
        """
        slider = self._checkpoints
        self._checkpoint.content = _line(text)
        slider.visible = count > 1
        if count > 1:
            slider.max = count
            if slider.value != number:
                slider.value = number

    def show_log(self, numbers: Mapping[str, str]) -> None:
        """Show the end of the log."""
        self._log.content = _table(numbers or {"log": "none yet"})


def _started(title: str, port: int) -> _Server:
    """The server, which listens."""
    if not 0 <= port <= LAST_PORT:
        raise UserError(f"must be a number from 0 to {LAST_PORT}, not {port}", "--port")
    own = websockets.asyncio.server.serve

    def serve(*words: Any, **named: Any) -> Any:
        return own(*words, **named, origins=[None, _OWN_PAGES])

    with mock.patch.object(websockets.asyncio.server, "serve", serve), _lock:
        server = _Server(host=HOST, port=port, label=title, verbose=False)
    if port and server.get_port() != port:
        server.stop()
        remedy = "Give another one; --port 0 takes any that is free"
        raise UserError(f"port {port} is taken, or may not be used", "--port", remedy)
    return server


_lock = threading.Lock()


def _field_of_view(camera: Camera) -> float:
    """The vertical one, in radians."""
    return 2 * math.atan(0.5 * camera.height / camera.fl_y)


def _orientation(camera: Camera) -> tuple[float, float, float, float]:
    """The rotation from OpenCV's axes (y down, looks along +z) to the world, as a quaternion."""
    rotation = camera.to_world[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    w, x, y, z = (float(v) for v in transforms.SO3.from_matrix(rotation).wxyz)
    return w, x, y, z


def _table(entries: Mapping[str, str]) -> str:
    rows = "".join(
        f'<tr><td style="opacity:.65;padding-right:1em;white-space:nowrap">{_text(key)}</td>'
        f'<td style="overflow-wrap:anywhere">{_text(value)}</td></tr>'
        for key, value in entries.items()
    )
    return f'<table style="font-size:.8em;margin:.2em .8em">{rows}</table>'


def _side_by_side(row: Sequence[Picture]) -> str:
    cells = "".join(
        f'<figure style="flex:1;min-width:0;margin:0">{_text(picture.caption)}<img alt="" '
        f'style="width:100%;display:block" src="{png_data_uri(picture.pixels)}"></figure>'
        for picture in row
    )
    style = "display:flex;gap:.3em;font-size:.75em;margin:.4em .8em"
    return f'<div style="{style}">{cells}</div>'


def _line(text: str) -> str:
    return f'<div style="font-size:.75em;opacity:.8;margin:.4em .8em">{_text(text)}</div>'


def _text(value: str) -> str:
    return html.escape(printable(value, 400))
