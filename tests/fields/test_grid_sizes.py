"""How large hash grids are, by what photographs show: numbers alone."""

from dataclasses import replace

import pytest

from unbake.fields.grid_sizes import LEVELS, TABLES, USUAL, SurfaceSeen, is_open, sized
from unbake.fields.settings import BitmapConfig, GridConfig, NetworkConfig


def size(seen, **grid):
    found = sized(NetworkConfig(GridConfig(**grid)), seen).grid
    return found.levels, found.table_log2


@pytest.mark.parametrize("cells", [33, 64, 65, 200, 256, 257, 1000])
def test_the_finest_cells_are_the_widest_that_are_no_wider_than_a_footprint(cells):
    seen = SurfaceSeen(extent=5.0, footprint=5.0 / cells, area=0.0)
    levels, _ = size(seen)
    assert 4 * 2 ** (levels - 2) < cells * (1 + 1e-9) and 4 * 2 ** (levels - 1) > cells * (1 - 1e-9)
    # Eight footprints are three levels, whatever the footprint.
    assert size(seen, footprints=8.0)[0] == levels - 3


def test_the_unit_of_length_does_not_matter():
    seen = SurfaceSeen(extent=10.4, footprint=0.052, area=422.0)
    scaled = SurfaceSeen(extent=1040.0, footprint=5.2, area=422e4)
    assert size(seen) == size(scaled) == (7, 18)


@pytest.mark.parametrize(("area", "table"), [(0, 15), (32768, 15), (32769, 16), (2**17, 17)])
def test_a_table_has_room_for_the_footprints_of_the_surface(area, table):
    assert size(SurfaceSeen(100.0, 1.0, area))[1] == table
    assert size(SurfaceSeen(100.0, 1.0, 64 * area), footprints=8.0)[1] == table


def test_sizes_have_bounds():
    assert size(SurfaceSeen(1.0, 1e-9, 1.0)) == (LEVELS[1], TABLES[1])
    assert size(SurfaceSeen(1.0, 10.0, 1e-9)) == (LEVELS[0], TABLES[0])


@pytest.mark.parametrize("base", [1, 3, 4, 1 << 20, 1 << 24])
@pytest.mark.parametrize("growth", [1.0, 1.0001, 1.5, 3.0, 2.0**24])
def test_any_base_and_growth_have_a_size_that_settings_accept(base, growth):
    for footprint in (1e-9, 1e-3, 0.1, 10.0):
        levels, _ = size(SurfaceSeen(1.0, footprint, 1.0), base_resolution=base, growth=growth)
        assert 1 <= levels <= LEVELS[1]


def test_a_smaller_growth_takes_more_levels():
    seen = SurfaceSeen(1.0, 1 / 200, 0.0)
    assert size(seen, growth=1.5)[0] == 11  # 4 * 1.5^10 = 231
    assert size(seen, base_resolution=16)[0] == 5  # 16 * 2^4 = 256


def test_sizes_that_are_given_stay():
    seen = SurfaceSeen(100.0, 1.0, 1e6)
    assert size(seen, levels=3) == (3, 19) and size(seen, table_log2=9) == (6, 9)
    whole = NetworkConfig(GridConfig(3, table_log2=9), width=5)
    assert sized(whole, seen) is whole and not is_open(whole)
    assert is_open(NetworkConfig(GridConfig(3))) and is_open(
        NetworkConfig(GridConfig(table_log2=9))
    )
    bitmap = BitmapConfig(9)
    assert sized(bitmap, seen) is bitmap and not is_open(bitmap)
    wide = NetworkConfig(width=5, learning_rate=0.5)
    assert sized(wide, seen) == replace(wide, grid=sized(wide, seen).grid)


def test_without_a_data_set_sizes_are_the_usual_ones():
    assert size(USUAL) == (7, 15) and size(USUAL, footprints=8.0) == (4, 15)
    assert size(USUAL, footprints=2.0) == (6, 15)
