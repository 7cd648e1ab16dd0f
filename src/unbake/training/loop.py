"""A fit: what it begins with, its folder, and the loop of its steps (`_Training.run`)."""

from __future__ import annotations

import dataclasses
import math
import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, final

import drjit as dr
import mitsuba as mi
from rich.console import Console

from ..config import FitConfig, to_toml
from ..config.fit import READ_EVERY
from ..errors import UserError, require_kind
from ..machine import machine
from ..ranks import Ranks
from ..signals import deferred
from .beginning import Begun, FitInput, agree, begin
from .checkpoint import Progress
from .first_lights import release_lights
from .held_aside import ERROR, ErrorCurve
from .memory import memory_mb
from .monitor import Monitor
from .roughness_search import RoughnessSearch
from .run_folder import RunFolder
from .run_lock import RunLock
from .same_on_ranks import require_same_state
from .saving import Saving
from .schedule import learning_rates
from .solved import read_solved
from .told_scale import weigh_convention
from .warm_start import OPTION
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
    require_kind(config, FitConfig, "config", 'unbake.preset("cpu")')
    ranks = ranks or Ranks()
    console = console or Console()
    if not ranks.leads:
        console = Console(quiet=True)
    folder = RunFolder(Path(run))
    with ExitStack() as held:

        def locked() -> RunLock | None:
            return held.enter_context(folder.lock()) if ranks.leads else None

        def ready() -> tuple[Begun, RunLock | None]:
            lock, solved = None, None
            if resume:
                if radiance_from is not None:
                    remedy = "A run that goes on has a radiance field already"
                    raise UserError("cannot be given together with --resume", OPTION, remedy)
                folder.require_resumable()
                lock = locked()
            else:
                folder.require_new()
                solved = None if radiance_from is None else read_solved(radiance_from)
            asked = FitInput(
                Path(data),
                folder,
                _resumed_config(folder, config) if resume else config,
                resume=resume,
                clip_negative=clip_negative and not resume,
                allow_outside=allow_outside,
                allow_doubtful=allow_doubtful,
                solved=solved,
            )
            return begin(asked, console, ranks), lock

        def make() -> RunLock | None:
            lock = locked()
            folder.require_new()
            return lock

        with ranks.apart():  # some may read for longer than others
            begun, lock = ranks.together(ready)
            agree(begun, ranks)
        if not resume:  # here all input is known to be good, and the folder is made
            lock = ranks.together(make)
        stop = held.enter_context(deferred())
        monitor = _prepare_folder(begun, folder, lock, console, tensorboard=tensorboard)
        training = _Training(begun, folder, lock, monitor, ranks)
        stopped = training.run(stop)
    progress = begun.progress
    if stopped:
        console.print(f"stopped at step {progress.step}; go on with --resume", highlight=False)
    return progress


def _resumed_config(run: RunFolder, config: FitConfig) -> FitConfig:
    """The settings a run was started with, but for how long it should go on."""
    return dataclasses.replace(run.settings(), steps=config.steps, seconds=config.seconds)


def _prepare_folder(
    begun: Begun, folder: RunFolder, lock: RunLock | None, console: Console, *, tensorboard: bool
) -> Monitor:
    """Write what makes the folder one of a run that can be resumed: its origin and settings.

    Lines of the log about steps that will be taken again are removed.

    Args:
        lock: of the folder; without one nothing is written, and what is logged goes nowhere.
        tensorboard: whether numbers are written for it.

    Returns:
        What tells and logs the fit.
    """
    config, progress = begun.config, begun.progress
    over = _is_over(config, progress)
    if begun.restored:
        more = f"going on after step {progress.step}"
        none = f"the run has {progress.step} steps already, and is to have no more"
        console.print(none if over else more, highlight=False)
    log, events = Path(os.devnull), None
    if lock is not None:
        folder.sweep()
        folder.forget_after(progress.step)
        folder.write_origin(begun.origin if over else begun.origin.on(machine()))
        folder.write_settings(config)  # from here on there is a run
        log = folder.log_file
        events = folder.events(progress.step + 1) if tensorboard else None
    return Monitor(log, console, _length(config), events)


