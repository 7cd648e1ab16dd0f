"""The exception for mistakes of a user: what is wrong, where, and the remedy."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import shlex
import sys
import types
import typing
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal, cast

#: Characters that are shown of a name, and of each part of a message.
_LONGEST_NAME, _LONGEST_PART = 80, 1000

#: How many of several faults one error tells.
_TOLD = 3
#: The least of a range of numbers that must be positive.
POSITIVE = sys.float_info.min


class UserError(Exception):
    """Bad input or an unusable machine, told in one line.

    Args:
        what: what is wrong, as a sentence without full stop.
        where: the file, key, view or option it was found in.
        remedy: what the user can do about it.

    The command line prints it and exits with status 2; it never shows a traceback.
    """

    def __init__(self, what: str, where: object | None = None, remedy: str | None = None) -> None:
        self.what = what
        self.where = None if where is None else str(where)
        self.remedy = remedy
        super().__init__(str(self))

    @property
    def parts(self) -> tuple[str, str | None, str | None]:
        """What is wrong, where, and the remedy, from which another process makes the same error."""
        return self.what, self.where, self.remedy

    def __str__(self) -> str:
        what = _one_line(self.what)
        text = what if self.where is None else f"{_one_line(self.where)}: {what}"
        return text if self.remedy is None else f"{text}. {_one_line(self.remedy)}"


@contextmanager
def collected(faults: list[UserError]) -> Iterator[None]:
    """Append an error of the block, or of the system in it, to others; the block ends there."""
    try:
        yield
    except UserError as error:
        faults.append(error)
    except OSError as error:
        faults.append(UserError(of_system(error)))


def raise_together(
    faults: Sequence[UserError], others: str = "", *, most: int | None = _TOLD
) -> None:
    """Raise one error for all that is wrong, or none; of much that is wrong it tells some.

    Args:
        faults: what is wrong, one after the other.
        others: how to learn of those that it does not tell, such as ", which the log has".
        most: how many it tells; None: all, as of options, which are few.
    """
    if len(faults) == 1:
        raise faults[0]
    if faults:
        told = "; ".join(map(str, faults[:most]))
        more = 0 if most is None else len(faults) - most
        raise UserError(f"{told}; and {more} more{others}" if more > 0 else told)


def of_system(error: OSError) -> str:
    """A full disk, a file taken away: which file, and what the system says."""
    return f"{error.filename or 'a file'}: {error.strerror or error}"


def printable(name: object, longest: int = _LONGEST_NAME) -> str:
    """A name on one line of a terminal, whatever it is.

    Args:
        name: from a file that others may have written.
        longest: characters to show; a longer name loses its middle.

    Returns:
        The name, with control characters, those that turn the direction of writing, and bytes that
        are not UTF-8 as escape sequences.
    """
    text = str(name)
    if len(text) > 2 * longest:  # so that a name of megabytes is not escaped as a whole
        text = f"{text[:longest]}{text[-longest:]}"
    text = "".join(c if c.isprintable() else _escaped(c) for c in text)
    if len(text) <= longest:
        return text
    head = longest // 2
    return f"{text[:head]}…{text[head + 1 - longest :]}"


def named(names: Sequence[object], most: int = _TOLD) -> str:
    """Names of views, files and the like, printable; of many the first ones."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(map(printable, names[:most])) + more


def quoted(path: str | os.PathLike[str]) -> str:
    """A path, quoted for a shell, as a word of a command that is told."""
    text = os.fspath(path)
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


def _escaped(character: str) -> str:
    code = ord(character)
    # Python decodes a byte of a path that is not UTF-8 to this code
    return f"\\x{code - 0xDC00:02x}" if 0xDC80 <= code <= 0xDCFF else ascii(character)[1:-1]


def _one_line(text: str) -> str:
    """A part of a message, with the names in it shortened; folders and files are names each."""
    text = re.sub(r"\s*\n\s*", " ", text)
    words = re.compile(rf"[^\s/]{{{_LONGEST_NAME + 1},}}")
    return printable(words.sub(lambda match: printable(match[0]), text), _LONGEST_PART)


