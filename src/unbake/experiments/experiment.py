"""An experiment: parts that are each done once, and what is made of what they found.

Every part's findings are kept in a file. So an experiment that was stopped goes on where it was,
and before it starts it can tell how long the rest will take on this machine.
"""

from __future__ import annotations

import csv
import gc
import hashlib
import io
import json
import shutil
import statistics
import time
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, final

import drjit as dr
import mitsuba as mi
from rich.console import Console

from ..errors import UserError
from ..io import write_atomically, write_json
from ..machine import machine
from . import Scale

if typing.TYPE_CHECKING:
    from matplotlib.figure import Figure

Findings = dict[str, Any]
Choice = typing.TypeVar("Choice")


@final
@dataclass(frozen=True)
class ExperimentContext:
    """How large an experiment is, and where its files are."""

    scale: Scale
    out: Path  #: folder of all experiments: OUT/NAME are results, OUT/work is what they came from
    scenes: Path  #: folder of published scenes
    console: Console = field(default_factory=lambda: Console(highlight=False))

    @property
    def work(self) -> Path:
        """The folder of data sets and runs, which experiments share."""
        return self.out / "work" / self.scale

    def pick(self, smoke: Choice, cpu: Choice, paper: Choice) -> Choice:
        """What belongs to the scale."""
        return {"smoke": smoke, "cpu": cpu, "paper": paper}[self.scale]

    def tell(self, line: str) -> None:
        """Print a line of progress."""
        self.console.print(line, markup=False, soft_wrap=True)


@final
@dataclass(frozen=True)
class Job:
    """A part of an experiment.

    Args:
        name: a file name, unique within the experiment.
        settings: all that decides what it finds: with others it is done again.
        work: what it does; what it returns is kept, as JSON.
        seconds: of computing that it took on the machine of `_REFERENCE`; None: nobody knows.
        waits: seconds that it takes besides, on any machine.
        files: that it writes: without them it is done again.
    """

    name: str
    settings: Mapping[str, Any]
    work: Callable[[], Findings]
    seconds: float | None
    waits: float = 0.0
    files: Sequence[Path] = ()


@final
@dataclass(frozen=True)
class ExperimentResult:
    """What is shown of an experiment.

    Args:
        rows: the data, one record a row; keys are the columns.
        tables: Markdown.
        draw: writes the figure to a PNG file; None: there is none.
    """

    rows: Sequence[Mapping[str, Any]]
    tables: str
    draw: Callable[[Path], None] | None = None


@final
@dataclass(frozen=True)
class Experiment:
    """A table or a figure of the paper.

    Args:
        name: as `unbake reproduce` knows it.
        title: what it shows.
        parts: in the order in which they are done. Raises a `UserError` if scenes are missing.
        show: from what the parts found, by name, to what is shown.
        plots: whether its figure needs matplotlib.
    """

    name: str
    title: str
    parts: Callable[[ExperimentContext], list[Job]]
    show: Callable[[ExperimentContext, Mapping[str, Findings]], ExperimentResult]
    plots: bool = False


def reproduce(experiment: Experiment, context: ExperimentContext, *, plan: bool = False) -> None:
    """Do what is left of an experiment, and write its data, table and figure to OUT/NAME.

    A part that fails does not keep others from being done.

    Args:
        plan: only tell what is left and how long it will take.

    Raises:
        UserError: something is missing, a part failed, or a file cannot be written.
        OSError: the folder cannot be made.
        KeyboardInterrupt: it was stopped; the same call goes on.
    """
    if experiment.plots and find_spec("matplotlib") is None:
        raise UserError("figures need matplotlib", remedy="pip install 'unbake[plots]'")
    parts = experiment.parts(context)
    left = [part for part in parts if "found" not in _kept(experiment, context, part)]
    _tell_plan(experiment, context, parts, left)
    if plan:
        return
    context.work.mkdir(parents=True, exist_ok=True)
    failed: list[tuple[str, UserError]] = []
    for part in left:
        context.console.rule(part.name, align="left")
        try:
            _do(experiment, context, part)
        except UserError as error:
            failed.append((part.name, error))
            context.tell(f"error: {error}")
    if failed:
        name, error = failed[0]
        raise UserError(f"{experiment.name}, {name}: {error.what}", error.where, error.remedy)
    kept = {part.name: _kept(experiment, context, part) for part in parts}
    shown = experiment.show(context, {name: k["found"] for name, k in kept.items()})
    _write(experiment, context, shown, kept)
    context.tell(shown.tables)
    context.tell(f"wrote {context.out / experiment.name}")


