"""Whether the processes of a fit share its photographs, or each holds all of them.

Processes that share them each learn from their own views (`dataset/shares.py`). The mean over
processes then is that over all views, for terms that are means over pixels. What is no such mean,
and would become another objective, is told here.
"""

from __future__ import annotations

from ..config import FitConfig
from ..dataset.views import Dataset
from ..ranks import Ranks
from .told_scale import may_be_untold


def kept_whole(config: FitConfig, dataset: Dataset, ranks: Ranks) -> str | None:
    """Why each process holds all photographs, in a few words; None where they are shared.

    Args:
        config: of the fit.
        dataset: of the fit, with training views.
        ranks: more than one.

    Raises:
        UserError: the scene or a mask cannot be read.
    """
    regularization, views = config.regularization, len(dataset.train)
    scattered = config.pixel_sampling == "all-views"
    reasons = {
        f"there are {views} training views for {ranks.size} processes": views < ranks.size,
        # Adam would take steps of one length on each, whatever the process weighs, and a process
        # would forget what its views do not tell.
        "processes take steps by themselves (--sync-every)": config.sync_every > 1,
        # μ is a multiple of the mean error over all views.
        "outliers are found by the error of all views (--outliers)": (
            config.objective.outliers != "kept"
        ),
        # In crops both points of a pair are of one view anyway.
        "points of all views are paired (regularization.albedo_ties_roughness)": (
            scattered and config.learns_materials and regularization.albedo_ties_roughness > 0
        ),
    }
    told = next((told for told, holds in reasons.items() if holds), None)
    # The square of a mean is not the mean of squares of parts.
    if told is None and may_be_untold(config, dataset):
        told = "the mean albedo of all views is known (lighting.anchor)"
    return told
