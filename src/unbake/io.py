"""Files: atomic writes, paths that stay in their folder, and typed access to JSON.

What is wrong with a file becomes a `UserError`.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import UserError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

if TYPE_CHECKING:
    import numpy as np
from .signals import cleaned_up

#: Longest text file that is read, in bytes: the poses of some 50,000 views.
LONGEST_TEXT = 64 << 20
#: The same of a line of a file that is read line by line, in characters.
_LONGEST_LINE = 1 << 20
#: How deep objects and lists of a file may be nested.
DEEPEST = 64

# ------------------------------------------------------------------------------------------ writing


def write_atomically(
    path: Path, write: Callable[[Path], object], *, durable: bool = False, what: str = "file"
) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it to `path`.

    Args:
        path: the file; its folder is made where there is none.
        write: is called with the temporary file's path.
        durable: flush the content to disk before the file takes its name, so that not even a
            power cut leaves half a file under that name.
        what: what the file is, for the error message.

    Raises:
        UserError: the folder cannot be made or written, or the name is that of a folder, or of a
            pipe or a device, which a file would replace, such as `/dev/null`.
    """
    path = Path(path)
    _require_name_of_file(path, what)
    temporary = temporary_beside(path)

    def remove() -> None:
        with contextlib.suppress(OSError):
            temporary.unlink()

    with cleaned_up(remove):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write(temporary)
            if durable:
                with open(temporary, "rb+") as file:
                    os.fsync(file.fileno())
            os.replace(temporary, path)
        except (OSError, RuntimeError) as error:
            reason = (isinstance(error, OSError) and error.strerror) or error
            raise UserError(f"the {what} cannot be written ({reason})", path) from error


def require_writable_file(path: Path | None, what: str = "file") -> None:
    """Raise the error that `write_atomically` would end in, before the work for it is done.

    Nothing is left behind; arguments as of `write_atomically`. Of None nothing is asked.

    Raises:
        UserError: there is a folder, a pipe or a device, or the folder of the file cannot be made
            or written.
    """
    if path is None:
        return
    path = Path(path)
    _require_name_of_file(path, what)
    _require_room(temporary_beside(path), path, what)


def require_writable_folder(folder: Path) -> None:
    """Raise a `UserError` unless files can be written to a folder, new or not; none is left."""
    folder = Path(folder)
    require_utf8(folder, "folder")
    if folder.exists() and not folder.is_dir():
        raise UserError("is not a folder", folder, "Give another --out")
    _require_room(temporary_beside(folder / "file"), folder, "folder")


def _require_room(temporary: Path, where: Path, what: str) -> None:
    """Write a temporary file and remove it, with the folders that are made for it."""
    remove_parents = removed_with_parents(temporary)

    def remove() -> None:
        with contextlib.suppress(OSError):
            temporary.unlink()
        remove_parents()

    with cleaned_up(remove):
        try:
            temporary.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(b"\n")
        except OSError as error:
            said = f"the {what} cannot be written ({error.strerror or error})"
            raise UserError(said, where, "Give another --out, or make room there") from None


def _require_name_of_file(path: Path, what: str) -> None:
    """Refuse a name that no file can take: of a folder, such as `.`, or of a device."""
    if not path.name or path.is_dir():
        said = f"the {what} cannot be written (there is a folder)"
        raise UserError(said, path, "Give the name of a file")
    if _is_device(path):
        said = f"the {what} cannot be written (there is a pipe or a device)"
        raise UserError(said, path, "Give another name")


