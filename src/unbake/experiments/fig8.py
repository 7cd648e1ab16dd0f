"""Figure 8: the ablation for an environment map that is optimized, with known materials."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from ..comparison.compare import UNTRAINED
from ..dataset.lighting import true_environment
from ..imaging.pictures import montage, read_exr, tonemap, write_png
from ..training.run_folder import RunFolder
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .scene_fits import ABLATION, SceneFits, exposure
from .scenes import scenes_at
from .seeds import plus_minus, seeds_in_words
from .tables import markdown

#: The held-out view below the maps.
VIEW = 0


def _scene_fits(context: ExperimentContext) -> SceneFits:
    scene = next(scene for scene in scenes_at(context) if not scene.room)
    scene_fits = SceneFits.of(context, scene, ABLATION.values())
    # Ours has two bounces on objects by default: a row would have a bounce more, not only a term.
    config = dataclasses.replace(
        scene_fits.config, unknown="lighting", score_seconds=0.0, bounces=1
    )
    return dataclasses.replace(scene_fits, config=config)


def _jobs(context: ExperimentContext) -> list[Job]:
    return _scene_fits(context).jobs(context)


#: Columns of the table: title, key, factor.
COLUMNS = (
    ("SH error, %", "sh_error", 100.0),
    ("SH error, aligned", "sh_error_aligned", 100.0),
    ("relighting, dB", "relight_psnr", 1.0),
    ("relighting, aligned", "relight_psnr_aligned", 1.0),
    ("rendering, dB", "render_psnr", 1.0),
)


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    scene_fits = _scene_fits(context)
    rows: list[dict[str, Any]] = []
    lines = []
    for title, method in ({"untrained": UNTRAINED} | ABLATION).items():
        fits = scene_fits.fits(context, findings, method)
        mean, *per_seed = scene_fits.rows(context, fits, step=title, method=method)
        rows += [mean, *per_seed]
        numbers = (plus_minus(mean, key, factor=factor) for _, key, factor in COLUMNS)
        lines.append([title, f"{mean.get('steps', 0):.0f}", *numbers])
    caption = f"{scene_fits.scene.label}, materials known; renderings: mean over held-out views; "
    caption += "aligned: after the best factor for each channel; "
    caption += f"{seeds_in_words(len(scene_fits.seeds))}\n\n"
    table = markdown(["step", "steps", *(title for title, *_ in COLUMNS)], lines)
    sheet = _picture(context, scene_fits)
    return ExperimentResult(rows, caption + table, lambda path: write_png(path, sheet))


def _picture(context: ExperimentContext, scene_fits: SceneFits) -> np.ndarray:
    """The maps of the first seed, and a view lit by them; the truth on the right."""
    view, folder = scene_fits.heldout(context)[VIEW], scene_fits.runs(context, scene_fits.seeds[0])
    runs = [RunFolder(folder / method) for method in ABLATION.values()]
    maps = [read_exr(run.environment()) for run in runs]
    renderings = [run.picture(view.split, view.name, "render") for run in runs]
    truth = true_environment(scene_fits.scene.data(context))
    photograph = read_exr(view.image)
    images = [
        exposure(photograph) * picture for picture in (*map(read_exr, renderings), photograph)
    ]
    return montage([[tonemap(p[..., :3]) for p in row] for row in ([*maps, truth], images)])


EXPERIMENT = Experiment(
    "fig8", "The ablation, for the environment (Fig. 8)", _jobs, _result, seeded=True
)
