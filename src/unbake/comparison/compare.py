"""Several methods on the same data set, each with its own rates, estimator and warm-up."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import drjit as dr
from rich.console import Console

from .. import backend, signals
from ..config import FitConfig, to_toml
from ..dataset.fingerprint import changed, fingerprint
from ..dataset.views import Dataset
from ..errors import UserError, require_kind
from ..evaluation.convergence import (
    WINDOW,
    milliseconds_per_step,
    score_curve,
    time_to_quality,
)
from ..evaluation.evaluate import description, evaluate, require_true_materials
from ..evaluation.settings import EvaluationSettings
from ..evaluation.yardsticks import can_have_ceiling, find_ceiling, measure_ceiling
from ..io import require_writable_folder, write_json
from ..machine import distinct_machines, machine
from ..memory import lack_told
from ..ranks import Agreed, Ranks
from ..report.page import write_report
from ..training.checkpoint import Progress, newest_progress
from ..training.defaults import told_unknown, with_data_defaults, with_defaults
from ..training.fresh_fit import compile_kernels
from ..training.loop import fit
from ..training.run_folder import RunFolder, require_no_link
from ..training.same_on_ranks import what_ranks_share
from .method_variant import MethodVariant
from .tables import print_comparison

DEFINITIONS = {
    "final_learning_rate": "the part of their start to which all rates fall over the fit",
    "warm_up": "steps over which the rates of the unknowns rise",
    "beta2": "Adam's β₂ for the unknowns at the first steps",
    "least_slope": "least slope of the bounds of albedo in gradients; 0: their own",
    "searches": "of roughness, that were made; methods without a radiance field make none",
    "samples": "camera samples traced in training, those of searches of roughness included; of an "
    "estimator with two passes, both count",
    "seconds": "training time: without scores, previews and checkpoints, with searches of "
    "roughness. Where the length is one in seconds, kernels of steps are compiled before; else "
    "their compilation is part of it",
    "milliseconds_per_step": "median after the first steps",
    "start_up_seconds": "training time beyond its steps at that median: compilation, unless it "
    "was before, and searches of roughness",
    "samples_per_second": "camera samples of a step over that median",
    "memory_mb": "resident memory of the process, which fits all methods one after the other: the "
    "most that a line of the log tells",
    "machines": "that took the steps of a run; empty: of a version that did not write them",
    "skipped": "steps whose loss was not finite",
    "notes": "what was noted of the fit: a state to which it went back, or that it learned nothing",
    "untrained": "the fields that all methods start from, with the shared representation and seed",
    "yardsticks": "of held-out views, in dB. ceiling: the same fields trained on the true maps of "
    "the training views, without rendering; constant: the mean of these maps, everywhere; null: "
    "no true maps",
    "score": "mean PSNR over all held-out views during training, with few samples per pixel",
    "time_to_quality": "psnr: where the scores of a run end, and 1 and 2 dB below that, for each "
    "unknown of the materials (aligned albedo, where photographs leave its scale open); seconds: "
    "training time after which a run first has it, interpolated linearly between scores; null: "
    f"never. Scores of all runs are smoothed by a running median of {WINDOW} (shorter at the "
    "ends). Targets below the end that a run has before its first step are left out",
}
#: Of compare.json; 1 had the last albedo alone in `time_to_quality`, and no key `format`.
COMPARISON_FORMAT = 2

_OF_SEVERAL = (
    "runs are of several machines or numbers of threads: their times and steps cannot be compared"
)
#: Name of the run whose fields are those that all methods start from.
UNTRAINED = "untrained"
#: The method of that run, which learns nothing: any has the same fields before its first step.
_CHEAPEST = MethodVariant("direct")
#: Settings of a method that it may have of its own, besides those that describe a run anywhere.
OF_METHOD = ("final_learning_rate", "warm_up", "beta2", "least_slope")
#: Metrics of an evaluation that describe recovered lighting.
LIGHTING = ("environment", "emission", "albedo_scale")
#: Keys of an evaluation that the comparison needs.
NUMBERS = {"steps", "samples", "seconds", "heldout", "train"}
#: The key of an evaluation that says what to measure its materials by.
YARDSTICKS = "yardsticks"
#: Keys of the row of untrained fields: no method and no time belong to them.
OF_UNTRAINED = ("unknown", "quantities", "representation", "error", "heldout", "train", *LIGHTING)


def compare(
    data: Path | str,
    variants: Sequence[MethodVariant],
    out: Path | str,
    config: FitConfig,
    *,
    evaluation: EvaluationSettings,
    clip_negative: bool = False,
    allow_outside: bool = False,
    allow_doubtful: bool = False,
    ceiling: bool = True,
    console: Console | None = None,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Fit, evaluate and report several methods, one after the other.

    The runs are in `out`/NAME. Finished runs are kept, interrupted ones continue. A method that
    fails is recorded with its error, also where it runs out of memory. One more run,
    `out`/untrained, has the fields that all methods start from: where the truth is grey, a method
    that learns nothing would seem to win. Where the data set has true maps, the ceiling of each
    method's fields is measured first.

    Args:
        data: folder of the data set.
        variants: the methods.
        out: folder to write: a folder for each run, `compare.json` and `report.html`.
        config: settings of all runs; its `method` is ignored.
        evaluation: how results are rendered.
        clip_negative: set negative pixels to zero.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        allow_doubtful: as in `fit`.
        ceiling: measure ceilings that the data set does not have yet.
        console: shows progress and tables.
        ranks: of MPI, which share the methods among them and all call this; None: this process is
            alone. What rank 0 writes is the same, but for times: fits run side by side.

    Returns:
        The content of `compare.json`: the methods' rows by name in `methods`, and that of the
        untrained fields in `untrained`. Other ranks than the first return nothing.

    Raises:
        UserError: `out` cannot be written, the data set cannot be used, a run in `out` has other
            settings or data, or every method failed.
        KeyboardInterrupt: a fit was stopped. The same call continues.

    Paper: Sec. 6.1, Fig. 3.
    """
    console, ranks = console or Console(highlight=False), ranks or Ranks()
    if not ranks.leads:
        console = Console(quiet=True)
    data, out, given = Path(data), Path(out), config

    dataset, config, fits = ranks.together(
        lambda: _checked(data, variants, out, config, evaluation, allow_outside, ranks.leads)
    )
    chosen = {name: settings for name, settings in fits.items() if name != UNTRAINED}
    if (recovered := told_unknown(given, dataset)) is not None:
        console.print(recovered, highlight=False, soft_wrap=True)
    if ranks.size > 1:
        told = json.dumps({name: to_toml(settings) for name, settings in fits.items()})
        ranks.require_same(what_ranks_share(told, fingerprint(dataset)))
        backend.share_cores(ranks.here)

    with ranks.apart():
        if ceiling and ranks.leads:
            _measure_ceilings(dataset, list(chosen.values()), console)
        ranks.gather(None)  # the others find it in the data set
        rows: dict[str, dict[str, Any]] = {}
        errors: dict[str, UserError] = {}
        for name in ranks.mine(list(fits)):
            console.rule(name, align="left")
            try:
                run = RunFolder(out / name)
                with lack_told():
                    if fits[name].seconds and _has_time_left(run, fits[name]):
                        compile_kernels(dataset, [fits[name]], clip_negative=clip_negative)
                    progress = _fitted(
                        data,
                        run,
                        fits[name],
                        console,
                        clip_negative=clip_negative,
                        allow_outside=allow_outside,
                        allow_doubtful=allow_doubtful,
                    )
                    metrics = _evaluated(dataset, run, progress, evaluation, console)
                rows[name] = _of_method(fits[name]) | _numbers(run, metrics, fits[name])
                rows[name]["searches"] = progress.searched
            except UserError as error:
                errors[name] = error
                rows[name] = _of_method(fits[name]) | {"error": str(error)}
                console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
            # Free the memory of this method for the next one.
            gc.collect()
            dr.flush_malloc_cache()
        found, errors = _of_all(ranks, rows, errors)
    rows = {name: found[name] for name in fits}
    if errors.keys() >= chosen.keys():
        raise Agreed.of(errors[next(iter(chosen))])
    if not ranks.leads:
        return {}

    start = {key: value for key, value in rows.pop(UNTRAINED).items() if key in OF_UNTRAINED}
    targets = time_to_quality({name: row.get("score", []) for name, row in rows.items()})
    result = {
        "format": COMPARISON_FORMAT,
        "data": str(data.resolve()),
        "machine": machine(),
        "settings": asdict(config),
        "evaluation": asdict(evaluation),
        "untrained": start,
        "methods": rows,
        "time_to_quality": [asdict(target) for target in targets],
        "definitions": DEFINITIONS,
    }
    write_json(out / "compare.json", result, allow_nan=False)
    good = [out / name for name in fits if name not in errors]
    failed = {name: str(error) for name, error in errors.items()}
    write_report(good, out / "report.html", failed, allow_outside=allow_outside)
    print_comparison(result, console)
    if len(machines_of(rows.values())) > 1:
        console.print(f"warning: {_OF_SEVERAL}", style="yellow", soft_wrap=True)
    return result


