"""The roughness that is to be expected of each piece of surface."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from searches import SEARCH, SMALL, made_up
from support import of_format

from unbake.config import FitConfig, read_toml, to_toml
from unbake.fields.field import FieldSpec
from unbake.fields.network import Network
from unbake.training import piece_levels
from unbake.training.piece_levels import LEVELS, expected, with_expected_levels
from unbake.training.roughness_curves import NODES, Curves, in_range, points
from unbake.training.roughness_search import descend, searched
from unbake.transport.by_roughness import PLACE

RED, BLUE = (0.9, 0.3, 0.3), (0.2, 0.3, 0.9)


def parabolas(least, known):
    """Errors of pieces that are least at their level, as much more beside it as is known of it."""
    least, known = np.array(least)[:, None], np.array(known)[:, None]
    return known * (LEVELS - least) ** 2


def levels_of(errors, colours, settings=SEARCH, pixels=100.0):
    return expected(errors, np.full(len(errors), pixels), np.array(colours), settings)


def test_what_photographs_show_stays():
    true = [0.2, 0.35, 0.7, 0.8]
    found = levels_of(parabolas(true, [1e5] * 4), [RED, BLUE, RED, BLUE])
    np.testing.assert_allclose(found, true, atol=0.01)


def test_what_photographs_do_not_show_is_as_of_like_colours():
    true, known = [0.25] * 6 + [0.75] * 6, [1e4] * 5 + [0.0] + [1e4] * 5 + [0.0]
    found = levels_of(parabolas(true, known), [RED] * 6 + [BLUE] * 6)
    assert found[5] == pytest.approx(0.25, abs=0.08)
    assert found[11] == pytest.approx(0.75, abs=0.08)
    # Where all colours are alike it is the mean of all pieces.
    found = levels_of(
        parabolas(true, known), [RED] * 6 + [BLUE] * 6, replace(SEARCH, like_colours=99)
    )
    np.testing.assert_allclose(found[[5, 11]], 0.5, atol=0.03)


def test_errors_are_as_small_as_with_the_true_distribution():
    rng, materials = np.random.default_rng(3), np.array([0.3, 0.85])
    true = rng.choice(materials, 300)
    known = 10 ** rng.uniform(-1, 3, 300)
    least = np.clip(true + rng.standard_normal(300) / np.sqrt(known), LEVELS[0], LEVELS[-1])
    errors = parabolas(least, known)
    found = levels_of(errors, [RED] * 300, replace(SEARCH, pixels_as_one=1.0))
    chance = np.exp(-known[:, None] * (materials - least[:, None]) ** 2 / 2)
    best = chance @ materials / chance.sum(1)
    of_minima, of_found, of_best = (
        np.square(x - true).mean() for x in (LEVELS[errors.argmin(1)], found, best)
    )
    assert of_best < of_found < 1.2 * of_best < of_minima


def test_a_piece_alone_does_not_confirm_its_own_noise():
    (found,) = levels_of(parabolas([LEVELS[0]], [1.0]), [RED], pixels=1e4)
    assert found == pytest.approx(LEVELS.mean(), abs=0.1)


def test_a_piece_does_not_confirm_its_own_noise_through_the_others(monkeypatch):
    # Ten pieces are known to be rough, of ten photographs tell nothing, and one seems smooth.
    sharp = 100 * (LEVELS - 0.85) ** 2
    errors = np.stack([sharp] * 10 + [0 * sharp] * 10 + [24.0 * (LEVELS > 0.2)])

    def of_the_odd_one():
        return levels_of(errors, [RED] * 21, replace(SEARCH, pixels_as_one=3.0))[-1]

    assert of_the_odd_one() > 0.7
    monkeypatch.setattr(piece_levels, "_MOST_ODD", 0)
    assert of_the_odd_one() < 0.45


def test_a_piece_that_differs_from_a_crowd_stays_what_photographs_show():
    true = [0.8] * 100 + [0.3]
    found = levels_of(parabolas(true, [1e4] * 101), [RED] * 101)
    assert found[-1] == pytest.approx(0.3, abs=0.02)


def test_a_few_pieces_do_not_tell_one_level_for_all():
    """What differs between four is not all noise; of two in a crowd of one level it is."""
    true, noise = [0.25, 0.4, 0.5, 0.7], 0.1
    crowd = parabolas([0.45] * 200, [SEARCH.pixels_as_one / noise**2] * 200)
    errors = parabolas(true, [SEARCH.pixels_as_one / noise**2] * 4)
    assert np.ptp(levels_of(errors, [RED] * 4)) > 0.15
    found = levels_of(np.concatenate([errors[1:3], crowd]), [RED] * 202)[:2]
    np.testing.assert_allclose(found, 0.45, atol=0.03)


def test_large_pieces_are_told_by_all_of_their_pixels():
    """Two of 20,000 pixels each stay apart; if few of many pixels told, they would seem alike."""
    errors = parabolas([0.4, 0.6], [0.2 * 20_000] * 2)
    far, near = (
        np.diff(levels_of(errors, [RED] * 2, pixels=pixels))[0] for pixels in (20_000.0, 2e6)
    )
    assert far > 0.15 > 0.1 > near


def roughness_at(field, parameters, point):
    before = dict(field.parameters())
    field.assign(before | parameters)
    found = np.array(in_range(field.evaluate(point)))
    field.assign(before)
    return found


def test_pieces_move_as_a_whole_and_nothing_else_does():
    rows = made_up(noise=0.02)
    rows["weight"] /= 0.02**2
    rows["weight"][rows["piece"] == 1] *= 1e-9  # of which photographs show nothing
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    curves = Curves.of(rows, 2, 6, albedo=True)
    first = descend(field, curves, replace(SEARCH, steps=200), 0.02)
    before = {key: np.array(x.array) for key, x in field.parameters().items()}
    found = with_expected_levels(field, curves, first, SEARCH)
    assert set(found) == set(first)
    np.testing.assert_array_equal(found["colours"].array, first["colours"].array)
    for key, x in field.parameters().items():
        assert np.array_equal(np.array(x.array), before[key]), key
    known = rows["piece"] == 0
    value = roughness_at(field, found, curves.point)
    assert value[known].mean() == pytest.approx(0.24, abs=0.03)
    # Both pieces are of one colour.
    assert value[~known].mean() == pytest.approx(0.24, abs=0.06)
    apart = {}
    for name, numbers in (("first", first), ("found", found)):
        value = (roughness_at(field, numbers, curves.point) - 0.02) / 0.98
        apart[name] = np.log(value / (1 - value))
    change = apart["found"] - apart["first"]
    for piece in (known, ~known):
        np.testing.assert_allclose(change[piece], change[piece].mean(), atol=1e-3)


def test_a_piece_without_a_curve_is_as_others_of_its_colour():
    rows = made_up(true=(0.24, 0.7))
    rows["weight"] *= 1e5
    # Photographs show a factor of 1.3, which leaves albedo below 1.
    rows["albedo"] = 0.75 * np.where(rows["piece"][:, None], BLUE, RED)
    shown = np.zeros(len(rows), PLACE)
    for name in shown.dtype.names:
        shown[name] = rows[name]
    more = shown.copy()
    more["piece"] += 2  # of which no pixel shows nothing else
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.5, seed=2))
    curves = Curves.of(rows, 2, 6, True, None, np.concatenate([shown, more]))
    found = searched(field, curves, SEARCH, 0.02)
    for piece, (true, other) in enumerate(((0.24, 0.7), (0.7, 0.24))):
        of_piece = shown[shown["piece"] == piece], more[more["piece"] == 2 + piece]
        told, untold = (roughness_at(field, found, points(x, albedo=True)) for x in of_piece)
        assert told.mean() == pytest.approx(true, abs=0.02)
        # One piece of a like colour counts as much as what all pieces have in common.
        assert untold.mean() == pytest.approx((3 * true + other) / 4, abs=0.05)
        # What varies within it is not known either.
        assert untold.std() < 0.02


def test_a_piece_moves_further_than_a_short_descent():
    rows = made_up(true=(0.24, 0.9))
    rows["weight"] *= 1e5
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.1, seed=2))
    curves = Curves.of(rows, 2, 6, albedo=True)
    near, far = (
        roughness_at(field, searched(field, curves, settings, 0.02), curves.point)
        for settings in (replace(SEARCH, steps=3, pixels_as_one=0), replace(SEARCH, steps=3))
    )
    high = rows["piece"] == 1
    assert near[high].mean() < 0.2
    assert far[high].mean() == pytest.approx(0.9, abs=0.03)


def test_what_is_smoother_than_curves_know_stays():
    rows = made_up(true=(0.1, 0.1))
    rows["weight"] *= 1e5
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.03, seed=2))
    curves = Curves.of(rows, 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    before = roughness_at(field, numbers, curves.point)
    after = roughness_at(field, with_expected_levels(field, curves, numbers, SEARCH), curves.point)
    assert before.max() < 0.06
    np.testing.assert_allclose(after, before, atol=1e-4)


def test_pieces_beyond_the_last_number_move_together():
    rows = made_up(noise=0.02)
    rows["weight"] /= 0.02**2
    rows["piece"] += 70  # the field has 64 numbers
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.8, seed=2))
    curves = Curves.of(rows, 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    found = with_expected_levels(field, curves, numbers, SEARCH)
    value = roughness_at(field, found, curves.point)
    assert value.std() < 0.02
    assert 0.24 < value.mean() < 0.55


def sums_between(nodes):
    """Sums over a piece whose curves have these sums at nodes, at 200 roughnesses."""
    rows = made_up(count=40, true=(0.1, 0.1))
    rows["piece"] = 0
    rows["coloured"] = rows["coloured2"] = rows["mixed"] = rows["target"] = 0
    rows["plain"], rows["plain2"] = 0, (np.array(nodes) / 40)[:, None]
    curves = Curves.of(rows, 2, 6, albedo=True)
    between = np.geomspace(NODES[0], NODES[-1], 200)
    return np.array([float(dr.sum(curves.at(dr.full(mi.Float, x, 40)))[0]) for x in between])


def test_there_is_no_hollow_beside_a_cliff():
    sums = sums_between([2, 87, 1289, 1300, 1310, 1320, 1330, 1335, 1340])
    assert np.diff(sums).min() > -1e-2
    assert sums_between([3, 2, 1289, 1300, 1310, 1320, 1330, 1335, 1340]).min() > 0


def test_sums_are_least_between_nodes_where_they_fall_and_rise():
    place = np.log(0.48)
    sums = sums_between(100 * (np.log(NODES) - place) ** 2)
    least = np.geomspace(NODES[0], NODES[-1], 200)[sums.argmin()]
    assert least == pytest.approx(0.48, abs=0.01)
    assert sums.min() == pytest.approx(0, abs=0.5)


def test_squared_errors_far_below_zero_do_not_count():
    assert sums_between([-4000] * len(NODES)).min() == pytest.approx(-40)


def test_older_runs_stay_at_what_is_most_probable(tmp_path):
    file = tmp_path / "config.toml"
    text = to_toml(FitConfig())
    file.write_text(text)
    assert read_toml(file).roughness_search == SEARCH
    old = of_format(text, 2).splitlines()
    kept = [x for x in old if not x.startswith("pixels_as_one")]
    file.write_text("\n".join(kept))
    assert read_toml(file).roughness_search == replace(SEARCH, pixels_as_one=0)


def test_rough_ground_in_the_sun_is_where_its_curve_is_least():
    # It falls steeply, and rises slowly where the light is hidden in the lobe anyway.
    known = {0.43: 184080, 0.55: 51509, 0.7: 3885, 0.8: 0, 0.9: 1880}
    logs = np.log(list(known))
    sums = sums_between(np.interp(np.log(NODES), logs, list(known.values())) / 1000)
    least = np.geomspace(NODES[0], NODES[-1], 200)[sums.argmin()]
    assert least == pytest.approx(0.8, abs=0.02)
