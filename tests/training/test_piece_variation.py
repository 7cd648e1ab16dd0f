"""How much roughness varies within each piece of surface, as far as photographs tell."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from searches import SEARCH, SMALL, made_up
from support import of_format, randomised

from unbake.config import FitConfig, read_toml, to_toml
from unbake.fields.field import FieldSpec
from unbake.fields.network import Network
from unbake.training.piece_variation import (
    ALBEDO_PARTS,
    PARTS,
    expected_albedo,
    with_all_variation,
    with_expected_variation,
)
from unbake.training.roughness_curves import (
    NODES,
    Curves,
    albedo_errors,
    in_range,
    of_roughness,
    pieces_of,
    points,
    squared_errors,
)
from unbake.training.roughness_search import searched
from unbake.training.seen_pieces import SeenPieces, chances, outputs_of, values_of

VARIED = replace(SMALL, pieces=replace(SMALL.pieces, variation=True))


def varied_field():
    """A field whose roughness differs within pieces."""
    field = Network(VARIED, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    parameters = randomised(field)
    parameters["pieces.0"] *= 0.3
    parameters["variation"] = parameters["variation"] * 0 + 1
    parameters["grid"] *= 20
    field.assign(parameters)
    return field


def roughness_at(field, numbers, point):
    before = dict(field.parameters())
    field.assign(before | numbers)
    found = np.array(in_range(field.evaluate(point)), np.float64)
    field.assign(before)
    return found


def photographed(rows, roughness):
    """The rows with photographs of this roughness, without noise."""
    every = np.arange(len(rows))
    x = np.clip(np.log(roughness), np.log(NODES[0]), np.log(NODES[-1]))
    left = np.clip(np.searchsorted(np.log(NODES), x) - 1, 0, len(NODES) - 2)
    part = ((x - np.log(NODES)[left]) / np.diff(np.log(NODES))[left])[:, None]
    image = rows["plain"] + rows["coloured"]
    rows["target"] = image[every, left] * (1 - part) + image[every, left + 1] * part
    return rows


def sampled(count=2000):
    rows = made_up(count=count)
    rows["albedo"] = np.random.default_rng(4).uniform(0.3, 0.6, (count, 1))
    rows["weight"] = 1e5
    return rows


def spread(values, pieces):
    return np.array([values[pieces == number].std() for number in (0, 1)])


def test_what_photographs_show_to_be_one_roughness_becomes_one():
    rows, field = sampled(), varied_field()
    point = Curves.of(rows, 2, 6, albedo=True).point
    before = roughness_at(field, {}, point)
    outputs = outputs_of(of_roughness(before))
    medians = np.array([np.median(outputs[rows["piece"] == number]) for number in (0, 1)])
    middle = np.array(in_range([mi.Float(values_of(medians))]))
    curves = Curves.of(photographed(rows, middle[rows["piece"]]), 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    after = roughness_at(
        field, with_expected_variation(field, curves, numbers, SEARCH), curves.point
    )
    assert spread(before, rows["piece"]).min() > 0.02
    assert (spread(after, rows["piece"]) < 0.2 * spread(before, rows["piece"])).all()
    for number, wanted in enumerate(middle):
        assert after[rows["piece"] == number].mean() == pytest.approx(wanted, abs=0.01)


def test_what_photographs_show_to_differ_differs():
    rows, field = sampled(), varied_field()
    point = Curves.of(rows, 2, 6, albedo=True).point
    before = roughness_at(field, {}, point)
    curves = Curves.of(photographed(rows, before), 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    found = with_expected_variation(field, curves, numbers, SEARCH)
    after = roughness_at(field, found, curves.point)
    assert spread(before, rows["piece"]).min() > 0.02
    np.testing.assert_allclose(after, before, atol=0.1 * before.std())


def test_what_photographs_do_not_show_is_as_is_to_be_expected():
    rows, field = sampled(), varied_field()
    rows["weight"] = 1e-12
    curves = Curves.of(rows, 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    for probable in (0.0, 0.4, 1.0):
        settings = replace(SEARCH, one_roughness=probable)
        found = with_expected_variation(field, curves, numbers, settings)
        expected = probable * PARTS[0] + (1 - probable) * PARTS[1:].mean()
        np.testing.assert_allclose(np.array(found["variation"])[:2], expected, rtol=1e-3)
        assert (np.array(found["variation"])[2:] == 1).all()


def test_what_a_search_took_the_next_one_has_again():
    rows, field = sampled(), varied_field()
    curves = Curves.of(rows, 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    before = roughness_at(field, numbers, curves.point)
    rows["weight"] = 1e-12
    nothing = Curves.of(rows, 2, 6, albedo=True)
    settings = replace(SEARCH, one_roughness=1.0)
    flat = with_expected_variation(field, nothing, numbers, settings)
    small = spread(roughness_at(field, flat, curves.point), rows["piece"])
    assert (small < 0.03 * spread(before, rows["piece"])).all()
    field.assign(dict(field.parameters()) | flat)
    again = with_all_variation(field, curves)
    np.testing.assert_allclose(roughness_at(field, again, curves.point), before, atol=1e-3)


def test_a_search_ends_with_pieces_of_one_roughness():
    rows = made_up(count=2000, noise=0.02)
    rows["weight"] /= 0.02**2
    field = varied_field()
    curves = Curves.of(rows, 2, 6, albedo=True)
    before = {key: np.array(x.array) for key, x in field.parameters().items()}
    apart, one = (
        roughness_at(field, searched(field, curves, settings, 0.02), curves.point)
        for settings in (replace(SEARCH, pixels_as_one=0), SEARCH)
    )
    for key, x in field.parameters().items():
        assert np.array_equal(np.array(x.array), before[key]), key
    assert (spread(one, rows["piece"]) < 0.5 * spread(apart, rows["piece"])).all()
    for number, true in enumerate((0.24, 0.55)):
        assert one[rows["piece"] == number].mean() == pytest.approx(true, abs=0.04)


def albedo_field(rows):
    """A field whose albedo differs within pieces, which the rows then have."""
    settings = replace(SMALL, pieces=replace(VARIED.pieces, colours=0, gain=1.0, learned=False))
    field = Network(settings, FieldSpec(3, bounded=True, initial=0.5, seed=2))
    parameters = randomised(field)
    parameters["variation"] = parameters["variation"] * 0 + 1
    parameters["grid"] *= 10
    field.assign(parameters)
    rows["albedo"] = albedo_at(field, {}, rows)
    return field


def albedo_at(field, numbers, rows):
    before = dict(field.parameters())
    field.assign(before | numbers)
    found = np.array([np.array(x, float) for x in field.evaluate(points(rows, albedo=False))])
    field.assign(before)
    return found.T


def of_albedo(rows, albedo, roughness):
    """The rows with photographs of this albedo and roughness, without noise."""
    node = NODES.index(roughness)
    factor = albedo / rows["albedo"]
    rows["target"] = rows["plain"][:, node] + factor * rows["coloured"][:, node]
    return rows


def test_an_albedo_that_photographs_show_to_be_one_becomes_one():
    rows = sampled()
    field = albedo_field(rows)
    piece = rows["piece"]
    medians = np.array([np.median(rows["albedo"][piece == number], 0) for number in (0, 1)])
    of_albedo(rows, medians[piece], 0.33)
    found = expected_albedo(field, rows, np.full(len(rows), 0.33), SEARCH)
    assert set(found) == {"pieces.0", "pieces.1", "pieces.2", "variation"}
    np.testing.assert_allclose(np.array(found["variation"])[:2], ALBEDO_PARTS[0], rtol=1e-3)
    after = albedo_at(field, found, rows)
    for number in (0, 1):
        before = rows["albedo"][piece == number].std(0)
        assert before.min() > 0.02
        assert (after[piece == number].std(0) < 0.2 * before).all()
        middle = np.median(after[piece == number], 0)
        np.testing.assert_allclose(middle, medians[number], atol=1e-4)


def test_an_albedo_that_photographs_show_to_differ_differs():
    rows = sampled()
    field = albedo_field(rows)
    of_albedo(rows, rows["albedo"], 0.33)
    found = expected_albedo(field, rows, np.full(len(rows), 0.33), SEARCH)
    np.testing.assert_allclose(np.array(found["variation"])[:2], 1, atol=0.02)
    np.testing.assert_allclose(albedo_at(field, found, rows), rows["albedo"], atol=0.01)


def brightest(rows, values):
    """The fifth of each piece's rows with the largest values."""
    chosen = np.zeros(len(rows), bool)
    for number in (0, 1):
        own = rows["piece"] == number
        chosen |= own & (values >= np.quantile(values[own], 0.8))
    return chosen


