"""Figures 1 and 6: the materials that each method recovers in the eight scenes."""

from __future__ import annotations

from collections.abc import Mapping

from ..imaging.pictures import write_png
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .scene_fits import MATERIALS, QUALITIES, SceneFits, at_equal_samples
from .scenes import scenes_at
from .tables import decibels, markdown

#: Columns of the figure.
METHODS = {"direct": "direct", "PRB": "prb", "ours": "ours", "no prior": "no-prior"}
#: Held-out views of each scene in the pictures.
VIEWS = (0, 1)


def _all_fits(context: ExperimentContext) -> list[SceneFits]:
    return [SceneFits.of(context, scene, METHODS.values()) for scene in scenes_at(context)]


def _jobs(context: ExperimentContext) -> list[Job]:
    return [job for scene_fits in _all_fits(context) for job in scene_fits.jobs(context)]


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    rows = []
    for scene_fits in _all_fits(context):
        scene = scene_fits.scene
        methods = findings[scene.folder]
        equal = at_equal_samples(methods)
        write_png(context.out / "fig6" / f"{scene.folder}.png", scene_fits.picture(context, VIEWS))
        for title, method in METHODS.items():
            row = methods[method]
            head = {"scene": scene.label, "method": title}
            length = {k: row[k] for k in ("steps", "samples", "seconds")}
            same = {f"{k}_at_equal_samples": v for k, v in equal[method].items()}
            *views, mean = scene_fits.qualities(context, method, row)
            rows.append(head | mean | length | same)
            rows += [head | views[number] for number in VIEWS]
    return ExperimentResult(rows, _tables(rows))


def _tables(rows: list[dict]) -> str:
    means = {(r["scene"], r["method"]): r for r in rows if "steps" in r}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    samples = [f"{quality}_at_equal_samples" for quality in MATERIALS]
    tables = []
    for title, keys in (
        ("Equal time: albedo / roughness / rendering", QUALITIES),
        ("Equal samples: albedo / roughness", samples),
    ):
        lines = [
            [scene, *(" / ".join(decibels(means[scene, m].get(k)) for k in keys) for m in METHODS)]
            for scene in scenes
        ]
        table = markdown(["scene", *METHODS], lines)
        tables.append(f"{title}; PSNR in dB, mean over held-out views\n\n{table}")
    lines = [
        [scene, *(f"{means[scene, m]['samples'] / 1e6:.0f} M" for m in METHODS)] for scene in scenes
    ]
    tables.append(f"Samples in equal time\n\n{markdown(['scene', *METHODS], lines)}")
    return "\n\n".join(tables)


EXPERIMENT = Experiment("fig6", "Materials of the eight scenes (Fig. 1, 6)", _jobs, _result)
