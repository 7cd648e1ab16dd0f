"""The command line.

Commands import what does their work only when they run, so that the help is fast, and as
`run_COMMAND` where it has no name of its own.
"""

from .dispatch import COMMANDS, GROUPS, SHARED, main

__all__ = ["COMMANDS", "GROUPS", "SHARED", "main"]
