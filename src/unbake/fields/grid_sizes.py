"""How large hash grids are that settings leave open: as fine as photographs tell surfaces apart.

Pure functions of numbers; `training/grid_sizes.py` has those of a data set. Ours, not the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from .settings import FINEST, FieldSettings, GridConfig, NetworkConfig

#: Levels and tables that are chosen. A level is a dozen launches, and the optimiser reads and
#: writes whole tables. Objects need up to 9 levels. A scene with a lamp as far away as a sun, or a
#: floor that ends at the horizon, needs more for the same cells.
LEVELS, TABLES = (2, 18), (15, 19)


@dataclass(frozen=True)
class SurfaceSeen:
    """The surface that the training views see, in world units.

    Args:
        extent: side of the cube that fields live in, positive.
        footprint: width of a pixel on the surfaces, the median over pixels; positive.
        area: of all surface that is seen, roughly.
    """

    extent: float
    footprint: float
    area: float


#: Where no data set tells: seven levels of albedo, and the smallest tables.
USUAL = SurfaceSeen(extent=1.0, footprint=1 / 200, area=0.0)


def sized(settings: FieldSettings, seen: SurfaceSeen) -> FieldSettings:
    """The settings of a field with sizes of its hash grid where they leave them open.

    Other representations, and sizes that are given, stay.
    """
    if not isinstance(settings, NetworkConfig):
        return settings
    grid = sized_grid(settings.grid, seen)
    return settings if grid == settings.grid else replace(settings, grid=grid)


def sized_grid(grid: GridConfig, seen: SurfaceSeen) -> GridConfig:
    """The same hash grid with sizes where it leaves them open."""
    levels = grid.levels or levels_for(grid, seen)
    return replace(grid, levels=levels, table_log2=grid.table_log2 or table_for(grid, seen))


def is_open(settings: FieldSettings) -> bool:
    """Whether the settings leave a size of a hash grid open."""
    if not isinstance(settings, NetworkConfig):
        return False
    return not (settings.grid.levels and settings.grid.table_log2)


def levels_for(grid: GridConfig, seen: SurfaceSeen) -> int:
    """The fewest levels whose finest cells are at most as wide as `footprints` of a pixel."""
    cells = seen.extent / (seen.footprint * grid.footprints)
    least, most = LEVELS
    if grid.growth > 1:
        finer = math.log2(grid.growth)
        base = math.log2(grid.base_resolution)
        # The finest resolution that settings may have.
        most = min(most, 1 + math.floor((FINEST - base) / finer))
        least = max(least, 1 + math.ceil((math.log2(cells) - base) / finer))
    return min(least, most)


def table_for(grid: GridConfig, seen: SurfaceSeen) -> int:
    """log2 of the number of entries for all finest cells on the seen surface."""
    cells = seen.area / (seen.footprint * grid.footprints) ** 2
    least, most = TABLES
    return min(max(least, math.ceil(math.log2(max(cells, 1.0)))), most)
