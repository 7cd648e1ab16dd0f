"""Samples of searches of roughness that are made up, and small fields to search in."""

import numpy as np

from unbake.config import RoughnessSearchConfig
from unbake.fields.settings import GridConfig, NetworkConfig, PieceConfig
from unbake.training.roughness_curves import NODES
from unbake.transport.by_roughness import row_type

SEARCH = RoughnessSearchConfig()
SMALL = NetworkConfig(
    GridConfig(levels=2, table_log2=8, base_resolution=2),
    width=8,
    hidden=1,
    pieces=PieceConfig(most=64, colours=2, own_colours=2),
)


def made_up(count=400, true=(0.24, 0.55), noise=0.0):
    """Rows of two pieces of surface, in whose photographs albedo differs from what it is by now."""
    rng = np.random.default_rng(1)
    rows = np.zeros(count, row_type(len(NODES)))
    rows["piece"], rows["strength"] = np.arange(count) % 2, 1
    rows["position"] = rng.uniform(0, 1, (count, 3))
    rows["albedo"], rows["weight"], rows["gain"] = 0.5, 1, 1
    sharp = rng.uniform(0.2, 1, (count, 1, 1))  # how much of a highlight a pixel shows
    nodes = np.array(NODES)[None, :, None]
    rows["plain"] = sharp * np.exp(-3 * nodes)
    rows["coloured"] = rng.uniform(0.5, 1, (count, 1, 3)) * (1 + 0 * nodes)
    rows["plain2"], rows["coloured2"] = rows["plain"] ** 2, rows["coloured"] ** 2
    rows["mixed"] = rows["plain"] * rows["coloured"]
    r = np.array(true)[rows["piece"]][:, None]
    factor = np.array([0.8, 1.3])[rows["piece"]][:, None]
    rows["target"] = sharp[:, 0] * np.exp(-3 * r) + factor * rows["coloured"][:, 0]
    rows["target"] += noise * rng.standard_normal((count, 3))
    return rows
