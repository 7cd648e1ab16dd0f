"""What commands print, and how they end."""

from __future__ import annotations

import sys
from typing import NoReturn

from rich.console import Console
from rich.text import Text

from ..errors import printable

#: Characters of a line that is printed: more than a path can have.
LONGEST = 1 << 14


def say(line: str) -> None:
    """Print a line; names in it may have control characters, which a terminal would obey."""
    print(printable(line, LONGEST), flush=True)


def fail(message: str) -> NoReturn:
    """Tell what is wrong, on one line whatever the width of the terminal, and exit."""
    line = Text.assemble(("error: ", "bold red"), " ".join(message.split()))
    Console(stderr=True).print(line, soft_wrap=True)
    sys.exit(2)
