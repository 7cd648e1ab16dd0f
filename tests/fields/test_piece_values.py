"""Points of a piece with albedo of equal brightness share a value, and points of one colour."""

import re
from dataclasses import replace
from itertools import product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import of_format, randomised, seeded

from unbake.config import FitConfig, from_toml, to_toml
from unbake.errors import UserError
from unbake.fields.domain import SurfacePoint
from unbake.fields.field import FieldSpec, PlaceNumbers
from unbake.fields.materials import make_materials
from unbake.fields.network import Network
from unbake.fields.perceptron import can_record_layout
from unbake.fields.piece_values import PieceValues
from unbake.fields.pieces import Piece, Pieces
from unbake.fields.settings import PLACES_LOG2, GridConfig, NetworkConfig, PieceConfig
from unbake.quantities import QUANTITIES

LANES = 300
SMALL = PieceConfig(most=5, brightnesses=4, gain=3.0)
SHARED = replace(SMALL, colours=3)
COLOURED = replace(SHARED, own_colours=2)
VARIED = replace(COLOURED, variation=True)
PLACED = replace(VARIED, places=2)
NETWORK = NetworkConfig(GridConfig(2, 2, 8), width=8, hidden=1, pieces=COLOURED)
ENGINES = ("tensor", "coopvec", *(["fused"] if can_record_layout() else []))


def points(albedo=None, seed=1, number=None, strength=1.0):
    sampler = seeded(seed, LANES)
    p = mi.Point3f(sampler.next_1d(), sampler.next_1d(), sampler.next_1d())
    grey = mi.Color3f(sampler.next_1d()) if albedo is None else mi.Color3f(albedo)
    piece = dr.arange(mi.UInt32, LANES) % 5 if number is None else mi.UInt32(number)
    dr.eval(p, grey, piece)
    return SurfacePoint(p, piece=Piece(piece, mi.Float(strength)), albedo=grey)


@pytest.mark.parametrize("outputs", [1, 3])
def test_engines_agree_with_pieces(outputs):
    results = []
    for engine in ENGINES:
        network = Network(NETWORK, FieldSpec(outputs, bounded=True, initial=0.3, seed=2))
        parameters = randomised(network)
        values = network.evaluate(points(), (), engine)
        dr.backward(dr.sum(sum(values)))
        gradients = {k: np.array(dr.grad(v).array) for k, v in parameters.items()}
        results.append((np.array([np.array(v) for v in values]), gradients))
    for values, gradients in results[1:]:
        np.testing.assert_allclose(values, results[0][0], atol=2e-5)
        for key, gradient in gradients.items():
            np.testing.assert_allclose(gradient, results[0][1][key], atol=2e-3, err_msg=key)
    reached = {key for key, gradient in results[0][1].items() if np.abs(gradient).max() > 0}
    assert reached == {key for key in results[0][1] if not key.startswith("own_colours")}


def test_untrained_pieces_change_nothing():
    network = Network(NETWORK, FieldSpec(1, bounded=True, initial=0.3, seed=2))
    (value,) = network.evaluate(points())
    np.testing.assert_allclose(np.array(value), 0.3, atol=5e-3)


def test_piece_and_brightness_decide_which_numbers_are_read():
    table = PieceValues(SMALL, 1)
    values = randomised(table)
    (dark,) = table.evaluate(points(0.0, number=2))
    dr.backward(dr.sum(dark))
    rows = np.array(dr.grad(values["pieces.0"])).reshape(-1, SMALL.brightnesses)
    assert rows[2, 0] > 0
    assert np.count_nonzero(rows) == 1  # all other pieces and brightnesses stay as they are
    (white,) = table.evaluate(points(1.0, number=2))
    assert np.abs(np.array(white) - np.array(dark)).mean() > 0.1


def test_values_between_brightnesses_are_between_theirs():
    table = PieceValues(SMALL, 1)
    randomised(table)
    low, middle, high = (
        np.array(table.evaluate(points(level**2))[0]) for level in (1 / 3, 0.5, 2 / 3)
    )
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-5)


