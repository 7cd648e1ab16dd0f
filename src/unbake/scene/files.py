"""The files that a scene names: found, and kept in one folder."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ..errors import UserError


def find(name: str, folders: Iterable[Path], root: Path, where: object) -> Path:
    """The first file of this name in `folders`.

    Args:
        name: as the scene has it: relative to one of the folders, or absolute.
        root: folder that the file must not leave, without links.
        where: what names the file, for error messages.

    Raises:
        UserError: there is no such file, it lies outside, or it is a pipe or a device.
    """
    file = _first(name, folders, where)
    if file is None:
        raise UserError(f"the file {name!r} does not exist", where)
    require_inside(file, root, where, repr(name))
    if not file.is_file():
        raise UserError(f"{name!r} is no regular file", where, "Name a file")
    return file


def find_folder(name: str, folders: Iterable[Path], root: Path, where: object) -> Path:
    """The first folder of this name in `folders`; arguments and errors as of `find`."""
    folder = _first(name, folders, where)
    if folder is None or not folder.is_dir():
        raise UserError(f"the folder {name!r} does not exist", where)
    require_inside(folder, root, where, repr(name))
    return folder


def require_inside(file: Path, root: Path, where: object, what: str) -> None:
    """Raise a `UserError` if a file lies, all links resolved, outside a folder without links."""
    try:
        inside = file.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # such as a link to itself
        raise UserError(f"{what} cannot be found", where, "Check its links") from None
    if not inside:
        remedy = "Move it there, or pass --allow-outside"
        raise UserError(f"{what} lies outside the folder {root}", where, remedy)


def _first(name: str, folders: Iterable[Path], where: object) -> Path | None:
    try:
        return next((f for f in (folder / name for folder in folders) if name and f.exists()), None)
    except (OSError, ValueError):
        raise UserError(f"{name!r} is not a path", where, "Correct it") from None
