"""The page's section on curves: charts of the logs, and times to a quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

from unbake.evaluation.convergence import ALIGNED_ALBEDO, score_curve, time_to_quality
from unbake.machine import distinct_machines
from unbake.quantities import ALIGNED, QUANTITIES
from unbake.report import charts, display
from unbake.report.runs import EvaluatedRun
from unbake.report.wording import NAMES
from unbake.training.monitor import loss_terms
from unbake.transport.terms import TERMS

#: Keys and titles of the scores of held-out views in a log.
SCORES = {f"{n}_psnr": f"Held-out {row.title.lower()} PSNR" for n, row in QUANTITIES.items()}
SCORES |= {ALIGNED: "Held-out albedo PSNR, aligned"}
#: Keys and titles of a validation in a log.
VALIDATION = {f"{name}_psnr": f"{row.title} PSNR" for name, row in QUANTITIES.items()}
VALIDATION |= {"render_psnr": "Rendering PSNR"}
AXES = {"step": "step", "seconds": "training time, seconds"}  # key in the log: title of the axis


def loss_charts(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """Charts of the terms of the loss, and of the loss on held-aside pixels where it is logged."""
    logged = dict.fromkeys(name for run in runs for line in run.log for name in loss_terms(line))
    names = [*(name for name in TERMS if name in logged), *(n for n in logged if n not in TERMS)]
    titles = {name: _term_title(name) for name in names}
    if any("held_aside" in line for run in runs for line in run.log):
        titles["held_aside"] = "Photometric loss, held-aside pixels"
    return _panels(
        runs, [run.log for run in runs], titles, "relative L2, no unit", logarithmic=True
    )


def _term_title(name: str) -> str:
    """The title of a term, also of a regularizer and of a term that is not registered here."""
    title = TERMS[name].title if name in TERMS else name.replace("_", " ").capitalize()
    return title or name


def score_charts(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """Charts of the PSNRs over all held-out views."""
    logs = [score_curve(run.log) for run in runs]
    return _panels(runs, logs, SCORES, "dB", axes=("seconds", "step"))


def validation_charts(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """Charts of the validation on one view; none if all views were scored."""
    logs = validations(runs)
    if all(score_curve(run.log) for run, log in zip(runs, logs, strict=True) if log):
        return []
    return _panels(runs, logs, VALIDATION, "dB")


def validations(runs: list[EvaluatedRun]) -> list[list[dict[str, Any]]]:
    """For each run its log records with a validation, whose numbers become keys of the record."""
    return [[r | r["validation"] for r in run.log if r.get("validation")] for run in runs]


def race(runs: list[EvaluatedRun]) -> list[dict[str, Any]]:
    """For each quantity, times to the scores that runs end with, and below.

    Empty if fewer than two runs have scores.
    """
    raced = [run for run in runs if not run.untrained]
    targets = time_to_quality({run.label: score_curve(run.log) for run in raced})
    if len({target.run for target in targets}) < 2:
        return []
    index = {run.label: i for i, run in enumerate(runs)}
    mixed = several_machines(raced)
    tables: dict[str, list[dict[str, Any]]] = {}
    for target in targets:
        first = _first(target.seconds)
        row = {
            "run": index[target.run],
            "below": f"{target.below:g} dB below" if target.below else None,
            "target": display.decibels(target.psnr),
            "times": [
                {"text": display.seconds(t), "best": not mixed and t is not None and t == first}
                for t in target.seconds.values()
            ],
        }
        tables.setdefault(target.quantity, []).append(row)
    titles = NAMES | {ALIGNED_ALBEDO: ALIGNED_ALBEDO.capitalize()}
    return [{"title": titles.get(name, name), "rows": rows} for name, rows in tables.items()]


def several_machines(runs: list[EvaluatedRun]) -> bool:
    """Whether machines that differ took the steps of runs, as far as these tell."""
    return len(distinct_machines(machine for run in runs for machine in run.machines)) > 1


def _first(times: Mapping[str, float | None]) -> float | None:
    return min((t for t in times.values() if t is not None), default=None)


def _panels(
    runs: list[EvaluatedRun],
    logs: list[list[dict[str, Any]]],
    titles: Mapping[str, str],
    unit: str,
    *,
    axes: Sequence[str] = tuple(AXES),
    logarithmic: bool = False,
) -> list[dict[str, Any]]:
    """A panel for each x axis and each key of `titles` that some log has.

    Its `svg` is None where a logarithmic axis can show no value of any run.
    """
    labels = [run.label for run in runs]
    panels = []
    for x_key, (key, title) in product(axes, titles.items()):
        x_title = AXES[x_key]
        value = partial(_value, key=key)
        figure = charts.chart(logs, x_key, x_title, value, logarithmic)
        lost = _lost(labels, charts.not_positive(logs, x_key, value)) if logarithmic else ""
        if figure is not None or lost:
            named = f"{title} over {x_title}"
            svg = None if figure is None else charts.inline_svg(figure, named, labels)
            panels.append({"title": title, "unit": unit, "svg": svg, "lost": lost})
    return panels


def _lost(labels: Sequence[str], counts: Sequence[tuple[int, int]]) -> str:
    """How many points of each run are not positive, for people; empty where all are."""
    told = zip(labels, counts, strict=True)
    return ", ".join(f"{label} {left} of {count}" for label, (left, count) in told if left)


def _value(record: Mapping[str, Any], key: str) -> Any:
    return record.get(key)
