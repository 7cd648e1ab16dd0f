"""Files: atomic writes, and typed access to JSON whose mistakes become `UserError`s."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import UserError


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it to `path`.

    Raises:
        UserError: the folder cannot be made or written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write(temporary)
        os.replace(temporary, path)
    except (OSError, RuntimeError) as error:
        raise UserError(f"the file cannot be written ({error})", path) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def read_json(path: Path) -> Any:
    """Parse a JSON file.

    Raises:
        UserError: the file is missing, unreadable, or not JSON.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UserError("the file does not exist", path, "Check the path") from None
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"the file is not readable JSON ({reason})", path, "Repair it") from None


def write_json(path: Path, content: Any, *, allow_nan: bool = True) -> None:
    """Write a JSON file, complete or not at all.

    Raises:
        UserError: the folder cannot be made or written.
    """
    described = json.dumps(content, indent=1, allow_nan=allow_nan) + "\n"
    write_atomically(path, lambda file: file.write_text(described, encoding="utf-8"))


def number(keys: dict[str, Any], key: str, where: str) -> float:
    """The number at a key; `where` (file and entry) goes into the error message."""
    value = _value(keys, key, where)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UserError(f"{key!r} is not a number", where, f"It is a {type(value).__name__}")
    try:
        return float(value)
    except OverflowError:
        raise UserError(f"{key!r} is too large", where, "Correct it") from None


def integer(keys: dict[str, Any], key: str, where: str) -> int:
    """The whole number at a key; floats such as 512.0 count, which some converters write."""
    value = number(keys, key, where)
    if not value.is_integer():
        raise UserError(f"{key!r} is {value:g}, not a whole number", where, "Correct it")
    return int(value)


def array(keys: dict[str, Any], key: str, shape: tuple[int, ...], where: str) -> np.ndarray:
    """The nested list of numbers at a key as a float64 array of that shape."""
    value = _value(keys, key, where)
    try:
        # Texts such as "1" would convert, but whoever wrote them meant something else
        result = np.array(value)
        numeric = np.issubdtype(result.dtype, np.number)
    except (TypeError, ValueError):
        result, numeric = np.empty(0), False
    if result.shape != shape or not numeric:
        size = " x ".join(str(n) for n in shape)
        raise UserError(f"{key!r} is not an array of {size} numbers", where, "Correct it")
    return result.astype(np.float64)


def text(keys: dict[str, Any], key: str, where: str) -> str:
    """The text at a key, not empty."""
    value = _value(keys, key, where)
    if not isinstance(value, str) or not value:
        raise UserError(f"{key!r} is not a text", where, "Correct it")
    return value


def _value(keys: dict[str, Any], key: str, where: str) -> Any:
    if key not in keys:
        raise UserError(f"the key {key!r} is missing", where, "Add it to the file")
    return keys[key]