def test_an_albedo_whose_bright_parts_alone_are_told_stays():
    rows = sampled()
    field = albedo_field(rows)
    told = rows[brightest(rows, rows["albedo"][:, 1])].copy()
    told["weight"][:, [0, 2]] = 0  # green tells all
    means = np.array([told["albedo"][told["piece"] == number].mean(0) for number in (0, 1)])
    of_albedo(told, means[told["piece"]], 0.33)
    roughness = np.full(len(told), 0.33)
    alone = expected_albedo(field, told, roughness, SEARCH)
    assert (np.array(alone["variation"])[:2] < 0.2).all()
    found = expected_albedo(field, told, roughness, SEARCH, rows)
    assert (np.array(found["variation"])[:2] > 0.7).all()
    errors = [np.abs(albedo_at(field, x, rows) - rows["albedo"])[:, 1] for x in (found, alone)]
    assert errors[0].mean() < 0.3 * errors[1].mean()


def test_a_roughness_whose_high_parts_alone_are_told_stays():
    rows, field = sampled(), varied_field()
    before = roughness_at(field, {}, Curves.of(rows, 2, 6, albedo=True).point)
    chosen = brightest(rows, before)
    told = rows[chosen].copy()
    means = np.array([before[chosen & (rows["piece"] == number)].mean() for number in (0, 1)])
    photographed(told, means[told["piece"]])
    numbers = {key: field.parameters()[key] for key in field.shared()}
    alone, found = (
        with_expected_variation(field, Curves.of(told, 2, 6, True, None, x), numbers, SEARCH)
        for x in (None, rows)
    )
    assert (np.array(alone["variation"])[:2] < 0.3).all()
    assert (np.array(found["variation"])[:2] > 0.6).all()


