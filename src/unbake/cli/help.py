"""The help of commands, wrapped: Tyro 1.0 leaves usage and paragraphs as long as they are."""

from __future__ import annotations

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Collection, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TextIO

#: Columns of a terminal that texts are wrapped for.
NARROWEST, WIDEST = 40, 100
#: Codes of colours, which take no column.
_CODES = re.compile(r"\x1b\[[0-9;]*m")


def columns() -> int:
    """How wide texts are."""
    return min(max(shutil.get_terminal_size().columns, NARROWEST), WIDEST)


class _Kept(io.TextIOWrapper):
    """Text that is kept, made for where it goes later: with colours and lines of boxes, or not."""

    def __init__(self, goes_to: TextIO) -> None:
        super().__init__(io.BytesIO(), encoding=goes_to.encoding, errors="replace")
        self._terminal = goes_to.isatty()

    def isatty(self) -> bool:
        """Whether it goes to a terminal."""
        return self._terminal

    def text(self) -> str:
        """What was written."""
        self.seek(0)
        return self.read()


@contextmanager
def wrapped_help(words: Collection[str]) -> Iterator[None]:
    """Wrap what is printed, if the words of the command line ask for help."""
    if not {"-h", "--help"} & set(words):
        yield
        return
    kept = _Kept(sys.stdout)
    try:
        with redirect_stdout(kept):
            yield
    finally:
        told = kept.text()
        for line in told.splitlines():
            print(wrapped(_with_out(line, told), columns()))


def _with_out(line: str, told: str) -> str:
    """A line of usage with `-o PATH` or `-o FILE` where Tyro 1.0 hides that in `[OPTIONS]`.

    Only where it is required.

    Args:
        line: of the help.
        told: all of the help.
    """
    plain = _CODES.sub("", line)
    if not plain.startswith("usage: ") or "[OPTIONS]" not in plain:
        return line
    found = re.search(
        r"-o (PATH|FILE), --out \1(.*?)(?=[│|] -|[╰+])", _CODES.sub("", told), re.DOTALL
    )
    if found is None or "(required)" not in found[2]:
        return line
    return line.replace("[OPTIONS]", f"[OPTIONS] -o {found[1]}")


def wrapped(line: str, width: int) -> str:
    """A line of usage or a paragraph as several; lines of boxes, which fit, stay as they are."""
    plain = _CODES.sub("", line)
    if len(plain) <= width or plain.startswith(tuple("│╭╰|+")):
        return line
    if not plain.startswith("usage: "):
        return textwrap.fill(plain, width)
    # An option stays on a line with its value.
    joined = re.sub(r"\[[^][]*\]|-\S+ [A-Z]+", lambda m: m[0].replace(" ", "\0"), plain)
    return textwrap.fill(joined, width, subsequent_indent=" " * 7).replace("\0", " ")
