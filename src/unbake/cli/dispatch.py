"""From the words of a command line to a command, and to an exit status; the help of `unbake`."""

from __future__ import annotations

import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping
from functools import partial

import tyro

from .. import signals
from ..errors import UserError, of_system
from ..memory import NO_MEMORY, lacks_memory
from ..version import VERSION
from . import bench, data_sets, doctor, results, training
from .console import fail, say
from .help import NARROWEST, columns, wrapped_help
from .processes import require_one_process
from .words import plain_words

_DESCRIPTION = (
    "Recovers the materials or the lighting of a scene with known geometry from posed "
    "photographs, with the global illumination taken out."
)
_START = (
    "unbake capture demo --out DATA",
    "unbake fit DATA --out RUN",
    "unbake evaluate RUN",
    "unbake report RUN --out report.html",
)
_STATUS = (
    "Exit status: 0; 1 where a part failed or a fit learned nothing; 2 on bad input or a full "
    "disk; ended early: 130 (Ctrl-C), 143 (SIGTERM), 129 (SIGHUP), 141 (closed pipe). Long "
    "commands, such as a fit, save their progress; others leave existing files untouched. A second "
    "Ctrl-C ends at once."
)

#: The commands by what they are for, in the order of the help.
GROUPS: Mapping[str, Mapping[str, Callable[..., int | None]]] = {
    "Start": {
        "capture": data_sets.capture,
        "import": data_sets.import_,
        "data": data_sets.data,
        "fit": training.fit,
    },
    "Results": {
        "evaluate": results.evaluate,
        "report": results.report,
        "export": results.export,
        "render": results.render,
        "relight": results.relight,
        "view": results.view,
    },
    "The forward problem": {
        "solve": training.solve,
    },
    "Compare and measure": {
        "compare": training.compare,
        **{f"bench {name}": measure for name, measure in bench.MEASUREMENTS.items()},
        "degrade": data_sets.degrade,
        "reproduce": training.reproduce,
    },
    "Check": {
        "doctor": doctor.doctor,
    },
}
#: All commands by name, of which some have two words.
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}
#: What commands that share their first word have in common.
FAMILIES: Mapping[str, str] = {"bench": bench.SUMMARY}
#: Those whose work several processes share. All others are refused to several: each process would
#: do all of the work, and write the same files.
SHARED = frozenset({"bench rates", "compare", "fit", "reproduce"})


def main() -> None:
    """Read the words of the command line and run a command; exits with its status.

    2 on bad input; 130, 143, 129 or 141 if a signal or a closed pipe ended it (`signals.py`).
    """
    if shutil.get_terminal_size().columns < NARROWEST:
        os.environ["COLUMNS"] = str(NARROWEST)  # Tyro 1.0 wraps texts forever below 10
    words = sys.argv[1:]
    family = words[0] if words and words[0] in FAMILIES else None
    asked = words if family is None else words[1:]
    if asked in ([], ["-h"], ["--help"]):
        told = _overview() if family is None else _overview_of(family)
        print(told, file=sys.stdout if asked else sys.stderr)
        sys.exit(0 if asked else 2)
    if words == ["--version"]:
        say(f"unbake {VERSION}")
        sys.exit(0)
    for command in COMMANDS.values():
        # Tyro 1.0 keeps the line breaks of some arguments' texts.
        command.__doc__ = re.sub(r"\n {8}(?=\S)", " ", inspect.getdoc(command) or "")
    try:
        name = words[0] if family is None else " ".join(words[:2])
        if name in COMMANDS.keys() - SHARED and not {"-h", "--help"} & {*words}:
            require_one_process(name, SHARED)
        with wrapped_help(words), plain_words():
            status = _run(family, asked)
    except UserError as error:
        fail(str(error))
    except (MemoryError, RuntimeError, ImportError) as error:  # Dr.Jit raises the second
        if not lacks_memory(error):
            raise
        fail(NO_MEMORY)
    except OSError as error:
        # A full disk, a file taken away: nothing that a traceback would explain.
        fail(of_system(error))
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(signals.status())
    sys.exit(status or 0)


def _run(family: str | None, words: list[str]) -> int | None:
    """Run a command; returns its status.

    Args:
        family: its first word, if it has two.
        words: the others.
    """
    name = words[0] if family is None else f"{family} {words[0]}"
    if name in COMMANDS:  # alone, so that errors name the command, and its help
        return tyro.cli(COMMANDS[name], prog=f"unbake {name}", args=words[1:])
    if family is not None:
        return tyro.extras.subcommand_cli_from_dict(
            _of_family(family), prog=f"unbake {family}", description=FAMILIES[family], args=words
        )
    # Families are told among the commands where a word is wrong.
    families = {name: partial(_tell_family, name) for name in FAMILIES}
    single = {n: c for n, c in COMMANDS.items() if " " not in n} | families
    return tyro.extras.subcommand_cli_from_dict(
        single, prog="unbake", description=_DESCRIPTION, args=words
    )


def _tell_family(family: str) -> int:
    """Tell the commands whose first word this is."""
    print(_overview_of(family), file=sys.stderr)
    return 2


def _of_family(family: str) -> dict[str, Callable[..., int | None]]:
    """The commands whose first word this is, by their second one."""
    start = f"{family} "
    return {n.removeprefix(start): c for n, c in COMMANDS.items() if n.startswith(start)}


def _summary(command: Callable[..., int | None]) -> str:
    """The first paragraph of the help of a command, without its full stop."""
    return " ".join((inspect.getdoc(command) or "").partition("\n\n")[0].split()).removesuffix(".")


def _listed(summaries: Mapping[str, str], width: int) -> list[str]:
    """Names with what they stand for, as wrapped lines.

    Args:
        width: of the longest name.
    """
    lines = []
    for name, text in summaries.items():
        first, further = f"  {name:{width}}  ", " " * (width + 4)
        lines += textwrap.wrap(text, columns(), initial_indent=first, subsequent_indent=further)
    return lines


def _overview() -> str:
    """The help of `unbake` alone: its commands, a line or two each."""
    width = max(len(name.split()[0]) for name in COMMANDS)
    lines = ["usage: unbake COMMAND ...", "", *textwrap.wrap(_DESCRIPTION, columns())]
    for title, group in GROUPS.items():
        summaries = {}
        for name, command in group.items():
            family = name.split()[0]
            summaries[family] = FAMILIES.get(family) or _summary(command)
        lines += ["", f"{title}:", *_listed(summaries, width)]
    more = "unbake COMMAND --help tells its options; unbake --version tells the version."
    lines += ["", *textwrap.wrap(more, columns())]
    lines += ["", "From nothing to a result:", *(f"  {command}" for command in _START)]
    return "\n".join([*lines, "", *textwrap.wrap(_STATUS, columns())])


def _overview_of(family: str) -> str:
    """The help of commands that share their first word."""
    summaries = {name: _summary(command) for name, command in _of_family(family).items()}
    lines = [f"usage: unbake {family} COMMAND ...", ""]
    lines += textwrap.wrap(f"{FAMILIES[family]}.", columns())
    lines += ["", *_listed(summaries, max(map(len, summaries))), ""]
    lines += textwrap.wrap(f"unbake {family} COMMAND --help tells its options.", columns())
    return "\n".join(lines)
