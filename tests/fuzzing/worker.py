"""A process that reads one damaged file after the other, and tells what became of each.

`engine.Worker` starts it, `python worker.py FOLDER`. It gets a line of JSON with the format and the
number of bytes, then the bytes, and answers with a line of JSON. A decoder that kills the process
kills none but this one.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import resource
import shutil
import sys
import traceback
import unicodedata
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

if TYPE_CHECKING:
    from .formats import Format

#: The most characters of an error's line.
LONGEST = 500
#: Address space of the process, so that a decoder that asks for all memory gets none.
ADDRESS_SPACE = 12 << 30


def main() -> None:
    """Read until the input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no answer
    warnings.simplefilter("ignore")  # nor are NumPy's remarks on infinite numbers
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from fuzzing.formats import FORMATS

    # What every reading needs is loaded before the first one is timed.
    from unbake import backend, cli  # noqa: F401

    backend.activate()

    def answer(content: object) -> None:
        answers.write(json.dumps(content) + "\n")
        answers.flush()

    readers: dict[str, Reader] = {}
    answer("ready")
    while line := sys.stdin.buffer.readline():
        asked = json.loads(line)
        content = sys.stdin.buffer.read(asked["size"])
        name = asked["format"]
        if name not in readers:
            readers[name] = Reader(FORMATS[name], Path(sys.argv[1]) / name.replace(" ", "-"))
        answer(readers[name].read(content))


class Reader:
    """Reads files of a format in a folder that is made again whenever a file in it changed."""

    def __init__(self, row: Format, folder: Path) -> None:
        self._row, self._folder = row, folder
        self._fresh()

    def read(self, content: bytes) -> dict[str, Any]:
        """What became of a content: `verdict` is worked, refused, or failed with a `kind`."""
        file = self._folder / self._row.file
        file.write_bytes(content)
        before = _listing(self._folder)
        found = self._outcome()
        after = _listing(self._folder)
        if after != before:
            changed = sorted(k for k in {*before, *after} if before.get(k) != after.get(k))
            if found["verdict"] != "worked" or not set(changed) <= set(self._row.makes):
                told = f"{found['verdict']}, but left {', '.join(changed)[:200]}"
                if found["verdict"] != "failed":
                    found = {"verdict": "failed", "kind": "files", "told": told}
            self._fresh()
        return found

    def _fresh(self) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir(parents=True)
        self._row.prepare(self._folder)

    def _outcome(self) -> dict[str, Any]:
        """Read as a command does, whose errors end in `cli.main`."""
        from unbake import cli

        printed = io.StringIO()
        try:
            with (
                patch("tyro.extras.subcommand_cli_from_dict", self._command),
                contextlib.redirect_stderr(printed),
            ):
                cli.main()
        except SystemExit as stop:
            return (
                {"verdict": "worked"} if not stop.code else _judged(stop.code, printed.getvalue())
            )
        except BaseException as error:
            frames = traceback.extract_tb(error.__traceback__)
            ours = [f for f in frames if f"{os.sep}unbake{os.sep}" in f.filename] or frames
            at = f"{Path(ours[-1].filename).name}:{ours[-1].name}"
            told = f"{type(error).__name__} in {at}: {str(error)[:200]}"
            return {"verdict": "failed", "kind": f"{type(error).__name__} {at}", "told": told}
        raise AssertionError("the command line did not exit")

    def _command(self, *_: object, **__: object) -> None:
        self._row.read(self._folder)


def _judged(status: object, text: str) -> dict[str, Any]:
    """Whether the command line has refused a file in one good line."""
    problem = None
    if status != 2:
        problem = f"exit status {status}"
    elif not text.startswith("error: ") or text.count("\n") != 1 or not text.endswith("\n"):
        problem = "not one line"
    elif len(text) > LONGEST:
        problem = f"more than {LONGEST} characters"
    elif any(unicodedata.category(c) in ("Cc", "Cs") for c in text[:-1]):
        problem = "control characters"
    elif "Traceback" in text:
        problem = "a traceback"
    if problem is None:
        return {"verdict": "refused", "told": text[:-1]}
    return {"verdict": "failed", "kind": f"error line: {problem}", "told": ascii(text[:300])}


def _listing(folder: Path) -> dict[str, tuple]:
    """Sizes and times of all files in a folder."""
    found = {}
    for root, _, names in os.walk(folder):
        for name in names:
            file = Path(root, name)
            state = file.lstat()
            found[file.relative_to(folder).as_posix()] = (state.st_size, state.st_mtime_ns)
    return found


if __name__ == "__main__":
    main()
