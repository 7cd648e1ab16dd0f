"""What of the photographs counts. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ..errors import POSITIVE, require_ranges
from .flag import Flag

Outliers = Literal["kept", "found"]


@dataclass(frozen=True)
class ObjectiveConfig:
    """How errors count that no material explains (ours); see `training/outliers.py`."""

    outliers: Annotated[
        Outliers,
        Flag(
            "What photographs show and the mesh lacks: kept, all pixels count alike, or found, "
            "where blocks of pixels that stay unexplained lose their weight"
        ),
    ] = "kept"
    block: int = 8  #: edge of the blocks in pixels
    tolerance: float = 10.0  #: errors, in mean errors, that leave a quarter of the weight
    learning_rate: float = 0.1  #: Adam; of the log odds of blocks

    def __post_init__(self) -> None:
        require_ranges(
            self,
            {"block": (1, 1024), "tolerance": (POSITIVE, 1e6), "learning_rate": (0, 1e3)},
        )
