"""A fit before its first step: all its input is read and checked, and nothing is written."""

from __future__ import annotations

import dataclasses
import json
import math
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

from rich.console import Console

from .. import backend
from ..config import FitConfig, to_toml
from ..dataset.fingerprint import changed, fingerprint
from ..dataset.photographs import MOST_PIXELS
from ..dataset.pixels import CameraRays, PixelSource
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..progress import Paced
from ..ranks import Ranks
from .checkpoint import Progress, load_checkpoint
from .defaults import told_unknown, with_defaults
from .first_gains import begin_cameras
from .first_lights import begin_lights
from .held_aside import HeldAside, HeldOutPhotographs
from .path_depth import told_depth, with_path_depth
from .plausibility import data_warnings
from .preview import Preview
from .problem import Problem, pixels_of, problem_of
from .regularizers import is_anchored
from .run_folder import Origin, RunFolder
from .same_on_ranks import require_same_state, what_ranks_share
from .sharing import kept_whole
from .solved import Solved
from .state import State, initial_state
from .step import TrainingStep
from .told_scale import told_convention
from .validation import Score
from .warm_start import solved_again, start_radiance, told_start, warm_start, with_solved_field

#: Seconds after the last line from which on it is told what a fit does before its first step.
_SOON = 3.0


@final
@dataclass(frozen=True)
class FitInput:
    """What a fit is asked to do.

    Args:
        data: folder of the data set.
        folder: of the run.
        config: the settings.
        resume: whether a run in the folder goes on.
        clip_negative: take negative pixels as zero, also where the run that goes on did not.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        allow_doubtful: begin also where the data are surely wrong, with a warning.
        solved: where L_θ starts; None: untrained, or as the run that goes on has it.
    """

    data: Path
    folder: RunFolder
    config: FitConfig
    resume: bool = False
    clip_negative: bool = False
    allow_outside: bool = False
    allow_doubtful: bool = False
    solved: Solved | None = None


@final
@dataclass(frozen=True)
class Begun:
    """A fit before its first step, or before it goes on."""

    config: FitConfig  #: with the defaults of the method and the data
    origin: Origin
    problem: Problem
    step: TrainingStep
    state: State
    progress: Progress  #: how far it is, at first that of a checkpoint; steps add to it
    restored: bool  #: whether there was such a checkpoint
    preview: Preview | None  #: None on ranks that show nothing
    score: Score | None
    aside: HeldAside | None  #: None where no pixels are held aside
    photographs: HeldOutPhotographs | None  #: the same, or the truth of held-out views is known
    views: list[str]  #: names of those that it learns from


def begin(asked: FitInput, console: Console, ranks: Ranks) -> Begun:
    """Read all input, and check it; nothing is written but the cache of the data set.

    Args:
        console: where warnings and what a fit has chosen are told, and what it does where that
            takes long.
        ranks: that begin together, in work of `Ranks.together`.

    Raises:
        UserError: the data set or the run cannot be used, or the data are doubtful.
    """
    resume, solved = asked.resume, asked.solved
    config = asked.config if solved is None else with_solved_field(asked.config, solved)
    doing = _doing(console)
    dataset = Dataset.load(asked.data, allow_outside=asked.allow_outside)
    before = asked.folder.origin() if resume else None
    recovered = None if resume else told_unknown(config, dataset)
    if not resume:
        doing("choosing the sizes of fields")
    config = with_path_depth(config, dataset) if resume else with_defaults(config, dataset)
    clip_negative = asked.clip_negative or (before is not None and before.clip_negative)
    doing("reading the files of the data set")
    files = _require_same_input(config, dataset, ranks)
    whole = None
    if ranks.size > 1:  # as the first one has it: rays may differ between machines
        own = ranks.together(lambda: kept_whole(config, dataset, ranks), math.inf)
        whole = ranks.gather(own)[0]
    if whole is not None:
        console.print(f"each process reads all photographs: {whole}", highlight=False)
    dealing = None if whole is not None else ranks
    doing("reading photographs")
    pixels = pixels_of(dataset, config, clip_negative=clip_negative, ranks=dealing, tell=doing.now)
    pixels = pixels.holding_aside(config.held_aside, config.seed)
    origin = _origin(asked, before, pixels, files, clip_negative=clip_negative)
    if before is not None:
        pixels = pixels.at_level(origin.photographs_level)
    problem, warnings = _problem(asked, config, dataset, pixels, origin, ranks, doing)
    for warning in warnings:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    step = TrainingStep(problem, pixels, config, ranks)
    for line in (
        recovered,
        None if solved is None else told_start(solved, config),
        told_depth(config, dataset) if config.follows_paths else None,
        told_convention(problem) if is_anchored(problem, config) and not resume else None,
    ):
        if line is not None:
            console.print(line, highlight=False, soft_wrap=True)
    doing("preparing the first step, for which kernels are compiled")
    state, restored = _state(problem, step, asked.folder if resume else None, origin, console)
    preview = Preview(problem, dataset, asked.folder) if ranks.leads else None
    scored = config.learns_materials and config.score_seconds
    shared = config.shares_scale
    score = Score(problem, dataset.heldout, shares_scale=shared) if scored else None
    compared = () if preview is None or preview.has_truth else dataset.heldout
    aside, photographs = _probes(step, problem, dataset, compared, clip_negative)
    step.require_memory(state)
    return Begun(
        config=config,
        origin=origin,
        problem=problem,
        step=step,
        state=state,
        progress=restored or Progress(),
        restored=restored is not None,
        preview=preview,
        score=score,
        aside=aside,
        photographs=photographs,
        views=[view.name for view in dataset.train],
    )


