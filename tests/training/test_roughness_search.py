"""Searches of roughness: what they sample, the curves they descend on, and their place in a fit."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from searches import SEARCH, SMALL, made_up
from support import (
    MPIEXEC,
    TINY_FIT,
    built_in_cameras,
    interrupt_at,
    needs_mpi,
    nothing_compiled,
    of_format,
    randomised,
)

from unbake.config import FitConfig, from_toml, preset, read_toml, to_toml
from unbake.dataset.pixels import PixelBatch, PixelSource
from unbake.fields.field import FieldSpec
from unbake.fields.network import Network
from unbake.quantities import QUANTITIES
from unbake.ranks import Ranks
from unbake.training import loop, roughness_search, search_samples
from unbake.training.checkpoint import Progress
from unbake.training.piece_variation import expected_albedo
from unbake.training.problem import make_problem
from unbake.training.roughness_curves import (
    NODES,
    Curves,
    groups,
    losses_by_roughness,
    points,
    precision,
    squared_errors,
)
from unbake.training.roughness_search import RoughnessSearch, descend
from unbake.training.run_folder import RunFolder
from unbake.training.search_samples import SearchSamples
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.training.watchdog import Watchdog
from unbake.transport.by_roughness import moments, row_type, stratified

#: With which a fit of few samples has enough of them for a search.
SHARE = 200.0
#: Two searches, at other places than the default ones.
TWICE = replace(SEARCH, times=2, last=0.75, share=0.4)
SETTINGS = replace(
    TINY_FIT,
    materials={name: {"neural": SMALL} for name in QUANTITIES},
    roughness_search=replace(TWICE, share=SHARE, spp=2, steps=30),
)


def started(built_in, config=SETTINGS):
    """A fresh fit of two views, whose photographs tell the number of each pixel."""
    cameras = built_in_cameras("cornell", 8, views=2)
    count = sum(camera.width * camera.height for camera in cameras)
    rgb = np.repeat(np.arange(1, count + 1)[:, None] / count, 3, 1)
    pixels = PixelSource.of(cameras, rgb, np.ones(count), foreground_only=False)
    problem = make_problem(built_in("cornell"), "visible", config, 0.2)
    return problem, pixels, TrainingStep(problem, pixels, config), initial_state(problem)


# ------------------------------------------------------------------------------------- samples


@pytest.mark.parametrize("guided", [True, False], ids=["guide", "no guide"])
def test_pixels_at_the_present_roughness_are_those_of_steps(built_in, guided):
    config = SETTINGS if guided else replace(SETTINGS, guide=replace(SETTINGS.guide, cells=0))
    problem, pixels, step, state = started(built_in, config)
    samples = SearchSamples(problem, step)
    flat = {key: type(x)(x) * 0 for key, x in state.phi.items() if key == "roughness.grid"}
    state.replace(flat)  # a network without inputs: roughness is the same everywhere
    state.publish(problem)
    point = problem.materials.locate(dr.zeros(mi.SurfaceInteraction3f), mi.Bool(False))
    value = float(problem.materials.evaluate_at(point)["roughness"][0])
    rows = samples.by_roughness(state, (3, 4), 512, 512, (value, 0.9))
    number = np.round(rows["target"][:, 0] * pixels.photographs.count).astype(int) - 1
    one = {n: i for i, n in enumerate(number)}  # drawn with replacement: one of each pixel
    chosen = np.fromiter(one.values(), int)
    assert len(one) > 50
    image = rows["plain"] + rows["coloured"]
    steps = _rendered(step, state, pixels)[number[chosen]]
    errors = image[chosen, 0] - steps
    assert abs(errors.mean()) < 0.02 * steps.mean()
    assert np.abs(errors).mean() < 0.15 * steps.mean()
    # Another roughness is another picture, by more than that.
    assert np.abs(image[chosen, 1] - image[chosen, 0]).mean() > 0.02 * steps.mean()


def _rendered(step, state, pixels):
    """All pixels as steps render them, shape (pixels, 3)."""
    table = pixels.photographs.table
    batch = PixelBatch.of(np.arange(len(table)), table)
    both = [step.probe(state, pixels.rays, batch, seed).mean(1) for seed in range(100)]
    return np.mean(both, 0)


def test_samples_of_a_set_are_stratified_and_sets_are_not_alike():
    sampler = stratified(64)
    sampler.seed(3, 2 * 64)
    number = np.array(sampler.next_1d()).reshape(8, 16) * 16
    np.testing.assert_array_equal(np.sort(number.astype(int), 1), [range(16)] * 8)
    assert len(np.unique(number.astype(int), axis=0)) == 8
    x, y = (np.array(column).reshape(8, 16) * 4 for column in sampler.next_2d())
    cell = 4 * x.astype(int) + y.astype(int)
    np.testing.assert_array_equal(np.sort(cell, 1), [range(16)] * 8)


def test_products_of_stratified_samples_are_without_bias():
    sampler = stratified(64)
    sampler.seed(3, 20_000 * 64)
    x = mi.Color3f(sampler.next_1d())
    found = moments(x, x * x, 64)
    # As if all samples were independent, they would be too small by 1e-3.
    for name, value in (("plain2", 1 / 4), ("mixed", 1 / 6), ("coloured2", 1 / 9)):
        assert found[name].mean() == pytest.approx(value, abs=1e-4)


def test_pixels_are_drawn_that_show_one_piece(built_in, monkeypatch):
    problem, pixels, step, state = started(built_in)
    samples = SearchSamples(problem, step)
    chosen = len(samples.by_roughness(state, (1, 2), 256, 16, NODES))
    monkeypatch.setattr(samples, "_of_one_piece", lambda _, seed, count: pixels.draw(seed, count))
    drawn = len(samples.by_roughness(state, (1, 2), 256, 16, NODES))
    assert drawn < 0.8 * chosen and chosen > 0.85 * 256


def test_a_search_without_a_pixel_of_use_finds_nothing(built_in, monkeypatch):
    problem, _, step, state = started(built_in)

    found = search_samples.by_roughness

    def none(*args, **options):
        chosen, rows = found(*args, **options)
        return chosen[:0], rows[:0]

    monkeypatch.setattr(search_samples, "by_roughness", none)
    assert len(SearchSamples(problem, step).by_roughness(state, (3, 0), 64, 4, (0.4,))) == 0
    before = {key: np.array(x.array) for key, x in state.phi.items()}
    search = RoughnessSearch(problem, SETTINGS, step, Ranks())
    assert search.search_if_due(0.5, state, 4) and search.made == 1
    assert all((np.array(x.array) == before[key]).all() for key, x in state.phi.items())


def test_nothing_is_compiled_for_another_draw_of_pixels(built_in):
    problem, _, step, state = started(built_in)
    samples = SearchSamples(problem, step)
    samples.by_roughness(state, (3, 0), 64, 64, (0.4, 0.6))
    with nothing_compiled():
        samples.by_roughness(state, (4, 1), 64, 64, (0.4, 0.6))


def test_places_are_of_any_pixels(built_in, monkeypatch):
    problem, pixels, step, state = started(built_in)
    samples = SearchSamples(problem, step)
    field = problem.materials["albedo"]
    differing = randomised(field)  # from place to place
    differing["grid"] *= 10
    state.replace({f"albedo.{key}": x for key, x in differing.items()})
    found = samples.places(state, (1, 2), 4096)
    # All of them show a material; not so many show one piece alone.
    assert len(found) == 4096
    monkeypatch.setattr(samples, "_of_one_piece", lambda _, seed, count: pixels.draw(seed, count))
    assert len(samples.by_roughness(state, (1, 2), 256, 16, NODES)) < 0.8 * 256
    values = np.array([np.array(x) for x in field.evaluate(points(found, albedo=False))])
    assert values.std() > 0.01
    np.testing.assert_allclose(found["albedo"], values.T, atol=1e-5)
    again, other = (samples.places(state, (1, seed), 4096) for seed in (2, 3))
    assert np.array_equal(found, again) and not np.array_equal(found, other)
    with nothing_compiled():
        samples.places(state, (4, 5), 4096)


def test_products_of_pairs_have_no_noise_of_their_own(built_in):
    problem, _, step, state = started(built_in)
    samples = SearchSamples(problem, step)
    many = samples.by_roughness(state, (3, 0), 512, 256, (0.4,))
    every = [samples.by_roughness(state, (3, seed), 512, 2, (0.4,)) for seed in range(1, 13)]
    few = np.concatenate(every)
    few = few[np.isin(few["target"][:, 0], many["target"][:, 0])]  # the same pixels
    assert not np.array_equal(every[0]["coloured"][:50], every[1]["coloured"][:50])
    # Squares of means of few samples would be larger by their variance.
    assert few["coloured2"].mean() == pytest.approx(many["coloured2"].mean(), rel=0.02)
    assert (few["coloured"] ** 2).mean() > 1.03 * many["coloured2"].mean()


def test_photographs_of_clipped_channels_do_not_count(built_in):
    _, pixels, *_ = started(built_in)
    clipped = replace(pixels, limits=np.array([0.25, 9.0], np.float32))
    problem = make_problem(built_in("cornell"), "visible", SETTINGS, 0.2)
    samples = SearchSamples(problem, TrainingStep(problem, clipped, SETTINGS))
    rows = samples.by_roughness(initial_state(problem), (3, 4), 512, 4, (0.4,))
    first = rows["target"][:, 0] <= 0.5
    over = first & (rows["target"][:, 0] >= 0.25)
    assert over.any() and (rows["weight"][over] == 0).all()
    assert (rows["weight"][~over] > 0).all()


# -------------------------------------------------------------------------------------- curves


def test_albedo_follows_for_each_roughness():
    rows = made_up()
    losses = losses_by_roughness(rows, groups(rows, 2, 6))
    for piece, node in ((0, NODES.index(0.24)), (1, NODES.index(0.55))):
        found = losses[rows["piece"] == piece].mean(0)
        assert found.argmin() == node
        assert abs(found[node]) < 1e-6 < 1e-2 * np.delete(found, node).min()
    # With albedo as it is, another roughness explains the photographs better.
    alone = losses_by_roughness(rows, np.arange(len(rows)))
    assert alone.shape == losses.shape
    fixed = ((rows["plain"] + rows["coloured"] - rows["target"][:, None]) ** 2).mean(2)
    assert fixed[rows["piece"] == 1].mean(0).argmin() != NODES.index(0.55)


def test_gains_belong_to_renderings():
    rows = made_up()
    told = losses_by_roughness(rows, groups(rows, 2, 6))
    rows["gain"] = 4
    rows["target"] *= 4
    rows["weight"] /= 16
    np.testing.assert_allclose(losses_by_roughness(rows, groups(rows, 2, 6)), told, atol=1e-6)


def test_groups_are_near_of_one_piece_and_of_one_colour():
    rows = np.zeros(5, row_type(1))
    rows["position"][1] = 0.9
    rows["piece"][2] = 7
    rows["albedo"][3] = 0.8
    found = groups(rows, 2, 6)
    assert len(set(found[:4])) == 4 and found[4] == found[0]


def test_curves_pass_through_their_nodes_and_are_flat_beyond():
    rows = made_up()
    losses = losses_by_roughness(rows, groups(rows, 2, 6))
    curves = Curves.of(rows, 2, 6, albedo=True)
    for number, node in enumerate(NODES):
        found = np.array(curves.at(dr.full(mi.Float, node, len(rows))))
        np.testing.assert_allclose(found, losses[:, number], atol=1e-5)
    for outside, end in ((0.02, 0), (1.0, -1)):
        roughness = dr.opaque(mi.Float, outside, len(rows))
        dr.enable_grad(roughness)
        found = curves.at(roughness)
        np.testing.assert_allclose(np.array(found), losses[:, end], atol=1e-5)
        dr.backward(found)
        assert (np.array(dr.grad(roughness)) == 0).all()


def descended(rows, count=200, **settings):
    """A field that descended on curves of rows, what it has found, and its roughness at pixels."""
    curves = Curves.of(rows, 2, 6, albedo=True)
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    before = {key: type(x)(x) for key, x in field.parameters().items()}
    found = descend(field, curves, replace(SEARCH, steps=count, **settings), 0.02)
    field.assign(before | found)
    quantity = QUANTITIES["roughness"]
    value = np.array(field.evaluate(curves.point)[0]) * (quantity.upper - quantity.lower)
    return field, found, value + quantity.lower


def test_a_field_descends_to_the_true_roughness_of_each_piece():
    rows = made_up(noise=0.02)
    rows["weight"] /= 0.02**2
    field, found, value = descended(rows)
    assert set(found) == set(field.shared()) == {"pieces.0", "colours", "own_colours.0"}
    for piece, true in enumerate((0.24, 0.55)):
        assert value[rows["piece"] == piece].mean() == pytest.approx(true, abs=0.04)


def test_only_what_points_share_moves():
    rows = made_up()
    field = Network(SMALL, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    before = {key: np.array(x.array) for key, x in field.parameters().items()}
    found = descend(field, Curves.of(rows, 2, 6, albedo=True), SEARCH, 0.02)
    for key, x in (field.parameters() | found).items():
        assert (np.array(x.array) == before[key]).all() == (key not in found)


def test_pieces_of_which_photographs_tell_little_are_like_the_others():
    def apart(weight, **settings):
        rows = made_up()
        rows["weight"] *= weight
        _, _, value = descended(rows, **settings)
        one, other = (value[rows["piece"] == piece].mean() for piece in (0, 1))
        return other - one

    assert apart(1e4) == pytest.approx(0.55 - 0.24, abs=0.05)
    assert apart(1e-4) < 0.05 < apart(1e-4, piece_spread=1e3, brightness_spread=1e3)


def test_colours_of_a_piece_differ_as_far_as_they_are_expected_to():
    rows = made_up()
    odd = rows["piece"] == 1
    rows["piece"] = 0
    rows["albedo"] = np.where(odd[:, None], (0.4, 0.7, 0.4), (0.6, 0.3, 0.6))  # equally bright
    rows["weight"] *= 1e4

    def apart(own, shared):
        spreads = {"own_colour_spread": own, "colour_spread": shared, "brightness_spread": 1e-4}
        _, _, value = descended(rows, **spreads)
        return value[odd].mean() - value[~odd].mean()

    assert apart(1e3, 1e-4) == pytest.approx(0.55 - 0.24, abs=0.05)
    assert apart(1e-4, 1e3) == pytest.approx(0.55 - 0.24, abs=0.05)
    assert abs(apart(1e-4, 1e-4)) < 0.05


@pytest.mark.parametrize(("albedo", "largest"), [(0.1, 3.0), (0.8, 1.25), (0.99, 1.05)])
def test_albedo_is_1_at_most_whatever_light_is_to_be_explained(albedo, largest):
    rows = made_up()
    rows["albedo"] = albedo
    rows["plain"], rows["plain2"], rows["mixed"] = 0, 0, 0
    rows["target"] = 3 * rows["coloured"][:, 0]  # the same at all nodes
    found = losses_by_roughness(rows, np.zeros(len(rows), int))
    wanted = squared_errors(rows, np.full((1, 1, 3), largest))
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4)


def test_errors_have_the_variance_1_however_bright_pixels_are():
    rows = made_up(count=40_000, true=(0.24, 0.24))
    rng = np.random.default_rng(3)
    r, deviation = np.full(len(rows), 0.24), rng.uniform(0.01, 1, (len(rows), 1))
    image = (rows["plain"] + rows["coloured"])[:, NODES.index(0.24)]
    rows["target"] = image + deviation * rng.standard_normal((len(rows), 3))
    # Weights tell brightnesses apart, whatever they are.
    rows["weight"] = deviation**-0.5
    rows["weight"][: len(rows) // 4, 1] = 0  # of clipped channels
    found = precision(rows, r)
    errors = found * rows["weight"] * (image - rows["target"]) ** 2
    assert (found[: len(rows) // 4, 1] == 1).all() and (errors[: len(rows) // 4, 1] == 0).all()
    for low, high in ((0.01, 0.2), (0.2, 0.5), (0.5, 1)):
        chosen = (deviation[:, 0] >= low) & (deviation[:, 0] < high)
        for channel in (0, 2):
            assert errors[chosen, channel].mean() == pytest.approx(1, rel=0.1)
    assert errors[len(rows) // 4 :, 1].mean() == pytest.approx(1, rel=0.05)


# --------------------------------------------------------------------------------------- a fit


def test_searches_come_at_their_places_and_steps_hardly_move_roughness(built_in):
    problem, _, step, state = started(built_in)
    search = RoughnessSearch(problem, SETTINGS, step, Ranks())
    assert not search.due(0.39) and search.rates({}, 0, 0.0) == {}
    assert search.due(0.4) and search.due(1.0)
    rates = {"albedo": 1.0, "roughness": 1.0}
    before = rates | {"roughness": SETTINGS.roughness_search.rate_before}
    assert 0 < before["roughness"] < 1
    assert search.rates(rates, 39, 0.39) == before
    none = replace(SETTINGS, roughness_search=replace(SETTINGS.roughness_search, times=0))
    assert RoughnessSearch(problem, none, step, Ranks()).rates(rates, 39, 0.39) == rates
    assert search.rates(rates, 40, 0.4) == before, "no search was made yet"
    before = {key: np.array(x.array) for key, x in state.phi.items()}
    assert search.search_if_due(0.2, state, 4) == 0
    samples = search.search_if_due(0.5, state, 4)
    assert search.made == 1 and not search.due(0.74) and search.due(0.75)
    assert search.rates(rates, 50, 0.5) == {"albedo": 1.0, "roughness": 0.0}
    assert samples == np.prod(search._size(4, 0.5))
    moved = {k for k, x in state.phi.items() if (np.array(x.array) != before[k]).any()}
    assert moved == {f"roughness.{key}" for key in ("pieces.0", "colours", "own_colours.0")}


def test_what_later_searches_find_is_averaged(built_in, monkeypatch):
    search = replace(SEARCH, share=SHARE, spp=2)
    config = replace(SETTINGS, roughness_search=search)
    problem, _, step, state = started(built_in, config)
    searches, key = RoughnessSearch(problem, config, step, Ranks()), "pieces.0"
    size = dr.width(problem.materials["roughness"].parameters()[key])
    finds = iter((1.0, 2.0, 4.0))
    monkeypatch.setattr(
        roughness_search, "searched", lambda *_: {key: dr.full(mi.Float, next(finds), size)}
    )
    numbers = []
    for done in (0.4, 0.65, 0.9):
        assert not searches.due(done - 0.01) and searches.search_if_due(done, state, 8)
        numbers.append(float(state.phi[f"roughness.{key}"][0]))
    # The first one is of an L_θ that is not there yet.
    np.testing.assert_allclose(numbers, [1, 2, 3], rtol=1e-6)
    assert not searches.due(1.0)


def test_a_shorter_fit_makes_up_for_the_searches_that_it_missed(built_in):
    problem, _, step, state = started(built_in)
    search = RoughnessSearch(problem, SETTINGS, step, Ranks())
    assert search.search_if_due(0.8, state, 4), "both places were passed, and no search was made"
    assert search.made == 2 and not search.due(1.0)


def test_a_fit_that_goes_on_makes_the_searches_of_its_new_length(cornell, tmp_path, unbake):
    settings = tmp_path / "settings.toml"
    settings.write_text(to_toml(replace(SETTINGS, pixels=16, steps=20)))
    made, search = [], RoughnessSearch._search

    def counted(self, state, number, *args):
        made.append(number)
        return search(self, state, number, *args)

    def fitted(name, *words):
        made.clear()
        return unbake("fit", cornell, "--out", tmp_path / name, *words).status, list(made)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RoughnessSearch, "_search", counted)
        assert fitted("longer", "--settings", settings) == (0, [8, 15])
        assert fitted("longer", "--resume", "--steps", 40) == (0, [30]), "the first is at 16"
        with patch.context() as other:
            interrupt_at(other, 6)
            assert fitted("shorter", "--settings", settings) == (130, [])
        assert fitted("shorter", "--resume", "--steps", 8) == (0, [8]), "both were due before"
    manifests = sorted((tmp_path / "shorter" / "checkpoints").glob("step-*/manifest.json"))
    assert [json.loads(x.read_text())["searches"] for x in manifests] == [0, 2]


def test_a_search_waits_for_a_state_that_may_stay(cornell, tmp_path, unbake, monkeypatch):
    """What the watchdog takes back must not count as made."""
    settings = tmp_path / "settings.toml"
    settings.write_text(to_toml(replace(SETTINGS, pixels=16, steps=20)))
    made, search = [], RoughnessSearch._search

    def counted(self, state, number, *args):
        made.append(number)
        return search(self, state, number, *args)

    monkeypatch.setattr(RoughnessSearch, "_search", counted)
    monkeypatch.setattr(Watchdog, "trusts", property(lambda self: self._progress.step > 11))
    outcome = unbake("fit", cornell, "--out", tmp_path / "run", "--settings", settings)
    assert outcome.status == 0 and made == [12, 15], "the first was due at 8"


def test_steps_of_older_runs_move_roughness_as_before():
    text = to_toml(FitConfig())
    old = of_format(text, 2)
    kept = "\n".join(x for x in old.splitlines() if not x.startswith("rate_before"))
    found = [from_toml(x).roughness_search.rate_before for x in (text, kept)]
    assert found == [FitConfig().roughness_search.rate_before, 1]


@pytest.mark.parametrize(("times", "second"), [(2, 0.8), (3, 0.6)])
def test_from_the_second_search_on_albedo_varies_as_photographs_tell(
    times, second, built_in, monkeypatch
):
    defaults = FitConfig().materials
    pieces = {name: defaults[name]["neural"].pieces for name in ("albedo", "roughness")}
    fields = {name: {"neural": replace(SMALL, pieces=pieces[name])} for name in pieces}
    searches = replace(SETTINGS.roughness_search, times=times)
    config = replace(SETTINGS, materials=SETTINGS.materials | fields, roughness_search=searches)
    problem, _, step, state = started(built_in, config)
    search = RoughnessSearch(problem, config, step, Ranks())

    def factors(name):
        return np.unique(np.array(state.phi[f"{name}.variation"]))

    assert search.search_if_due(0.5, state, 4)
    assert factors("albedo").tolist() == [1]
    assert factors("roughness").min() < 1
    shown = []

    def seen(*args):
        shown.extend(args[4:])
        return expected_albedo(*args)

    monkeypatch.setattr(roughness_search, "expected_albedo", seen)
    assert search.search_if_due(second, state, 8)
    assert 0.1 < factors("albedo").min() < 1
    # As many as the pixels of the search, of which fewer show one piece alone.
    assert len(shown[0]) == search._size(8, second)[0]


def test_fits_of_few_samples_do_not_search(built_in):
    config = replace(SETTINGS, roughness_search=SEARCH)
    problem, _, step, state = started(built_in, config)
    search = RoughnessSearch(problem, config, step, Ranks())
    rates = {"albedo": 1.0, "roughness": 1.0}
    assert search.search_if_due(0.5, state, 4) == 0
    assert search.rates(rates, 4, 0.5) == rates


@pytest.mark.parametrize(
    "change",
    [{"method": "prb"}, {"method": "direct"}, {"quantities": ("albedo",)}],
    ids=["prb", "direct", "albedo alone"],
)
def test_nothing_is_searched_where_there_is_nothing_to_search_with(built_in, change):
    config = replace(SETTINGS, **change)
    problem, _, step, _ = started(built_in, config)
    search = RoughnessSearch(problem, config, step, Ranks())
    assert not search.due(1.0)
    rates = {"albedo": 1.0, "roughness": 1.0}
    assert search.rates(rates, 90, 0.9) == rates


def test_a_fit_tells_the_samples_of_its_searches(cornell, tmp_path, unbake):
    settings, out = tmp_path / "settings.toml", tmp_path / "run"
    settings.write_text(to_toml(replace(SETTINGS, pixels=16, steps=20)))
    assert unbake("fit", cornell, "--settings", settings, "--out", out).status == 0
    of_steps = 20 * 16 * SETTINGS.spp
    told = RunFolder(out).log()[-1]["samples"]
    # Both sample as many pixels as two views of 16 x 16 have, eight times each.
    assert told == of_steps + TWICE.times * 2 * 16**2 * 8
    assert unbake("evaluate", out).status == 0
    found = json.loads((out / "evaluation" / "metrics.json").read_text())
    assert found["samples"] == told


def test_searches_are_part_of_the_time_of_a_fit(cornell, tmp_path, unbake, monkeypatch):
    settings, out = tmp_path / "settings.toml", tmp_path / "run"
    # The first one comes as held-aside pixels are measured, the other before a line of the log.
    search = replace(SETTINGS.roughness_search, first=0.75, last=1.0)
    settings.write_text(to_toml(replace(SETTINGS, pixels=16, steps=20, roughness_search=search)))
    now, original = [0.0], RoughnessSearch._search

    def searched(*args):
        now[0] += 1.0
        return original(*args)

    monkeypatch.setattr(loop, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(RoughnessSearch, "_search", searched)
    assert unbake("fit", cornell, "--settings", settings, "--out", out).status == 0
    assert RunFolder(out).log()[-1]["seconds"] == 2.0


def test_time_of_searches_is_not_that_of_steps(built_in):
    """Rates fell while nothing was learned: by a third of the whole decay in two searches."""
    config = replace(SETTINGS, steps=0, seconds=100.0, roughness_search=TWICE)
    problem, _, step, _ = started(built_in, config)
    search = RoughnessSearch(problem, config, step, Ranks())

    def done(made=0, **numbers):
        search.made = made
        progress = Progress(step=10_000, samples=10_000 * config.samples_per_step, **numbers)
        return loop._fraction(config, progress, search)

    # Two searches are to come, with 0.4 of the samples of all steps each, where photographs have
    # so many pixels.
    photographs = SimpleNamespace(count=10**9)
    search._step = SimpleNamespace(pixels=SimpleNamespace(photographs=photographs))
    assert done(seconds=20.0) == pytest.approx(20 / (100 / 1.8), rel=1e-3)
    assert done(1, seconds=50.0, searching=20.0, last_search=20.0) == 0.5
    assert done(2, seconds=80.0, searching=40.0, last_search=20.0) == 40 / 60
    assert done(2, seconds=101.0, searching=40.0, last_search=20.0) == 1
    # One that does not fit is not waited for.
    assert done(1, seconds=70.0, searching=40.0, last_search=40.0) == 30 / 60
    search._step = step
    count, spp = step.pixels.photographs.count, 4 * SEARCH.spp
    each = count * spp * 20 / (10_000 * config.samples_per_step)
    assert done(seconds=20.0) == pytest.approx(20 / (100 - 2 * each)), "all pixels there are"
    by_steps = replace(config, steps=20_000, seconds=0.0)
    assert loop._fraction(by_steps, Progress(step=10_000, searching=9.0), search) == 0.5
    short = Progress(step=4, seconds=50.0)
    assert loop._fraction(config, short, search) == 0.5, "none will be made"


def test_a_fit_that_goes_on_makes_no_search_again_unless_it_is_longer(built_in):
    """The first search was quicker than was reckoned, so that less than its place is done."""
    config = replace(SETTINGS, steps=0, seconds=100.0)
    problem, _, step, _ = started(built_in, config)
    begun = SimpleNamespace(config=config, problem=problem, step=step)
    for length, made in ((100.0, 1), (50.0, 0)):
        begun.progress = Progress(
            step=20, seconds=35.0, samples=10**6, searches=1, searching=5.0, last_search=5.0,
            length=length,
        )  # fmt: skip
        assert loop._searches(begun, Ranks()).made == made
        assert begun.progress.searches == made and begun.progress.length == 100


def test_searches_draw_no_more_pixels_than_photographs_have(built_in):
    """The noise of a photograph is the same at each draw: more samples of each pixel help."""
    problem, _, step, _ = started(built_in)
    search = RoughnessSearch(problem, SETTINGS, step, Ranks())
    assert search._size(1000, 1.0) == (step.pixels.photographs.count, 4 * 2)
    count = 10_000
    photographs = SimpleNamespace(count=count)
    search._step = SimpleNamespace(pixels=SimpleNamespace(photographs=photographs))
    spp, per_step = SETTINGS.roughness_search.spp, SETTINGS.samples_per_step

    def size(pixels):
        return search._size(1, SHARE * per_step / (pixels * spp))

    assert size(4000) is None
    assert size(5000) == (5000, spp) and size(19_000) == (count, spp)
    assert size(25_000) == (count, 2 * spp)
    assert size(400_000) == (count, 4 * spp)


def test_a_fit_without_memory_for_a_search_is_saved(cornell, tmp_path, unbake, monkeypatch):
    settings, out = tmp_path / "settings.toml", tmp_path / "run"
    settings.write_text(to_toml(replace(SETTINGS, pixels=16, steps=20)))

    def none(*args):
        raise MemoryError

    monkeypatch.setattr(RoughnessSearch, "_search", none)
    outcome = unbake("fit", cornell, "--settings", settings, "--out", out)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert re.search(r"no memory for a search of roughness with \d+ pixels", outcome.err)
    assert [path.name for path in RunFolder(out).written_checkpoints()] == ["step-000000008"]
    # There is no memory for the second one, either; the first is not tried again.
    for step, status in ((8, 2), (15, 0)):
        outcome = unbake("fit", cornell, "--out", out, "--resume", "--steps", 20)
        assert outcome.status == status and f"going on after step {step}" in outcome.out, outcome


@needs_mpi
def test_ranks_search_together(cornell, tmp_path):
    settings, out = tmp_path / "settings.toml", tmp_path / "run"
    settings.write_text(to_toml(replace(SETTINGS, pixels=16, steps=20)))
    command = [MPIEXEC, "-n", "2", sys.executable, "-m", "unbake", "fit", cornell]
    command += ["--settings", settings, "--out", out]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr  # which also tells that their states are equal
    told = RunFolder(out).log()[-1]["samples"]
    # Searches sample as many pixels as there are, 512, eight times each.
    assert told == 20 * 16 * SETTINGS.spp + TWICE.times * 512 * 8


SHARED = """
import numpy as np
from unbake import backend
backend.activate()
from dataclasses import replace
from searches import SEARCH, SMALL, made_up
from unbake.training.roughness_curves import NODES, Curves
from unbake.training.roughness_search import descend, searched
from unbake.fields.field import FieldSpec
from unbake.fields.network import Network
from unbake.ranks import Ranks
rows, found = made_up(noise=0.02)[:10_001], []
rows["weight"] /= 0.02**2
every = Curves.of(rows, 2, 6, True)
varied = replace(SMALL, pieces=replace(SMALL.pieces, variation=True))
for ranks in (Ranks(), Ranks.of_environment()):
    field = Network(varied, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    before = dict(field.parameters())
    curves = Curves.of(rows, 2, 6, True, ranks, rows[::3])
    assert curves.total == len(rows)
    assert abs(len(np.array(curves.losses)) - len(NODES) * len(rows) / ranks.size) <= len(NODES)
    field.assign(before | searched(field, curves, SEARCH, 0.02, ranks))
    found.append(np.array(field.evaluate(every.point)[0]))
assert ranks.size == 2 and found[0].std() > 0.1
assert np.abs(found[0] - found[1]).max() < 1e-3, np.abs(found[0] - found[1]).max()

# What is expected of pieces that one of the ranks has alone counts once, too.
rows, found = made_up(noise=0.02), []
rows["piece"] = 2 * (np.arange(400) // 20) + np.arange(400) % 2
rows["weight"] = 100
whole = Curves.of(rows, 1, 6, True)
for ranks in (Ranks(), Ranks.of_environment()):
    field = Network(varied, FieldSpec(1, bounded=True, initial=0.4, seed=2))
    before = dict(field.parameters())
    curves = Curves.of(rows, 1, 6, True, ranks)
    field.assign(before | descend(field, curves, SEARCH, 0.02, ranks))
    found.append(np.array(field.evaluate(whole.point)[0]))
assert found[0].std() > 0.05
assert np.abs(found[0] - found[1]).max() < 1e-3, np.abs(found[0] - found[1]).max()
"""


@needs_mpi
def test_ranks_find_together_what_one_would():
    command = [MPIEXEC, "-n", "2", sys.executable, "-c", SHARED]
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    environment = os.environ | {"PYTHONPATH": path}
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr


def test_older_runs_and_the_papers_settings_do_not_search(tmp_path):
    assert preset("paper").roughness_search.times == preset("release").roughness_search.times == 0
    text = to_toml(FitConfig())
    start = text.index("[roughness_search]")
    table = text[start:].partition("\n[")[0]
    file = tmp_path / "config.toml"
    file.write_text(text)
    assert read_toml(file).roughness_search == SEARCH
    file.write_text(of_format(text.replace(table, ""), 2))
    assert read_toml(file).roughness_search.times == 0
