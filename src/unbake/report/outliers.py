"""The page's section on what a fit took for things that the mesh lacks."""

from __future__ import annotations

from typing import Any

import numpy as np

from unbake.imaging import pictures
from unbake.report import display
from unbake.report.runs import EvaluatedRun


def outlier_section(runs: list[EvaluatedRun]) -> list[dict[str, Any]] | None:
    """A share and pictures for each run that looked for outliers; None if none did.

    Raises:
        UserError: an evaluated picture is gone.
    """
    found = []
    for run in runs:
        told = run.metrics.get("outliers")
        if not told:
            continue
        shares = {row["name"]: row["share"] for row in told["images"]}
        figures = []
        for name in told["shown"]:
            file = display.evaluated(run, run.folder.picture("train", name, "outliers", ".png"))
            small = pictures.shrink(pictures.read_png(file), display.LONGEST_SIDE)
            picture = pictures.png_data_uri(np.round(small).astype(np.uint8))
            figures.append({"name": name, "picture": picture, "share": _percent(shares.get(name))})
        found.append({"label": run.label, "share": _percent(told["share"]), "figures": figures})
    return found or None


def _percent(share: object) -> str:
    known = display.number(share)
    return display.DASH if known is None else f"{100 * known:.1f} %"
