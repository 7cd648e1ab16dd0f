"""One self-contained HTML page that compares runs on the same data: numbers, images, charts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, final

import jinja2
import numpy as np

from unbake.dataset.views import Dataset, read_photograph, read_view
from unbake.errors import UserError
from unbake.evaluation.convergence import WINDOW, score_curve, time_to_quality
from unbake.fields.registry import representation, representations
from unbake.imaging import pictures
from unbake.io import write_text
from unbake.quantities import QUANTITIES
from unbake.report import charts, display
from unbake.report.cameras import camera_section
from unbake.report.lighting import lighting_section
from unbake.report.outliers import outlier_section
from unbake.report.relit import relit_sections
from unbake.report.runs import Run, View, data_folder, labels, read_run, read_views
from unbake.report.sheets import texture_sections
from unbake.training.monitor import loss_terms
from unbake.transport.terms import TERMS

TEMPLATE = Path(__file__).with_name("report.html.jinja")
SPLITS = ("heldout", "train")
#: How notes of fits that learned nothing begin.
_LEARNED_NOTHING = ("nothing was learned", "nothing useful was learned")
#: Names of the quantities that have pictures.
NAMES = {"render": "Rendering"} | {name: row.title for name, row in QUANTITIES.items()}
#: PSNRs: key, quantity and heading.
PSNRS = [("render_psnr", "render", "Rendering")]
for _name, _row in QUANTITIES.items():
    PSNRS.append((f"{_name}_psnr", _name, _row.title))
    if _name == "albedo":
        PSNRS.append(("albedo_psnr_aligned", _name, "Aligned albedo"))
#: Scores of renderings beside PSNR: key, heading, and which is best.
SIMILAR: tuple[tuple[str, str, display.Choice], ...] = (
    ("render_ssim", "SSIM", max),
    ("render_flip", "FLIP", min),
)
#: What results are measured by, in the order of their rows, and what it is called.
YARDSTICKS = {
    "ceiling": "Ceiling",
    "constant": "Constant",
    "untrained": "Untrained",
}
#: Captions of the scales beside pictures.
UNITS = {"render": "linear radiance", "environment": "linear radiance"} | {
    name: f"{row.title.lower()}, {row.lower:.0f} to {row.upper:.0f}"
    for name, row in QUANTITIES.items()
}
#: Headings of the definitions of an evaluation.
DEFINED = {
    "psnr": "PSNR",
    "albedo_psnr_aligned": "Aligned albedo",
    "yardsticks": "Ceiling, constant, untrained",
    "colour_space": "Colour space",
    "mask": "Mask",
    "render_ssim": "SSIM",
    "render_flip": "FLIP",
}
LIGHT_DEFINED = {
    "environment": {
        "sh_error": "SH error",
        "relight_psnr": "Relighting PSNR",
        "aligned": "Aligned",
    },
    "emission": {"emission_error": "Error"},
}
SCORES = {f"{n}_psnr": f"Held-out {row.title.lower()} PSNR" for n, row in QUANTITIES.items()}
OPTIMIZED = {
    "materials": "Materials",
    "lighting": "Lighting",
    "materials+lighting": "Materials and lighting",
    "emission": "Lights",
}
VALIDATION = {f"{name}_psnr": f"{row.title} PSNR" for name, row in QUANTITIES.items()}
VALIDATION |= {"render_psnr": "Rendering PSNR"}
AXES = {"step": "step", "seconds": "training time, seconds"}  # key in the log: title of the axis


@final
@dataclass(frozen=True)
class Scales:
    """How values become colours, the same for all runs and views."""

    exposure: float  #: stops
    error: dict[str, float]  #: by quantity, the error that has the brightest colour


def write_report(
    runs: Sequence[str | Path],
    out: str | Path,
    failed: Mapping[str, str] | None = None,
    *,
    exported: Sequence[str | Path] = (),
    relit: Sequence[str | Path] = (),
    allow_outside: bool = False,
) -> Path:
    """Write one HTML page that compares evaluated runs with the ground truth and each other.

    The page contains its images, styles and script and loads nothing from elsewhere.
    Pictures of renderings and colours are linear RGB seen through the sRGB curve; other quantities
    are shown without a curve. Larger pictures than 640 pixels are averaged down; PSNRs are those of
    the evaluation, from full resolution.

    Args:
        runs: run folders, all evaluated on the same data.
        out: the page's file; it appears complete or not at all.
        failed: further runs that failed: name to reason.
        exported: folders of `export`, with textures, whose sheets are shown.
        relit: folders of `relight` or `render`, whose pictures are shown.
        allow_outside: read files of the data set that lie outside of its folder.

    Returns:
        `out`.

    Raises:
        UserError: a run was not evaluated, runs differ in data, a file is gone or malformed, or a
            folder was made of another run.
    """
    out = Path(out)
    if not runs:
        raise UserError("a report needs at least one run")
    loaded = [read_run(path, label) for path, label in labels(runs)]
    data = data_folder(loaded)
    dataset = Dataset.load(data, allow_outside=allow_outside)
    views = read_views(dataset, loaded)
    scales = _scales(loaded, views)
    groups = [
        {
            "split": split,
            "total": sum(view.split == split for view in dataset.views),
            "views": [_view_block(view, loaded, scales) for view in views if view.split == split],
        }
        for split in SPLITS
    ]
    lighting, materials = lighting_section(loaded, dataset), _materials(loaded)
    textures = texture_sections([Path(folder) for folder in exported], loaded)
    strips = relit_sections([Path(folder) for folder in relit], loaded, allow_outside)
    page = (
        _environment()
        .from_string(TEMPLATE.read_text(encoding="utf-8"))
        .render(
            scene=data.name,
            dataset=dataset,
            runs=loaded,
            psnrs=_psnrs(loaded).values(),
            rows=_table(loaded),
            yardsticks=_yardsticks(loaded),
            similar=_similar(loaded),
            light=lighting,
            textures=textures,
            strips=strips,
            cameras=camera_section(loaded),
            outliers=outlier_section(loaded),
            optimized=_optimized(loaded),
            materials=bool(materials),
            known=any(name in view.truth for view in views for name in QUANTITIES),
            recovered=_listed([*_words(materials), *(["light"] if lighting else [])]),
            colours=_listed(["renderings", *_words(materials, "colour")]).capitalize(),
            data=_words(materials, "data"),
            listed=_listed,
            names=NAMES | {"environment": "Environment map"},
            units=UNITS,
            measures=YARDSTICKS,
            failed=failed or {},
            groups=groups,
            scales=scales,
            longest=display.LONGEST_SIDE,
            magma=pictures.MAGMA,
            charts=charts,
            losses=_loss_charts(loaded),
            scores=_score_charts(loaded),
            race=_race(loaded),
            window=WINDOW,
            trained=[i for i, run in enumerate(loaded) if not run.untrained],
            validation=_validation_charts(loaded),
            validated=sorted(
                {r["split"] for log in _validations(loaded) for r in log if "split" in r}
            ),
            settings=_settings(loaded),
            definitions=_definitions(loaded),
        )
    )
    write_text(out, page)
    return out


# ----------------------------------------------------------------------------------------- pictures


def _recovered(run: Run, view: View, quantity: str) -> Path | None:
    """A run's image of a view; None if it was not evaluated or the quantity not optimized."""
    if not run.view(view.name) or not run.optimizes(quantity):
        return None
    return display.evaluated(run, run.folder.picture(view.split, view.name, quantity))