@final
class _Training:
    """The steps of a fit that are left, and what goes on beside them.

    Args:
        begun: the fit.
        folder: of the run.
        lock: of the folder; None on ranks that write nothing.
        monitor: tells and logs what goes on.
        ranks: that take the steps together.
    """

    def __init__(
        self,
        begun: Begun,
        folder: RunFolder,
        lock: RunLock | None,
        monitor: Monitor,
        ranks: Ranks,
    ) -> None:
        config, progress, origin = begun.config, begun.progress, begun.origin
        about = {"run": origin.run, "seed": config.seed, "data": origin.fingerprint}
        about["settings"] = to_toml(config)
        self._begun, self._lock, self._monitor, self._ranks = begun, lock, monitor, ranks
        self._saving = Saving(folder, lock, about, config.checkpoint_seconds, progress.seconds)
        self._errors = ErrorCurve(begun.aside, config, _measured_before(folder), progress)
        self._watchdog = Watchdog(begun.state, begun.step, progress, begun.views)
        self._search = _searches(begun, ranks)
        self._shown_at = self._scored_at = progress.seconds
        begun.step.pixels.photographs.expect_random()
        self._clock = 0.0  # when training began, but for the times at which it stood still

    def run(self, stop: list[int]) -> bool:
        """Take the steps; returns whether the fit was stopped.

        Args:
            stop: fills at any moment, when the fit should end.

        Raises:
            UserError: the loss does not stay finite, the fit diverges twice, there is no memory, or
                what was learned cannot be saved.
        """
        begun, ranks, monitor = self._begun, self._ranks, self._monitor
        config, progress, state, score = begun.config, begun.progress, begun.state, begun.score
        unknown = next(iter(state.phi)).partition(".")[0]  # the first one, whose rate is logged
        recent: list[dict[str, mi.Float]] = []
        failures: list[UserError] = []  # to write what was due last
        stopped, last = False, self._over
        with monitor:
            if score is not None and not progress.step:
                monitor.record(0.0, _log_entry([], progress, 0.0) | {"score": score.measure()})
            self._start_clock()
            if last and not begun.restored:  # nothing to learn: untrained fields are the result
                failures = [*self._saving.save(state, progress), *self._show()]
            # `stop` may fill at any moment: looked at in one place, so that no fit ends unsaved.
            while not last:
                rates = self._rates()
                recent.append(begun.step(state, progress.step, rates))
                progress.step += 1
                progress.samples += config.samples_per_step
                # It does not wait for the machine, so that slow steps are saved in time, too.
                # A state that may be taken back is not saved, and not read sooner for it.
                save = self._watchdog.trusts and self._saving.due(time.perf_counter() - self._clock)
                # What depends on a clock is the same on all ranks from here on: as rank 0 says.
                measure = ranks.leads and self._errors.due(progress)
                stopped, save, measure = ranks.any(bool(stop), save, measure)
                last = self._over or stopped
                full = len(recent) >= READ_EVERY
                timed = config.seconds or score is not None
                if full or last or save or measure or (timed and progress.step % TIME_EVERY == 0):
                    self._read_clock()
                self._search_if_due()
                last = last or self._over
                rated = score is not None and (
                    last or progress.seconds - self._scored_at >= config.score_seconds
                )
                if not (full or last or rated or save or measure):
                    continue

                begun.step.unite(state)
                readings = begun.step.read(recent)
                recent.clear()
                ranks.announce()  # rank 0 writes, and may measure for minutes
                # Scores, checkpoints and previews are not training: the clock stands still.
                ended = last and not stopped  # one that was stopped is not judged by its few steps
                entry = _log_entry(readings, progress, rates[unknown])
                self._measure(entry, scores=rated, errors=measure or ended)
                self._saving.require_held()
                monitor.record(_done(config, progress), entry)
                self._watch(readings, ended=ended, stopped=stopped)
                ranks.announce()  # again, where ranks told each other something since
                failures = self._keep(save=save, last=last)
                self._start_clock()
                require_same_state(state, ranks)
            if ranks.of_first(not stopped and not failures):
                self._judge()
        for failure in [*failures, *monitor.failures]:
            raise failure
        return stopped

    def _rates(self) -> dict[str, float]:
        """The learning rates of the next step, for which lights and their scale are let go in time.

        They depend on how much is done: on steps, or on time where time is the limit.
        """
        step, done = self._begun.progress.step, self._fraction
        release_lights(self._begun.problem, done)
        weigh_convention(self._begun.problem, self._begun.config, done)
        rates = learning_rates(self._begun.config, step, done)
        return self._watchdog.rates(self._search.rates(rates, step, done))

    @property
    def _fraction(self) -> float:
        """How much of the steps is done, in [0, 1]."""
        return _fraction(self._begun.config, self._begun.progress, self._search)

    @property
    def _over(self) -> bool:
        return _is_over(self._begun.config, self._begun.progress)

    def _start_clock(self) -> None:
        """Let the clock go on from the training time so far."""
        self._clock = time.perf_counter() - self._begun.progress.seconds

    def _read_clock(self) -> None:
        """Wait for the machine, and note the training time, the same on all ranks."""
        dr.sync_thread()
        self._begun.progress.seconds = self._ranks.of_first(time.perf_counter() - self._clock)

    def _search_if_due(self) -> None:
        """Search for roughness, if that is due: its samples and its time are those of the fit.

        Raises:
            UserError: there is no memory for it.
        """
        if not self._watchdog.trusts:
            return  # a state that may be taken back: it comes after that
        state, progress = self._begun.state, self._begun.progress
        before, seconds = progress.seconds, self._begun.config.seconds
        if seconds and progress.last_search > seconds - before:
            return  # there is no time for another one
        try:
            samples = self._search.search_if_due(self._fraction, state, progress.step)
        except UserError:  # the state is that of before: a search leaves what it finds at its end
            progress.searches = self._search.passed(self._fraction)  # it is not tried again
            self._saving.save(state, progress)
            raise
        if samples:  # on all ranks
            progress.samples += samples
            progress.searches, progress.searched = self._search.made, self._search.searched
            self._read_clock()
            progress.last_search = progress.seconds - before
            progress.searching += progress.last_search
            self._watchdog.keep()

    def _measure(self, entry: dict[str, Any], *, scores: bool, errors: bool) -> None:
        """Add to a line of the log what is due.

        Args:
            scores: against the true materials.
            errors: on held-aside pixels.
        """
        begun = self._begun
        if scores and begun.score is not None:
            begun.state.publish(begun.problem)
            entry["score"] = begun.score.measure()
            self._scored_at = begun.progress.seconds
        if errors:
            self._errors.measure(begun.state, entry, begun.progress)

    def _watch(self, readings: list[dict[str, float]], *, ended: bool, stopped: bool) -> None:
        """Let the watchdog look at the last steps. If it gives up, the last good state is saved.

        Args:
            ended: whether the fit ends with these.
            stopped: whether it was stopped before its end.
        """
        progress, monitor = self._begun.progress, self._monitor
        try:
            told = self._watchdog.read(readings, last=ended)
            told += self._watchdog.settle() if stopped else []
            for line in told:
                monitor.note(progress.step, progress.seconds, line)
        except UserError as error:
            monitor.note(progress.step, progress.seconds, str(error), say=False)
            self._saving.save(self._begun.state, progress)
            raise

    def _keep(self, *, save: bool, last: bool) -> list[UserError]:
        """Save and show what is due.

        Args:
            save: whether a checkpoint is due.
            last: whether no step follows.

        Returns:
            Why something could not be written.
        """
        state, progress = self._begun.state, self._begun.progress
        failures: list[UserError] = []
        if last or (save and self._watchdog.trusts):
            failures += self._saving.save(state, progress)
        if last or progress.seconds - self._shown_at >= self._begun.config.preview_seconds:
            failures += self._show()
            self._shown_at = progress.seconds
        for failure in () if last else failures:
            self._monitor.say(f"warning: {failure}; the fit goes on, and tries again later")
        return failures

    def _judge(self) -> None:
        """Note what is wrong with a fit that has ended, or tell whether it was still improving."""
        config, progress = self._begun.config, self._begun.progress
        progress.warning = self._watchdog.verdict(learning_rates(config, progress.step, 0.0))
        if progress.warning is not None:
            monitor, at = self._monitor, (progress.step, progress.seconds)
            monitor.note(*at, progress.warning, verdict=True)
            return
        for line in [*self._unreached(), *self._errors.told()]:
            self._monitor.say(line)

    def _unreached(self) -> list[str]:
        """A line if no photograph depends on the strength of a lamp, which is where it began."""
        begun = self._begun
        emission = begun.problem.emission
        if emission is None or not begun.progress.step:
            return []
        unreached = begun.state.unreached("emission.log", 3)
        names = [begun.problem.emitter_names[i] for i in unreached if i not in emission.held]
        if not names:
            return []
        return [
            f"warning: no photograph depends on the strength of {', '.join(names)}, along the "
            "bounces of this method: it is where it began. Try more --bounces, or --method prb"
        ]

    def _show(self) -> list[UserError]:
        """Show a preview, or return why it cannot be written; nothing without a lock."""
        begun = self._begun
        if self._lock is None or begun.preview is None:
            return []
        begun.state.publish(begun.problem)
        counted = begun.progress.counted()
        try:
            lines = begun.preview.show(begun.progress)
        except UserError as error:
            return [error]
        if begun.photographs is not None:
            found = begun.photographs.measure(begun.state)
            lines += [{**counted, "validation": found}] if found else []
        elif not lines and begun.aside is not None:
            found = begun.aside.measure(begun.state)
            if ERROR in found:
                lines.append({**counted, "validation": {ERROR: found[ERROR]}})
        for line in lines:
            self._monitor.validation(line)
        return []