@pytest.mark.parametrize("count", [200, 201])
def test_the_middle_of_a_piece_is_the_median_of_all_that_shows_it(count):
    rows = sampled()
    field = albedo_field(rows)
    shown, told = rows[rows["piece"] == 0][: 2 * count].copy(), rows[:100]
    shown["piece"][::2] = 5  # which no pixel tells
    seen = SeenPieces(field, points(told, albedo=False), pieces_of(told), {})
    found = seen.middles(points(shown, albedo=False))
    wanted = np.median(outputs_of(albedo_at(field, {}, shown[1::2]).T), 1)
    np.testing.assert_allclose(found[:, 0], wanted, rtol=1e-5)
    own = outputs_of(albedo_at(field, {}, told[told["piece"] == 1]).T)
    np.testing.assert_allclose(found[:, 1], own.mean(1), rtol=1e-5)  # which nothing else shows


def test_another_search_of_albedo_goes_on_from_what_is_left():
    rows = sampled()
    field = albedo_field(rows)
    rows["weight"] = 1e-12  # photographs show nothing
    settings = replace(SEARCH, one_albedo=1.0)
    first = spread(outputs_of(rows["albedo"][:, 1]), rows["piece"])
    for factor in (1 / 8, 1 / 64, 1 / 64):
        found = expected_albedo(field, rows, np.full(len(rows), 0.33), settings)
        np.testing.assert_allclose(np.array(found["variation"])[:2], factor, rtol=1e-3)
        field.assign(dict(field.parameters()) | found)
        rows["albedo"] = albedo_at(field, {}, rows)
        now = spread(outputs_of(rows["albedo"][:, 1]), rows["piece"])
        np.testing.assert_allclose(now, factor * first, rtol=1e-3)