def _is_device(path: Path) -> bool:
    """Whether there is something else than a file or a folder; links are followed."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


def temporary_beside(path: Path) -> Path:
    """A name in the folder of a file that nobody can foresee, and so none that a link waits at."""
    return path.with_name(f".{path.name[:40]}.{secrets.token_hex(8)}.tmp")


def remove_unfinished(folder: Path) -> None:
    """Delete the temporary files that a killed `write_atomically` left in a folder of our own."""
    for temporary in folder.glob(".*.tmp"):
        temporary.unlink(missing_ok=True)


def unfinished(path: Path) -> list[Path]:
    """The temporary files that a killed `write_atomically` left of one file, and no others."""
    if not path.parent.is_dir():
        return []
    # Version 0.1 had the number of the process in them.
    form = re.compile(rf"\.{re.escape(path.name[:40])}\.([0-9a-f]{{16}}|[0-9]{{1,10}})\.tmp")
    return [found for found in path.parent.iterdir() if form.fullmatch(found.name)]


def require_new_folder(out: Path) -> None:
    """Raise a `UserError` unless there is nothing at a path, or an empty folder."""
    require_utf8(out, "folder")
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise UserError("is not a folder", out, "Give another --out")
    if out.is_dir() and any(out.iterdir()):
        raise UserError("the folder is not empty", out, "Give another --out, or empty it")


@contextlib.contextmanager
def filled_folder(out: Path) -> Iterator[Path]:
    """A folder to write to, which gets the name `out` at the end; nothing is left of a failure.

    Args:
        out: as `require_new_folder` wants it.

    Raises:
        UserError: the folder cannot be made or written.
    """
    # Within a folder that there is: it may be the present one, or another file system.
    folder, name = (out, "folder") if out.is_dir() else (out.parent, out.name)
    partial = folder / f".{name[:100]}.{secrets.token_hex(8)}.partial"
    with cleaned_up(removed_with_parents(partial)):
        try:
            partial.mkdir(parents=True)
            yield partial
            if folder == out:
                if any(path != partial for path in out.iterdir()):
                    what = "another program has written to the folder meanwhile"
                    raise UserError(what, out, "Give another --out")
                _move_up(partial)
            else:
                partial.rename(out)
        except OSError as error:
            raise UserError(f"cannot be written ({error.strerror})", where=out) from None


def removed_with_parents(folder: Path) -> Callable[[], None]:
    """What removes a folder that is yet to be made, and parents that do not exist yet, if empty."""
    missing = [parent for parent in folder.parents if not parent.exists()]

    def remove() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # something is in there
            for parent in missing:
                parent.rmdir()

    return remove


def _move_up(folder: Path) -> None:
    """Move all that is in a folder to the folder above; folders first, which files tell of."""
    for path in sorted(folder.iterdir(), key=lambda path: (path.is_file(), path.name)):
        path.rename(folder.parent / path.name)
    folder.rmdir()


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Hold a folder, after waiting for other processes that do; the lock ends with the process.

    Yields:
        Whether it is held: some network file systems have no locks.
    """
    number = os.open(folder, os.O_RDONLY)
    try:
        yield take_lock(number, wait=True) is True
    finally:
        os.close(number)


def is_locked(folder: Path) -> bool:
    """Whether a process holds a folder, or may hold it."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except OSError:
        return True
    try:
        return take_lock(number, wait=False) is not True
    finally:
        os.close(number)


def take_lock(number: int, *, wait: bool) -> bool | None:
    """Lock an open file or folder for this process, until it is closed or the process ends.

    Args:
        number: its file descriptor.
        wait: until a process that holds it lets go.

    Returns:
        Whether it is held; None where there are no locks, as on some network file systems.
    """
    if fcntl is None:
        return None
    try:
        fcntl.flock(number, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


def write_text(path: Path, content: str, *, durable: bool = False) -> None:
    """Write a UTF-8 text file, complete or not at all; arguments as in `write_atomically`."""
    write_atomically(path, lambda p: p.write_text(content, encoding="utf-8"), durable=durable)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays to an .npz file, complete or not at all; errors as of `write_atomically`."""
    import numpy as np

    def write(target: Path) -> None:
        with open(target, "wb") as file:  # np.savez appends .npz to names
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]

    write_atomically(path, write)


def write_json(path: Path, content: Any, *, allow_nan: bool = True, durable: bool = False) -> None:
    """Write a JSON file, complete or not at all; arguments as in `write_atomically`.

    Raises:
        UserError: the folder cannot be made or written.
        ValueError: a number is not finite, and `allow_nan` is False.
    """
    write_text(path, json.dumps(content, indent=1, allow_nan=allow_nan) + "\n", durable=durable)


