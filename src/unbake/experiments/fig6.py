"""Figures 1 and 6: the materials that each method recovers in the eight scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..comparison.compare import UNTRAINED
from ..imaging.pictures import write_png
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .scene_fits import LENGTH, QUALITIES, SceneFits
from .scenes import PaperScene, scenes_at
from .seeds import plus_minus
from .tables import markdown

Row = dict[str, Any]

#: Columns of the figure.
METHODS = {
    "direct": "direct",
    "PRB": "prb",
    "AD-PT": "ad-pt",
    "ours": "ours",
    "no prior": "no-prior",
}
#: Columns of the tables at equal samples: fitted again with as many as `SLOW` traced in its time.
AT_EQUAL_SAMPLES = {name: METHODS[name] for name in ("direct", "ours", "no prior")}
SLOW = "PRB"
#: Estimators of squared errors in words.
ESTIMATORS = {"all-pairs": "all pairs", "split-halves": "split halves", "two-pass": "two passes"}
#: Methods that are shown with the better one.
WITH_CHOICE = ("PRB", "AD-PT")
#: Held-out views of each scene in the pictures.
VIEWS = (0, 1)


def _seeds(context: ExperimentContext, scene: PaperScene) -> int:
    """Number of seeds. At cpu scale one of all rooms takes an hour."""
    return context.pick(2, 2 if scene.room else 3, 1)


def _all_fits(context: ExperimentContext) -> list[SceneFits]:
    return [
        SceneFits.of(context, scene, METHODS.values(), _seeds(context, scene))
        for scene in scenes_at(context)
    ]


def _jobs(context: ExperimentContext) -> list[Job]:
    jobs = []
    for scene_fits in _all_fits(context):
        jobs += scene_fits.jobs(context)
        quick = list(AT_EQUAL_SAMPLES.values())
        jobs += scene_fits.jobs_at_equal_samples(context, METHODS[SLOW], quick)
    return jobs


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    rows: list[Row] = []
    for scene_fits in _all_fits(context):
        folder = scene_fits.scene.folder
        write_png(context.out / "fig6" / f"{folder}.png", scene_fits.picture(context, VIEWS))
        for title, method in ({UNTRAINED: UNTRAINED} | METHODS).items():
            fits = scene_fits.fits(context, findings, method)
            told = scene_fits.rows(context, fits, method=title)
            if title in AT_EQUAL_SAMPLES:
                equal = scene_fits.fits_at_equal_samples(context, findings, method)
                told = _beside(told, scene_fits.rows(context, equal))
            elif title == SLOW:
                told = _beside(told, told)
            rows += told
            views = scene_fits.qualities(context, fits[0])
            head = {"method": title, "scene": scene_fits.scene.label}
            rows += [head | views[number] for number in VIEWS]
    return ExperimentResult(rows, tables(rows))


def _beside(rows: list[Row], equal: list[Row]) -> list[Row]:
    """Rows with the numbers at equal samples, as KEY_at_equal_samples."""
    merged = []
    for row, other in zip(rows, equal, strict=True):
        numbers = {}
        for key in (*LENGTH, *QUALITIES):
            for end in ("", "_sd"):
                if key + end in other:
                    numbers[f"{key}_at_equal_samples{end}"] = other[key + end]
        merged.append(row | numbers)
    return merged


def _estimators(by_scene: Mapping[str, str]) -> str:
    """Estimators in words, with their scenes if there are several."""
    used = {e: [s for s in by_scene if by_scene[s] == e] for e in by_scene.values()}
    if len(used) == 1:
        return ESTIMATORS[next(iter(used))]
    return ", ".join(f"{ESTIMATORS[e]} in {', '.join(scenes)}" for e, scenes in used.items())


def tables(rows: list[Row]) -> str:
    """The tables of rows of some scenes, as Markdown."""
    means = {(row["scene"], row["method"]): row for row in rows if "seeds" in row}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    by_scene = {m: {scene: means[scene, m]["estimator"] for scene in scenes} for m in METHODS}
    estimators = "; ".join(f"{m}: {_estimators(by_scene[m])}" for m in WITH_CHOICE)
    others = {e for m in METHODS if m not in WITH_CHOICE for e in by_scene[m].values()}
    parts = [
        "PSNR in dB, mean over held-out views; ± is the standard deviation over so many seeds. "
        f"Samples are camera samples traced in all passes. Estimators: {estimators}; "
        f"the others: {' or '.join(ESTIMATORS[e] for e in sorted(others))}"
    ]
    names = {"albedo_psnr": "albedo", "roughness_psnr": "roughness", "render_psnr": "rendering"}
    equal = [m for m in METHODS if m in AT_EQUAL_SAMPLES or m == SLOW]
    for title, columns, end in (
        ("Equal time", [UNTRAINED, *METHODS], ""),
        (f"Equal samples, those of {SLOW} in equal time", equal, "_at_equal_samples"),
    ):
        for key in QUALITIES:
            lines = [
                [
                    scene,
                    int(means[scene, SLOW]["seeds"]),
                    *(plus_minus(means[scene, m], key + end) for m in columns),
                ]
                for scene in scenes
            ]
            table = markdown(["scene", "seeds", *columns], lines)
            parts.append(f"{title}: {names[key]}\n\n{table}")
    lines = [
        [scene, *(f"{means[scene, m]['samples'] / 1e6:.0f} M" for m in METHODS)] for scene in scenes
    ]
    parts.append(f"Samples in equal time\n\n{markdown(['scene', *METHODS], lines)}")
    return "\n\n".join(parts)


EXPERIMENT = Experiment(
    "fig6",
    "Materials of the eight scenes (Fig. 1, 6)",
    _jobs,
    _result,
    seeded=True,
    by_scene=True,
)