def require_name(name: str, known: Collection[str], what: str, where: object | None = None) -> None:
    """Raise a `UserError` unless a name is one of those that are known; it lists them.

    Args:
        name: what was given.
        known: the names there are.
        what: what is named, such as `method`.
        where: as in `UserError`.
    """
    if name not in known:
        raise UserError(f"no {what} named {name!r}", where, f"There are {', '.join(known)}")


def require(good: bool, key: str, wanted: str, value: object) -> None:
    """Raise a `UserError` that says what a setting must be, unless it is good."""
    if not good:
        raise UserError(f"must be {wanted}, not {printable(repr(value))}", where=key)


def require_kind(value: object, kind: type, where: str, example: str) -> None:
    """Raise a `UserError` unless an argument of a public function is of a class.

    Args:
        value: what was given.
        kind: the class.
        where: name of the argument.
        example: an expression that makes one.
    """
    if not isinstance(value, kind):
        what = f"must be {kind.__name__}, not {type(value).__name__}"
        raise UserError(what, where, f"Give one, such as {example}")


def require_ranges(settings: object, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Raise a `UserError` that names all values of a wrong type, and all numbers out of range.

    Scalars of numpy become Python's own, which files can hold.

    Args:
        settings: a dataclass; its numbers, texts, names of a `Literal` and dataclasses must have
            the types that it declares.
        ranges: the least and the most of numbers, by their names; None is one that is left open.
    """
    wrong = {}
    for key, hint in _checked(type(settings)).items():
        value = plain(given := getattr(settings, key))
        if value is not given:
            object.__setattr__(settings, key, value)
        if (told := mistyped(value, hint)) is not None:
            wrong[key] = told
    for key, (least, most) in ranges.items():
        value = getattr(settings, key)
        wanted = None if value is None or key in wrong else _wanted(value, least, most)
        if wanted is not None:
            wrong[key] = f"must be {wanted}, not {value!r}"
    if wrong:
        (key, first), *others = wrong.items()
        raise UserError("; ".join([first, *(f"{k}: {told}" for k, told in others)]), where=key)


def plain(value: Any) -> Any:
    """A scalar of numpy as Python's own, which files can hold; anything else as it is."""
    return value.item() if getattr(value, "shape", None) == () else value


def mistyped(value: object, hint: Any) -> str | None:
    """What is wrong with the type of a value, or with a name; None where nothing is.

    An integer is good for `float`, a bool for neither number.

    Args:
        value: of a setting.
        hint: its annotation: a class, a `Literal`, or one of these or None.
    """
    kind = _without_none(hint)
    if value is None and kind is not hint:
        return None
    if typing.get_origin(kind) is Literal:
        names = typing.get_args(kind)
        good = isinstance(value, str | int) and value in names
        told = f"must be one of {', '.join(map(str, names))}, not {printable(repr(value))}"
    else:
        good = isinstance(value, int | float if kind is float else kind)
        good = good and (kind is bool or not isinstance(value, bool))
        told = f"must be {kind.__name__}, not {type(value).__name__}"
    return None if good else told


@cache
def _checked(kind: type) -> dict[str, Any]:
    """The annotations of those fields of a dataclass whose types are checked, by name."""
    hints = typing.get_type_hints(kind)
    fields = {field.name: hints[field.name] for field in dataclasses.fields(cast(Any, kind))}
    return {name: hint for name, hint in fields.items() if _is_checked(_without_none(hint))}


def _is_checked(kind: Any) -> bool:
    plain = kind in (bool, int, float, str) or typing.get_origin(kind) is Literal
    return plain or dataclasses.is_dataclass(kind)


def _without_none(hint: Any) -> Any:
    """The annotation X of `X | None`; any other as it is."""
    if typing.get_origin(hint) not in (types.UnionType, typing.Union):
        return hint
    kinds = [kind for kind in typing.get_args(hint) if kind is not types.NoneType]
    return kinds[0] if len(kinds) == 1 else hint


def _wanted(value: float, least: float, most: float) -> str | None:
    """What a number should be; None where it is in range."""
    # An integer is finite, but with hundreds of digits it is no float.
    if isinstance(value, float) and not math.isfinite(value):
        return "a finite number"
    if value < least:
        return "positive" if least == POSITIVE else f"{least} or more"
    return f"{most} or less" if value > most else None