def test_colours_of_a_piece_are_linear_between_corners_that_it_has_by_itself():
    table = PieceValues(replace(SMALL, own_colours=2), 1)
    values = randomised(table)
    values["pieces.0"] = values["pieces.0"] * 0
    table.assign(values)
    # As square roots, halfway between corners along green, and at one along red and blue.
    colour = (0.25, 0.75**2, 1.0)
    (found,) = table.evaluate(points(colour, number=3, strength=0.5), searching=True)
    corners = np.array(values["own_colours.0"]).reshape(5, 3, 3, 3)  # piece, blue, green, red
    wanted = SMALL.gain * (corners[3, 2, 1, 1] + corners[3, 2, 2, 1]) / 2
    np.testing.assert_allclose(np.array(found), wanted, atol=1e-5)
    dr.backward(dr.sum(found))
    reached = np.array(dr.grad(values["own_colours.0"])).reshape(5, 3, 3, 3)
    assert set(np.flatnonzero(reached.any(axis=(1, 2, 3)))) == {3}
    (unknown,) = table.evaluate(points(colour, number=3, strength=0.0))
    np.testing.assert_array_equal(np.array(unknown), 0)


def at_corner(piece, corner, value):
    """A number of a piece at one corner of a lattice."""
    where = mi.Point3u(*[mi.UInt32(x) for x in corner])
    return PlaceNumbers(mi.UInt32(piece), where, [mi.Float(value)])


def test_numbers_by_place_are_linear_between_corners_of_the_piece_that_has_them():
    table = PieceValues(PLACED, 1)
    assert table.place_cells == (2, 4, 8)
    values = {key: x * 0 + (key == "variation") for key, x in randomised(table).items()}
    # The corner at (0.5, 0, 1) of the coarsest lattice, and that at (0.25, 0.25, 0) of the next.
    found = table.placed([at_corner(3, (1, 0, 2), 5.0), at_corner(3, (1, 1, 0), -2.0)])
    table.assign(values | found)

    def at(position, number=3, strength=1.0):
        piece = Piece(mi.UInt32(number), mi.Float(strength))
        point = SurfacePoint(mi.Point3f(*position), piece=piece, albedo=mi.Color3f(0.5))
        return float(table.evaluate(point)[0][0])

    assert at((0.5, 0, 1)) == pytest.approx(5)
    assert at((0.5, 0, 0.75)) == pytest.approx(2.5)
    assert at((0.25, 0.25, 0.875)) == pytest.approx(5 * 0.5 * 0.5 * 0.75)
    assert at((0.25, 0.25, 0)) == pytest.approx(-2)
    assert at((0.375, 0.25, 0)) == pytest.approx(-1)
    assert at((1, 0.5, 0)) == 0
    assert at((7, float("nan"), 1)) == at((1, 0, 1))
    for number, strength in ((2, 1.0), (3, 0.0)):
        assert at((0.5, 0, 1), number, strength) == 0
    table.assign(values | table.placed([]))
    assert at((0.5, 0, 1)) == 0


def test_pieces_have_numbers_of_their_own_at_one_corner():
    table = PieceValues(replace(PLACED, most=64), 1)
    zero = {key: x * 0 for key, x in table.parameters().items()}
    every = np.arange(64)
    corner = mi.Point3u(*[mi.UInt32(1)] * 3)
    wanted = (every + 1).astype(np.float32)
    number = mi.UInt32(every.astype(np.uint32))
    table.assign(zero | table.placed([PlaceNumbers(number, corner, [mi.Float(wanted)])]))
    point = SurfacePoint(mi.Point3f(0.5), piece=Piece(number, mi.Float(1)))
    np.testing.assert_allclose(np.array(table.evaluate(point)[0]), wanted, rtol=1e-6)