def _doing(console: Console) -> Paced:
    """Tells what a fit does, unless something was told of it a moment before."""

    def tell(line: str) -> None:
        console.print(line, highlight=False, markup=False, soft_wrap=True)

    return Paced(tell, _SOON)


def _origin(
    asked: FitInput,
    before: Origin | None,
    pixels: PixelSource,
    files: dict[str, str],
    *,
    clip_negative: bool,
) -> Origin:
    """Where a run comes from; one that goes on keeps most of it.

    Args:
        before: of the run that goes on.
        pixels: to train on.
        files: the data set's fingerprint.

    Raises:
        UserError: the run that goes on was started with other data.
    """
    origin = Origin(
        data=str(asked.data.resolve()),
        mean_radiance=pixels.photographs.mean,
        level=pixels.photographs.level,
        clip_negative=clip_negative,
        run=uuid.uuid4().hex if before is None else before.run,
        fingerprint=files,
        warm_start=None if asked.solved is None else warm_start(asked.solved),
    )
    if before is None:
        return origin
    _require_same_data(asked.folder, before, origin)
    kept = ("mean_radiance", "level", "warm_start", "machines")
    return dataclasses.replace(origin, **{name: getattr(before, name) for name in kept})


def _problem(
    asked: FitInput,
    config: FitConfig,
    dataset: Dataset,
    pixels: PixelSource,
    origin: Origin,
    ranks: Ranks,
    doing: Paced,
) -> tuple[Problem, list[str]]:
    """The problem as it begins, and warnings where something is odd about it or the data.

    Args:
        config: with the defaults of the method and the data.
        doing: called with what is done.

    Raises:
        UserError: as of `begin`.
    """
    doing("making the scene")
    problem = problem_of(dataset, config, origin.photographs_level)
    if problem.camera is not None or problem.light_is_unknown:
        doing("finding where cameras and lights begin")
    untold = begin_cameras(problem, dataset, pixels, ranks)
    begin_lights(problem, pixels, ranks)
    if problem.radiance is not None:
        problem.radiance.scale = origin.radiance_scale
    odd = [] if asked.solved is None else start_radiance(problem, asked.solved)
    doing("checking the data")
    allowed = asked.allow_doubtful or asked.resume
    doubts = data_warnings(dataset, pixels, problem, allow_doubtful=allowed)
    if untold is not None and not asked.resume:
        doubts.append(untold)
    return problem, [*odd, *doubts]


def _state(
    problem: Problem,
    step: TrainingStep,
    folder: RunFolder | None,
    origin: Origin,
    console: Console,
) -> tuple[State, Progress | None]:
    """The state that a fit begins with, and its progress if that is one of a checkpoint.

    Args:
        folder: of a run that goes on; None: it is new.
    """
    state = initial_state(problem)
    # A resumed fit plans with the first state, too, and so goes on as if it had not stopped.
    step.plan(state)
    restored = None if folder is None else load_checkpoint(folder, state)
    if folder is not None and restored is None:
        console.print("the run has no checkpoint yet: it begins again", highlight=False)
        if origin.warm_start is not None:
            start_radiance(problem, solved_again(origin.warm_start))
            state = initial_state(problem)
    return state, restored


def agree(begun: Begun, ranks: Ranks) -> None:
    """Check that all ranks begin with the same state; from then on each has its share of the cores.

    Raises:
        Agreed: they do not.
    """
    if ranks.size == 1:
        return
    ranks.require_same({"length so far": json.dumps(begun.progress.counted())})
    require_same_state(begun.state, ranks)
    backend.share_cores(ranks.here, least=1)  # all is read


def _require_same_input(config: FitConfig, dataset: Dataset, ranks: Ranks) -> dict[str, str]:
    """The data set's fingerprint, which all ranks must have, and the same settings.

    It is compared before they share the photographs: that takes the same views on each.

    Raises:
        Agreed: they have not.
    """
    files = ranks.together(lambda: fingerprint(dataset), math.inf)
    ranks.require_same(what_ranks_share(to_toml(config), files))
    return files


def _require_same_data(run: RunFolder, before: Origin, now: Origin) -> None:
    """Refuse another data set than that of the run; its folder may have moved."""
    differing = changed(before.fingerprint, now.fingerprint)
    # Other versions may decode the same files a little differently.
    known = "photographs" in before.fingerprint
    if not (known or math.isclose(before.mean_radiance, now.mean_radiance, rel_tol=1e-4)):
        differing = ["photographs", *differing]
    if differing:
        what = "this is not the data set that the run {} was started with: other {}"
        raise UserError(
            what.format(run.path, ", ".join(differing)),
            where=now.data,
            remedy=f"Give {before.data} as it was, or start another run",
        )


def _probes(
    step: TrainingStep,
    problem: Problem,
    dataset: Dataset,
    compared: Sequence[View],
    clip_negative: bool,
) -> tuple[HeldAside | None, HeldOutPhotographs | None]:
    """What is measured beside the training, from photographs alone.

    Args:
        step: of the fit, with its pixels.
        compared: the held-out views, if this rank compares their photographs.
    """
    every = sum(view.camera.width * view.camera.height for view in dataset.views)
    if every > MOST_PIXELS:
        compared = ()
    rays = CameraRays.of([view.camera for view in (*dataset.train, *compared)])
    held, camera = step.pixels.held_aside(), problem.camera
    aside = photographs = None
    if held is not None:
        exposures = step.pixels.exposures
        aside = HeldAside(step, rays, held, step.config, camera=camera, exposures=exposures)
    if compared:
        photographs = HeldOutPhotographs(
            step,
            rays,
            dataset,
            step.config,
            clip_negative=clip_negative,
            camera=camera,
            poses=problem.poses,
        )
    return aside, photographs
