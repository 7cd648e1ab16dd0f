"""Processes that MPI started: those of commands that share their work, and of those that do not."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager

from ..errors import UserError, printable
from ..ranks import Agreed, Ranks, started
from .console import LONGEST, say


@contextmanager
def sharing_ranks() -> Iterator[Ranks]:
    """The ranks that this process is one of; what fails on one of them ends all, in one line."""
    ranks = Ranks.of_environment()
    with ranks.guarded(lambda line: print(printable(line, LONGEST), file=sys.stderr)):
        yield ranks
        ranks.leave()


def require_one_process(command: str, sharing: Collection[str]) -> None:
    """Refuse several processes that were started for a command of one.

    Args:
        command: with its name.
        sharing: names of the commands whose work they share.

    Raises:
        Agreed: there are several.
    """
    several = started()
    if several < 2:
        return
    try:
        ranks = Ranks.of_environment()
    except UserError:  # they do not know of each other, and each tells it
        ranks = Ranks()
    with ranks.guarded(say):
        what = f"{several} processes were started, and unbake {command} takes one"
        remedy = f"Run it without mpiexec; processes share {', '.join(sorted(sharing))}"
        raise Agreed(what, remedy=remedy)
