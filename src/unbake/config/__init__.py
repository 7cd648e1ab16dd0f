"""The settings of a fit, read from and written to TOML. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from ..fields.settings import (
    BitmapConfig,
    DenseGridConfig,
    FieldSettings,
    GridConfig,
    NetworkConfig,
)
from .camera import CameraConfig
from .fit import (
    MOST_BOUNCES,
    PAPER_DEPTH,
    ChosenEstimator,
    Estimator,
    FitConfig,
    LightingConfig,
    PathConfig,
    Precision,
    PresetName,
    PriorName,
    Reference,
    RegularizationConfig,
    TransportConfig,
    Unknown,
)
from .flag import Flag
from .objective import ObjectiveConfig
from .presets import QUALITIES, preset, with_method, with_quality
from .roughness_search import RoughnessSearchConfig
from .tables import update
from .toml import from_toml, read_toml, to_tables, to_toml

__all__ = [
    "MOST_BOUNCES",
    "PAPER_DEPTH",
    "QUALITIES",
    "BitmapConfig",
    "CameraConfig",
    "ChosenEstimator",
    "DenseGridConfig",
    "Estimator",
    "FieldSettings",
    "FitConfig",
    "Flag",
    "GridConfig",
    "LightingConfig",
    "NetworkConfig",
    "ObjectiveConfig",
    "PathConfig",
    "Precision",
    "PresetName",
    "PriorName",
    "Reference",
    "RegularizationConfig",
    "RoughnessSearchConfig",
    "TransportConfig",
    "Unknown",
    "from_toml",
    "preset",
    "read_toml",
    "to_tables",
    "to_toml",
    "update",
    "with_method",
    "with_quality",
]