def _references(view: View) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The truth of each quantity, (H, W, 3), and the pixels whose errors count, (H, W) bool.

    Those of renderings are not masked, and show what is unknown where the data set tells that.
    """
    photograph = read_photograph(view.source, clip_negative=True)
    maps = {name: read_view(path, view.source) for name, path in view.source.truth.items()}
    known = {name: pixels[..., 3] >= 0.5 for name, pixels in maps.items()}
    counted = np.logical_and.reduce([photograph[..., 3] >= 0.5, *known.values()])
    found = {name: (pixels[..., :3], known[name]) for name, pixels in maps.items()}
    return {"render": (photograph[..., :3], counted)} | found


def _scales(runs: list[Run], views: list[View]) -> Scales:
    """Exposure and error scales from all pictures of the page."""
    radiance: list[np.ndarray] = []
    errors: dict[str, list[list[np.ndarray]]] = {q: [[] for _ in runs] for q in NAMES}
    for view in views:
        for quantity, (reference, mask) in _references(view).items():
            if quantity == "render":
                radiance.append(pictures.sample(reference.mean(axis=2)[mask]))
            for run, parts in zip(runs, errors[quantity], strict=True):
                recovered = _recovered(run, view, quantity)
                if recovered is not None:
                    error = display.error(display.rgb(recovered)[0], reference, recovered)
                    parts.append(pictures.sample(error[mask]))
    error_scales = {q: display.error_scale(errors[q]) for q in NAMES}
    return Scales(pictures.fitting_exposure(radiance), error_scales)


def _view_block(view: View, runs: list[Run], scales: Scales) -> dict[str, Any]:
    """A view's images for the template: a column a quantity with truth and runs."""
    references = _references(view)
    height, width = references["render"][0].shape[:2]
    quantities = [q for q in NAMES if any(run.optimizes(q) for run in runs)]
    columns = [_column(view, runs, q, references.get(q), scales) for q in quantities]
    return {"name": view.name, "width": width, "height": height, "columns": columns}


