"""The training loop, top to bottom."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import time
import uuid
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
from rich.console import Console

from .. import backend
from ..config import FitConfig, to_toml
from ..config.fit import READ_EVERY
from ..dataset.fingerprint import changed, fingerprint
from ..dataset.photographs import MOST_PIXELS
from ..dataset.pixels import CameraRays, PixelSource
from ..dataset.views import Dataset
from ..errors import UserError
from ..machine import machine
from ..ranks import Ranks
from ..signals import deferred
from ..version import VERSION
from .checkpoint import Progress, load_checkpoint, state_digest
from .defaults import told_unknown, with_defaults
from .event_log import EventLog
from .first_gains import begin_cameras
from .held_aside import ERROR, ErrorCurve, HeldAside, HeldOutPhotographs
from .memory import memory_mb
from .monitor import Monitor
from .path_depth import told_depth, with_path_depth
from .plausibility import data_warnings
from .preview import Preview
from .problem import Problem, pixels_of, problem_of
from .roughness_search import RoughnessSearch
from .run_folder import Origin, RunFolder
from .run_lock import RunLock
from .saving import Saving
from .schedule import learning_rates
from .sharing import kept_whole
from .solved import Solved, read_solved
from .state import State, initial_state
from .step import TrainingStep
from .validation import Score
from .warm_start import (
    OPTION,
    solved_again,
    start_radiance,
    told_start,
    warm_start,
    with_solved_field,
)
from .watchdog import Watchdog

#: Steps between looks at the clock, where time is the limit or decides when to score. Looking waits
#: for the machine, too.
TIME_EVERY = 4


def fit(
    data: Path | str,
    run: Path | str,
    config: FitConfig,
    *,
    resume: bool = False,
    clip_negative: bool = False,
    allow_outside: bool = False,
    allow_doubtful: bool = False,
    tensorboard: bool = False,
    radiance_from: Path | str | None = None,
    console: Console | None = None,
    ranks: Ranks | None = None,
) -> Progress:
    """Recover materials or lighting of a scene from its photographs.

    Args:
        data: a data set's folder, with `transforms.json`.
        run: the folder to write: settings, log, checkpoints and previews. It is locked meanwhile.
        config: what to do; ignored, but for `steps` and `seconds`, when resuming. With no steps
            and no seconds the run has untrained fields.
        resume: go on with the run's newest checkpoint.
        clip_negative: take negative pixels as zero.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        allow_doubtful: begin also where poses seem to have other axes or units, or light seems to
            turn with the cameras, which is otherwise an error; told as a warning.
        tensorboard: write the numbers of the log for TensorBoard, too.
        radiance_from: a folder that `solve` or `fine_tune` wrote: L_θ starts as that field instead
            of untrained, with its settings; not when resuming. The materials that it was solved
            with do not count.
        ranks: of MPI, which fit together and all call this; None: this process is alone. Rank 0
            alone writes; the others read data set and run.

    Returns:
        How far the fit came, and what is wrong with it. SIGINT (Ctrl-C), SIGTERM and SIGHUP end it
        early, with a checkpoint.

    Raises:
        UserError: the data set or the run's folder cannot be used, the data are doubtful, what was
            learned cannot be saved, the loss does not stay finite, the fit diverges twice, or the
            solved field is of another scene or other settings.

    Paper: Sec. 4, 5.4.
    """
    ranks = ranks or Ranks()
    console = console or Console()
    if not ranks.leads:
        console = Console(quiet=True)
    folder = RunFolder(Path(run))
    with ExitStack() as held:

        def locked() -> RunLock | None:
            return held.enter_context(folder.lock()) if ranks.leads else None

        def begin() -> tuple[_Begun, RunLock | None]:
            lock = None
            if resume:
                if radiance_from is not None:
                    remedy = "A run that goes on has a radiance field already"
                    raise UserError("cannot be given together with --resume", OPTION, remedy)
                folder.require_resumable()
                lock = locked()
                settings, solved = _resumed_config(folder, config), None
            else:
                folder.require_new()
                settings = config
                solved = None if radiance_from is None else read_solved(radiance_from)
            negative = clip_negative and not resume
            begun = _begin(
                Path(data),
                folder,
                settings,
                console,
                resume,
                negative,
                allow_outside,
                solved,
                ranks,
                allow_doubtful or resume,
            )
            return begun, lock

        def make() -> RunLock | None:
            lock = locked()
            folder.require_new()
            return lock

        with ranks.apart():  # some may read for longer than others
            begun, lock = ranks.together(begin)
            _agree(begun, ranks)
        if not resume:  # here all input is known to be good, and the folder is made
            lock = ranks.together(make)
        stop = held.enter_context(deferred())
        progress, stopped = _train(begun, folder, lock, stop, console, tensorboard, ranks)
    if stopped:
        console.print(f"stopped at step {progress.step}; go on with --resume", highlight=False)
    return progress


@dataclass(frozen=True)
class _Begun:
    """A fit before its first step, or before it goes on."""

    config: FitConfig
    origin: Origin
    problem: Problem
    step: TrainingStep
    state: State
    restored: Progress | None  #: of the checkpoint that it goes on with
    preview: Preview | None  #: None on ranks that show nothing
    score: Score | None
    aside: HeldAside | None  #: None where no pixels are held aside
    photographs: HeldOutPhotographs | None  #: the same, or the truth of held-out views is known
    views: list[str]  #: names of those that it learns from


def _begin(
    data: Path,
    folder: RunFolder,
    config: FitConfig,
    console: Console,
    resume: bool,
    clip_negative: bool = False,
    allow_outside: bool = False,
    solved: Solved | None = None,
    ranks: Ranks | None = None,
    allow_doubtful: bool = False,
) -> _Begun:
    """Read all input, and check it; nothing is written but the cache of the data set.

    Args:
        ranks: that begin together, in work of `Ranks.together`.
    """
    ranks = ranks or Ranks()
    if solved is not None:
        config = with_solved_field(config, solved)
    dataset = Dataset.load(data, allow_outside=allow_outside)
    before = folder.origin() if resume else None
    recovered = None if resume else told_unknown(config, dataset)
    config = with_path_depth(config, dataset) if resume else with_defaults(config, dataset)
    clip_negative = clip_negative or (before is not None and before.clip_negative)
    files = _require_same_input(config, dataset, ranks)
    whole = kept_whole(config, dataset, ranks) if ranks.size > 1 else None
    if whole is not None:
        console.print(f"each process reads all photographs: {whole}", highlight=False)
    dealing = None if whole is not None else ranks
    pixels = pixels_of(dataset, config, clip_negative=clip_negative, ranks=dealing)
    pixels = pixels.holding_aside(config.held_aside, config.seed)
    origin = Origin(
        data=str(data.resolve()),
        mean_radiance=pixels.photographs.mean,
        clip_negative=clip_negative,
        run=uuid.uuid4().hex if before is None else before.run,
        fingerprint=files,
        warm_start=None if solved is None else warm_start(solved),
    )
    if before is not None:
        _require_same_data(folder, before, origin)
        kept = {"warm_start": before.warm_start, "machines": before.machines}
        origin = dataclasses.replace(origin, **kept)
    problem = problem_of(dataset, config, origin.mean_radiance)
    untold = begin_cameras(problem, dataset, pixels)
    if problem.radiance is not None:
        problem.radiance.scale = origin.radiance_scale
    odd = [] if solved is None else start_radiance(problem, solved)
    doubts = data_warnings(dataset, pixels, problem, allow_doubtful=allow_doubtful)
    if untold is not None and not resume:
        doubts.append(untold)
    for warning in [*odd, *doubts]:
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)
    if recovered is not None:
        console.print(recovered, highlight=False, soft_wrap=True)
    if solved is not None:
        console.print(told_start(solved, config), highlight=False, soft_wrap=True)
    if config.follows_paths:
        console.print(told_depth(config, dataset), highlight=False, soft_wrap=True)
    step = TrainingStep(problem, pixels, config, ranks)
    state, restored = _state(problem, step, folder if resume else None, origin, console)
    preview = Preview(problem, dataset, folder) if ranks.leads else None
    scored = config.learns_materials and config.score_seconds
    score = Score(problem, dataset.heldout) if scored else None
    aside, photographs = _probes(problem, dataset, pixels, step, preview, clip_negative)
    step.require_memory(state)
    names = [view.name for view in dataset.train]
    return _Begun(
        config, origin, problem, step, state, restored, preview, score, aside, photographs, names
    )


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


def what_ranks_share(settings: str, files: Mapping[str, Any]) -> dict[str, str]:
    """Version, settings and data set, for `Ranks.require_same`.

    Args:
        settings: as text.
        files: the data set's fingerprint.
    """
    return {
        "version": f"{VERSION}, Mitsuba {mi.__version__}, {mi.variant()}",
        "settings": settings,
        "data set": json.dumps(files, sort_keys=True),
    }


def _require_same_input(config: FitConfig, dataset: Dataset, ranks: Ranks) -> dict[str, str]:
    """The data set's fingerprint, which all ranks must have, and the same settings.

    It is compared before they share the photographs: that takes the same views on each.

    Raises:
        Agreed: they have not.
    """
    files = ranks.together(lambda: fingerprint(dataset), math.inf)
    ranks.require_same(what_ranks_share(to_toml(config), files))
    return files


def _agree(begun: _Begun, ranks: Ranks) -> None:
    """Check that all ranks begin with the same state.

    Raises:
        Agreed: they do not.
    """
    if ranks.size == 1:
        return
    progress = begun.restored or Progress()
    ranks.require_same({"length so far": json.dumps(progress.counted())})
    _require_same_state(begun.state, ranks)
    backend.share_cores(ranks.here, least=1)  # all is read


def _require_same_state(state: State, ranks: Ranks) -> None:
    """Check that the states of all ranks are equal, bit for bit."""
    if ranks.size > 1:
        ranks.require_same({"state": state_digest(state)})


def _probes(
    problem: Problem,
    dataset: Dataset,
    pixels: PixelSource,
    step: TrainingStep,
    preview: Preview | None,
    clip_negative: bool,
) -> tuple[HeldAside | None, HeldOutPhotographs | None]:
    """What is measured beside the training, from photographs alone.

    Args:
        preview: None: held-out photographs are left to the rank that has one.
    """
    compared = [] if preview is None or preview.has_truth else dataset.heldout
    every = sum(view.camera.width * view.camera.height for view in dataset.views)
    if every > MOST_PIXELS:
        compared = []
    rays = CameraRays.of([view.camera for view in (*dataset.train, *compared)])
    held = pixels.held_aside()
    aside = None
    if held is not None:
        aside = HeldAside(
            step, rays, held, step.config, camera=problem.camera, exposures=pixels.exposures
        )
    photographs = None
    if compared:
        photographs = HeldOutPhotographs(
            step,
            rays,
            dataset,
            step.config,
            clip_negative=clip_negative,
            camera=problem.camera,
            poses=problem.poses,
        )
    return aside, photographs


def _train(  # noqa: PLR0915 - the loop in one piece, top to bottom
    begun: _Begun,
    folder: RunFolder,
    lock: RunLock | None,
    stop: list[int],
    console: Console,
    tensorboard: bool,
    ranks: Ranks,
) -> tuple[Progress, bool]:
    """Take the steps that are left.

    Args:
        lock: of the folder; None on ranks that write nothing.
        stop: fills at any moment, when the fit should end.
        tensorboard: whether numbers are written for it.
        ranks: that take the steps together.

    Returns:
        How far the fit came, and whether it was stopped.
    """
    config, problem, state, score = begun.config, begun.problem, begun.state, begun.score
    progress = begun.restored or Progress()
    over = _done(config, progress) >= (config.seconds or config.steps)
    if begun.restored is not None:
        more = f"going on after step {progress.step}"
        none = f"the run has {progress.step} steps already, and is to have no more"
        console.print(none if over else more, highlight=False)
    origin = begun.origin if over else begun.origin.on(machine())
    log, events = _open(begun, origin, folder, lock, progress, tensorboard)
    errors = ErrorCurve(begun.aside, config, _measured_before(folder), progress)

    unknown = next(iter(state.phi)).partition(".")[0]  # the first one, whose rate is logged
    total = config.seconds or config.steps
    about = {"run": begun.origin.run, "seed": config.seed, "data": begun.origin.fingerprint}
    about["settings"] = to_toml(config)
    saving = Saving(folder, lock, about, config.checkpoint_seconds, progress.seconds)
    shown_at = scored_at = progress.seconds
    recent: list[dict[str, mi.Float]] = []
    watchdog = Watchdog(state, begun.step, progress, begun.views)
    search = _searches(begun, progress, ranks)
    failures: list[UserError] = []  # to write what was due last
    stopped = False
    with Monitor(log, console, total, events) as monitor:
        if score is not None and not progress.step:
            monitor.record(0.0, _log_entry([], progress, 0.0) | {"score": score.measure()})
        clock = time.perf_counter() - progress.seconds
        # `stop` may fill at any moment: looked at in one place, so that no fit ends unsaved.
        last = over
        if last and begun.restored is None:  # nothing to learn: the untrained fields are the result
            failures = [*saving.save(state, progress), *_show(begun, monitor, progress, lock)]
        while not last:
            # Rates depend on how much is done: on steps, or on time where time is the limit.
            done = _done(config, progress) / total
            rates = learning_rates(config, progress.step, done)
            rates = watchdog.rates(search.rates(rates, progress.step, done))
            recent.append(begun.step(state, progress.step, rates))
            progress.step += 1
            progress.samples += config.samples_per_step
            # This clock does not wait for the machine, so that slow steps are saved in time, too.
            save = saving.due(time.perf_counter() - clock)
            # What depends on a clock is the same on all ranks from here on: as rank 0 says.
            measure = ranks.leads and errors.due(progress)
            stopped, save, measure = ranks.any(bool(stop), save, measure)
            last = _done(config, progress) >= total or stopped
            full = len(recent) >= READ_EVERY
            timed = config.seconds or score is not None
            if full or last or save or measure or (timed and progress.step % TIME_EVERY == 0):
                dr.sync_thread()
                progress.seconds = ranks.of_first(time.perf_counter() - clock)
                last = last or _done(config, progress) >= total
            now = _done(config, progress) / total
            _search(search, watchdog, now, saving, state, progress, clock, ranks)
            last = last or _done(config, progress) >= total
            due = score is not None and progress.seconds - scored_at >= config.score_seconds
            if not (full or last or due or save or measure):
                continue

            begun.step.unite(state)
            readings = begun.step.read(recent)
            recent.clear()
            entry = _log_entry(readings, progress, rates[unknown])
            ranks.announce()  # rank 0 writes, and may measure for minutes
            # Scores, checkpoints and previews are not training: the clock stands still.
            if score is not None and (due or last):
                state.publish(problem)
                entry["score"] = score.measure()
                scored_at = progress.seconds
            if measure or (last and not stopped):
                errors.measure(state, entry, progress)
            saving.require_held()
            monitor.record(_done(config, progress), entry)
            ended = last and not stopped  # one that was stopped is not judged by its few steps
            _watch(watchdog, readings, monitor, saving, begun, progress, ended)
            ranks.announce()  # again, where ranks told each other something since
            failures = saving.save(state, progress) if last or (save and watchdog.trusts) else []
            if last or progress.seconds - shown_at >= config.preview_seconds:
                failures += _show(begun, monitor, progress, lock)
                shown_at = progress.seconds
            for failure in () if last else failures:
                monitor.say(f"warning: {failure}; the fit goes on, and tries again later")
            clock = time.perf_counter() - progress.seconds
            _require_same_state(state, ranks)
        if ranks.of_first(not stopped and not failures):
            _judge(watchdog, monitor, progress, config, errors)
    for failure in [*failures, *monitor.failures]:
        raise failure
    return progress, stopped


def _open(
    begun: _Begun,
    origin: Origin,
    folder: RunFolder,
    lock: RunLock | None,
    progress: Progress,
    tensorboard: bool,
) -> tuple[Path, EventLog | None]:
    """Make the folder that of the run, without what is of steps that will be taken again.

    Returns:
        The files of the log and for TensorBoard; without a lock what is logged goes nowhere.
    """
    if lock is None:
        return Path(os.devnull), None
    folder.sweep()
    folder.forget_after(progress.step)
    folder.write_origin(origin)
    folder.write_settings(begun.config)  # from here on there is a run, which can be resumed
    return folder.log_file, folder.events(progress.step + 1) if tensorboard else None


def _searches(begun: _Begun, progress: Progress, ranks: Ranks) -> RoughnessSearch:
    """The searches of a fit, some of which may have been made before."""
    config = begun.config
    search = RoughnessSearch(begun.problem, config, begun.step, ranks)
    # In a longer fit than before, places lie later. Older versions made all in their places.
    passed = search.passed(_done(config, progress) / (config.seconds or config.steps or 1))
    search.made = passed if progress.searches is None else min(progress.searches, passed)
    return search


def _search(
    search: RoughnessSearch,
    watchdog: Watchdog,
    done: float,
    saving: Saving,
    state: State,
    progress: Progress,
    clock: float,
    ranks: Ranks,
) -> None:
    """Search for roughness, if that is due: its samples and its time are those of the fit.

    Args:
        search: what searches.
        watchdog: goes back no further than to what is found.
        done: fraction of the fit.
        saving: saves the state where there is no memory for the search.
        state: where what is found is left.
        progress: of the fit.
        clock: when training began, but for the times at which it stood still.
        ranks: that search together.

    Raises:
        UserError: there is no memory for it.
    """
    try:
        samples = search.search_if_due(done, state, progress.step)
    except UserError:  # the state is that of before: a search leaves what it finds at its end
        saving.save(state, progress)
        raise
    if samples:  # on all ranks
        dr.sync_thread()
        progress.samples += samples
        progress.searches = search.made
        progress.seconds = ranks.of_first(time.perf_counter() - clock)
        watchdog.keep()


def _watch(
    watchdog: Watchdog,
    readings: list[dict[str, float]],
    monitor: Monitor,
    saving: Saving,
    begun: _Begun,
    progress: Progress,
    last: bool,
) -> None:
    """Let the watchdog look at the last steps. Where it gives up, the last good state is saved."""
    try:
        for line in watchdog.read(readings, last=last):
            monitor.note(progress.step, progress.seconds, line)
    except UserError as error:
        monitor.note(progress.step, progress.seconds, str(error), say=False)
        saving.save(begun.state, progress)
        raise


def _judge(
    watchdog: Watchdog,
    monitor: Monitor,
    progress: Progress,
    config: FitConfig,
    errors: ErrorCurve,
) -> None:
    """Note what is wrong with a fit that has ended, or tell whether it was still improving."""
    progress.warning = watchdog.verdict(learning_rates(config, progress.step, 0.0))
    if progress.warning is not None:
        monitor.note(progress.step, progress.seconds, progress.warning, verdict=True)
        return
    for line in errors.told():
        monitor.say(line)


def _show(
    begun: _Begun, monitor: Monitor, progress: Progress, lock: RunLock | None
) -> list[UserError]:
    """Show a preview, or return why it cannot be written; nothing without a lock."""
    if lock is None or begun.preview is None:
        return []
    begun.state.publish(begun.problem)
    try:
        lines = begun.preview.show(progress)
    except UserError as error:
        return [error]
    if begun.photographs is not None:
        found = begun.photographs.measure(begun.state)
        lines += [{**progress.counted(), "validation": found}] if found else []
    elif not lines and begun.aside is not None:
        found = begun.aside.measure(begun.state)
        if ERROR in found:
            lines.append({**progress.counted(), "validation": {ERROR: found[ERROR]}})
    for line in lines:
        monitor.validation(line)
    return []


def _measured_before(folder: RunFolder) -> list[dict]:
    """Lines of the log of the steps before, with errors on held-aside pixels."""
    try:
        return [line for line in folder.log() if ERROR in line]
    except UserError:  # what a user made of the log is no reason not to go on
        return []


def _done(config: FitConfig, progress: Progress) -> float:
    return progress.seconds if config.seconds else progress.step


def _log_entry(readings: list[dict[str, float]], progress: Progress, rate: float) -> dict:
    """A line of the log: means over the steps since the last one."""
    entry: dict = progress.counted()
    for term in readings[0] if readings else ():
        values = [reading[term] for reading in readings]
        if term == "skipped":
            entry[term] = int(sum(values))
            continue
        finite = [v for v in values if math.isfinite(v)]
        entry[term] = sum(finite) / len(finite) if finite else math.nan
    entry |= {
        "samples_per_second": progress.samples / max(progress.seconds, 1e-9),
        "memory_mb": memory_mb(),
        "learning_rate": rate,
    }
    return entry


def _resumed_config(run: RunFolder, config: FitConfig) -> FitConfig:
    """The settings a run was started with, but for how long it should go on."""
    return dataclasses.replace(run.settings(), steps=config.steps, seconds=config.seconds)


def _require_same_data(run: RunFolder, before: Origin, now: Origin) -> None:
    """Refuse another data set than that of the run; its folder may have moved."""
    differing = changed(before.fingerprint, now.fingerprint)
    if not math.isclose(before.mean_radiance, now.mean_radiance, rel_tol=1e-4):
        differing = differing or ["photographs"]
    if differing:
        what = "this is not the data set that the run {} was started with: other {}"
        raise UserError(
            what.format(run.path, ", ".join(differing)),
            where=now.data,
            remedy=f"Give {before.data} as it was, or start another run",
        )
