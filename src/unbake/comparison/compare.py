"""Methods against each other on the same data with the same settings."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import drjit as dr
from rich.console import Console
from rich.table import Table

from ..config import FitConfig
from ..dataset.views import Dataset
from ..errors import UserError
from ..evaluation.convergence import milliseconds_per_step, score_curve, time_to_quality
from ..evaluation.evaluate import description, evaluate
from ..evaluation.settings import EvaluationSettings
from ..io import write_json
from ..machine import machine
from ..report.page import write_report
from ..training.checkpoint import Progress
from ..training.loop import fit
from ..training.run_folder import RunFolder
from .method_variant import MethodVariant

DEFINITIONS = {
    "seconds": "training time: without scores, previews and checkpoints, with the compilation of "
    "the first steps",
    "milliseconds_per_step": "median after the first steps",
    "start_up_seconds": "what training took beyond its steps at that median, most of it compilation"
    " (kernels that an earlier run compiled are taken from a cache)",
    "samples_per_second": "camera samples of a step over that median; of two passes, one counts",
    "memory_mb": "largest resident memory of the process, which fits method after method",
    "score": "mean PSNR over all held-out views during training, from few samples",
    "time_to_quality": "target: a run's last score of albedo; seconds: when a run reached it and "
    "never fell below it again, between scores on a straight line; null: never",
}

#: What an evaluation says of recovered light.
LIGHT = ("environment", "emission", "albedo_scale")
NUMBERS = {"steps", "samples", "seconds", "heldout", "train"}


def compare(
    data: Path,
    variants: Sequence[MethodVariant],
    out: Path,
    config: FitConfig,
    *,
    evaluation: EvaluationSettings,
    clip_negative: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Fit, evaluate and report several methods, one after the other.

    Runs go to `out`/NAME. Those that are finished are kept, interrupted ones go on. A method that
    fails is recorded with its error.

    Args:
        data: a data set's folder.
        contenders: what to compare.
        out: the folder to write: a folder a run, `compare.json` and `report.html`.
        config: settings of all runs; `method` is of no account.
        evaluation: how results are rendered.
        clip_negative: take negative pixels as zero.

    Returns:
        What it writes to `compare.json`.

    Raises:
        UserError: the data set cannot be used, a run in `out` has other settings or data, or every
            method failed.
        KeyboardInterrupt: a fit was stopped; the same call goes on.

    Paper: Sec. 6.1, Fig. 3.
    """
    console = console or Console(highlight=False)
    chosen = {variant.name: variant.settings(config) for variant in variants}
    if len(chosen) < len(variants) or not chosen:
        what = "a method is given twice" if chosen else "no method given"
        raise UserError(what, "--methods", "Name each one once, such as: ours prb prb:bitmap")
    Dataset.load(data)
    for name, settings in chosen.items():
        _check_kept(RunFolder(out / name), settings, data)

    rows: dict[str, dict[str, Any]] = {}
    errors: list[UserError] = []
    for name, settings in chosen.items():
        console.rule(name, align="left")
        try:
            run = RunFolder(out / name)
            progress = _fitted(data, run, settings, clip_negative, console)
            metrics = _evaluated(run, progress, evaluation, console)
            rows[name] = description(settings) | _numbers(run, metrics)
        except UserError as error:
            errors.append(error)
            rows[name] = description(settings) | {"error": str(error)}
            console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
        # Memory of one method is not to be missed by the next.
        gc.collect()
        dr.flush_malloc_cache()
    if len(errors) == len(rows):
        raise errors[0]

    targets = time_to_quality({name: row.get("score", []) for name, row in rows.items()})
    result = {
        "data": str(data.resolve()),
        "machine": machine(),
        "settings": asdict(config),
        "evaluation": asdict(evaluation),
        "methods": rows,
        "time_to_quality": [asdict(target) for target in targets],
        "definitions": DEFINITIONS,
    }
    write_json(out / "compare.json", result, allow_nan=False)
    good = [out / name for name, row in rows.items() if "error" not in row]
    failed = {name: row["error"] for name, row in rows.items() if "error" in row}
    write_report(good, out / "report.html", failed)
    _print(result, console)
    return result


def _check_kept(run: RunFolder, settings: FitConfig, data: Path) -> None:
    """Refuse a run of other settings or data: it would be compared as if it were this one."""
    if not run.exists:
        return
    stored = vars(run.settings())
    other = ", ".join(key for key, value in vars(settings).items() if stored[key] != value)
    if other:
        raise UserError(
            f"the run in this folder differs in {other}", run.path, "Give another --out"
        )
    if run.data(run.origin().data).resolve() != data.resolve():
        raise UserError("the run in this folder has other data", run.path, "Give another --out")


