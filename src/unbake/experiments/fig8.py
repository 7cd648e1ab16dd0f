"""Figure 8: the ablation for an environment map that is optimized, with known materials."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..dataset.lighting import true_environment
from ..imaging.pictures import montage, read_exr, tonemap, write_png
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .scene_fits import ABLATION, SceneFits, exposure
from .scenes import scenes_at
from .tables import decibels, markdown

#: The held-out view below the maps.
VIEW = 0


def _scene_fits(context: ExperimentContext) -> SceneFits:
    scene = next(scene for scene in scenes_at(context) if not scene.room)
    scene_fits = SceneFits.of(context, scene, ABLATION.values())
    config = dataclasses.replace(scene_fits.config, unknown="lighting", score_seconds=0.0)
    return dataclasses.replace(scene_fits, config=config)


def _jobs(context: ExperimentContext) -> list[Job]:
    return _scene_fits(context).jobs(context)


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    scene_fits = _scene_fits(context)
    rows, lines = [], []
    for title, method in ABLATION.items():
        fit = findings[scene_fits.scene.folder][method]
        row = {"step": title} | scene_fits.row(context, method, fit) | fit["environment"]
        rows.append({key: value for key, value in row.items() if value is not None})
        error, relit = f"{100 * row['sh_error']:.1f} %", decibels(row["relight_psnr"])
        lines.append([title, row["steps"], error, relit, decibels(row["render_psnr"])])
    titles = ["step", "steps", "SH error", "relighting", "rendering"]
    caption = f"{scene_fits.scene.label}, materials known; PSNR in dB, "
    caption += "renderings: mean over held-out views\n\n"
    sheet = _picture(context, scene_fits)
    return ExperimentResult(
        rows, caption + markdown(titles, lines), lambda path: write_png(path, sheet)
    )


def _picture(context: ExperimentContext, scene_fits: SceneFits) -> np.ndarray:
    """The recovered maps, and a view lit by them; the truth on the right."""
    view = scene_fits.heldout(context)[VIEW]
    runs = [scene_fits.run(context, method) for method in ABLATION.values()]
    maps = [read_exr(run.environment()) for run in runs]
    renderings = [run.picture(view.split, view.name, "render") for run in runs]
    truth = true_environment(scene_fits.scene.data(context))
    photograph = read_exr(view.image)
    images = [
        exposure(photograph) * picture for picture in (*map(read_exr, renderings), photograph)
    ]
    return montage([[tonemap(p[..., :3]) for p in row] for row in ([*maps, truth], images)])


EXPERIMENT = Experiment("fig8", "The ablation, for the environment (Fig. 8)", _jobs, _result)
