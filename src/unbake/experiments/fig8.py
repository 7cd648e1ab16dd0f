"""Figure 8: the ablation for an unknown environment map, around an object of known material."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..data.lights import true_environment
from ..imaging.pictures import montage, read_exr, tonemap, write_png
from .experiment import Experiment, Found, Part, Setting, Shown, markdown
from .ladder import ABLATION, Ladder, decibels, exposure
from .scenes import scenes_at

#: The held-out view that is shown below the maps.
VIEW = 0


def _ladder(setting: Setting) -> Ladder:
    scene = next(scene for scene in scenes_at(setting) if not scene.room)
    ladder = Ladder.of(setting, scene, ABLATION.values())
    config = dataclasses.replace(ladder.config, unknown="lighting", score_seconds=0.0)
    return dataclasses.replace(ladder, config=config)


def _parts(setting: Setting) -> list[Part]:
    return _ladder(setting).parts(setting)


def _show(setting: Setting, found: Mapping[str, Found]) -> Shown:
    ladder = _ladder(setting)
    rows, lines = [], []
    for title, method in ABLATION.items():
        fit = found[ladder.scene.folder][method]
        row = {"step": title} | ladder.row(setting, method, fit) | fit["environment"]
        rows.append({key: value for key, value in row.items() if value is not None})
        off, relit = f"{100 * row['sh_error']:.1f} %", decibels(row["relight_psnr"])
        lines.append([title, row["steps"], off, relit, decibels(row["render_psnr"])])
    titles = ["step", "steps", "low frequencies off", "relighting", "rendering"]
    caption = f"{ladder.scene.label}, materials known; PSNR in dB, "
    caption += "renderings: mean over held-out views\n\n"
    sheet = _picture(setting, ladder)
    return Shown(rows, caption + markdown(titles, lines), lambda path: write_png(path, sheet))


def _picture(setting: Setting, ladder: Ladder) -> np.ndarray:
    """The maps that were found, and a view lit by them; the truth on the right."""
    view = ladder.heldout(setting)[VIEW]
    folders = [ladder.evaluation(setting, method) for method in ABLATION.values()]
    maps = [read_exr(folder / "environment.exr") for folder in folders]
    renderings = [folder / view.split / f"{view.name}_render.exr" for folder in folders]
    truth = true_environment(ladder.scene.data(setting))
    photograph = read_exr(view.image)
    images = [
        exposure(photograph) * picture for picture in (*map(read_exr, renderings), photograph)
    ]
    return montage([[tonemap(p[..., :3]) for p in row] for row in ([*maps, truth], images)])


EXPERIMENT = Experiment("fig8", "The ablation, for the environment (Fig. 8)", _parts, _show)