def _searches(begun: Begun, ranks: Ranks) -> RoughnessSearch:
    """The searches of a fit, some of which may have been made before."""
    config, progress = begun.config, begun.progress
    search = RoughnessSearch(begun.problem, config, begun.step, ranks)
    search.made, search.searched = progress.searches or 0, progress.searched
    passed = search.passed(_fraction(config, progress, search))
    if progress.searches is None:  # older versions made all in their places
        search.made = search.searched = passed
    elif progress.timed not in (None, bool(config.seconds)) or _length(config) > progress.length:
        # In a longer fit than before, places lie later. The first search there replaces what those
        # of the shorter fit have found, and until then steps leave it alone.
        search.made = min(search.made, passed)
        search.searched = min(search.searched, max(1, search.made))
        progress.last_search = 0.0
    progress.searches, progress.searched = search.made, search.searched
    progress.length, progress.timed = _length(config), bool(config.seconds)
    return search


def _measured_before(folder: RunFolder) -> list[dict]:
    """Lines of the log of the steps before, with errors on held-aside pixels."""
    try:
        return [line for line in folder.log() if ERROR in line]
    except UserError:  # what a user made of the log is no reason not to go on
        return []


def _length(config: FitConfig) -> float:
    """How long a fit is to be, in seconds or in steps."""
    return config.seconds or config.steps


