"""Campaigns of damaged files: how many are read how, and what fails.

Hypothesis draws the inputs. Workers read them (see `worker.py`): what kills or hangs a worker is
charged to the input in hand, and another worker takes over.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from .formats import FORMATS, ROOT, Format

#: Files that have failed once, in a folder for each format.
CORPUS = ROOT / "tests" / "data" / "corpus"
#: Seconds after which a file that is still being read counts as one that hangs.
PATIENCE = 60.0
#: Inputs that Hypothesis draws in one go; it remembers all of them.
_ROUND = 250
#: The fewest of a round: nothing new in all of them, and there is nothing new to draw.
_FEWEST = 50


class Worker:
    """A process that reads damaged files; a context manager.

    Args:
        patience: seconds that a file may take.
        command: the process; for tests.
    """

    def __init__(self, patience: float = PATIENCE, command: list[str] | None = None) -> None:
        self._patience = patience
        self._command = command or [sys.executable, str(Path(__file__).with_name("worker.py"))]
        self._folder = tempfile.TemporaryDirectory(prefix="fuzz-")
        self._process: subprocess.Popen[bytes] | None = None
        self._said: IO[bytes] | None = None
        self.starts = 0

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()
        self._folder.cleanup()

    def read(self, name: str, content: bytes) -> dict[str, Any]:
        """What became of the content of a file of a format."""
        process = self._process or self._start()
        assert process.stdin is not None
        asked = json.dumps({"format": name, "size": len(content)}) + "\n"
        with contextlib.suppress(BrokenPipeError):  # told by the answer that never comes
            process.stdin.write(asked.encode() + content)
            process.stdin.flush()
        answer = self._answer(self._patience)
        return answer if answer is not None else self._buried()

    def _start(self) -> subprocess.Popen[bytes]:
        self._end()
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `_end`
        paths = [str(ROOT / "src"), os.environ.get("PYTHONPATH", "")]
        self._process = subprocess.Popen(
            [*self._command, self._folder.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            cwd=self._folder.name,
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, paths))},
            start_new_session=True,
        )
        self.starts += 1
        if self._answer(PATIENCE) != "ready":
            raise RuntimeError(f"no worker starts: {self._last_words()}")
        return self._process

    def _answer(self, patience: float) -> Any | None:
        """A line of JSON; None if there is none in time, or the process has ended."""
        process = self._process
        assert process is not None and process.stdout is not None
        if not select.select([process.stdout], [], [], patience)[0]:
            return None
        line = process.stdout.readline()
        return json.loads(line) if line.endswith(b"\n") else None

    def _buried(self) -> dict[str, Any]:
        """How the process ended that gives no answer."""
        process = self._process
        assert process is not None
        try:
            # Its pipe is closed a moment before it has ended.
            status = process.wait(timeout=1)
        except subprocess.TimeoutExpired:
            kind, told = "hang", f"not read in {self._patience:g} s"
        else:
            name = signal.Signals(-status).name if status < 0 else f"exit status {status}"
            kind, told = name, f"{name}: {self._last_words()}"
        self._end()
        return {"verdict": "failed", "kind": kind, "told": told}

    def _last_words(self) -> str:
        if self._said is None:
            return ""
        self._said.seek(0, os.SEEK_END)
        self._said.seek(max(0, self._said.tell() - 300))
        return " ".join(self._said.read().decode("utf-8", "replace").split())

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()
        if self._said is not None:
            self._said.close()
            self._said = None


@dataclass
class Failure:
    """Inputs of a format that failed alike: the smallest of them."""

    format: str
    kind: str
    told: str
    content: bytes
    count: int = 1

    def keep(self, corpus: Path = CORPUS) -> Path:
        """Write the input into the corpus."""
        name = hashlib.sha256(self.content).hexdigest()[:12]
        file = corpus / folder_name(self.format) / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(self.content)
        return file


@dataclass
class Campaign:
    """Counts of a series of inputs, by format and verdict, and what failed.

    Args:
        worker: reads them.
        watch: is called after each input.
    """

    worker: Worker
    watch: Callable[[Campaign], object] = lambda campaign: None
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    slowest: float = 0.0  #: seconds
    failures: dict[tuple[str, str], Failure] = field(default_factory=dict)
    _seen: set[tuple[str, bytes]] = field(default_factory=set)

    @property
    def total(self) -> int:
        """Number of inputs read."""
        return sum(sum(counted.values()) for counted in self.counts.values())

    def read(self, name: str, content: bytes) -> None:
        """Let the worker read an input, and count it."""
        start = time.monotonic()
        found = self.worker.read(name, content)
        self.slowest = max(self.slowest, time.monotonic() - start)
        counted = self.counts.setdefault(name, {"worked": 0, "refused": 0, "failed": 0})
        counted[found["verdict"]] += 1
        if found["verdict"] == "failed":
            self._fail(name, found, content)
        self.watch(self)

    def _fail(self, name: str, found: dict[str, Any], content: bytes) -> None:
        key = name, found["kind"]
        known = self.failures.get(key)
        if known is None:
            self.failures[key] = Failure(name, found["kind"], found["told"], content)
            return
        known.count += 1
        if len(content) < len(known.content):
            known.content, known.told = content, found["told"]

    def mutate(self, name: str, count: int, start: int) -> None:
        """Read damaged files of a format, no two of them the same.

        Args:
            count: how many; fewer where nothing new is drawn any more.
            start: seed; the same one draws the same inputs.
        """
        numbers, fresh, left = random.Random(f"{name} {start}"), True, count
        while fresh and left > 0:
            fresh = False

            @seed(numbers.getrandbits(64))
            @settings(
                max_examples=min(max(left, _FEWEST), _ROUND),
                database=None,
                deadline=None,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(damaged(FORMATS[name]))
            def draw(content: bytes) -> None:
                nonlocal fresh, left
                if (name, content) in self._seen or left == 0:
                    return
                self._seen.add((name, content))
                fresh, left = True, left - 1
                self.read(name, content)

            draw()

    def replay(self, corpus: Path = CORPUS) -> None:
        """Read everything that has failed once."""
        for name, file in kept(corpus):
            self.read(name, file.read_bytes())


def damaged(row: Format) -> st.SearchStrategy[bytes]:
    """Files of a format with one to three mutations."""

    @st.composite
    def strategy(draw: Any) -> bytes:
        content = draw(st.sampled_from(list(row.samples())))
        for _ in range(draw(st.integers(1, 3))):
            content = draw(st.sampled_from(row.mutations))(draw, content)
        return content

    return strategy()


def shares(total: int, names: list[str]) -> dict[str, int]:
    """How many inputs each format gets of a total, by weight; at least one."""
    whole = sum(FORMATS[name].weight for name in names)
    return {name: max(1, round(total * FORMATS[name].weight / whole)) for name in names}


def folder_name(name: str) -> str:
    """The folder of a format in the corpus."""
    return name.replace(" ", "-")


def kept(corpus: Path = CORPUS) -> Iterator[tuple[str, Path]]:
    """Formats and files of the corpus."""
    for name in FORMATS:
        folder = corpus / folder_name(name)
        for file in sorted(folder.iterdir()) if folder.is_dir() else ():
            yield name, file