def _column(
    view: View,
    runs: list[Run],
    quantity: str,
    truth: tuple[np.ndarray, np.ndarray] | None,
    scales: Scales,
) -> dict[str, Any]:
    def paint(linear: np.ndarray) -> str:
        if quantity in QUANTITIES and QUANTITIES[quantity].display == "data":
            small = pictures.shrink(linear, display.LONGEST_SIDE)
            return pictures.png_data_uri(pictures.to_bytes(small))
        return display.tonemapped(linear, scales.exposure if quantity == "render" else 0.0)

    values = [display.number(run.view(view.name).get(f"{quantity}_psnr")) for run in runs]
    scale = scales.error[quantity]
    reference, mask = truth or (None, None)
    cells = []
    for run, psnr in zip(runs, display.marked(values, display.decibels), strict=True):
        path = _recovered(run, view, quantity)
        empty = "not evaluated" if run.optimizes(quantity) else "known, not optimized"
        cell: dict[str, Any] = {"picture": None, "error": None, "empty": empty}
        cell["trouble"] = _nothing_learned(run) if run.optimizes(quantity) else None
        if path is not None:
            image = display.rgb(path)[0]
            cell["picture"] = paint(image)
            if reference is not None and mask is not None:
                cell["error"] = display.painted(display.error(image, reference, path), scale, mask)
        unit = "" if psnr["text"] == display.DASH else " dB"
        more = display.similar(run.view(view.name)) if quantity == "render" else ""
        cells.append(cell | {"number": psnr["text"] + unit, "best": psnr["best"], "more": more})
    shown = None if reference is None else paint(reference)
    return {"quantity": quantity, "truth": shown, "scale": scale, "cells": cells}


# ------------------------------------------------------------------------------------------ numbers


def _nothing_learned(run: Run) -> str | None:
    """Why a run is no result, in a few words; None if it is one.

    Its fit noted that nothing was learned, or each material of held-out views scores below that of
    the untrained fields.
    """
    if run.untrained:
        return None
    if any(str(line.get("note", "")).startswith(_LEARNED_NOTHING) for line in run.log):
        return "nothing learned"
    before = (run.metrics.get("yardsticks") or {}).get("untrained") or {}
    found = run.metrics.get("heldout") or {}
    keys = [f"{name}_psnr" for name in QUANTITIES]
    pairs = [(display.number(found.get(key)), display.number(before.get(key))) for key in keys]
    known = [(score, first) for score, first in pairs if score is not None and first is not None]
    below = known and all(score < first for score, first in known)
    return "worse than untrained" if below else None


def _psnrs(runs: list[Run]) -> dict[str, str]:
    """Keys and headings of the columns: quantities that some run optimized, and aligned albedo.

    Materials without a number in any run, as where no truth is known, have none.
    """
    aligned = any("albedo_psnr_aligned" in (run.metrics.get("heldout") or {}) for run in runs)
    return {
        key: heading
        for key, quantity, heading in PSNRS
        if any(run.optimizes(quantity) for run in runs)
        and (aligned or key != "albedo_psnr_aligned")
        and (quantity == "render" or any(_has_number(run, key) for run in runs))
    }


def _has_number(run: Run, key: str) -> bool:
    """Whether a PSNR of any split is a number."""
    return any(display.number((run.metrics.get(s) or {}).get(key)) is not None for s in SPLITS)


