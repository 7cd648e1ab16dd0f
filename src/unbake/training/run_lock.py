"""The lock of a folder: one process writes to it at a time."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import final

from ..errors import UserError
from ..io import take_lock

NAME = ".lock"


@final
class RunLock:
    """Holds a folder for this process; a context manager.

    The lock is the system's (`flock`): it ends with the process however that ends, so that none is
    ever left behind. The file `.lock` stays, with the number of the process that has it. File
    systems without locks are used without.

    Args:
        folder: is made where there is none.
        doing: what the holder does, for the message of the other one: `fits`.
    """

    def __init__(self, folder: Path, doing: str) -> None:
        self._folder, self._doing = folder, doing
        self._file = -1

    def __enter__(self) -> RunLock:
        path = self._folder / NAME
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._file = os.open(path, flags, 0o644)
            plain = stat.S_ISREG(os.fstat(self._file).st_mode)
        except OSError as error:
            raise UserError(
                f"the folder cannot be written to ({error.strerror})",
                path if path.is_symlink() else self._folder,
                "Give another one, or make it writable",
            ) from None
        try:
            if not plain:
                raise UserError("is not a plain file", path, "Remove it")
            self._take(path)
        except BaseException:
            os.close(self._file)
            raise
        return self

    def _take(self, path: Path) -> None:
        if take_lock(self._file, wait=False) is False:
            holder = os.read(self._file, 20).decode("ascii", "replace").strip()
            raise UserError(
                f"another process (number {holder or 'unknown'}) {self._doing} in this folder",
                self._folder,
                "Wait for its end or stop it, or give another folder",
            )
        with suppress(OSError):  # a full disk; the number is only told
            os.ftruncate(self._file, 0)
            os.lseek(self._file, 0, os.SEEK_SET)
            os.write(self._file, f"{os.getpid()}\n".encode())

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._file)

    def require_held(self) -> None:
        """Check that the folder is still the one that was locked.

        Raises:
            UserError: it was deleted, moved or replaced.
        """
        try:
            there, ours = os.stat(self._folder / NAME), os.fstat(self._file)
            same = (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
        except OSError:
            same = False
        if not same:
            raise UserError(
                "the folder was deleted, moved or replaced while it was written to",
                self._folder,
                "What was not in it any more is lost; start again, or resume in its new place",
            )
