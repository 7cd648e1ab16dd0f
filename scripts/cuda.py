"""Everything there is to measure on a machine with an NVIDIA GPU; see scripts/cuda.sh."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from rich.console import Console

from unbake.dataset.data_folder import DataFolder
from unbake.errors import UserError
from unbake.experiments import Name
from unbake.experiments.commands import (
    call_settings,
    command,
    end_of_call,
    main,
    run_jobs,
    unbake,
)
from unbake.experiments.jobs import Findings, Job, JobRunner, Unfinished
from unbake.experiments.scales import SMOKE
from unbake.io import write_text
from unbake.training.run_folder import RunFolder

ROOT = Path(__file__).parents[1]
FIGURES = get_args(Name)
#: Tables and figures that need no published scene.
WITHOUT_SCENES = ("table2", "fig5")
JOBS = ("doctor", "tests", "step", "methods", "staircase", *FIGURES)


@dataclass(frozen=True)
class Machine:
    """The jobs of a machine.

    Args:
        out: folder of results.
        scale: paper, or smoke.
        staircase: data set of STAIRCASE.
        scenes: folder of the published scenes.
        steps: length of the fit of STAIRCASE.
        until: value of `time.monotonic()` at which the time of this call is up.
    """

    out: Path
    scale: str
    staircase: Path | None
    scenes: Path
    steps: int
    until: float | None

    def jobs(self, name: str) -> list[Job]:
        """What belongs to a name of `JOBS`; nothing if it cannot be done here."""
        match name:
            case "doctor":
                return [Job(name, {}, self._doctor, files=[self.out / "doctor.txt"])]
            case "tests":
                words = (sys.executable, "-m", "pytest", "-q", "-m", "not slow", ROOT / "tests")
                log = self.out / "tests.txt"
                return [Job(name, {}, lambda: command(words, log=log) or {}, files=[log])]
            case "step":
                single = [self._bench(f"step-{m}", "step", m) for m in ("ours", "prb", "ad-pt")]
                return [self._demo(), *single]
            case "methods":
                words = ("ours", "direct", "no-prior", "prb", "ad-pt", "ours:bitmap", "prb:bitmap")
                return [self._demo(), self._bench(name, "methods", *words)]
            case "staircase":
                return self._staircase()
        if name not in WITHOUT_SCENES and not self.scenes.is_dir():
            print(f"SCENES is not set: {name} is left out", flush=True)
            return []
        folder = self.out / "reproduction"
        words = ("reproduce", name, "--scale", self.scale, "--out", folder, "--scenes", self.scenes)
        work = partial(unbake, *words, until=self.until)
        files = [folder / name / "table.md"]
        return [Job(name, {"scale": self.scale}, lambda: work() or {}, files=files)]

    @property
    def settings(self) -> str:
        """Settings of steps and fits, as TOML."""
        return 'preset = "paper"\n' if self.scale == "paper" else SMOKE

    @property
    def settings_file(self) -> Path:
        """The file of the settings."""
        return self.out / "step.toml"

    @property
    def _data(self) -> Path:
        return self.out / "data" / "demo"

    def _doctor(self) -> Findings:
        libraries = [line for line in _printed("ldconfig", "-p").splitlines() if _matters(line)]
        write_text(self.out / "machine.txt", "\n".join([_printed("nvidia-smi"), *libraries]) + "\n")
        unbake("doctor", log=self.out / "doctor.txt")
        return {}

    def _demo(self) -> Job:
        """The data set that steps are measured on."""
        views, size, spp = (8, 256, 32) if self.scale == "paper" else (2, 16, 4)
        words = ["--views", views, "--held-out", 1, "--resolution", size, "--spp", spp]

        def work() -> Findings:
            if not self._data.exists():
                unbake("capture", "demo", "--out", self._data, *words)
            return {}

        return Job(
            "data-demo", {"size": words}, work, files=[DataFolder(self._data).transforms_file]
        )

    def _bench(self, name: str, what: str, *methods: str) -> Job:
        steps = 100 if self.scale == "paper" else 10
        file = self.out / f"{name}.json"
        option = "--method" if what == "step" else "--methods"
        words = ["bench", what, "--data", self._data, option, *methods, "--steps", steps]
        work = partial(unbake, *words, "--settings", self.settings_file, "--out", file)
        described = {"methods": methods, "steps": steps, "settings": self.settings}
        return Job(name, described, lambda: work() or {}, files=[file])

    def _staircase(self) -> list[Job]:
        """A fit in slices that continue one another; 4.7 G samples at the paper's sizes."""
        data, before = self.staircase, []
        if data is None:
            if self.scale == "paper":
                print("STAIRCASE is not set: left out", flush=True)
                return []
            data, before = self._data, [self._demo()]
        run = RunFolder(self.out / "staircase")

        def work() -> Findings:
            words: list[object] = ["fit", data, "--out", run.path, "--steps", self.steps]
            words += (
                ["--resume"] if run.config_file.is_file() else ["--settings", self.settings_file]
            )
            evaluate = partial(unbake, "evaluate", run.path, "--spp", 64, "--train-views", 2)
            try:
                unbake(*words, until=self.until)
            except Unfinished:
                # What was learned so far is worth a number, if there is a checkpoint.
                if run.written_checkpoints():
                    evaluate()
                raise
            evaluate()
            return {}

        described = {"data": str(data), "steps": self.steps, "settings": self.settings}
        return [*before, Job("staircase", described, work, files=[run.metrics_file])]


def _printed(*words: str) -> str:
    """What a program prints."""
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{words[0]}: {error}"
    return done.stdout + done.stderr


def _matters(line: str) -> bool:
    return "nvoptix" in line or "libcuda" in line


def run(words: Sequence[str] | None = None) -> int:
    """Run the jobs that are named on the command line."""
    known = os.environ
    parser = argparse.ArgumentParser(prog="scripts/cuda.sh", description=__doc__)
    parser.add_argument("out", metavar="OUT", type=Path)
    parser.add_argument("jobs", metavar="JOB", nargs="*", help=f"of: {' '.join(JOBS)}")
    parser.add_argument("--scale", default=known.get("SCALE") or "paper")
    parser.add_argument("--staircase", type=Path, default=known.get("STAIRCASE") or None)
    parser.add_argument("--scenes", type=Path, default=known.get("SCENES") or "scenes")
    parser.add_argument("--steps", type=int, default=known.get("STEPS") or None)
    call_settings(parser)
    args = parser.parse_args(words)
    if args.scale not in ("paper", "smoke"):
        raise UserError(f"it is paper or smoke, not {args.scale}", "SCALE")
    unknown = [job for job in args.jobs if job not in JOBS]
    if unknown:
        raise UserError(f"no job named {unknown[0]!r}", remedy=f"There are {', '.join(JOBS)}")
    steps, until = args.steps or (18_000 if args.scale == "paper" else 20), end_of_call(args)
    machine = Machine(args.out, args.scale, args.staircase, args.scenes, steps, until)
    write_text(machine.settings_file, machine.settings)
    jobs = {job.name: job for name in args.jobs or JOBS for job in machine.jobs(name)}
    console = Console(highlight=False)
    outcome = run_jobs(JobRunner(args.out / "jobs", console), list(jobs.values()), args, until)
    return 1 if outcome is not None and outcome.failed else 0


if __name__ == "__main__":
    main(run)
