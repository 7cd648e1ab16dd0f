"""A finished (or running) fit, read back from its folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ..config import FitConfig
from ..dataset.camera import Camera
from ..dataset.fingerprint import changed, geometry_fingerprint
from ..dataset.views import Dataset, View
from ..errors import UserError, quoted
from ..scene.parse import ParsedScene
from .checkpoint import Progress, load_checkpoint
from .poses import refined_view
from .problem import Problem, problem_of, weigh_lights_alike
from .run_folder import RunFolder
from .state import State, initial_state


@dataclass
class Recovered:
    """A run read back: the recovered scene, its settings and its data set."""

    problem: Problem
    dataset: Dataset
    config: FitConfig
    progress: Progress
    clip_negative: bool

    def __repr__(self) -> str:
        config = self.config
        told = f"{config.unknown!r} by {config.method!r}, {self.progress.step} steps"
        return f"Recovered({told}, {str(self.dataset.folder)!r})"

    def camera(self, view: View) -> Camera:
        """The camera of a view of the data set, as the fit found it; see `refined_view`."""
        return refined_view(self.problem.poses, self.dataset.train, view).camera

    @property
    def cameras(self) -> list[Camera]:
        """Those of the training views."""
        return [self.camera(view) for view in self.dataset.train]


@dataclass
class OpenedRun:
    """A run whose checkpoints can be read, with fields that are untrained until one is."""

    folder: RunFolder
    problem: Problem
    dataset: Dataset
    config: FitConfig
    state: State
    clip_negative: bool


def open_run(
    run: str | Path,
    *,
    allow_outside: bool = False,
    change: Callable[[ParsedScene], object] | None = None,
    single: bool = False,
) -> OpenedRun:
    """Read settings and data set of a run, and make its fields.

    Args:
        run: folder of a fit.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        change: called with the scene before it is made, such as to give it another light.
        single: networks multiply in single precision, whatever the run did.

    Raises:
        UserError: the folder holds no run, or its data set is gone.
    """
    run = Path(run)
    folder = RunFolder(run)
    folder.require_fitted()
    config = folder.settings()
    if single:
        config = replace(config, precision="single")
    origin = folder.origin()
    data = folder.data(origin.data)
    if not data.is_dir():
        resume = f"unbake fit DATA --out {quoted(run)} --resume"
        moved = f"Put it back, or tell where it is now: {resume}"
        raise UserError(f"the data set of the run {run} is gone", data, moved)
    dataset = Dataset.load(data, allow_outside=allow_outside)
    problem = problem_of(dataset, config, origin.photographs_level, change=change)
    if problem.radiance is not None:
        problem.radiance.scale = origin.radiance_scale
    return OpenedRun(folder, problem, dataset, config, initial_state(problem), origin.clip_negative)


def told_changed(parts: Sequence[str]) -> str:
    """A line of parts of a data set that are others than a run was fit to."""
    return f"warning: other {', '.join(parts)} than the run was fit to"


def tell_changed_geometry(folder: RunFolder, dataset: Dataset, tell: Callable[[str], None]) -> None:
    """Tell if the scene, the poses or the views are others than the run was fit to.

    Args:
        folder: of the run.
        dataset: as it is now.
        tell: called with the line.
    """
    parts = changed(folder.origin().fingerprint, geometry_fingerprint(dataset))
    if parts:
        tell(told_changed(parts))


def load_run(
    run: str | Path,
    *,
    allow_outside: bool = False,
    change: Callable[[ParsedScene], object] | None = None,
    single: bool = False,
) -> Recovered:
    """Read a run's newest checkpoint.

    `problem.scene_view.scene` is a Mitsuba scene with the recovered fields in the place of its
    unknown quantities, its environment or its lights' strengths. Any integrator of Mitsuba renders
    it, unless a field cannot be evaluated inside of loops (`problem.materials.can_stand_alone`).

    Args:
        run: folder of a fit.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        change: called with the scene before it is made, such as to give it another light.
        single: networks multiply in single precision, whatever the run did.

    Raises:
        UserError: the folder holds no run, no checkpoint, or its data set is gone.
    """
    opened = open_run(run, allow_outside=allow_outside, change=change, single=single)
    progress = load_checkpoint(opened.folder, opened.state)
    if progress is None:
        raise UserError("no readable checkpoint", where=run, remedy="Fit again, or wait for one")
    opened.state.publish(opened.problem)
    if opened.problem.light_is_unknown:  # only now it is known how strong it is
        weigh_lights_alike(opened.problem, opened.dataset)
    return Recovered(opened.problem, opened.dataset, opened.config, progress, opened.clip_negative)