def machines_of(rows: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """The different machines that rows of a comparison are of, as far as these tell."""
    return distinct_machines(machine for row in rows for machine in row.get("machines", ()))


def _checked(
    data: Path,
    variants: Sequence[MethodVariant],
    out: Path,
    config: FitConfig,
    evaluation: EvaluationSettings,
    allow_outside: bool,
    writes: bool,
) -> tuple[Dataset, FitConfig, dict[str, FitConfig]]:
    """The data set, settings of all runs, and those of each by its name, the untrained one first.

    Args:
        writes: whether this process writes what is of all runs.

    Raises:
        UserError: see `compare`.
    """
    require_kind(config, FitConfig, "config", 'unbake.preset("cpu")')
    require_kind(evaluation, EvaluationSettings, "evaluation", "unbake.EvaluationSettings()")
    names = [variant.name for variant in variants]
    if len(set(names)) < len(names) or not names:
        what = "a method is given twice" if names else "no method given"
        raise UserError(what, "--methods", "Name each one once, such as: ours prb prb:bitmap")
    if UNTRAINED in names:
        raise UserError(f"a comparison has a run {UNTRAINED!r} already", "--methods", "Rename it")
    if writes:  # fits and ceilings that take long come before anything is written
        require_writable_folder(out)
    dataset = Dataset.load(data, allow_outside=allow_outside)
    files = (
        fingerprint(dataset) if any(RunFolder(out / n).exists for n in (*names, UNTRAINED)) else {}
    )
    if evaluation.truth:
        require_true_materials(dataset)
    config = with_data_defaults(config, dataset)
    chosen = {v.name: with_defaults(v.settings(config), dataset) for v in variants}
    untrained = with_defaults(_CHEAPEST.settings(config), dataset)
    untrained = replace(untrained, steps=0, seconds=0.0, score_seconds=0.0)
    fits = {UNTRAINED: untrained, **chosen}
    for name, settings in {**chosen, **fits}.items():
        _check_kept(RunFolder(out / name), settings, data, files)
    return dataset, config, fits


def _of_all(
    ranks: Ranks, rows: Mapping[str, Any], errors: Mapping[str, UserError]
) -> tuple[dict[str, Any], dict[str, UserError]]:
    """The rows and the errors of all ranks."""
    parts = {name: error.parts for name, error in errors.items()}
    every = ranks.gather({"rows": dict(rows), "errors": parts})
    failed = {name: error for one in every for name, error in one["errors"].items()}
    found = {name: row for one in every for name, row in one["rows"].items()}
    return found, {name: UserError(*error) for name, error in failed.items()}


def _check_kept(run: RunFolder, settings: FitConfig, data: Path, files: Mapping[str, str]) -> None:
    """Refuse a link in the run's place, and a run that has other settings or data.

    Args:
        files: the data set's fingerprint, where there are runs; its folder may have moved.
    """
    require_no_link(run.path)
    if not run.exists:
        return
    origin = run.origin()
    elsewhere = run.data(origin.data).resolve() != data.resolve()
    if changed(origin.fingerprint, files) if origin.fingerprint else elsewhere:
        raise UserError("the run in this folder has other data", run.path, "Give another --out")
    stored = vars(run.settings())
    other = ", ".join(key for key, value in vars(settings).items() if stored[key] != value)
    if other:
        raise UserError(
            f"the run in this folder differs in {other}", run.path, "Give another --out"
        )


def _measure_ceilings(dataset: Dataset, fits: Sequence[FitConfig], console: Console) -> None:
    """Measure the ceilings that the data set does not have yet, for the evaluations to find."""

    def tell(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    # The same fields once, also where the cache of the data set cannot be written.
    distinct = {(c.representation, repr(c.material_settings)): c for c in fits}
    for config in distinct.values():
        if not can_have_ceiling(dataset, config) or find_ceiling(dataset, config) is not None:
            continue
        console.rule(f"ceiling of {config.representation} fields", align="left")
        try:
            measure_ceiling(dataset, config, tell=tell)
        except UserError as error:
            console.print(f"no ceiling: {error}", style="yellow", markup=False, soft_wrap=True)
        gc.collect()
        dr.flush_malloc_cache()


def _has_time_left(run: RunFolder, settings: FitConfig) -> bool:
    """Whether a run of some seconds has steps to take, at its beginning or after an interrupt."""
    progress = newest_progress(run) if run.exists else None
    return progress is None or progress.seconds < settings.seconds


def _fitted(
    data: Path,
    run: RunFolder,
    settings: FitConfig,
    console: Console,
    *,
    clip_negative: bool,
    allow_outside: bool,
    allow_doubtful: bool,
) -> Progress:
    resume, path = run.exists, run.path
    progress = fit(
        data,
        path,
        settings,
        resume=resume,
        clip_negative=clip_negative,
        allow_outside=allow_outside,
        allow_doubtful=allow_doubtful,
        console=console,
    )
    done, total = progress.step, settings.steps
    if settings.seconds:
        done, total = progress.seconds, settings.seconds
    if done < total or signals.received():
        console.print("the same command goes on from here")
        raise KeyboardInterrupt
    return progress


def _evaluated(
    dataset: Dataset,
    run: RunFolder,
    progress: Progress,
    settings: EvaluationSettings,
    console: Console,
) -> dict[str, Any]:
    """Metrics of the run.

    Evaluates it unless they are of this state and these settings, with the ceiling if there is one.
    """
    if run.metrics_file.is_file():
        metrics = run.metrics()
        same = metrics.get("steps") == progress.step
        same = same and metrics.get("evaluation") == asdict(settings)
        same = same and run.data(metrics["data"]).resolve() == dataset.folder.resolve()
        # Version 0.1 had no yardsticks; runs of known materials have none.
        same = same and (YARDSTICKS in metrics or not metrics.get("quantities"))
        if same and YARDSTICKS in metrics and metrics[YARDSTICKS]["ceiling"] is None:
            same = find_ceiling(dataset, run.settings()) is None
        if same and NUMBERS <= metrics.keys():
            return metrics
    return evaluate(
        run.path,
        settings,
        allow_outside=dataset.allow_outside,
        tell=lambda line: console.print(line, soft_wrap=True),
    )


def _of_method(config: FitConfig) -> dict[str, Any]:
    """What tells the settings of a method from those of others."""
    return description(config) | {key: getattr(config, key) for key in OF_METHOD}


def _numbers(run: RunFolder, metrics: dict[str, Any], config: FitConfig) -> dict[str, Any]:
    log = run.log()
    each = milliseconds_per_step(log)
    steps, samples, seconds = (metrics[key] for key in ("steps", "samples", "seconds"))
    return {
        "steps": steps,
        "samples": samples,
        "seconds": seconds,
        "samples_per_second": None if each is None else 1e3 * config.samples_per_step / each,
        "milliseconds_per_step": each,
        "start_up_seconds": None if each is None else max(0.0, seconds - steps * each / 1e3),
        "machines": list(run.origin().machines),
        "memory_mb": max((r["memory_mb"] for r in log if "memory_mb" in r), default=None),
        "heldout": metrics["heldout"],
        "train": metrics["train"],
        "skipped": sum(r.get("skipped", 0) for r in log),
        "notes": [r["note"] for r in log if "note" in r],
        "score": score_curve(log),
        **{key: metrics[key] for key in (YARDSTICKS, *LIGHTING) if key in metrics},
    }
