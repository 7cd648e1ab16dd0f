"""The exception for mistakes of a user: what is wrong, where, and the remedy."""

from __future__ import annotations

from collections.abc import Collection


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

    def __str__(self) -> str:
        text = self.what if self.where is None else f"{self.where}: {self.what}"
        return text if self.remedy is None else f"{text}. {self.remedy}"


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
        raise UserError(f"must be {wanted}, not {value!r}", where=key)