# -------------------------------------------------------------------------------------------- paths


def inside(
    folder: Path, name: str, where: str, what: str = "folder", *, allow_outside: bool = False
) -> Path:
    """The file of a folder that a text names, relative to the folder, which it must not leave.

    Args:
        folder: the folder, such as that of a data set.
        name: from a file that others may have written.
        where: the file and entry that `name` was found in.
        what: what the folder is, for the error message.
        allow_outside: accept files that lie elsewhere.

    Raises:
        UserError: `name` is not a path, or leads out of the folder.
    """
    try:
        # Mitsuba takes no other names
        name.encode()
        resolved = (folder / name).resolve()
        contained = resolved.is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):
        raise UserError(f"{name!r} is not a path", where, "Correct it") from None
    if not contained and not allow_outside:
        raise UserError(
            f"{name!r} lies outside the {what}",
            where,
            f"Move the file into {folder}, or pass --allow-outside",
        )
    return folder / name


def relative(folder: Path, path: Path, what: str = "folder") -> str:
    """The inverse of `inside`: the path from a folder to a file in it, with forward slashes.

    Raises:
        UserError: the file lies outside the folder.
    """
    resolved, root = path.resolve(), folder.resolve()
    if not resolved.is_relative_to(root):
        raise UserError(f"the file lies outside the {what}", path, f"Move it into {folder}")
    return resolved.relative_to(root).as_posix()