def _table(runs: list[Run]) -> list[dict[str, Any]]:
    """One row a run: for each split and quantity its mean PSNR, the best of each column marked."""
    columns = []
    for split, key in ((split, key) for split in SPLITS for key in _psnrs(runs)):
        values = [display.number((run.metrics.get(split) or {}).get(key)) for run in runs]
        tops = [_ceiling(run, key) if split == "heldout" else None for run in runs]
        marked = display.marked(values, display.decibels)
        columns.append(
            [c | {"gap": _gap(*pair)} for c, *pair in zip(marked, values, tops, strict=True)]
        )
    return [
        {
            "run": run,
            "trouble": _nothing_learned(run),
            "method": "untrained" if run.untrained else run.metrics["method"],
            "details": _details(run),
            "steps": _count(run.metrics.get("steps")),
            "samples": _count(run.metrics.get("samples")),
            "seconds": _seconds(run.metrics.get("seconds")),
            "cells": row,
        }
        for run, row in zip(runs, zip(*columns, strict=True), strict=True)
    ]


def _similar(runs: list[Run]) -> list[tuple[Run, list[dict[str, Any]]]]:
    """One row a run: SSIM and FLIP of each split, the best of each column marked.

    Empty where no run has them, as after an evaluation by an earlier version.
    """
    columns = []
    for split, (key, _, choose) in product(SPLITS, SIMILAR):
        values = [display.number((run.metrics.get(split) or {}).get(key)) for run in runs]
        columns.append(display.marked(values, display.fraction, choose))
    if all(cell["text"] == display.DASH for column in columns for cell in column):
        return []
    return [(run, list(row)) for run, row in zip(runs, zip(*columns, strict=True), strict=True)]


def _ceiling(run: Run, key: str) -> float | None:
    found = run.metrics.get("yardsticks") or {}
    return display.number((found.get("ceiling") or {}).get(key))


def _gap(value: float | None, ceiling: float | None) -> str | None:
    """How far a PSNR is from its ceiling, with its sign; None where that is not known."""
    if value is None or ceiling is None:
        return None
    return f"{'−' if value < ceiling else '+'}{abs(value - ceiling):.2f}"


def _yardsticks(runs: list[Run]) -> list[dict[str, Any]]:
    """A row for each yardstick: its PSNRs of held-out views, and the runs it is of if not all.

    Fields before their first step have no row where there is a run of them.
    """
    rows: list[dict[str, Any]] = []
    for kind in YARDSTICKS:
        if kind == "untrained" and any(run.untrained for run in runs):
            continue
        for run in runs:
            scores = (run.metrics.get("yardsticks") or {}).get(kind) or {}
            values = [display.number(scores.get(key)) for key in _psnrs(runs)]
            if all(value is None for value in values):
                continue
            same = next((r for r in rows if (r["kind"], r["values"]) == (kind, values)), None)
            if same is None:
                cells = ["" if v is None else display.decibels(v) for v in values]
                same = {"kind": kind, "values": values, "cells": cells, "labels": []}
                rows.append(same)
            same["labels"] += [] if run.untrained else [run.label]
    trained = [run.label for run in runs if not run.untrained]
    return [row | {"labels": [] if row["labels"] == trained else row["labels"]} for row in rows]


def _details(run: Run) -> list[tuple[str, str, str]]:
    """What is to be known of a run, in a few words each: text, symbol and subscript."""
    return [*_described(run), *((text, "", "") for text in [*_trend(run), *_warnings(run)])]


def _trend(run: Run) -> list[str]:
    """Whether the fit was still improving, by the error on pixels that it did not learn from."""
    found = run.metrics.get("convergence") or {}
    keys = ("change", "share", "noise")
    change, share, noise = (display.number(found.get(key)) for key in keys)
    word = {
        "improving": "still improving",
        "plateau": "at a plateau",
        "rising": "getting worse",
        "unclear": "too noisy",
    }
    if change is None or share is None or found.get("trend") not in word:
        return []
    spread = "" if noise is None else f" ± {100 * noise:.1f}"
    moved = f"{'rose' if change > 0 else 'fell'} by {100 * abs(change):.1f}{spread} %"
    told = f"the error on held-aside pixels {moved} over the last {100 * share:.0f} % of the fit"
    return [f"{word[found['trend']]} ({told})"]


def _warnings(run: Run) -> list[str]:
    """Steps that were skipped, and what a fit's watchdog noted."""
    skipped = sum(line.get("skipped", 0) for line in run.log)
    told = [f"{_count(skipped)} of {_count(run.metrics.get('steps'))} steps skipped"]
    return [*(told if skipped else []), *(line["note"] for line in run.log if "note" in line)]