def _done(config: FitConfig, progress: Progress) -> float:
    """How much of it is done, in the same unit."""
    return progress.seconds if config.seconds else progress.step


def _fraction(config: FitConfig, progress: Progress, search: RoughnessSearch) -> float:
    """How much of the steps is done, in [0, 1].

    Time that searches take is not theirs: rates would fall while nothing is learned.
    """
    if not config.seconds:
        return progress.step / (config.steps or 1)
    steps = progress.seconds - progress.searching
    searching = progress.searching + search.seconds_left(progress, config.seconds)
    return min(1.0, steps / max(config.seconds - searching, 1e-9))


def _is_over(config: FitConfig, progress: Progress) -> bool:
    return _done(config, progress) >= _length(config)


def _log_entry(readings: list[dict[str, float]], progress: Progress, rate: float) -> dict[str, Any]:
    """A line of the log: means over the steps since the last one."""
    entry = progress.counted()
    for term in readings[0] if readings else ():
        values = [reading[term] for reading in readings]
        if term == "skipped":
            entry[term] = sum(value > 0 for value in values)  # of several processes it is a mean
            continue
        finite = [v for v in values if math.isfinite(v)]
        entry[term] = sum(finite) / len(finite) if finite else math.nan
    entry |= {
        "samples_per_second": progress.samples / max(progress.seconds, 1e-9),
        "memory_mb": memory_mb(),
        "learning_rate": rate,
    }
    return entry
