"""Figure 7: the ablation for materials, from direct illumination to ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..imaging.pictures import write_png
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .scene_fits import ABLATION, QUALITIES, SceneFits
from .scenes import scenes_at
from .tables import decibels, markdown

#: Columns of the figure.
METHODS = ABLATION | {"ours without prior": "no-prior"}
#: The held-out view in the picture.
VIEW = 0


def _scene_fits(context: ExperimentContext) -> SceneFits:
    # With the settings of Figure 6: both share the fits.
    return SceneFits.of(context, scenes_at(context)[0], METHODS.values())


def _jobs(context: ExperimentContext) -> list[Job]:
    return _scene_fits(context).jobs(context)


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    scene_fits = _scene_fits(context)
    fits = findings[scene_fits.scene.folder]
    rows: list[dict[str, Any]] = [
        {"step": title} | scene_fits.row(context, method, fits[method])
        for title, method in METHODS.items()
    ]
    table = markdown(
        ["step", "steps", "albedo", "roughness", "rendering"],
        [[r["step"], r["steps"], *(decibels(r[k]) for k in QUALITIES)] for r in rows],
    )
    caption = f"{scene_fits.scene.label}; PSNR in dB, mean over held-out views\n\n"
    sheet = scene_fits.picture(context, [VIEW])
    return ExperimentResult(rows, caption + table, lambda path: write_png(path, sheet))


EXPERIMENT = Experiment("fig7", "The ablation, for materials (Fig. 7)", _jobs, _result)
