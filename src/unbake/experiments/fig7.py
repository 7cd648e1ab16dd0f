"""Figure 7: from direct illumination to ours, one step after the other."""

from __future__ import annotations

from collections.abc import Mapping

from ..imaging.pictures import write_png
from .experiment import Experiment, Found, Part, Setting, Shown, markdown
from .ladder import ABLATION, QUALITIES, Ladder, decibels
from .scenes import scenes_at

#: Columns of the figure.
METHODS = ABLATION | {"ours without prior": "no-prior"}
#: The held-out view that is shown.
VIEW = 0


def _ladder(setting: Setting) -> Ladder:
    # As in Figure 6, so that what both show is fitted once.
    return Ladder.of(setting, scenes_at(setting)[0], METHODS.values())


def _parts(setting: Setting) -> list[Part]:
    return _ladder(setting).parts(setting)


def _show(setting: Setting, found: Mapping[str, Found]) -> Shown:
    ladder = _ladder(setting)
    fits = found[ladder.scene.folder]
    rows = [
        {"step": title} | ladder.row(setting, method, fits[method])
        for title, method in METHODS.items()
    ]
    table = markdown(
        ["step", "steps", "albedo", "roughness", "rendering"],
        [[r["step"], r["steps"], *(decibels(r[k]) for k in QUALITIES)] for r in rows],
    )
    caption = f"{ladder.scene.label}; PSNR in dB, mean over held-out views\n\n"
    sheet = ladder.picture(setting, [VIEW])
    return Shown(rows, caption + table, lambda path: write_png(path, sheet))


EXPERIMENT = Experiment("fig7", "The ablation, for materials (Fig. 7)", _parts, _show)
