"""An experiment: a table or figure of the paper, made from the findings of its jobs."""

from __future__ import annotations

import gc
import json
import shutil
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import drjit as dr
from rich.console import Console

from .. import backend
from ..errors import UserError
from ..io import write_atomically, write_json, write_text
from ..machine import machine
from ..ranks import Agreed, Ranks
from ..version import VERSION
from . import Scale
from .jobs import Findings, Job, JobRunner, Record
from .speed import slowness
from .tables import csv_text

if typing.TYPE_CHECKING:
    from matplotlib.figure import Figure

Choice = typing.TypeVar("Choice")


@final
@dataclass(frozen=True)
class ExperimentContext:
    """Size of the experiments, and where their files are.

    Args:
        scale: the size.
        out: folder of all experiments: results in OUT/NAME, data sets, runs and records of jobs in
            OUT/work.
        scenes: folder of the published scenes.
        console: shows progress.
        seeds: number of fits of each kind, with seeds 0, 1, …; None: the scale's.
        only: folders of the scenes that an experiment by scene has; empty: the scale's.
    """

    scale: Scale
    out: Path
    scenes: Path
    console: Console = field(default_factory=lambda: Console(highlight=False))
    seeds: int | None = None
    only: tuple[str, ...] = ()

    @property
    def work(self) -> Path:
        """The folder of data sets and runs, shared by all experiments of a scale."""
        return self.out / "work" / self.scale

    def pick(self, smoke: Choice, cpu: Choice, paper: Choice) -> Choice:
        """The value for the scale."""
        return {"smoke": smoke, "cpu": cpu, "paper": paper}[self.scale]

    def tell(self, line: str) -> None:
        """Print a line of progress."""
        self.console.print(line, markup=False, soft_wrap=True)


@final
@dataclass(frozen=True)
class ExperimentResult:
    """The data, tables and figure of an experiment.

    Args:
        rows: the data, one record per row; keys are the columns.
        tables: Markdown.
        draw: writes the figure to a PNG file; None if there is no figure.
    """

    rows: Sequence[Mapping[str, Any]]
    tables: str
    draw: Callable[[Path], None] | None = None


@final
@dataclass(frozen=True)
class Experiment:
    """A table or figure of the paper.

    Args:
        name: its name for `unbake reproduce`.
        title: what it shows.
        jobs: makes its jobs, in the order in which they run. Raises `UserError` if scenes are
            missing.
        result: makes the result from the findings of the jobs, by name.
        seeded: whether its fits are repeated with several seeds.
        by_scene: whether it has a part for each published scene.
    """

    name: str
    title: str
    jobs: Callable[[ExperimentContext], list[Job]]
    result: Callable[[ExperimentContext, Mapping[str, Findings]], ExperimentResult]
    seeded: bool = False
    by_scene: bool = False


def reproduce(
    experiment: Experiment,
    context: ExperimentContext,
    *,
    plan: bool = False,
    ranks: Ranks | None = None,
) -> None:
    """Run what is left of an experiment, and write its data, table and figure to OUT/NAME.

    A job that fails does not keep the others from running.

    Args:
        plan: only show what is left and how long it takes.
        ranks: of MPI, which share the jobs and all call this; None: this process is alone. Rank 0
            writes the results.

    Raises:
        UserError: a scene is missing, a job failed, a file cannot be written, or seeds or scenes
            are asked of an experiment without any.
        OSError: the folder cannot be made.
        KeyboardInterrupt: SIGINT or SIGTERM arrived. The same call continues.

    Paper: Table 1, 2, Fig. 3–8.
    """
    ranks = ranks or Ranks()
    if context.seeds is not None and not experiment.seeded:
        remedy = "Leave it out: only fits are repeated with several seeds"
        raise UserError(f"{experiment.name} has no seeds", "--seeds", remedy)
    if context.only and not experiment.by_scene:
        what = f"{experiment.name} is not made scene by scene"
        raise UserError(what, "--only", "Leave it out")
    if not ranks.leads:
        context = replace(context, console=Console(quiet=True))
    jobs = ranks.together(lambda: experiment.jobs(context))
    runner = JobRunner(
        context.work / experiment.name, context.console, machine, slowness, _release_memory, ranks
    )
    context.tell(f"{experiment.name}: {experiment.title} ({context.scale} scale)")
    if ranks.leads:
        context.tell(runner.plan(jobs))
    if plan:
        return
    context.work.mkdir(parents=True, exist_ok=True)
    if ranks.size > 1:
        told = json.dumps([[job.name, dict(job.settings)] for job in jobs])
        ranks.require_same({"version": VERSION, "jobs": told})
        backend.share_cores(ranks.here)
    outcome = runner.run(jobs)
    for name, error in outcome.failed.items():
        raise Agreed(f"{experiment.name}, {name}: {error.what}", error.where, error.remedy)
    if outcome.left:
        raise KeyboardInterrupt  # a job was stopped
    if not ranks.leads:
        return
    result = experiment.result(context, outcome.findings)
    _write(experiment, context, result, jobs, outcome.records)
    context.tell(result.tables)
    context.tell(f"wrote {context.out / experiment.name}")


def copy_file(source: Path, folder: Path) -> None:
    """Copy a file of a job to the folder of results."""
    write_atomically(folder / source.name, lambda file: shutil.copyfile(source, file))


def save_figure(figure: Figure, path: Path) -> None:
    """Write a matplotlib figure to a PNG file, complete or not at all."""
    write_atomically(path, lambda file: figure.savefig(file, dpi=130, format="png"))


def _seconds_by_scene(jobs: Sequence[Job], records: Mapping[str, Record]) -> dict[str, float]:
    """The time of the jobs of each scene, by its folder: their group, or else their name."""
    spent: dict[str, float] = {}
    for job in jobs:
        scene = job.group or job.name
        spent[scene] = spent.get(scene, 0.0) + records[job.name]["seconds"]
    return {scene: round(seconds, 1) for scene, seconds in spent.items()}


def _release_memory() -> None:
    gc.collect()
    dr.flush_malloc_cache()


def _write(
    experiment: Experiment,
    context: ExperimentContext,
    result: ExperimentResult,
    jobs: Sequence[Job],
    records: Mapping[str, Record],
) -> None:
    folder = context.out / experiment.name
    machines = [record["machine"] for record in records.values()]
    data = {
        "experiment": experiment.name,
        "title": experiment.title,
        "scale": context.scale,
        # Jobs that were continued elsewhere ran on several machines.
        "machines": list({json.dumps(machine): machine for machine in machines}.values()),
        "seconds": round(sum(record["seconds"] for record in records.values()), 1),
    }
    if experiment.by_scene:
        data["seconds_by_scene"] = _seconds_by_scene(jobs, records)
    data["rows"] = [dict(row) for row in result.rows]
    write_json(folder / "data.json", data)
    write_text(folder / "data.csv", csv_text(result.rows))
    write_text(folder / "table.md", result.tables.rstrip() + "\n")
    if result.draw is not None:
        result.draw(folder / "figure.png")
