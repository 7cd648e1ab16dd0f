"""What a fit took for things that the mesh lacks: shares of photographs, and pictures of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ..dataset.views import fitted_pixels, read_photograph
from ..imaging.pictures import tonemap, write_png
from ..training.recovered import Recovered
from ..training.run_folder import EvaluationFolder

#: Pictures of views with outliers, at most: of those with the largest share.
_PICTURES = 12
#: Outliers are as bright as the photograph, half in this colour.
_TINT = np.array([255, 0, 255])

DEFINITIONS = {
    "outliers": "share of the pixels of training photographs in blocks that lost over half of "
    "their weight in the fit, because they stayed unexplained; masked and hidden pixels are left "
    "out. Scores count all others alike",
}


def evaluate_outliers(
    recovered: Recovered, out: EvaluationFolder, tell: Callable[[str], None]
) -> dict[str, Any]:
    """Numbers for `metrics.json`, and pictures beside it; empty where all pixels count alike.

    Raises:
        UserError: a photograph cannot be read.
    """
    model, views = recovered.problem.outliers, recovered.dataset.train
    if model is None:
        return {}
    background, taken = recovered.dataset.background, model.taken()
    lost, counts = [], []
    for number, (view, blocks) in enumerate(zip(views, taken, strict=True)):
        counted = model.pixels_in(number, fitted_pixels(view, background))
        lost.append(int(counted[blocks].sum()))
        counts.append(int(counted.sum()))
    shares = [part / max(count, 1) for part, count in zip(lost, counts, strict=True)]
    whole = sum(lost) / max(sum(counts), 1)
    most = sorted(range(len(views)), key=lambda i: -shares[i])[:_PICTURES]
    shown = sorted(i for i in most if shares[i] > 0)
    for i in shown:
        picture = tonemap(read_photograph(views[i], recovered.clip_negative)[..., :3])
        mask = model.mask(i, taken[i])
        if (counted := fitted_pixels(views[i], background)) is not None:
            mask &= counted
        picture[mask] = (picture[mask] // 2 + _TINT // 2).astype(np.uint8)
        write_png(out.picture("train", views[i].name, "outliers", ".png"), picture)
    tell(
        f"outliers: {100 * whole:.1f} % of the pixels, {100 * max(shares):.1f} % of a view at most"
    )
    images = [{"name": view.name, "share": s} for view, s in zip(views, shares, strict=True)]
    return {"outliers": {"share": whole, "images": images, "shown": [views[i].name for i in shown]}}