def _described(run: Run) -> list[tuple[str, str, str]]:
    """Representations, unknown and estimator of a run as text, symbol and subscript."""
    metrics = run.metrics
    if "estimator" not in metrics:
        return []
    estimator = str(metrics["estimator"])
    details = [(form, "φ", "")] if (form := _form(metrics.get("representation"))) else []
    if differing := metrics.get("data_changed"):
        details.append((f"evaluated on other {_listed(differing)}", "", ""))
    if run.untrained:
        return [*details, ("initial values, the same for all methods", "", "")]
    details.append((_form(metrics.get("radiance")) or "no", "L", "θ"))
    if metrics.get("warm_start"):
        details.append(("solved before the fit", "L", "θ"))
    if _unknown(metrics) != "materials":
        details.append(
            (f"{OPTIMIZED.get(_unknown(metrics), 'something').lower()} optimized", "", "")
        )
    if metrics.get("bounces", 1) != 1:
        details.append((f"{metrics['bounces']} bounces", "", ""))
    if metrics.get("prior", "extra-bounce") != "extra-bounce":
        details.append((f"{metrics['prior']} prior".replace("-", " "), "", ""))
    passes = {"all-pairs": "all pairs", "split-halves": "split halves", "two-pass": "two passes"}
    return [*details, (passes.get(estimator, estimator), "", "")]


def _form(name: object) -> str | None:
    """What a representation is called on the page; the name of one that is not registered."""
    if not isinstance(name, str):
        return None
    return representation(name).title if name in representations() else name


def _materials(runs: list[Run]) -> list[str]:
    """Quantities of materials that some run optimized."""
    return [name for name in QUANTITIES if any(run.optimizes(name) for run in runs)]


def _listed(words: Sequence[str]) -> str:
    """Words as a sentence lists them."""
    return " and ".join(filter(None, [", ".join(words[:-1]), *words[-1:]]))


def _words(names: Sequence[str], display: str | None = None) -> list[str]:
    """Quantities in a sentence: all, or those that are displayed so."""
    rows = [QUANTITIES[name] for name in names]
    return [row.title.lower() for row in rows if display in (None, row.display)]


def _unknown(metrics: dict[str, Any]) -> str:
    return str(metrics.get("unknown", "materials"))


def _optimized(runs: list[Run]) -> str:
    """What the runs optimized, for the title."""
    kinds = {_unknown(run.metrics) for run in runs}
    if len(kinds) == 1:
        return OPTIMIZED.get(kinds.pop(), "Scene")
    return "Materials and lighting" if any("materials" in k for k in kinds) else "Lighting"


def _count(value: object) -> str:
    number = display.number(value)
    if number is None:
        return "—"
    for unit, size in (("G", 1e9), ("M", 1e6)):
        if number >= 0.9995 * size:  # what is rounded up to it, too
            return f"{number / size:.3g}\N{NO-BREAK SPACE}{unit}"
    return f"{number:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def _seconds(value: object) -> str:
    number = display.number(value)
    if number is None:
        return "—"
    return f"{number:.1f}" if number < 100 else _count(round(number))


def _definitions(runs: list[Run]) -> dict[str, list[dict[str, Any]]]:
    """Definitions of the numbers in each part of the page, from the evaluations."""
    psnrs = _psnrs(runs)
    told = {k: v for k, v in DEFINED.items() if k in psnrs or k != "albedo_psnr_aligned"}
    numbers = [_told(run, told) | _rendering(run) for run in runs]
    lighting = {
        kind: [_told(run, words) if run.optimizes(kind) else {} for run in runs]
        for kind, words in LIGHT_DEFINED.items()
    }
    cameras = [_told(run, {"camera": "Cameras"}) for run in runs]
    lacking = [_told(run, {"outliers": "Outliers"}) for run in runs]
    parts = {"numbers": numbers, "camera": cameras, "outliers": lacking} | lighting
    return {part: _grouped(runs, said) for part, said in parts.items()}


def _told(run: Run, names: dict[str, str]) -> dict[str, str]:
    said = run.metrics.get("definitions") or {}
    return {name: str(said[key]) for key, name in names.items() if said.get(key)}


def _rendering(run: Run) -> dict[str, str]:
    said = run.metrics.get("render") or {}
    spp, depth = said.get("spp", display.DASH), said.get("max_depth", display.DASH)
    told = {"Rendered with": f"{spp} samples a pixel, path depth {depth}"} if said else {}
    exposure = display.number(run.metrics.get("display_exposure"))
    return told if exposure is None else told | {"Display exposure": f"{exposure:+.1f} stops"}