def require_utf8(path: Path, what: str) -> None:
    """Raise a `UserError` if the name of a file or folder is not UTF-8, as Mitsuba needs it.

    Args:
        what: what lies there, for the error message.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        raise UserError(f"the path of the {what} is not UTF-8", path, "Rename it") from None


def require_file(path: Path, what: str = "file", remedy: str | None = None) -> None:
    """Raise a `UserError` unless there is a regular file, which can be opened without waiting.

    Args:
        what: what the file is, for the error message.
        remedy: what the user can do.
    """
    try:
        mode = Path(path).stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"the {what} does not exist", path, remedy) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"the {what} cannot be read ({reason})", path, remedy) from None
    if stat.S_ISDIR(mode):
        raise UserError(f"the {what} cannot be read (Is a directory)", path, remedy)
    if not stat.S_ISREG(mode):
        raise UserError(f"the {what} cannot be read (it is a pipe or a device)", path, remedy)


# ------------------------------------------------------------------------------------ text and JSON


def read_text(path: Path, remedy: str | None = None) -> str:
    """The content of a UTF-8 text file.

    Args:
        remedy: what the user can do where the file cannot be read.

    Raises:
        UserError: the file is missing, unreadable, or not UTF-8.
    """
    with _read_as_text(path, remedy):
        size = Path(path).stat().st_size
        if size > LONGEST_TEXT:
            said = f"the file has {size / 1e6:.0f} MB, more than the {LONGEST_TEXT / 1e6:.0f} MB"
            raise UserError(f"{said} that are read", path, remedy or "Repair it")
        return Path(path).read_text(encoding="utf-8")


def read_lines(path: Path, remedy: str | None = None) -> Iterator[str]:
    """The lines of a UTF-8 text file of any length.

    Args:
        remedy: what the user can do where the file cannot be read.

    Raises:
        UserError: the file is missing, unreadable, or not UTF-8, or a line is too long.
    """
    with _read_as_text(path, remedy), open(path, encoding="utf-8") as file:
        while line := file.readline(_LONGEST_LINE + 1):
            if len(line) > _LONGEST_LINE:
                said = f"a line has more than the {_LONGEST_LINE} characters that are read"
                raise UserError(said, path, remedy or "Repair it")
            yield line


@contextlib.contextmanager
def _read_as_text(path: Path, remedy: str | None) -> Iterator[None]:
    """Tell what keeps a file from being read as UTF-8 text; arguments as in `read_text`."""
    require_file(path, remedy=remedy or "Check the path")
    try:
        yield
    except OSError as error:
        said = f"the file cannot be read ({error.strerror})"
        raise UserError(said, path, remedy or "Check the path") from None
    except UnicodeDecodeError:
        raise UserError("the file is not UTF-8 text", path, remedy or "Repair it") from None


def read_json(path: Path, remedy: str | None = None) -> Any:
    """Parse a JSON file.

    Args:
        remedy: what the user can do where the file is missing or damaged.

    Raises:
        UserError: the file is missing, unreadable, or not JSON.
    """
    # Programs of Windows may begin a file with the mark of its byte order.
    content = read_text(path, remedy).removeprefix("\ufeff")
    try:
        parsed = json.loads(content)
    except (ValueError, RecursionError) as error:
        said = f"the file is not readable JSON ({why_unreadable(error)})"
        raise UserError(said, path, remedy or "Repair it") from None
    if nesting(parsed) > DEEPEST:
        said = f"the file is not readable JSON (nested deeper than {DEEPEST} levels)"
        raise UserError(said, path, remedy or "Repair it")
    return parsed


def why_unreadable(error: ValueError | RecursionError) -> str:
    """What a parser of JSON or TOML found, for people."""
    if isinstance(error, RecursionError):
        return "nested too deep"
    # Python: "Exceeds the limit (4300 digits) for integer string conversion: …"
    return "a number has too many digits" if "digits" in str(error) else str(error)


def nesting(content: object) -> int:
    """How deep objects and lists are nested: 0 for a number or a text."""
    depth, level = 0, [content]
    while level := [x for x in level if isinstance(x, dict | list)]:
        depth += 1
        level = [y for x in level for y in (x.values() if isinstance(x, dict) else x)]
    return depth


def read_object(path: Path, remedy: str | None = None) -> dict[str, Any]:
    """Parse a JSON file that holds an object; arguments as in `read_json`.

    Raises:
        UserError: the file is missing, unreadable, not JSON, or holds something else.
    """
    content = read_json(path, remedy)
    if not isinstance(content, dict):
        raise UserError("the file does not hold a JSON object", path, remedy or "Repair it")
    return content


def number(keys: dict[str, Any], key: str, where: str) -> float:
    """The number at a key, finite; `where` (file and entry) goes into the error message."""
    value = _value(keys, key, where)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{key!r} is not a number", where, f"It is a {type(value).__name__}")
    try:
        result = float(value)
    except OverflowError:
        raise UserError(f"{key!r} is too large", where, "Write a smaller number") from None
    if not math.isfinite(result):
        raise UserError(f"{key!r} is {result}, not a finite number", where, "Write a number")
    return result


def integer(keys: dict[str, Any], key: str, where: str) -> int:
    """The whole number at a key; floats such as 512.0 count, which some converters write."""
    value = number(keys, key, where)
    if not value.is_integer():
        raise UserError(f"{key!r} is {value:g}, not a whole number", where, "Write a whole one")
    return int(value)


def array(keys: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """The nested list of numbers at a key as a float64 array of that shape."""
    import numpy as np  # here, for settings are read without it

    value = _value(keys, key, where)
    try:
        # Texts such as "1" would convert, but are a mistake
        result = np.array(value)
        numeric = np.issubdtype(result.dtype, np.number)
    except (TypeError, ValueError):
        result, numeric = np.empty(0), False
    if result.shape != shape or not numeric:
        size = " x ".join(str(n) for n in shape)
        raise UserError(f"{key!r} is not an array of {size} numbers", where, "Write a list of them")
    return result.astype(np.float64)


def text(keys: dict[str, Any], key: str, where: str) -> str:
    """The text at a key, not empty."""
    value = _value(keys, key, where)
    if not isinstance(value, str) or not value:
        raise UserError(f"{key!r} is not a text", where, "Put it in quotes")
    return value


def _value(keys: dict[str, Any], key: str, where: str) -> Any:
    if key not in keys:
        raise UserError(f"the key {key!r} is missing", where, "Add it to the file")
    return keys[key]
