"""Settings to start from."""

from __future__ import annotations

import dataclasses
from typing import Any

from ..errors import UserError
from ..fields.settings import GridConfig, NetworkConfig
from ..quantities import QUANTITIES
from .fit import FitConfig, PresetName


def _paper() -> FitConfig:
    """Sec. 5.3, 5.4 and Table 1 (STAIRCASE): resolutions 2^1 … 2^16, table 2^17, Adam 5e-4."""
    grid = GridConfig(levels=16, features=2, table_log2=17, base_resolution=2, growth=2.0)
    return FitConfig(
        preset="paper",
        steps=18_000,
        pixels=16_384,
        spp=16,
        radiance_spp=0,
        final_learning_rate=1.0,
        warm_up=0,
        estimator="two-pass",
        loss_reference="photograph",
        loss_epsilon=0.01,
        **_networks(grid),
    )


def _networks(grid: GridConfig) -> dict[str, Any]:
    """All fields as networks over the same hash grid (Sec. 5.3, 5.4)."""
    material = NetworkConfig(grid, width=256, hidden=1, learning_rate=5e-4)
    return {
        "materials": {name: {"neural": material} for name in QUANTITIES},
        "radiance": {"neural": NetworkConfig(grid, width=256, hidden=3, learning_rate=5e-4)},
    }


def _release() -> FitConfig:
    """The settings of the authors' public release: 17 levels, base 2, scale 1.5, table 2^18."""
    grid = GridConfig(levels=17, features=2, table_log2=18, base_resolution=2, growth=1.5)
    return dataclasses.replace(
        _paper(),
        preset="release",
        **_networks(grid),
    )


def preset(name: PresetName) -> FitConfig:
    """The settings of a preset: `cpu` (ours, two cores), `paper` (Sec. 5) or `release`."""
    match name:
        case "cpu":
            return FitConfig()
        case "paper":
            return _paper()
        case "release":
            return _release()
    raise UserError(f"no preset named {name!r}", remedy="Presets are cpu, paper and release")
