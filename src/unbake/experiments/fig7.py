"""Figure 7: from direct illumination to ours, one step after the other."""

from __future__ import annotations

from collections.abc import Mapping

from ..imaging.pictures import write_png
from .experiment import Experiment, Found, Part, Setting, Shown, markdown
from .fig6 import ladder_of
from .ladder import QUALITIES, Ladder, decibels
from .scenes import SCENES, STAIRCASE

#: Columns of the figure.
METHODS = {
    "direct": "direct",
    "+ prior": "with-prior",
    "+ stop gradient": "with-stop-gradient",
    "+ second bounce": "with-second-bounce",
    "+ LHS (ours)": "ours",
    "ours without prior": "no-prior",
}
#: The held-out view that is shown.
VIEW = 0


def _ladder(setting: Setting) -> Ladder:
    # As in Figure 6, so that what both show is fitted once.
    scene = SCENES[-1] if setting.scale == "smoke" else STAIRCASE
    return ladder_of(setting, scene, list(METHODS.values()))


def _parts(setting: Setting) -> list[Part]:
    ladder = _ladder(setting)
    return [ladder.scene.capture(setting), ladder.part(setting, setting.pick(2.0, 30.0, None))]


def _show(setting: Setting, found: Mapping[str, Found]) -> Shown:
    ladder = _ladder(setting)
    rows = []
    for title, method in METHODS.items():
        row = found[ladder.scene.folder][method]
        length = {k: row[k] for k in ("steps", "samples", "seconds")}
        head = {"step": title, "method": method, "scene": ladder.scene.label}
        *_, mean = ladder.qualities(setting, method, row)
        rows.append(head | length | mean)
    table = markdown(
        ["step", "steps", "albedo", "roughness", "rendering"],
        [[r["step"], r["steps"], *(decibels(r[k]) for k in QUALITIES)] for r in rows],
    )
    caption = f"{ladder.scene.label}; PSNR in dB, mean over held-out views\n\n"
    sheet = ladder.picture(setting, [VIEW])
    return Shown(rows, caption + table, lambda path: write_png(path, sheet))


EXPERIMENT = Experiment("fig7", "The ablation, for materials (Fig. 7)", _parts, _show)
