"""Roughness differs from place to place on a piece of surface as far as photographs tell."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from searches import SEARCH, SMALL, made_up
from support import of_format

from unbake.config import FitConfig, from_toml, to_toml
from unbake.fields.arrays import from_numpy
from unbake.fields.field import FieldSpec, holding
from unbake.fields.network import Network
from unbake.training import piece_places
from unbake.training.piece_places import (
    SHIFTS,
    _Cells,
    _first_half,
    _shares,
    _solved,
    expected_places,
)
from unbake.training.piece_variation import with_all_variation
from unbake.training.roughness_curves import NODES, Curves, of_roughness, points, roughness_of
from unbake.training.roughness_search import averaged, searched
from unbake.training.seen_pieces import outputs_of

PLACED = replace(SMALL, pieces=replace(SMALL.pieces, places=4, variation=True))
NOISE = 0.02
GENTLE_NOISE = 0.06
#: The test has less noise than photographs: pixels count one by one, and albedo is as it should be.
SURE = replace(SEARCH, pixels_as_one=1.0, place_cells=1, cells=1)


def roughness_by_place(position):
    return 0.4 + 0.2 * np.sin(2 * np.pi * position[:, 0]) * np.cos(2 * np.pi * position[:, 1])


def light_of(rows, roughness):
    """What pixels of `made_up` show at a roughness, shape (n, 3)."""
    sharp = rows["plain"][:, :1] / np.exp(-3 * 0.1)
    return (sharp * np.exp(-3 * roughness)[:, None, None] + rows["coloured"][:, :1])[:, 0]


def photographed(count=20_000, seed=2):
    """Rows of two pieces, of which the first differs from place to place, and the truth."""
    rows = made_up(count)
    rng = np.random.default_rng(seed)
    true = np.where(rows["piece"] == 0, roughness_by_place(rows["position"]), 0.55)
    rows["target"] = light_of(rows, true)
    rows["target"] += NOISE * rng.standard_normal((count, 3))
    rows["weight"] = NOISE**-2
    return rows, true


def field_of(settings=PLACED):
    return Network(settings, FieldSpec(1, bounded=True, initial=0.4, seed=2))


def values(field, numbers, rows):
    with holding(field, numbers):
        return np.array(roughness_of(field, points(rows, albedo=True)), np.float64)


def found_of(field, rows, settings=SURE, placed=True):
    curves = Curves.of(rows, settings.cells, settings.colours, albedo=True)
    return searched(field, curves, settings, 0.02, None, rows if placed else None)


def test_what_differs_from_place_to_place_is_found_where_it_does():
    rows, true = photographed()
    field = field_of()
    first, second = rows["piece"] == 0, rows["piece"] == 1
    without = values(field, found_of(field, rows, placed=False), rows)
    found = found_of(field, rows)
    roughness = values(field, found, rows)
    assert np.std(without[first] - true[first]) > 0.09
    assert np.std(roughness[first] - true[first]) < 0.04
    # The other piece has one roughness, and nothing by place.
    np.testing.assert_array_equal(np.array(found["placed"])[:2], [1, 0])
    assert np.std(roughness[second]) < 0.01
    assert roughness[second].mean() == pytest.approx(0.55, abs=0.04)
    # The next search begins without.
    with holding(field, found):
        every = with_all_variation(field, Curves.of(rows, 1, 6, albedo=True))
    assert not np.array(every["placed"]).any() and not np.array(every["places.0"]).any()


def test_searches_are_averaged_by_place_too():
    rows, _ = photographed()
    field = field_of()
    found = found_of(field, rows)
    before = {key: dr.detach(field.parameters()[key]) for key in found}
    curves = Curves.of(rows, 1, 6, albedo=True)
    mixed = averaged(field, curves, (before, found), 0.5)
    whole, half = (np.array(x["places.0"]) for x in (found, mixed))
    np.testing.assert_allclose(half, whole / 2, atol=1e-6)
    assert (np.array(mixed["placed"]) > 0).sum() == 1


def test_noise_differs_from_place_to_place_and_is_not_found():
    field = field_of()
    for seed in range(3):
        rows, _ = photographed(4000, seed)
        rows["piece"] = 1
        noisy = np.random.default_rng(seed).standard_normal((len(rows), 3))
        rows["target"] = light_of(rows, np.full(len(rows), 0.55)) + 0.3 * noisy
        rows["weight"] = 0.3**-2
        # Every pixel is there four times, each time with the noise of its photograph.
        rows = np.concatenate([rows] * 4)
        found = found_of(field, rows)
        assert not np.array(found["placed"]).any()


def test_small_cells_of_albedo_are_no_places():
    """Factors of few pixels each take up noise, and prefer another roughness all over the piece."""
    rows, rng = made_up(8000), np.random.default_rng(0)
    rows["piece"], rows["albedo"] = 1, rng.uniform(0.2, 0.9, (len(rows), 3))
    rows["target"] = rows["plain"][:, 4] + rows["coloured"][:, 4]
    rows["target"] += 0.3 * rng.standard_normal((len(rows), 3))
    rows["weight"] = 0.3**-2
    found = found_of(field_of(), rows, replace(SURE, place_cells=16))
    assert not np.array(found["placed"]).any()


def test_the_smallest_error_is_found_beyond_a_hump():
    """What is least lies at another shift on each side of the cube, and a hump is on the way."""
    where = np.random.default_rng(0).uniform(0, 1, (400, 3))
    cells = _Cells.of(np.zeros(400, int), where, (4, 8, 16))
    valley = np.where(where[:, 0] < 0.5, -1.5, 1.0)[:, None]
    curve = 100 - 60 * np.exp(-(((SHIFTS - valley) / 0.3) ** 2))
    curve += 20 * np.exp(-(((SHIFTS - valley / 2) / 0.3) ** 2))
    of_cell = cells.sums(list(curve.T), np.ones(400, bool))
    _, shifts = _solved(cells.lattices, [of_cell])
    far = shifts[0, -1, cells.of_pixel]
    assert np.mean(np.abs(far - valley[:, 0]) < 0.4) > 0.8


def test_a_gentle_change_is_found_that_lattices_would_lose_in_noise():
    """Roughness rises from one end of a piece to the other, seen by few noisy pixels."""
    rows, rng = made_up(1500), np.random.default_rng(0)
    rows["piece"], rows["position"][:, 1] = 0, 0.3
    rows["position"][:, [0, 2]] = 0.2 + 0.5 * rng.uniform(0, 1, (len(rows), 2))
    true = 0.1 + 0.8 * rows["position"][:, 0]
    rows["target"] = light_of(rows, true)
    rows["target"] += GENTLE_NOISE * rng.standard_normal((len(rows), 3))
    rows["weight"] = GENTLE_NOISE**-2
    field = field_of()
    roughness = values(field, found_of(field, rows), rows)
    assert np.std(true) > 0.1
    # With numbers on lattices alone it is 0.025.
    assert np.std(roughness - true) < 0.02


@pytest.mark.parametrize(
    ("low", "high"), [((0, 0, 0), (1, 1, 1)), ((0.1, 0.3, 0.2), (0.8, 0.3, 0.7))]
)
def test_what_is_told_around_a_piece_is_the_same_on_the_finest_lattice(low, high):
    """Whether the piece fills the scene or is flat; and so it is read from the field."""
    rng, rows = np.random.default_rng(0), made_up(3000)
    rows["position"], rows["piece"] = rng.uniform(low, high, (len(rows), 3)), 0
    cells = _Cells.of(np.zeros(len(rows), int), rows["position"].astype(float), (4, 8, 16))
    numbers = rng.standard_normal((3, len(cells.around.piece)))
    around = (numbers[:, cells.around.place] * cells.around.share).sum(2)
    *others, finest = cells.as_lattices(numbers)
    lattice = cells.lattices[-1]
    np.testing.assert_allclose((finest[:, lattice.place] * lattice.share).sum(2), around, atol=1e-9)
    assert around.std() > 0.1 and not any(x.any() for x in others)
    field = field_of()
    levels = [
        lattice.told(told[0], np.zeros(1), np.ones(1, bool))
        for lattice, told in zip(cells.lattices, (*others, finest), strict=True)
    ]
    where = (rows["position"] - cells.low[0]) / cells.size[0]
    expected = _shares(where) @ numbers[0]
    after, before = (values(field, x, rows) for x in (field.placed(levels), {}))
    changed = outputs_of(of_roughness(after)) - outputs_of(of_roughness(before))
    # Corners that share a place in the table have no number: more of them where there are more.
    wrong = np.abs(changed - expected) > 1e-3
    assert wrong.mean() < (0.02 if low[1] == high[1] else 0.15)
    assert np.median(np.abs(changed - expected)) < 1e-5


def test_small_pieces_have_one_roughness_from_end_to_end():
    """Numbers of corners far away would be large: no way around a small piece is probable."""
    rng = np.random.default_rng(0)
    where = np.concatenate([rng.uniform(0.4, 0.45, (300, 3)), rng.uniform(0, 1, (300, 3))])
    cells = _Cells.of(np.repeat([0, 1], 300), where, (4, 8))
    rows = made_up(600)
    rows["piece"], rows["position"] = np.repeat([0, 1], 300), where
    rows["target"], rows["weight"] = rows["plain"][:, 4] + rows["coloured"][:, 4], 1.0
    half = np.arange(600) % 2 == 0
    parts = [(x, Curves.of(rows[x], 4, 6, True)) for x in (half, ~half, np.ones(600, bool))]
    numbers, changes = cells.told(parts, [np.zeros(600)], np.ones(2))
    assert [len(x) for x in numbers] == [6, 6] and changes.shape == (2, 6)
    assert np.isinf(changes[0, 3:]).all() and np.isfinite(changes[1]).all()


def test_wrong_colours_alone_do_not_tell_places():
    """The mean over a piece is better than what colours say of it: by itself, not by place."""
    rows, rng = made_up(4000), np.random.default_rng(0)
    rows["piece"], rows["weight"] = 0, NOISE**-2
    rows["target"] = rows["plain"][:, 4] + rows["coloured"][:, 4]
    rows["target"] += NOISE * rng.standard_normal((len(rows), 3))
    level = outputs_of(of_roughness(NODES[4]))
    astray = level + 0.5 * rng.choice([-1, 1], len(rows))
    cells = _Cells.of(np.zeros(4000, int), rows["position"].astype(float), (4, 8))
    half = rng.random(4000) < 0.5
    parts = [(x, Curves.of(rows[x], 1, 6, True)) for x in (half, ~half, half | ~half)]
    _, of_mean = cells.told(parts, [cells.means(astray)], np.ones(1))
    _, of_both = cells.told(parts, [astray, cells.means(astray)], np.ones(1))
    np.testing.assert_allclose(of_both[0, 6:], of_mean[0], atol=1e-3)
    assert of_both.min() > -10 and of_both[0, :6].min() > 100


@pytest.mark.parametrize("variation", [True, False])
def test_what_steps_have_learned_of_a_pattern_is_not_counted_twice(variation):
    """The network has half of the slope, which numbers beside the mean have as well."""
    rows, rng = made_up(8000), np.random.default_rng(0)
    rows["piece"], rows["albedo"] = 0, 0.5
    along = rows["position"][:, 0]
    true = 0.25 + 0.5 * along
    rows["target"] = light_of(rows, true)
    rows["target"] += 0.03 * rng.standard_normal((len(rows), 3))
    rows["weight"] = 0.03**-2
    field = field_of(replace(PLACED, pieces=replace(PLACED.pieces, variation=variation)))
    own = {k: x for k, x in field.parameters().items() if k not in field.shared()}
    optimizer = mi.ad.Adam(0.02, {k: x for k, x in own.items() if not k.startswith("place")})
    learned = from_numpy(mi.Float, (0.375 + 0.25 * along).astype(np.float32))
    for _ in range(100):
        field.assign(field.parameters() | dict(optimizer.items()))
        there = roughness_of(field, points(rows, albedo=True))
        dr.backward(dr.mean(dr.square(there - learned)))
        optimizer.step()
    field.assign(field.parameters() | {k: dr.detach(x) for k, x in optimizer.items()})
    assert 0.06 < np.std(values(field, {}, rows) - true) < 0.08
    roughness = values(field, found_of(field, rows, SEARCH), rows)
    assert np.sqrt(np.mean((roughness - true) ** 2)) < (0.02 if variation else 0.05)


def test_colours_leave_to_places_what_is_theirs():
    """Roughness rises along a wall, and most of its dark spots are where it is smooth."""
    rows, _ = photographed()
    along, rng = rows["position"][:, 0], np.random.default_rng(0)
    rows["piece"] = 0
    rows["albedo"] = np.where(rng.uniform(0, 1, len(rows)) < along, 0.7, 0.2)[:, None]
    true = 0.25 + 0.5 * along
    rows["target"] = light_of(rows, true)
    rows["target"] += NOISE * rng.standard_normal((len(rows), 3))
    field = field_of()
    found = found_of(field, rows)
    other = rows.copy()
    other["albedo"] = 0.9 - rows["albedo"]
    apart = values(field, found, rows) - values(field, found, other)
    assert np.abs(apart).mean() < 0.06
    assert np.std(values(field, found, rows) - true) < 0.06


def test_pieces_that_show_most_come_first_where_there_is_no_room(monkeypatch):
    rows, _ = photographed(5000)
    rows["piece"] = np.where(rows["position"][:, 2] > 0.5, rows["piece"], 2 + rows["piece"])
    true = np.where(rows["piece"] % 2 == 0, roughness_by_place(rows["position"]), 0.55)
    rows["target"] = light_of(rows, true)
    rows["target"][rows["piece"] == 2] += 0.05 * np.random.default_rng(0).standard_normal(3)
    field = field_of()
    found = with_all_variation(field, Curves.of(rows, 1, 6, albedo=True))

    def placed():
        told = expected_places(field, rows, found, SURE, albedo=True)
        return np.array(told["placed"]) > 0

    assert placed()[[0, 2]].all()
    monkeypatch.setattr(piece_places, "_MOST_CORNERS", 4000)
    assert placed()[[0, 2]].sum() == 1
    monkeypatch.setattr(piece_places, "_MOST_CORNERS", 10)
    assert not placed().any()


def test_a_pixel_that_was_drawn_twice_is_in_one_half():
    rows, _ = photographed(1000)
    twice = np.concatenate([rows, rows[::-1]])
    half = _first_half(twice)
    np.testing.assert_array_equal(half[:1000], half[1000:][::-1])
    assert 0.4 < half.mean() < 0.6


@pytest.mark.parametrize(("count", "noise"), [(1, 0.05), (3, 0.05), (12, 0.02), (12, 0.05)])
def test_pieces_of_few_pixels_have_none(count, noise):
    """They are as they should be; some have no pixel in one of the halves."""
    field, rows, rng = field_of(), made_up(60 * count), np.random.default_rng(0)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    rows["piece"] = np.arange(len(rows)) % 60
    rows["position"] = rng.uniform(0, 0.9, (60, 3))[rows["piece"]]
    rows["position"] += rng.uniform(0, 0.1, (len(rows), 3))
    true = values(field, numbers, rows)[:, None]
    sharp = rows["plain"][:, 0] / np.exp(-3 * 0.1)
    rows["target"] = sharp * np.exp(-3 * true) + rows["coloured"][:, 0]
    rows["target"] += noise * rng.standard_normal((len(rows), 3))
    rows["weight"] = noise**-2
    found = expected_places(field, rows, numbers, SEARCH, albedo=False)
    assert not np.array(found["placed"]).any()


def test_fields_without_places_are_searched_as_without():
    rows, _ = photographed(400)
    both = (found_of(field_of(SMALL), rows, placed=placed) for placed in (True, False))
    first, second = ({key: np.array(x) for key, x in found.items()} for found in both)
    assert first.keys() == second.keys() and "placed" not in first
    for key, value in first.items():
        np.testing.assert_allclose(value, second[key], atol=1e-5)


@pytest.mark.parametrize("count", [0, 1])
def test_without_pixels_nothing_differs(count):
    rows, _ = photographed(400)
    field = field_of()
    numbers = {key: field.parameters()[key] for key in field.shared()}
    found = expected_places(field, rows[:count], numbers, SURE, albedo=True)
    assert not np.array(found["placed"]).any() and not np.array(found["places.0"]).any()


def test_pieces_that_share_a_number_unlike_have_none_by_place():
    rows, _ = photographed()
    rows["piece"] += 70  # the field has 64 numbers
    rows["strength"] = np.where(rows["piece"] == 70, 0.5, 0.1)
    field = field_of()
    numbers = {key: field.parameters()[key] for key in field.shared()}
    found = expected_places(field, rows, numbers, SURE, albedo=True)
    assert not np.array(found.get("placed", 0)).any()


def test_runs_of_before_go_on_without_places():
    text = of_format(to_toml(FitConfig()), 6)
    kept = [x for x in text.splitlines() if not x.startswith(("places =", "no_places", "place_"))]
    before = from_toml("\n".join(kept))
    assert before.materials["roughness"]["neural"].pieces.places == 0
    assert before.roughness_search == SEARCH
