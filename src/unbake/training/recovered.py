"""A finished (or running) fit, read back from its folder."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from ..config import FitConfig, read_toml
from ..dataset.views import Dataset
from ..errors import UserError
from ..io import write_json
from .checkpoint import Progress, load_checkpoint
from .problem import Problem, make_problem
from .step import initial_state

#: What a run was made from: a file of its folder.
ORIGIN = "origin.json"


@dataclass(frozen=True)
class Origin:
    """What a run was made from, beside its settings."""

    data: str  # the data set's folder
    mean_radiance: float  # of its training pixels; the scale of the radiance field
    clip_negative: bool


@dataclass
class Recovered:
    """A run: what was recovered, with which settings, from which data."""

    problem: Problem
    dataset: Dataset
    config: FitConfig
    progress: Progress
    clip_negative: bool


def load_run(run: Path) -> Recovered:
    """Read a run's newest checkpoint.

    `problem.world.scene` is a Mitsuba scene with the recovered fields in the place of its albedo
    and roughness, its environment or its lights' strengths. Where materials were recovered, any
    integrator of Mitsuba renders it after `problem.materials.stand_alone()`, and else at once.

    Raises:
        UserError: the folder holds no run, no checkpoint, or its data set is gone.
    """
    if not (run / "config.toml").is_file() or not (run / ORIGIN).is_file():
        raise UserError("no run in this folder", where=run, remedy="Make one with `unbake fit`")
    config = read_toml(run / "config.toml")
    origin = read_origin(run)
    data = Path(origin.data)
    if not data.is_dir():
        moved = f"Put it back, or tell where it is now: unbake fit DATA --out {run} --resume"
        raise UserError(f"the data set of the run {run} is gone", data, moved)
    dataset = Dataset.load(data)
    problem = make_problem(dataset.scene, dataset.background, config, origin.mean_radiance)
    state = initial_state(problem)
    progress = load_checkpoint(run / "checkpoints", state)
    if progress is None:
        raise UserError("no readable checkpoint", where=run, remedy="Fit again, or wait for one")
    state.publish(problem)
    return Recovered(problem, dataset, config, progress, origin.clip_negative)


def write_origin(run: Path, origin: Origin) -> None:
    """Write `origin.json`, complete or not at all."""
    write_json(run / ORIGIN, asdict(origin))


def read_origin(run: Path) -> Origin:
    """Read `origin.json`.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        facts = json.loads((run / ORIGIN).read_text(encoding="utf-8"))
        radiance, clip = float(facts["mean_radiance"]), bool(facts["clip_negative"])
        return Origin(str(facts["data"]), radiance, clip)
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError("cannot be read", run / ORIGIN, "Fit again into another folder") from None
