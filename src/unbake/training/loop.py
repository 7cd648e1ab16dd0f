"""The training loop, top to bottom."""

from __future__ import annotations

import dataclasses
import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import drjit as dr
import mitsuba as mi
from rich.console import Console

from ..config import FitConfig
from ..dataset.views import Dataset
from ..errors import UserError
from .checkpoint import Progress, load_checkpoint, save_checkpoint
from .defaults import with_defaults
from .memory import memory_mb
from .monitor import Monitor
from .path_depth import told_depth, with_path_depth
from .preview import Preview
from .problem import camera_warnings, make_problem, training_pixels
from .run_folder import Origin, RunFolder
from .schedule import learning_rates
from .state import initial_state
from .step import TrainingStep
from .validation import Score

#: Steps between readings of the loss; reading waits for the machine.
READ_EVERY = 20
#: Steps between looks at the clock, where time is the limit or decides when to score. Looking waits
#: for the machine, too.
TIME_EVERY = 4
#: Consecutive steps without a finite loss after which a fit gives up.
GIVE_UP_AFTER = 100


def fit(  # noqa: C901, PLR0912, PLR0915 - the loop in one piece, top to bottom
    data: Path | str,
    run: Path | str,
    config: FitConfig,
    *,
    resume: bool = False,
    clip_negative: bool = False,
    console: Console | None = None,
) -> Progress:
    """Recover materials or lighting of a scene from its photographs.

    Args:
        data: a data set's folder, with `transforms.json`.
        run: the folder to write: settings, log, checkpoints and previews.
        config: what to do; ignored, but for `steps` and `seconds`, when resuming. With no steps
            and no seconds the run has untrained fields.
        resume: go on with the run's newest checkpoint.
        clip_negative: take negative pixels as zero.

    Returns:
        How far the fit came. Ctrl-C ends it early, with a checkpoint.

    Raises:
        UserError: the data set or the run's folder cannot be used, or the loss does not stay
            finite.

    Paper: Sec. 4, 5.4.
    """
    console = console or Console()
    data, run = Path(data), Path(run)
    folder = RunFolder(run)
    if resume:
        config = _resumed_config(folder, config)
    else:
        folder.require_new()
    dataset = Dataset.load(data)
    config = with_path_depth(config, dataset) if resume else with_defaults(config, dataset)
    clip_negative = clip_negative or (resume and folder.origin().clip_negative)
    pixels = training_pixels(
        dataset, clip_negative=clip_negative, smoothed=config.loss_reference == "smoothed"
    )
    mean_radiance = pixels.photographs.mean
    if resume:
        _require_same_photographs(folder, data, mean_radiance)
    problem = make_problem(dataset.scene, dataset.background, config, mean_radiance)
    for warning in camera_warnings(dataset, problem.scene_view.scene):
        console.print(f"warning: {warning}", style="yellow", markup=False, soft_wrap=True)

    if config.follows_paths:
        console.print(told_depth(config, dataset), highlight=False, soft_wrap=True)
    state = initial_state(problem)
    # A resumed fit plans with the first state, too, and so goes on as if it had not stopped.
    step = TrainingStep(problem, pixels, config)
    step.plan(state)
    restored = load_checkpoint(folder, state) if resume else None
    progress = restored or Progress()
    if resume:
        console.print(f"going on after step {progress.step}", highlight=False)
    preview = Preview(problem, dataset, folder)
    scored = config.learns_materials and config.score_seconds
    score = Score(problem, dataset.heldout) if scored else None
    step.require_memory(state)
    # Here all input is known to be good, and the folder is made.
    folder.write_origin(Origin(str(data.resolve()), mean_radiance, clip_negative))
    folder.write_settings(config)
    folder.forget_after(progress.step)

    unknown = next(iter(state.phi)).partition(".")[0]  # the first one, whose rate is logged
    total = config.seconds or config.steps
    saved_at = shown_at = scored_at = progress.seconds
    recent: list[dict[str, mi.Float]] = []
    skipped = 0
    with Monitor(folder.log_file, console, total) as monitor, _stop_on_interrupt() as stop:
        if score is not None and not progress.step:
            monitor.record(0.0, _log_entry([], progress, 0.0) | {"score": score.measure()})
        clock = time.perf_counter() - progress.seconds
        # `stop` may fill at any moment: looked at in one place, so that no fit ends unsaved.
        last = _done(config, progress) >= total
        if last and restored is None:  # nothing to learn: the untrained fields are the result
            save_checkpoint(folder, state, progress)
            state.publish(problem)
            for line in preview.show(progress):
                monitor.validation(line)
        while not last:
            # Rates depend on how much is done: on steps, or on time where time is the limit.
            done = _done(config, progress) / total
            rates = learning_rates(config, progress.step, done)
            recent.append(step(state, progress.step, rates))
            progress.step += 1
            progress.samples = progress.step * config.samples_per_step
            last = _done(config, progress) >= total or bool(stop)

            full = len(recent) >= READ_EVERY
            timed = config.seconds or score is not None
            if full or last or (timed and progress.step % TIME_EVERY == 0):
                dr.sync_thread()
                progress.seconds = time.perf_counter() - clock
                last = last or _done(config, progress) >= total
            due = score is not None and progress.seconds - scored_at >= config.score_seconds
            if not (full or last or due):
                continue

            entry = _log_entry(recent, progress, rates[unknown])
            skipped = skipped + entry["skipped"] if entry["skipped"] == len(recent) else 0
            recent.clear()
            # Scores, checkpoints and previews are not training: the clock stands still.
            if score is not None and (due or last):
                state.publish(problem)
                entry["score"] = score.measure()
                scored_at = progress.seconds
            monitor.record(_done(config, progress), entry)
            if skipped >= GIVE_UP_AFTER:
                raise UserError(
                    f"the loss was not finite in the last {skipped} steps",
                    where=run,
                    remedy="Lower the learning rates, or look for extreme pixels in the images",
                )
            if last or progress.seconds - saved_at >= config.checkpoint_seconds:
                save_checkpoint(folder, state, progress)
                saved_at = progress.seconds
            if last or progress.seconds - shown_at >= config.preview_seconds:
                state.publish(problem)
                for line in preview.show(progress):
                    monitor.validation(line)
                shown_at = progress.seconds
            clock = time.perf_counter() - progress.seconds
    if stop:
        console.print(f"stopped at step {progress.step}; go on with --resume", highlight=False)
    return progress


