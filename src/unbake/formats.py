"""The versions of the files that unbake writes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .errors import UserError


def check_format(keys: Mapping[str, Any], newest: int, where: object) -> int:
    """The format of a file's content: its "format", 1 where it names none.

    Args:
        keys: the file's content.
        newest: the newest format that can be read.
        where: the file.

    Raises:
        UserError: the format is newer, or not a positive whole number.
    """
    version = keys.get("format", 1)
    if type(version) is not int or version < 1:
        raise UserError(f"'format' is {version!r}, not a positive whole number", where, "Repair it")
    if version > newest:
        raise UserError(
            f"was written by a newer unbake (format {version}; this one reads up to {newest})",
            where,
            "Update unbake",
        )
    return version
