"""Figure 7: the ablation for materials, from direct illumination to ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..comparison.compare import UNTRAINED
from ..imaging.pictures import write_png
from .experiment import Experiment, ExperimentContext, ExperimentResult
from .jobs import Findings, Job
from .scene_fits import ABLATION, QUALITIES, SceneFits
from .scenes import scenes_at
from .seeds import plus_minus, seeds_in_words
from .tables import markdown

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
    rows: list[dict[str, Any]] = []
    lines = []
    for title, method in ({"untrained": UNTRAINED} | METHODS).items():
        fits = scene_fits.fits(context, findings, method)
        mean, *per_seed = scene_fits.rows(context, fits, step=title, method=method)
        rows += [mean, *per_seed]
        psnrs = (plus_minus(mean, key) for key in QUALITIES)
        lines.append([title, f"{mean.get('steps', 0):.0f}", *psnrs])
    table = markdown(["step", "steps", "albedo", "roughness", "rendering"], lines)
    caption = f"{scene_fits.scene.label}; PSNR in dB, mean over held-out views, "
    caption += f"{seeds_in_words(len(scene_fits.seeds))}\n\n"
    sheet = scene_fits.picture(context, [VIEW])
    return ExperimentResult(rows, caption + table, lambda path: write_png(path, sheet))


EXPERIMENT = Experiment("fig7", "The ablation, for materials (Fig. 7)", _jobs, _result, seeded=True)
