"""How long paths are that are followed to their end: as long as the light of a data set needs."""

from __future__ import annotations

from dataclasses import replace

from ..config import PAPER_DEPTH, FitConfig
from ..dataset.views import Dataset

#: The share of the light that paths carry at least.
SHARE = 0.99


def with_path_depth(config: FitConfig, dataset: Dataset) -> FitConfig:
    """The settings with a depth of paths, where they leave it open (`path.max_depth = 0`).

    It is the smallest that carries 99 % of the light in the training views, but not less than the
    paper's, 15. It is 15 as well where the data set does not say how much light paths carry. (Light
    that is left out is explained by wrong materials, and with Russian roulette a larger depth takes
    hardly any time where there is little light to follow.)

    Paper: Sec. 6.
    """
    if config.path.max_depth:
        return config
    depth = max(PAPER_DEPTH, dataset.depth_of_light(SHARE) or 0)
    return replace(config, path=replace(config.path, max_depth=depth))


def told_depth(config: FitConfig, dataset: Dataset) -> str:
    """One line on the depth of paths, and how much of the light they carry."""
    depth = config.path.chosen_depth
    carried = dataset.light_of_depth(depth)
    if carried is None:
        return f"paths end at depth {depth}; the data set does not say how much light they carry"
    text = f"paths end at depth {depth} and carry {100 * carried:.1f} % of the light"
    if carried < SHARE:
        text += "; path.max_depth = 0 chooses a depth that carries more"
    if depth == PAPER_DEPTH:
        return text
    return f"{text} (depth {PAPER_DEPTH}: {100 * (dataset.light_of_depth(PAPER_DEPTH) or 0):.1f} %)"