def test_corners_that_would_share_a_number_have_none():
    table = PieceValues(replace(PLACED, most=4096), 1)
    every = np.arange(4096 * 200, dtype=np.uint32)
    corner = mi.Point3u(*[mi.UInt32(every // 4096 % 9)] * 2, mi.UInt32(every // 4096 // 9))
    one = mi.Float(np.ones(len(every), np.float32))
    found = table.placed([PlaceNumbers(mi.UInt32(every % 4096), corner, [one])])
    kept = int(np.array(found["places.0"]).sum())
    # Of n corners dealt to m places, n exp(-n / m) are alone.
    alone = len(every) * np.exp(-len(every) / (1 << PLACES_LOG2))
    assert kept == pytest.approx(alone, rel=0.02)


def test_deviations_are_those_of_the_pieces_that_are_asked_for():
    table = PieceValues(COLOURED, 1)
    values = randomised(table)
    found = table.deviations(points(number=dr.arange(mi.UInt32, LANES) % 2 + 1, strength=0.5))
    own = np.array(found["own_colours"]).reshape(5, 27)
    wanted = COLOURED.gain * np.array(values["own_colours.0"]).reshape(5, 27)
    np.testing.assert_allclose(own[1:3], wanted[1:3], rtol=1e-6)
    np.testing.assert_array_equal(own[[0, 3, 4]], 0)
    pieces = np.array(found["pieces"]).reshape(5, SMALL.brightnesses)
    wanted = 0.5 * COLOURED.gain * np.array(values["pieces.0"]).reshape(5, SMALL.brightnesses)
    np.testing.assert_allclose(pieces[1:3], wanted[1:3], rtol=1e-6)
    np.testing.assert_array_equal(pieces[[0, 3, 4]], 0)


def test_weak_pieces_count_less():
    table = PieceValues(SMALL, 1)
    randomised(table)
    full, half = (np.array(table.evaluate(points(strength=s))[0]) for s in (1.0, 0.5))
    np.testing.assert_allclose(half, full / 2, atol=1e-6)


def test_raised_pieces_have_higher_outputs_everywhere_and_others_the_same():
    table = PieceValues(COLOURED, 1)
    values = randomised(table)
    of_all = points(number=dr.arange(mi.UInt32, LANES) % 5, strength=0.25)
    before = np.array(table.evaluate(of_all)[0])
    raised = table.raised(Piece(mi.UInt32([1, 3]), mi.Float(0.25)), mi.Float([0.5, -2]))
    assert set(raised) == {"pieces.0"}
    table.assign(values | raised)
    change = np.array(table.evaluate(of_all)[0]) - before
    wanted = np.array([0, 0.5, 0, -2, 0])[np.arange(LANES) % 5]
    np.testing.assert_allclose(change, wanted, atol=1e-5)
    network = Network(replace(NETWORK, pieces=PieceConfig()), FieldSpec(1, bounded=True))
    assert not network.raised(Piece(mi.UInt32([1]), mi.Float(1)), mi.Float([1]))


def test_varied_pieces_differ_less_from_a_value_that_stays():
    network = Network(replace(NETWORK, pieces=VARIED), FieldSpec(2, bounded=True, seed=2))
    values = randomised(network)
    values["variation"] = values["variation"] * 0 + 1
    network.assign(values)
    of_all = points(number=dr.arange(mi.UInt32, LANES) % 5, strength=0.25)

    def outputs():
        value = np.array([np.array(x, np.float64) for x in network.evaluate(of_all)])
        return np.log(value / (1 - value))

    before = outputs()
    own, factor = [1, 3], np.array([0.25, 0.5])
    about = np.array([[0.3, -0.2], [1.0, 0.1]])  # of each output, on each piece

    def vary(factor):
        piece = Piece(mi.UInt32(own), mi.Float(0.25))
        found = network.varied(piece, [mi.Float(x) for x in about], mi.Float(factor))
        assert set(found) == {"pieces.0", "pieces.1", "variation"}
        network.assign(network.parameters() | found)
        return outputs()

    after = vary(factor)
    wanted = before.copy()
    for number, middle, part in zip(own, about.T[:, :, None], factor, strict=True):
        here = np.arange(LANES) % 5 == number
        wanted[:, here] = middle + part * (before[:, here] - middle)
    np.testing.assert_allclose(after, wanted, atol=1e-4)
    # A factor is of all that there is, not of what is left.
    np.testing.assert_allclose(vary(factor), wanted, atol=1e-4)
    np.testing.assert_allclose(vary(np.ones(2)), before, atol=1e-4)


def test_pieces_without_strength_keep_their_factor():
    table = PieceValues(VARIED, 1)
    values = randomised(table)
    values["variation"] = values["variation"] * 0 + 1
    table.assign(values)
    found = table.varied(Piece(mi.UInt32([2]), mi.Float(0)), [mi.Float(0.1)], mi.Float([0.5]))
    for key, x in found.items():
        np.testing.assert_array_equal(np.array(x), np.array(values[key]))


def test_surfaces_of_which_nothing_is_known_have_no_factor():
    network = Network(replace(NETWORK, pieces=VARIED), FieldSpec(1, bounded=True, seed=2))
    values = randomised(network)
    spreads = {}
    for strength, factor in ((0.0, 1), (0.0, 1 / 64), (0.5, 1), (0.5, 1 / 64)):
        values["variation"] = values["variation"] * 0 + factor
        network.assign(values)
        value = np.array(network.evaluate(points(number=4, strength=strength))[0])
        spreads[strength, factor] = value.std()
    assert spreads[0.0, 1] == spreads[0.0, 1 / 64] > 0.01
    assert spreads[0.5, 1 / 64] < 0.5 * spreads[0.5, 1]


def test_no_gradient_reaches_factors():
    network = Network(replace(NETWORK, pieces=PLACED), FieldSpec(1, bounded=True, seed=2))
    values = randomised(network)
    dr.backward(dr.sum(network.evaluate(points())[0]))
    reached = {k for k, v in values.items() if np.abs(np.array(dr.grad(v).array)).max() > 0}
    assert reached == values.keys() - {"variation", "own_colours.0", "places.0", "placed"}


def test_searches_move_colours_of_pieces_and_steps_do_not():
    network = Network(replace(NETWORK, pieces=VARIED), FieldSpec(1, bounded=True, seed=2))
    values = randomised(network)
    at = points()
    found = network.with_shared(network.beside_shared(at), at)
    np.testing.assert_allclose(np.array(found), np.array(network.evaluate(at)), atol=1e-5)
    dr.backward(dr.sum(found[0]))
    assert np.abs(np.array(dr.grad(values["own_colours.0"]))).max() > 0
    assert np.abs(np.array(dr.grad(values["variation"]))).max() == 0


def test_numbers_that_are_not_learned_change_nothing_by_themselves():
    spec = FieldSpec(3, bounded=True, initial=0.3, seed=2)
    settings = replace(SMALL, variation=True, learned=False, brightnesses=1, gain=1.0, network=1.0)
    found = []
    for pieces in (settings, PieceConfig()):
        network = Network(replace(NETWORK, pieces=pieces), spec)
        values = network.parameters()
        dr.enable_grad(values)
        network.assign(values)
        outputs = network.evaluate(points())
        dr.backward(dr.sum(outputs[0] + 2 * outputs[1]))
        gradients = {key: np.array(dr.grad(x).array) for key, x in values.items()}
        found.append((np.array([np.array(x) for x in outputs]), gradients))
    (with_pieces, gradients), (without, wanted) = found
    np.testing.assert_allclose(with_pieces, without, atol=1e-6)
    for key, gradient in wanted.items():
        np.testing.assert_allclose(gradients[key], gradient, atol=1e-5, err_msg=key)
    for key in gradients.keys() - wanted.keys():
        assert not gradients[key].any(), key


def test_colours_are_shared_by_all_pieces():
    table = PieceValues(SHARED, 1)
    values = randomised(table)
    values["pieces.0"] *= 0
    table.assign(values)
    red, blue = mi.Color3f(1, 0.1, 0.1), mi.Color3f(0.1, 0.1, 1)
    one, other, third = (
        np.array(table.evaluate(points(colour, number=n))[0])
        for colour, n in ((red, 1), (red, 3), (blue, 1))
    )
    np.testing.assert_array_equal(one, other)
    assert np.abs(one - third).min() > 0.05  # as bright, and yet another number


def test_colours_between_corners_have_values_between():
    table = PieceValues(SHARED, 1)
    values = randomised(table)
    values["pieces.0"] *= 0
    table.assign(values)
    low, middle, high = (
        np.array(table.evaluate(points(mi.Color3f(0, level**2, 0)))[0])
        for level in (1 / 3, 0.5, 2 / 3)
    )
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-4)


@pytest.mark.parametrize("albedo", [-1.0, 2.0, float("nan")])
def test_an_albedo_out_of_bounds_reads_no_other_memory(albedo):
    table = PieceValues(COLOURED, 1)
    randomised(table)
    bound = points(1.0 if albedo == 2.0 else 0.0)
    found, wanted = (np.array(table.evaluate(p)[0]) for p in (points(albedo), bound))
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_a_number_out_of_bounds_reads_no_other_memory():
    # Another quantity may tell more pieces apart.
    table = PieceValues(SMALL, 1)
    randomised(table)
    found, wanted = (np.array(table.evaluate(points(number=n))[0]) for n in (70, 4))
    np.testing.assert_array_equal(found, wanted)


def test_a_point_that_does_not_tell_its_piece_is_refused():
    with pytest.raises(ValueError, match="without its piece"):
        PieceValues(SMALL, 1).evaluate(SurfacePoint(mi.Point3f(0.5)))


def test_roughness_does_not_pull_albedo():
    settings = {name: NETWORK for name in ("albedo", "roughness")}
    materials = with_pieces(make_materials("neural", settings, [], seed=1))
    values = randomised(materials)
    material = materials.evaluate(surface(materials), mi.Bool(True))
    dr.backward(dr.sum(material["roughness"]))
    reached = {k for k, v in values.items() if np.abs(np.array(dr.grad(v).array)).max() > 0}
    of_roughness = {k for k in values if k.startswith("roughness.")}
    assert reached == of_roughness - {"roughness.own_colours.0"}


def test_roughness_alone_has_pieces():
    materials = with_pieces(make_materials("neural", {"roughness": NETWORK}, [], seed=1))
    randomised(materials)
    values = np.array(materials.evaluate(surface(materials), mi.Bool(True))["roughness"])
    bounds = QUANTITIES["roughness"]
    assert np.ptp(values) > 0.005  # the network's share: all is one piece of one brightness
    assert (values >= bounds.lower).all()
    assert (values <= bounds.upper).all()


def test_sizes_tell_the_memory():
    for outputs, settings in product(
        (1, 3), (SMALL, COLOURED, VARIED, replace(VARIED, brightnesses=1))
    ):
        counted = sum(dr.width(v) for v in PieceValues(settings, outputs).parameters().values())
        assert counted == settings.numbers(outputs)


@pytest.mark.parametrize(
    "wrong",
    [
        {"most": -1},
        {"brightnesses": 0},
        {"gain": 0.0},
        {"network": 0.0},
        {"colours": -1},
        {"own_colours": 13},
        {"places": 17},
    ],
)
def test_sizes_out_of_range_are_refused(wrong):
    with pytest.raises(UserError, match=next(iter(wrong))):
        PieceConfig(**wrong)


def with_pieces(materials):
    made = mi.load_dict({"type": "scene", "wall": {"type": "rectangle"}})
    materials.pieces = Pieces(made, SMALL.most)
    materials.pieces.attach(made)
    materials.scene = made  # keeps it alive
    return materials


def surface(materials):
    x = points().position.x
    rays = mi.Ray3f(mi.Point3f(1.8 * x - 0.9, 0, 1), mi.Vector3f(0, 0, -1))
    return materials.scene.ray_intersect(rays)


def test_runs_of_before_have_no_pieces_and_what_a_user_gives_has():
    def pieces(text):
        return from_toml(text).materials["roughness"]["neural"].pieces

    def most(text):
        return pieces(text).most

    now = to_toml(FitConfig())
    assert most(now) == FitConfig().materials["roughness"]["neural"].pieces.most > 0
    assert most("steps = 5") == most(now)
    assert most("materials.roughness.neural.pieces.most = 7") == 7
    old = of_format(now, 2)
    before = re.sub(r"\[materials\.roughness\.neural\.pieces\]\n(.+\n)+", "", old)
    assert before != old
    assert most(before) == 0
    assert most(before.replace("format = 2\n", "")) == 0
    assert pieces("steps = 5").colours > 0
    assert pieces("steps = 5").own_colours > 0
    older = re.sub("(?m)^own_colours = .+\n", "", of_format(now, 5))
    assert pieces(older) == replace(pieces(now), own_colours=0)
    assert pieces("steps = 5").places > 0
    older = re.sub("(?m)^places = .+\n", "", of_format(now, 6))
    assert pieces(older) == replace(pieces(now), places=0)
    assert pieces(re.sub("(?m)^colours = .+\n", "", old)) == replace(pieces(now), colours=0)
