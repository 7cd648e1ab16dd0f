"""Tables of comparisons for the terminal."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rich.console import Console
from rich.table import Column, Table

from ..quantities import ALIGNED, QUANTITIES

Row = dict[str, Any]

#: What is told below the scores.
_ONE_SEED = (
    "One fit of each method: its spread between seeds is not known, and differences of some tenths "
    "of a dB may be chance."
)
_NO_LIMIT = "How much of the error of renderings is noise is told with --evaluate-truth alone."
#: Characters that a column of names may be folded to where a table is too wide.
_NARROWEST = 12


def print_comparison(result: Row, console: Console) -> None:
    """Print the content of `compare.json`: quality, speed, lighting and time to quality."""
    rows = {"untrained": result["untrained"]} | result["methods"]
    _print_quality(rows, console)
    _print_lighting(rows, console)
    _print_time_to_quality(result["time_to_quality"], console)


def print_step_times(rows: list[Row], console: Console) -> None:
    """Print the rows of `unbake bench methods`."""
    table = _table("method", "materials", "radiance", "estimator")
    _add_numbers(table, "ms a step", "k samples/s", "times the first")
    for row in rows:
        names = (row["method"], row["representation"] or "known", row["radiance"] or "none")
        if "error" in row:
            table.add_row(*names, row["estimator"], "failed")
            continue
        time, rate = row["milliseconds_per_step"], row["samples_per_second"] / 1e3
        ratio = _number(row["times_the_first"], 2)
        table.add_row(*names, row["estimator"], f"{time:.1f}", f"{rate:.0f}", ratio)
    _show(table, console)


def print_rates(searches: list[Row], console: Console) -> None:
    """Print the best trials of `unbake bench rates`, beside the fields' own rates."""
    table = _table("data", "method", "best", title="Mean PSNR in dB, and multiples of the rates")
    _add_numbers(table, "trials", "untrained", "own rates", "best")
    for search in searches:
        best, trials = search["best"], search["trials"]
        rates = [f"{name} {by:g}" for name, by in best["factors"].items()]
        schedule = {"final_learning_rate": "final rate", "warm_up": "warm-up"}
        rates += [f"{title} {best[key]:g}" for key, title in schedule.items() if key in best]
        chosen = "\n".join([*rates, best["estimator"]])
        scores = search["untrained"].get("score"), trials[0]["score"], best["score"]
        numbers = (_number(score, 2) for score in scores)
        table.add_row(search["data"], search["method"], chosen, str(len(trials)), *numbers)
    _show(table, console)


def _print_quality(rows: dict[str, Row], console: Console) -> None:
    evaluated = [row["heldout"] for row in rows.values() if "heldout" in row]
    materials = [q for q in QUANTITIES if any(f"{q}_psnr" in means for means in evaluated)]
    columns = {f"{name}_psnr": name for name in ("render", *materials)}
    if any(ALIGNED in means for means in evaluated):
        columns[ALIGNED] = "albedo, aligned"
    table = _table("run", title="Held-out views, PSNR in dB")
    _add_numbers(table, *columns.values(), "steps", "M\nsamples", "time", "ms a\nstep")
    for name, row in rows.items():
        if "error" in row:
            table.add_row(name, "failed")
            continue
        table.add_row(name, *_scores(row["heldout"], columns), *_effort(row))
    own = [f"{name}_psnr" for name in materials]
    measured = [_yardsticks(rows, kind) for kind in ("constant", "ceiling")]
    if any(measured):
        table.add_section()
    for label, scores in (pair for pairs in measured for pair in pairs):
        told = zip(columns, _scores(scores, columns), strict=True)
        table.add_row(label, *(x if key in own else "" for key, x in told))
    limit = next((m["true_render_psnr"] for m in evaluated if m.get("true_render_psnr")), None)
    if limit is not None:
        table.add_row("true materials", _number(limit, 1))
    _show(table, console)
    console.print(_ONE_SEED)
    if limit is None and any(measured):  # the true materials are known
        console.print(_NO_LIMIT)