def test_errors_by_albedo_are_those_of_curves():
    rows = sampled()
    rows["target"] += 0.1
    rows["weight"] = 1
    factor = np.random.default_rng(2).uniform(0.5, 1.5, (len(rows), 3))
    wanted = squared_errors(rows, factor[:, None])
    for node in (0, 3, 7):
        found = albedo_errors(rows, np.full(len(rows), NODES[node]), factor * rows["albedo"])
        np.testing.assert_allclose(found, wanted[:, node], rtol=1e-5, atol=1e-6)
    middle = albedo_errors(rows, np.full(len(rows), np.sqrt(NODES[3] * NODES[4])), rows["albedo"])
    ends = [albedo_errors(rows, np.full(len(rows), NODES[i]), rows["albedo"]) for i in (3, 4)]
    assert (middle < np.maximum(*ends) + 1e-6).mean() > 0.95
    assert np.abs(middle - ends[0]).min() > 0
    beyond = albedo_errors(rows, np.full(len(rows), 0.02), factor * rows["albedo"])
    np.testing.assert_allclose(beyond, wanted[:, 0], rtol=1e-5, atol=1e-6)


def test_pixels_of_a_piece_tell_no_more_than_some_would():
    errors = np.array([[0.0, 40.0, 90.0]])
    few = replace(SEARCH, pixels_as_one=2.0, pixels_at_most=1000)
    every = replace(few, pixels_at_most=0)
    wanted = chances(errors, np.array([500.0]), every)
    np.testing.assert_allclose(chances(errors, np.array([2000.0]), few), wanted)
    np.testing.assert_allclose(chances(20 * errors, np.array([40_000.0]), few), wanted)
    assert (chances(20 * errors, np.array([40_000.0]), every) < wanted)[0, 1:].all()


def test_small_pieces_of_different_strength_that_share_a_number_stay():
    rows = sampled()
    rows["piece"] += 70  # the field has 64 numbers
    field = varied_field()
    numbers = {key: field.parameters()[key] for key in field.shared()}
    for strengths, stays in (((0.5, 0.5), False), ((0.5, 0.1), True)):
        rows["strength"] = np.array(strengths)[rows["piece"] - 70]
        curves = Curves.of(rows, 2, 6, albedo=True)
        found = with_expected_variation(field, curves, numbers, replace(SEARCH, one_roughness=1.0))
        assert (np.array(found["variation"]) == 1).all() == stays
        assert (np.array(found["pieces.0"]) == np.array(numbers["pieces.0"])).all() == stays


def test_fields_without_factors_stay():
    rows = sampled()
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    curves = Curves.of(rows, 2, 6, albedo=True)
    numbers = {key: field.parameters()[key] for key in field.shared()}
    found = with_expected_variation(field, curves, numbers, SEARCH)
    assert set(found) == {"pieces.0", "colours", "own_colours.0"}
    for key, x in numbers.items():
        np.testing.assert_array_equal(np.array(found[key].array), np.array(x.array))


def test_runs_of_before_have_no_factors_and_count_all_pixels(tmp_path):
    file = tmp_path / "config.toml"
    text = to_toml(FitConfig())
    file.write_text(text)
    assert read_toml(file).materials["roughness"]["neural"].pieces.variation
    assert read_toml(file).materials["albedo"]["neural"].pieces.most
    albedo = "[materials.albedo.neural.pieces]\n"
    names = ("variation", "pixels_at_most", "one_")
    text = of_format(text, 2)
    kept = text.replace(text[text.index(albedo) :].split("\n\n")[0], albedo + "most = 0")
    file.write_text("\n".join(x for x in kept.splitlines() if not x.startswith(names)))
    before = read_toml(file)
    for name in ("albedo", "roughness"):
        assert not before.materials[name]["neural"].pieces.variation
    assert not before.materials["albedo"]["neural"].pieces.most
    assert before.roughness_search == replace(SEARCH, pixels_at_most=0)
