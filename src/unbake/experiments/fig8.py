"""Figure 8: the ablation for an unknown environment map, around an object of known material."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ..data.lights import true_environment
from ..imaging.pictures import montage, read_exr, tonemap, write_png
from .experiment import Experiment, Found, Part, Setting, Shown, markdown
from .ladder import Ladder, decibels, exposure, lasting
from .scenes import SCENES

#: Columns of the figure.
METHODS = {
    "direct": "direct",
    "+ prior": "with-prior",
    "+ stop gradient": "with-stop-gradient",
    "+ second bounce": "with-second-bounce",
    "+ LHS (ours)": "ours",
}
#: The held-out view that is shown below the maps.
VIEW = 0


def _ladder(setting: Setting) -> Ladder:
    name = "DRAGON" if setting.scale == "smoke" else "LEGO"
    scene = next(scene for scene in SCENES if scene.name == name)
    config = lasting(
        dataclasses.replace(scene.settings(setting), unknown="lighting"),
        setting.pick(0.0, 60.0, 0.0),
        steps=setting.pick(6, 1, scene.steps),
        score_seconds=0.0,
    )
    return Ladder(scene, list(METHODS.values()), config, spp=setting.pick(2, 32, 128))


def _parts(setting: Setting) -> list[Part]:
    ladder = _ladder(setting)
    return [ladder.scene.capture(setting), ladder.part(setting, setting.pick(2.0, 25.0, None))]


def _show(setting: Setting, found: Mapping[str, Found]) -> Shown:
    ladder = _ladder(setting)
    rows, lines = [], []
    for title, method in METHODS.items():
        row = found[ladder.scene.folder][method]
        length = {k: row[k] for k in ("steps", "samples", "seconds")}
        head = {"step": title, "method": method, "scene": ladder.scene.label}
        *_, mean = ladder.qualities(setting, method, row)
        light = row["environment"] | {"render_psnr": mean["render_psnr"]}
        rows.append(head | length | light)
        off, relit = f"{100 * light['sh_error']:.1f} %", decibels(light["relight_psnr"])
        lines.append([title, row["steps"], off, relit, decibels(light["render_psnr"])])
    titles = ["step", "steps", "low frequencies off", "relighting", "rendering"]
    caption = f"{ladder.scene.label}, materials known; PSNR in dB, "
    caption += "renderings: mean over held-out views\n\n"
    sheet = _picture(setting, ladder)
    return Shown(rows, caption + markdown(titles, lines), lambda path: write_png(path, sheet))


def _picture(setting: Setting, ladder: Ladder) -> np.ndarray:
    """The maps that were found, and a view lit by them; the truth on the right."""
    view = ladder.heldout(setting, VIEW)
    folders = [ladder.evaluation(setting, method) for method in METHODS.values()]
    maps = [read_exr(folder / "environment.exr") for folder in folders]
    renderings = [folder / view.split / f"{view.name}_render.exr" for folder in folders]
    truth = true_environment(ladder.scene.data(setting))
    photograph = read_exr(view.image)
    images = [
        exposure(photograph) * picture for picture in (*map(read_exr, renderings), photograph)
    ]
    return montage([[tonemap(p[..., :3]) for p in row] for row in ([*maps, truth], images)])


EXPERIMENT = Experiment("fig8", "The ablation, for the environment (Fig. 8)", _parts, _show)