def _scores(means: Row, keys: Iterable[str]) -> list[str]:
    return [_number(means.get(key), 1) for key in keys]


def _yardsticks(rows: dict[str, Row], kind: str) -> list[tuple[str, Row]]:
    """The scores of a yardstick with its label; one for each representation, if they differ."""
    found: dict[str, Row] = {}
    for row in rows.values():
        scores = (row.get("yardsticks") or {}).get(kind)
        if scores and scores not in found.values():
            found.setdefault(row["representation"], scores)
    if len(found) == 1:
        return [(kind, scores) for scores in found.values()]
    return [(f"{kind} {name}", scores) for name, scores in found.items()]


def _effort(row: Row) -> list[str]:
    """Steps, samples and times of a run; nothing for untrained fields."""
    if "steps" not in row:
        return ["0"]
    millions, time = row["samples"] / 1e6, row["milliseconds_per_step"]
    return [str(row["steps"]), f"{millions:.1f}", f"{row['seconds']:.0f} s", _number(time, 1)]


def _print_lighting(rows: dict[str, Row], console: Console) -> None:
    maps = {name: row["environment"] for name, row in rows.items() if row.get("environment")}
    if maps:
        table = _table("run", title="Environment map")
        _add_numbers(table, "SH error", "aligned", "relighting", "aligned")
        for name, metrics in maps.items():
            errors = [f"{100 * metrics[k]:.1f} %" for k in ("sh_error", "sh_error_aligned")]
            relit = [f"{metrics[k]:.1f} dB" for k in ("relight_psnr", "relight_psnr_aligned")]
            table.add_row(name, *errors, *relit)
        _show(table, console)
    for name, row in rows.items():
        known = [x for x in row.get("emission", ()) if x["emission_error"] is not None]
        for emitter in known:
            error = 100 * emitter["emission_error"]
            console.print(f"{name}: {emitter['name']} {error:.2f} % off")


def _print_time_to_quality(targets: list[Row], console: Console) -> None:
    """A table for each quantity. Runs are numbered, so that many fit beside each other."""
    numbers = {run: str(i) for i, run in enumerate(_runs(targets), 1)}
    if len(numbers) < 2:
        return
    for quantity in dict.fromkeys(target["quantity"] for target in targets):
        table = _table("end of", title=f"Seconds to {quantity} PSNR, smoothed")
        _add_numbers(table, "dB", *numbers.values())
        for target in targets:
            if target["quantity"] != quantity:
                continue
            run, below = target["run"], target["below"]
            label = f"  {below:g} dB below" if below else f"{numbers[run]} {run}"
            times = [_number(target["seconds"][name], 0) for name in numbers]
            table.add_row(label, _number(target["psnr"], 1), *times)
        _show(table, console)


def _runs(targets: list[Row]) -> list[str]:
    """The runs that set targets, in the order of the comparison."""
    setting = {target["run"] for target in targets}
    return [run for run in targets[0]["seconds"] if run in setting] if targets else []


def _show(table: Table, console: Console) -> None:
    """Print a table; where its numbers do not fit the console, wider than that: none is cut."""
    least = 1
    for column in table.columns:
        cells = [str(cell) for cell in column.cells]
        words = str(column.header).split()  # titles may break between words
        if column.justify == "right":
            column.min_width = max(map(len, [*words, *cells]))
        else:
            column.min_width = min(max(map(len, [*words, *cells])), _NARROWEST)
        least += column.min_width + 3  # with the line and the spaces beside it
    if least > console.width:
        table.width = least
    console.print(table, crop=False)


def _table(*names: str, title: str | None = None) -> Table:
    """A table whose first columns are names, which are folded where they are long, not cut."""
    columns = (Column(name, overflow="fold") for name in names)
    return Table(*columns, title=title, title_justify="left")


def _add_numbers(table: Table, *titles: str) -> None:
    for title in titles:
        table.add_column(title, justify="right")


def _number(value: float | None, digits: int) -> str:
    return "—" if value is None else f"{value:.{digits}f}"