def _grouped(runs: list[Run], said: list[dict[str, str]]) -> list[dict[str, Any]]:
    """One entry for all runs with the same definitions; none for runs without."""
    entries: list[dict[str, Any]] = []
    for run, words in zip(runs, said, strict=True):
        same = next((entry for entry in entries if entry["words"] == words), None)
        if same is not None:
            same["labels"].append(run.label)
        elif words:
            entries.append({"words": words, "labels": [run.label]})
    return entries


def _settings(runs: list[Run]) -> dict[str, list[tuple[str, list[str]]]]:
    """Settings that differ between runs, and those that all share."""
    keys = list(dict.fromkeys(key for run in runs for key in run.config))
    rows = [(key, [_setting(run.config.get(key)) for run in runs]) for key in keys]
    return {
        "differing": [row for row in rows if len(set(row[1])) > 1],
        "shared": [row for row in rows if len(set(row[1])) == 1],
    }


def _setting(value: object) -> str:
    if value is None:
        return "—"
    return str(value).lower() if isinstance(value, bool) else str(value)


# ------------------------------------------------------------------------------------------- curves


def _loss_charts(runs: list[Run]) -> list[dict[str, Any]]:
    logged = dict.fromkeys(name for run in runs for line in run.log for name in loss_terms(line))
    names = [*(name for name in TERMS if name in logged), *(n for n in logged if n not in TERMS)]
    titles = {name: _term_title(name) for name in names}
    if any("held_aside" in line for run in runs for line in run.log):
        titles["held_aside"] = "Photometric loss, held-aside pixels"
    return _charts(
        runs, [run.log for run in runs], titles, "relative L2, no unit", logarithmic=True
    )


def _term_title(name: str) -> str:
    """The title of a term, also of a regularizer and of a term that is not registered here."""
    title = TERMS[name].title if name in TERMS else name.replace("_", " ").capitalize()
    return title or name


def _score_charts(runs: list[Run]) -> list[dict[str, Any]]:
    logs = [score_curve(run.log) for run in runs]
    return _charts(runs, logs, SCORES, "dB", axes=("seconds", "step"))


def _charts(
    runs: list[Run],
    logs: list[list[dict[str, Any]]],
    titles: Mapping[str, str],
    unit: str,
    *,
    axes: Sequence[str] = tuple(AXES),
    logarithmic: bool = False,
) -> list[dict[str, Any]]:
    """A panel for each x axis and each key of `titles` that some log has."""
    labels = [run.label for run in runs]
    panels = []
    for x_key, (key, title) in product(axes, titles.items()):
        x_title = AXES[x_key]
        figure = charts.chart(logs, x_key, x_title, lambda r, k=key: r.get(k), logarithmic)
        if figure is not None:
            svg = charts.inline_svg(figure, f"{title} over {x_title}", labels)
            panels.append({"title": title, "unit": unit, "svg": svg})
    return panels


def _race(runs: list[Run]) -> list[dict[str, Any]]:
    """For each quantity, times to the scores that runs end with, and below.

    Empty if fewer than two runs have scores.
    """
    raced = [run for run in runs if not run.untrained]
    targets = time_to_quality({run.label: score_curve(run.log) for run in raced})
    if len({target.run for target in targets}) < 2:
        return []
    index = {run.label: i for i, run in enumerate(runs)}
    tables: dict[str, list[dict[str, Any]]] = {}
    for target in targets:
        row = {
            "run": index[target.run],
            "below": f"{target.below:g} dB below" if target.below else None,
            "target": display.decibels(target.psnr),
            "times": [
                {"text": _seconds(t), "best": t is not None and t == _first(target.seconds)}
                for t in target.seconds.values()
            ],
        }
        tables.setdefault(target.quantity, []).append(row)
    return [{"title": NAMES.get(name, name), "rows": rows} for name, rows in tables.items()]


def _first(times: Mapping[str, float | None]) -> float | None:
    return min((t for t in times.values() if t is not None), default=None)


def _validation_charts(runs: list[Run]) -> list[dict[str, Any]]:
    """Charts of the validation on one view; none if all views were scored."""
    logs = _validations(runs)
    if all(score_curve(run.log) for run, log in zip(runs, logs, strict=True) if log):
        return []
    return _charts(runs, logs, VALIDATION, "dB")


def _validations(runs: list[Run]) -> list[list[dict[str, Any]]]:
    """For each run its log records with a validation, whose numbers become keys of the record."""
    return [[r | r["validation"] for r in run.log if r.get("validation")] for run in runs]


def _environment() -> jinja2.Environment:
    return jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