def _fitted(
    data: Path, run: RunFolder, settings: FitConfig, clip_negative: bool, console: Console
) -> Progress:
    resume, path = run.exists, run.path
    progress = fit(
        data, path, settings, resume=resume, clip_negative=clip_negative, console=console
    )
    done, total = progress.step, settings.steps
    if settings.seconds:
        done, total = progress.seconds, settings.seconds
    if done < total:
        console.print("the same command goes on from here")
        raise KeyboardInterrupt
    return progress


def _evaluated(
    run: RunFolder, progress: Progress, settings: EvaluationSettings, console: Console
) -> dict[str, Any]:
    """The run's metrics: those it has, if they are of this state and these settings."""
    if run.metrics_file.is_file():
        metrics = run.metrics()
        render = {"spp": settings.spp, "max_depth": settings.max_depth}
        same = metrics.get("steps") == progress.step and metrics.get("render") == render
        if same and NUMBERS <= metrics.keys():
            return metrics
    return evaluate(run.path, settings, tell=lambda line: console.print(line, soft_wrap=True))


def _numbers(run: RunFolder, metrics: dict[str, Any]) -> dict[str, Any]:
    log = run.log()
    each = milliseconds_per_step(log)
    steps, samples, seconds = (metrics[key] for key in ("steps", "samples", "seconds"))
    return {
        "steps": steps,
        "samples": samples,
        "seconds": seconds,
        "samples_per_second": None if each is None else 1e3 * samples / steps / each,
        "milliseconds_per_step": each,
        "start_up_seconds": None if each is None else max(0.0, seconds - steps * each / 1e3),
        "memory_mb": max((r["memory_mb"] for r in log if "memory_mb" in r), default=None),
        "heldout": metrics["heldout"],
        "train": metrics["train"],
        "score": score_curve(log),
        **{key: metrics[key] for key in LIGHT if key in metrics},
    }


# -------------------------------------------------------------------------------------------- table


def _print(result: dict[str, Any], console: Console) -> None:
    table = Table("run", title="Held-out views, PSNR in dB", title_justify="left")
    for title in ("render", "albedo", "rough.", "steps", "time", "ms/step", "samples/s"):
        table.add_column(title, justify="right")
    for name, row in result["methods"].items():
        if "error" in row:
            table.add_row(name, *["failed"] + [""] * 6)
            continue
        quality = [row["heldout"].get(f"{k}_psnr") for k in ("render", "albedo", "roughness")]
        table.add_row(
            name,
            *[_number(value, 2) for value in quality],
            str(row["steps"]),
            f"{row['seconds']:.0f} s",
            _number(row["milliseconds_per_step"], 1),
            _number(row["samples_per_second"], 0),
        )
    console.print(table)
    _print_lighting(result["methods"], console)
    targets = result["time_to_quality"]
    if len(targets) < 2:
        return
    table = Table("albedo PSNR of", "dB", title="Seconds to that quality", title_justify="left")
    for name in targets[0]["seconds"]:
        table.add_column(name, justify="right")
    for target in targets:
        times = [_number(seconds, 1) for seconds in target["seconds"].values()]
        table.add_row(target["run"], _number(target["albedo_psnr"], 2), *times)
    console.print(table)


def _print_lighting(rows: dict[str, dict[str, Any]], console: Console) -> None:
    maps = {name: row["environment"] for name, row in rows.items() if row.get("environment")}
    if maps:
        table = Table("run", title="Environment map", title_justify="left")
        for title in ("low frequencies off", "aligned", "relighting", "aligned"):
            table.add_column(title, justify="right")
        for name, found in maps.items():
            errors = [f"{100 * found[k]:.1f} %" for k in ("sh_error", "sh_error_aligned")]
            relit = [f"{found[k]:.1f} dB" for k in ("relight_psnr", "relight_psnr_aligned")]
            table.add_row(name, *errors, *relit)
        console.print(table)
    for name, row in rows.items():
        known = [x for x in row.get("emission", ()) if x["emission_error"] is not None]
        for emitter in known:
            console.print(f"{name}: {emitter['name']} {100 * emitter['emission_error']:.2f} % off")


def _number(value: float | None, digits: int) -> str:
    return "—" if value is None else f"{value:.{digits}f}"
