"""`unbake view`: shows a data set or a run until it is told to end."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from pathlib import Path

from .. import signals
from ..dataset.data_folder import DataFolder
from ..errors import UserError
from ..io import require_utf8
from ..training.run_folder import RunFolder
from .dependencies import require_viser
from .glb import glb
from .viewed import RADIANCE, ViewedData, ViewedRun

PORT = 8080
#: Seconds between two looks into the run's folder, and of a still camera before radiance is new.
POLL, STILL = 2.0, 0.4


def view(
    folder: Path | str,
    port: int = PORT,
    *,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> None:
    """Show a data set or a run on a page of this machine, until a signal comes.

    Nothing is written. A run may still be going on: new checkpoints are shown as they come.

    Args:
        folder: of a fit, or of a data set.
        port: of 127.0.0.1; 0: any that is free.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        tell: called with the address.

    Raises:
        UserError: viser is not installed, there is neither a run nor a data set, one cannot be
            read, or the port is taken.
    """
    require_viser()
    with signals.deferred() as stop, Viewer(opened(Path(folder), allow_outside), port) as viewer:
        tell(f"{viewer.url} shows {folder}; Ctrl-C ends it")
        while not stop:
            viewer.step()


def opened(folder: Path, allow_outside: bool = False) -> ViewedData:
    """The run or the data set in a folder.

    Raises:
        UserError: there is neither, or it cannot be read.
    """
    require_utf8(folder, "folder")
    if RunFolder(folder).exists:
        return ViewedRun(folder, allow_outside=allow_outside)
    if not folder.is_dir():
        raise UserError("there is no such folder", folder, "Give that of a run or a data set")
    if not DataFolder(folder).transforms_file.is_file():
        what = "there is neither a run nor a data set in this folder"
        raise UserError(what, folder, "Make one with `unbake fit` or `unbake capture`")
    return ViewedData(folder, allow_outside=allow_outside)


class Viewer:
    """A page, and what it shows; a context manager.

    All work is done in `step`, on one thread. What is done on the page waits for it.

    Args:
        viewed: what is shown.
        port: of the page.

    Raises:
        UserError: the port is taken.
    """

    def __init__(self, viewed: ViewedData, port: int = PORT) -> None:
        from .page import Page  # needs viser

        self._viewed = viewed
        self._choices = viewed.choices()
        self._choice = next(iter(self._choices))
        self._views = viewed.dataset.views
        self._number = 0
        self._exposure = 0.0
        self._eye = viewed.overview()[0]
        self._moved: float | None = None  # when the camera did, where radiance has to follow
        self._wanted: Path | None = None  # a checkpoint; None: the newest
        self._surface_is_old = self._pictures_are_old = True
        self._looked = -POLL
        self._trouble = ""  # why the checkpoint that is wanted is not shown
        self._page = Page(
            "unbake view",
            port,
            list(self._choices.values()),
            [(each.name, each.split == "train") for each in self._views],
            [each.camera for each in self._views],
            viewed.overview(),
            has_checkpoints=isinstance(viewed, ViewedRun),
        )

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._page.close()

    @property
    def url(self) -> str:
        """The address of the page."""
        return self._page.url

    def step(self, seconds: float = STILL) -> None:
        """Do what was asked on the page, look into the folder, and show what is new.

        Args:
            seconds: to wait for something to be done on the page.
        """
        if time.monotonic() - self._looked >= POLL:
            self._look()
            self._looked = time.monotonic()
        self._refresh()
        events = self._page.events
        try:
            self._handle(events.get(timeout=seconds))
            for _ in range(events.qsize()):  # those that come meanwhile wait
                self._handle(events.get_nowait())
        except queue.Empty:
            pass

    def _handle(self, event) -> None:
        value = event.value
        if event.kind == "eye":
            self._eye, self._moved = value, time.monotonic()
        elif event.kind == "there":
            self._page.go_to(self._number, event.client)
        elif event.kind == "choice":
            self._choice = next(k for k, title in self._choices.items() if title == value)
            self._surface_is_old = self._pictures_are_old = True
        elif event.kind == "exposure":
            self._exposure = float(value)
            self._surface_is_old |= self._choice == RADIANCE
            self._pictures_are_old = True
        elif event.kind in ("view", "step"):
            number = value if event.kind == "view" else (self._number + value) % len(self._views)
            if number != self._number:
                self._number, self._pictures_are_old = number, True
                self._page.choose(number)
        elif event.kind == "checkpoint" and isinstance(self._viewed, ViewedRun):
            written = self._viewed.checkpoints()
            self._wanted = written[value - 1] if value < len(written) else None
            self._looked = -POLL

    def _look(self) -> None:
        """Look for the checkpoint that is wanted, and at the log."""
        viewed = self._viewed
        if not isinstance(viewed, ViewedRun):
            if self._surface_is_old:
                self._page.show_facts(viewed.told())
            return
        written = viewed.checkpoints()
        if self._wanted is not None and self._wanted not in written:
            self._wanted = None  # deleted by the fit
        before, self._trouble = self._trouble, ""
        try:
            if viewed.follow() if self._wanted is None else viewed.turn_to(self._wanted):
                self._surface_is_old = self._pictures_are_old = True
        except UserError as error:
            self._trouble = str(error)
        if self._trouble != before:
            self._page.say(self._trouble)
        number = written.index(viewed.shown) + 1 if viewed.shown in written else len(written)
        which = f"{number} of {len(written)}" if written else "none yet: waiting for the first"
        follows = "; newer ones are shown as they come" if self._wanted is None else ""
        self._page.show_checkpoints(len(written), max(number, 1), which + follows)
        self._page.show_facts(viewed.told())
        self._page.show_log(viewed.log())

    def _refresh(self) -> None:
        if self._moved is not None and time.monotonic() - self._moved > STILL:
            self._moved = None
            self._surface_is_old |= self._choice == RADIANCE
        if self._surface_is_old:
            self._surface_is_old = False
            colours = self._viewed.colours(self._choice, self._eye, self._exposure)
            self._page.show_surface(glb(self._viewed.surface, colours))
        if self._pictures_are_old:
            self._pictures_are_old = False
            self._page.say("rendering …")
            try:
                view = self._views[self._number]
                self._page.show_pictures(self._viewed.pictures(view, self._choice, self._exposure))
                self._page.say(self._trouble)  # pictures are of the checkpoint before
            except UserError as error:
                self._page.say(str(error))