def _done(config: FitConfig, progress: Progress) -> float:
    return progress.seconds if config.seconds else progress.step


def _log_entry(recent: list[dict[str, mi.Float]], progress: Progress, rate: float) -> dict:
    """A line of the log: means over the steps since the last one."""
    entry: dict = {
        "step": progress.step,
        "seconds": progress.seconds,
        "samples": progress.samples,
    }
    for term in recent[0] if recent else ():
        values = [float(losses[term][0]) for losses in recent]
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
    run.require_resumable()
    return dataclasses.replace(run.settings(), steps=config.steps, seconds=config.seconds)


def _require_same_photographs(run: RunFolder, data: Path, mean_radiance: float) -> None:
    """Refuse other photographs than those of the run; the data set may have moved."""
    origin = run.origin()
    if not math.isclose(origin.mean_radiance, mean_radiance, rel_tol=1e-4):
        raise UserError(
            f"these are not the photographs that the run {run.path} was started with",
            where=data,
            remedy=f"Give {origin.data}, or start another run",
        )


@contextmanager
def _stop_on_interrupt() -> Iterator[list[bool]]:
    """A list that fills on Ctrl-C or SIGTERM; a second Ctrl-C ends the program at once.

    In another thread than the main one signals cannot be handled, and the list stays empty.
    """
    stop: list[bool] = []
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handler(number: int, frame: object) -> None:
        if stop:
            raise KeyboardInterrupt
        stop.append(True)

    previous = {s: signal.signal(s, handler) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for s, old in previous.items():
            signal.signal(s, old)
