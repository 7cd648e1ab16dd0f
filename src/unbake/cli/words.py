"""How words of the command line become numbers and paths, and what is told where they do not."""

from __future__ import annotations

import typing
from collections.abc import Callable
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from ..errors import printable


def plain_words() -> ConstructorRegistry:
    """What reads numbers and paths, as a context in which a command line is read.

    Tyro 1.0 tells of `{None}|INT`, and of what Python says of a text that is no number. An empty
    path, as of a variable of a shell that is not set, would be the present folder.
    """
    registry = ConstructorRegistry()
    registry.primitive_rule(_rule)
    return registry


def _rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """How a word becomes a value of a type, or None where that is not given; None: as usual."""
    kinds = {info.type}
    if info.type_origin in (typing.Union, UnionType):
        kinds = set(typing.get_args(info.type)) - {NoneType}
    name, read = _READ.get(kinds.pop(), ("", None)) if len(kinds) == 1 else ("", None)
    if read is None:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=name,
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: True,
        str_from_instance=lambda value: [str(value)],
    )


def _whole(word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise ValueError(f"must be a whole number, not {printable(repr(word))}") from None


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        raise ValueError(f"must be a number, not {printable(repr(word))}") from None


def _path(word: str) -> Path:
    if not word:
        raise ValueError("must be a path, and is empty: give . for the present folder")
    return Path(word)


#: What reads a word of a type, and what stands for it in the help.
_READ: dict[Any, tuple[str, Callable[[str], Any]]] = {
    int: ("INT", _whole),
    float: ("NUMBER", _number),
    Path: ("PATH", _path),
}