def _do(experiment: Experiment, context: ExperimentContext, part: Job) -> None:
    """Do a part and keep what it found; if it is stopped, how long it took so far."""
    kept = {"settings": dict(part.settings), "machine": machine()}
    before, start = _kept(experiment, context, part).get("seconds", 0.0), time.perf_counter()
    try:
        kept["found"] = part.work()
    finally:
        kept["seconds"] = round(before + time.perf_counter() - start, 2)
        write_json(_file(experiment, context, part), kept)
        # Memory of one part is not to be missed by the next.
        gc.collect()
        dr.flush_malloc_cache()


def _tell_plan(
    experiment: Experiment, context: ExperimentContext, parts: list[Job], left: list[Job]
) -> None:
    context.tell(f"{experiment.name}: {experiment.title} ({context.scale} scale)")
    if not left:
        context.tell(f"all {len(parts)} parts are done")
        return
    told = f"{len(parts) - len(left)} of {len(parts)} parts are done, "
    known = [part.seconds for part in left if part.seconds is not None]
    if len(known) < len(left):
        context.tell(told + "nobody has measured how long the others take at this scale")
        return
    seconds = sum(known) * _slowness() + sum(part.waits for part in left)
    context.tell(told + f"the others take about {duration(seconds)} on this machine")


def duration(seconds: float) -> str:
    """A length of time in words."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


# ------------------------------------------------------------------------------ What is kept of it


def _file(experiment: Experiment, context: ExperimentContext, part: Job) -> Path:
    return context.work / experiment.name / f"{part.name}.json"


def _kept(experiment: Experiment, context: ExperimentContext, part: Job) -> Findings:
    """What was written of a part with the same settings; `found` is in it if it was done."""
    try:
        kept = json.loads(_file(experiment, context, part).read_text(encoding="utf-8"))
        if kept["settings"] != json.loads(json.dumps(dict(part.settings))):
            return {}
        if not all(file.is_file() for file in part.files):
            kept.pop("found", None)
        return kept
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _write(
    experiment: Experiment,
    context: ExperimentContext,
    shown: ExperimentResult,
    kept: Mapping[str, Findings],
) -> None:
    folder = context.out / experiment.name
    data = {
        "experiment": experiment.name,
        "title": experiment.title,
        "scale": context.scale,
        # Parts may have been done on different ones.
        "machines": list({json.dumps(k["machine"]): k["machine"] for k in kept.values()}.values()),
        "seconds": round(sum(k["seconds"] for k in kept.values()), 1),
        "rows": [dict(row) for row in shown.rows],
    }
    write_json(folder / "data.json", data)
    _write_text(folder / "data.csv", _csv(shown.rows))
    _write_text(folder / "table.md", shown.tables.rstrip() + "\n")
    if shown.draw is not None:
        shown.draw(folder / "figure.png")


def digest(described: Mapping[str, Any]) -> str:
    """A short name for settings: other settings have another one."""
    text = json.dumps(described, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def _write_text(path: Path, text: str) -> None:
    write_atomically(path, lambda p: p.write_text(text, encoding="utf-8"))


def _csv(rows: Sequence[Mapping[str, Any]]) -> str:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


# --------------------------------------------------------------------------------- Tables, numbers


def markdown(titles: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table; numbers are set to the right, and None is a dash."""
    cells = [["—" if c is None else str(c) for c in row] for row in rows]
    lines = [titles, ["---"] + ["---:"] * (len(titles) - 1), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def copy_file(source: Path, folder: Path) -> None:
    """Copy what a part wrote to where results are."""
    write_atomically(folder / source.name, lambda file: shutil.copyfile(source, file))


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure of matplotlib to a PNG file, complete or not at all."""
    write_atomically(path, lambda file: figure.savefig(file, dpi=130, format="png"))


# ------------------------------------------------------------------------------------------- Speed

#: Seconds that the probe took where the parts' seconds come from: two cores of an AMD EPYC.
_REFERENCE = 0.145


def _slowness() -> float:
    """How many times longer than on the reference machine things take here."""
    scene = mi.load_dict(mi.cornell_box())
    sensor, integrator = scene.sensors()[0], mi.load_dict({"type": "path", "max_depth": 8})
    seconds = []
    for seed in range(4):
        start = time.perf_counter()
        dr.eval(mi.render(scene, sensor=sensor, integrator=integrator, spp=8, seed=seed))
        dr.sync_thread()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds[1:]) / _REFERENCE
