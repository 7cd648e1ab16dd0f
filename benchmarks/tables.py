"""Prints the tables of docs/comparison.md and docs/performance.md: `python tables.py [RESULTS]`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import here

from summary import phases_of, read, roofline_of, scores

from unbake.evaluation import convergence
from unbake.experiments.seeds import plus_minus, seeds_in_words
from unbake.experiments.seeds import spread as spread_of
from unbake.experiments.tables import markdown

RESULTS = Path(__file__).parent / "results"


def main(folder: Path = RESULTS) -> None:
    """Print every table whose numbers are in a folder of results."""
    for title, names, table in TABLES:
        files = [folder / f"{name}.json" for name in names]
        if all(file.is_file() for file in files):
            print(f"{title}\n\n{table(*map(read, files))}\n")
    for file in sorted(folder.glob("*.json")):
        result = read(file)
        if isinstance(result.get("steps"), list):
            print(f"Where the time of a step goes, ms, {file.stem}\n\n{phases(result)}\n")


def steps(result: dict) -> str:
    """Milliseconds of a step, and as multiples of the step of ours."""
    rows = [
        [
            f"`{row['method']}`",
            row["representation"],
            row["estimator"].replace("-", " "),
            f"{row['milliseconds_per_step']:.0f} ms",
            f"{ratio(row, result):.2f}",
        ]
        for row in result["rows"]
    ]
    return markdown(["method", "materials", "estimator", "a step", "/ ours"], rows)


def ratio(row: dict, table: dict) -> float:
    """Time of a step as a multiple of that of ours with the same materials."""
    same = (r for r in table["rows"] if r["representation"] == row["representation"])
    ours = next(r for r in same if r["method"] == "ours")
    return row["milliseconds_per_step"] / ours["milliseconds_per_step"]


def quality(result: dict) -> str:
    """What every method reaches on held-out views, and with how many samples."""
    rows = []
    for name, row in methods_of(result):
        if "error" in row:
            rows.append([f"`{name}`", "", "", "", row["error"], "", ""])
            continue
        # Version 0.1.0, whose rows have no `per_seed`, counts one of two passes.
        millions = f"{row.get('samples', 0) / 1e6:.1f}" if "per_seed" in row else ""
        length = f"{row.get('steps', 0):.0f}", millions, spread(row, "milliseconds_per_step", 1, 0)
        psnr = (spread(row, key, by, digits) for _, key, by, digits in PSNR)
        rows.append([f"`{name}`", *length, *psnr])
    titles = ["run", "steps", "M samples", "ms a step", "albedo", "roughness", "rendering"]
    return markdown(titles, rows) + over_seeds(result)


def demo(result: dict) -> str:
    """What `make demo` recovers, and what its noise would leave of a perfect result."""
    names = {"ours": "unbake", "direct": "direct illumination"}
    rows = [
        [names[name], f"{row['seconds']:.0f} s", *(spread(row, *column) for _, *column in PSNR)]
        for name, row in result["methods"].items()
    ]
    limit = spread(result["methods"]["ours"], "true_render_psnr", 1, 1)
    rows.append(["the true materials, rendered alike", "", "", "", limit])
    return markdown(["", "training", *(title for title, *_ in PSNR)], rows)


def over_seeds(result: dict) -> str:
    """The line below a table that says what its spread is of."""
    return f"\n\n{seeds_in_words(len(result['seeds'])).capitalize()}."


def methods_of(result: dict) -> list[tuple[str, dict]]:
    """Rows of a comparison by name, after that of the fields before their first step."""
    untrained = {"untrained": result["untrained"]} if "untrained" in result else {}
    return list((untrained | result["methods"]).items())


def targets(end: dict, runs: dict) -> list[dict]:
    """When another method has the quality that it ends with, or a little less, and when ours has.

    Returns:
        For each quantity and target: `psnr`; seconds after which the other method (`rival`) and
        ours first have it; `times`, their ratio. Numbers of ours are means over seeds, with
        `KEY_sd`, and absent where a seed does not get there; `never` counts those.
    """
    name, curve = next((n, c) for n, r in methods_of(end) for c in scores(r) if len(c) > 1)
    ours = {f"ours {i}": curve for i, curve in enumerate(scores(runs["methods"]["ours"]))}
    rows = []
    for target in convergence.time_to_quality({name: curve, **ours}):
        if target.run != name:
            continue
        own, times = target.seconds[name], [target.seconds[run] for run in ours]
        row = {"name": name, "quantity": target.quantity, "below": target.below}
        row |= {"psnr": target.psnr, "rival": own, "seeds": len(times), "never": times.count(None)}
        if None not in times:
            row |= spread_of("ours", times) | spread_of("times", [own / t for t in times if t])
        rows.append(row)
    return rows


def at_end(result: dict, quantity: str) -> list[dict]:
    """When each rival has what it ends with, and when ours does, seed by seed, in equal schedules.

    Returns:
        For each rival with scores: `name`; `psnr` of its smoothed end in dB; seconds after which
        it (`rival`) and ours (`ours`) first have that, and `times`, their ratio; means over seeds,
        with KEY_sd. `seeds` of them, `never` without ours, and `level`, the number whose rival
        ends no higher than it began. `ours` and `times` are absent where one of these is not zero.
    """
    rows, ours = [], scores(result["methods"]["ours"])
    for name, row in result["methods"].items():
        curves = [] if name == "ours" or "error" in row else scores(row)
        pairs = [{name: a, "ours": b} for a, b in zip(curves, ours, strict=False)]
        ends = [
            target
            for pair in pairs
            for target in convergence.time_to_quality(pair)
            if (target.run, target.quantity, target.below) == (name, quantity, 0.0)
        ]
        if not ends:
            continue
        times = [target.seconds["ours"] for target in ends]
        level = sum(target.seconds[name] == 0 for target in ends)
        found = {"name": name, "quantity": quantity, "seeds": len(ends), "level": level}
        found |= {"never": times.count(None)}
        found |= spread_of("psnr", [target.psnr for target in ends])
        own = [target.seconds[name] for target in ends]
        found |= spread_of("rival", own)
        if None not in times and not level:
            ratios = [r / t for r, t in zip(own, times, strict=True) if t]
            found |= spread_of("ours", times) | spread_of("times", ratios)
        rows.append(found)
    return rows


def equal_schedules(result: dict) -> str:
    """`at_end` of albedo and roughness as a table."""
    rows = []
    for row in (row for quantity in ("albedo", "roughness") for row in at_end(result, quantity)):
        if "ours" in row:
            told = f"{plus_minus(row, 'ours', 1)} s", plus_minus(row, "times", 1)
        elif row["level"]:
            told = f"untrained fields have it in {row['level']} of {row['seeds']} runs", ""
        else:
            told = f"not in {row['never']} of {row['seeds']} runs", ""
        end = f"{plus_minus(row, 'psnr')} dB", f"{plus_minus(row, 'rival')} s"
        rows.append([row["quantity"], f"`{row['name']}`", *end, *told])
    titles = ["", "rival", "its end", "it has that after", "`ours` after", "times sooner"]
    return markdown(titles, rows) + over_seeds(result)


def time_to_quality(end: dict, runs: dict) -> str:
    """`targets` as a table."""
    found, rows = targets(end, runs), []
    for row in found:
        below = f"{row['below']:g} dB below" if row["below"] else "at its end"
        cells = [row["quantity"], below, f"{row['psnr']:.1f} dB", f"{row['rival']:.0f} s"]
        never = f"not in {row['never']} of {row['seeds']} runs"
        ours = plus_minus(row, "ours", 0)
        rows.append(
            [*cells, never if ours is None else f"{ours} s", plus_minus(row, "times", 1) or ""]
        )
    name = f"`{found[0]['name']}`" if found else "rival"
    titles = ["", "quality", "PSNR", f"{name} has it after", "`ours` after", "times sooner"]
    return markdown(titles, rows)


def phases(result: dict) -> str:
    """Milliseconds of the phases of the steps of a machine, and of the roofline."""
    names = dict.fromkeys(name for step in result["steps"] for name in phases_of(step))
    rows = []
    for name in names:
        times = [phases_of(step).get(name, {}).get("milliseconds") for step in result["steps"]]
        rows.append([name, *("" if time is None else f"{time:.1f}" for time in times)])
    rows.append(
        ["whole step", *(f"{step['milliseconds_per_step']:.1f}" for step in result["steps"])]
    )
    least = [roofline_of(step) for step in result["steps"]]
    rows.append(
        ["roofline", *("" if r is None else f"{r['milliseconds']['all']:.1f}" for r in least)]
    )
    return markdown(["", *map(_step_title, result["steps"])], rows)


def _step_title(step: dict) -> str:
    """Method, materials unless they are networks, and scene; version 0.1.0 knows no materials."""
    materials = step["settings"].get("representation", "neural")
    method = step["method"] if materials == "neural" else f"{step['method']}:{materials}"
    scene = "demo" if step["data"] == "demo" else "STAIRCASE"
    return f"`{method}`, {scene}"


def spreads(*columns: tuple[str, str, float, int]) -> Callable[[dict], str]:
    """Mean and spread over seeds; a column is its title, key, factor and digits."""

    def table(result: dict) -> str:
        rows = [
            [f"`{name}`", *(spread(row, key, by, digits) for _, key, by, digits in columns)]
            for name, row in methods_of(result)
        ]
        return markdown(["run", *(title for title, *_ in columns)], rows) + over_seeds(result)

    return table


def variants(names: list[str], *columns: tuple[str, str, float, int]) -> Callable[..., str]:
    """One method with several settings, a file of results each; before them what they start from.

    Rows of untrained fields that are the same are told once.
    """

    def cells(row: dict) -> list[str]:
        return [spread(row, key, by, digits) for _, key, by, digits in columns]

    def table(*results: dict) -> str:
        fitted = [[n, *cells(r["methods"]["ours"])] for n, r in zip(names, results, strict=True)]
        starts = [cells(r["untrained"]) if "untrained" in r else None for r in results]
        if all(start == starts[0] for start in starts):
            first = [] if starts[0] is None else [["untrained", *starts[0]]]
            rows = [*first, *fitted]
        else:
            rows = []
            for name, start, row in zip(names, starts, fitted, strict=True):
                rows += [row] if start is None else [[f"{name}, untrained", *start], row]
        return markdown(["", *(title for title, *_ in columns)], rows) + over_seeds(results[0])

    return table


def prior(*results: dict) -> str:
    """The same fits with and without the prior, by what the training cameras see."""
    rows = []
    for case, result in zip(PRIOR.values(), results, strict=True):
        for name, row in methods_of(result):
            if "error" in row:
                rows.append([case, f"`{name}`", row["error"], *[""] * 4])
                continue
            seen = "_seen" if "albedo_psnr_seen" in result["methods"]["ours"] else ""
            if f"albedo_psnr{seen}" not in row:
                continue  # untrained fields, whose groups of views were not scored apart
            keys = [f"{key}_psnr{seen}" for key in ("albedo", "roughness", "render")]
            keys += ["albedo_psnr_unseen", "render_psnr_unseen"]
            rows.append([case, f"`{name}`", *(spread(row, key, 1, 1) for key in keys)])
    seen, unseen = ("albedo", "roughness", "rendering"), ("albedo, unseen", "rendering, unseen")
    titles = ["training views", "run", *(f"{title}, dB" for title in (*seen, *unseen))]
    return markdown(titles, rows) + over_seeds(results[0])


def spread(row: dict, key: str, factor: float, digits: int) -> str:
    """A mean, and the standard deviation over seeds if there are several."""
    return plus_minus(row, key, digits, factor) or ""


PSNR = (
    ("albedo, dB", "albedo_psnr", 1, 1),
    ("roughness, dB", "roughness_psnr", 1, 1),
    ("rendering, dB", "render_psnr", 1, 1),
)
LIGHT = (
    ("SH error, %", "sh_error", 100, 1),
    ("SH error, aligned", "sh_error_aligned", 100, 1),
    ("relighting, dB", "relight_psnr", 1, 1),
    ("relighting, aligned", "relight_psnr_aligned", 1, 1),
    ("rendering, dB", "render_psnr", 1, 1),
)
BOTH = (
    ("albedo, dB", "albedo_psnr", 1, 1),
    ("albedo, scale aligned", "albedo_psnr_aligned", 1, 1),
    ("roughness, dB", "roughness_psnr", 1, 1),
    ("SH error, %", "sh_error", 100, 1),
    ("aligned", "sh_error_aligned", 100, 1),
    ("relighting, dB", "relight_psnr", 1, 1),
    ("relighting, aligned", "relight_psnr_aligned", 1, 1),
)
#: Data sets of the job `prior`.
PRIOR = {
    "demo": "24 of the demo",
    "few": "6 of the demo",
    "three": "3 of the demo",
    "half": "12 of one half of the demo",
    "annex": "16 of the first room of the annex",
}


def cameras(result: dict) -> str:
    """Scores with each fault of cameras taken for known and fitted, and what was found of it.

    Scores with a dagger are of earlier versions, which did not write when they were made.
    """
    rows = {(row["fault"], row["cameras"]): row for row in result["rows"]}
    table = []
    for fault in dict.fromkeys(fault for fault, _ in rows):
        known, fitted = (rows.get((fault, cameras), {}) for cameras in ("known", "fitted"))
        scores = [at_true_cameras(row) if row else "" for row in (known, fitted)]
        scaled = "response_scaled_error_rms" in fitted
        found = [
            form.format(fitted[key])
            for key, form in CAMERAS.items()
            if fitted.get(key) and not (scaled and key == "response_error_rms")
        ]
        table.append([fault, *scores, ", ".join(found)])
    return markdown(["fault", "known", "fitted", "error of what was found"], table)


def at_true_cameras(row: dict) -> str:
    """Albedo and roughness; where poses may be off, as the true cameras see the materials."""
    true = "true_albedo_psnr" in row
    keys = [f"{'true_' if true else ''}{name}_psnr" for name in ("albedo", "roughness")]
    scores = " / ".join(plus_minus(row, key) or "" for key in keys)
    return scores if "made" in row else f"{scores} †"


CAMERAS = {
    "stops_error_rms": "exposures {:.2f} stops",
    "balance_error_rms": "white balance {:.2f} stops",
    "vignetting_error_most": "vignetting {:.2f} of the light",
    "response_error_rms": "response {:.3f} of white",
    "response_scaled_error_rms": "response {:.3f} of white after a common scale",
    "train_pixels": "poses {:.2f} pixels",
}


def photographs(result: dict) -> str:
    """What fits of real photographs reach, with exposures as EXIF tells them and fitted."""
    table = []
    for row in result["rows"]:
        stops = plus_minus(row, "stops_error_rms", 2) or ""
        albedo = sum(row["albedo_mean"]) / 3
        cells = [row["cameras"], f"{row['render_psnr']:.1f}", stops]
        table.append([*cells, f"{albedo:.2f}", f"{100 * row['albedo_white']:.0f} %"])
    titles = ["cameras", "held-out photographs, dB", "exposures against EXIF, stops"]
    return markdown([*titles, "mean albedo", "albedo above 0.9"], table)


TABLES = (
    ("Faults of cameras", ("cameras-demo",), cameras),
    ("Faults of cameras, KITCHEN", ("cameras-kitchen",), cameras),
    ("Real photographs", ("sceaux",), photographs),
    ("Time of a step", ("methods-demo",), steps),
    ("Demo", ("demo",), demo),
    ("Equal time, demo", ("rivals-demo",), quality),
    ("STAIRCASE", ("staircase",), quality),
    ("Equal samples, demo", ("equal-demo",), quality),
    ("Equal schedules, demo", ("rivals-demo",), equal_schedules),
    ("Time to quality, demo", ("long-demo", "rivals-demo"), time_to_quality),
    ("Ablation, materials", ("ablation-materials",), spreads(*PSNR)),
    ("Ablation, lighting", ("ablation-lighting",), spreads(*LIGHT)),
    (
        "Materials and lighting",
        ("still-materials", "still-lighting", "still-materials+lighting"),
        variants(["materials alone", "lighting alone", "both"], *BOTH),
    ),
    ("Emission", ("emission",), spreads(("error, %", "emission_error", 100, 2))),
    (
        "Few views",
        ("sparse-none", "sparse-smooth", "sparse-tied", "sparse-both"),
        variants(
            ["none", "`roughness_smoothness = 0.02`", "`albedo_ties_roughness = 0.1`", "both"],
            *PSNR,
        ),
    ),
    ("With and without the prior", tuple(f"prior-{data}" for data in PRIOR), prior),
)

if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
