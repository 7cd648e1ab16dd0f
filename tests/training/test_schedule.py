"""Learning rates: they decay, those of the unknowns first rise, and every unknown has one."""

import dataclasses
from typing import get_args

import pytest
from support import TINY_FIT, with_more

from unbake.config import (
    BitmapConfig,
    CameraConfig,
    DenseGridConfig,
    FitConfig,
    LightingConfig,
    NetworkConfig,
    Unknown,
    update,
)
from unbake.training.problem import make_problem
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state

STEADY = FitConfig(
    final_learning_rate=0.01,
    warm_up=0,
    materials={
        "albedo": {
            "neural": NetworkConfig(learning_rate=0.2),
            "grid": DenseGridConfig(learning_rate=0.3),
            "bitmap": BitmapConfig(learning_rate=0.6),
        },
        "roughness": {
            "neural": NetworkConfig(learning_rate=0.05),
            "grid": DenseGridConfig(learning_rate=0.4),
            "bitmap": BitmapConfig(learning_rate=0.7),
        },
    },
    radiance={
        "neural": NetworkConfig(learning_rate=0.1),
        "grid": DenseGridConfig(learning_rate=0.5),
    },
    lighting=LightingConfig(learning_rate=0.8),
)


def changed(**settings):
    return dataclasses.replace(STEADY, **settings)


def test_all_rates_decay_exponentially_and_then_stay():
    first, half, last, after = (learning_rates(STEADY, 9, done) for done in (0, 0.5, 1, 1.7))
    for name, rate in first.items():
        assert half[name] == pytest.approx(0.1 * rate)
        assert last[name] == pytest.approx(0.01 * rate)
    assert after == last
    constant = changed(final_learning_rate=1.0)
    assert learning_rates(constant, 9, 1) == learning_rates(constant, 9, 0)


def test_rates_of_the_unknowns_rise_while_that_of_the_radiance_does_not():
    rising = changed(warm_up=4)
    full = learning_rates(rising, 100, 0)
    for step, share in [(0, 0.2), (1, 0.4), (3, 0.8), (4, 1), (5, 1)]:
        rates = learning_rates(rising, step, 0)
        assert rates.pop("radiance") == 0.1
        for name, rate in rates.items():
            assert rate == pytest.approx(share * full[name]), (step, name)


def test_rates_of_the_unknowns_are_multiples_of_the_fields_own():
    factors = {"albedo": 2.5, "roughness": 0.4, "environment": 6.25}
    plain, scaled = (
        learning_rates(config, 9, 0.5) for config in (STEADY, changed(rate_factors=factors))
    )
    for name, rate in plain.items():
        assert scaled[name] == pytest.approx(factors.get(name, 1.0) * rate), name


def test_vignetting_is_found_faster_than_exposures_and_responses_stay():
    camera = CameraConfig("per-image", vignetting="radial", response="monotone")
    rates = learning_rates(changed(camera=camera), 9, 0.5)
    assert rates["vignetting"] > rates["exposure"] > rates["response"] == 0


@pytest.mark.parametrize(
    ("settings", "albedo", "roughness", "radiance"),
    [
        ({}, 0.2, 0.05, 0.1),
        ({"representation": "grid"}, 0.3, 0.4, 0.1),
        ({"representation": "bitmap"}, 0.6, 0.7, 0.1),
        ({"radiance_representation": "grid"}, 0.2, 0.05, 0.5),
        ({"representation": "grid", "radiance_representation": "grid"}, 0.3, 0.4, 0.5),
    ],
    ids=["networks", "grid", "bitmap", "radiance grid", "both grids"],
)
def test_each_representation_has_its_rates(settings, albedo, roughness, radiance):
    lighting = {"environment": 0.8, "emission": 0.8}
    expected = {"albedo": albedo, "roughness": roughness, "radiance": radiance} | lighting
    assert learning_rates(changed(**settings), 0, 0) == expected


#: The first words of parameters' names, by what is unknown.
WORDS = {
    "materials": {"albedo", "roughness"},
    "lighting": {"environment"},
    "emission": {"emission"},
    "materials+lighting": {"albedo", "roughness", "environment"},
    "materials+emission": {"albedo", "roughness", "emission"},
    "lighting+emission": {"environment", "emission"},
    "materials+lighting+emission": {"albedo", "roughness", "environment", "emission"},
}


def test_all_that_may_be_unknown_is_known_here():
    assert {*WORDS, "auto"} == {*get_args(Unknown)}


@pytest.mark.parametrize("representation", ["neural", "grid", "bitmap", "triplane"])
@pytest.mark.parametrize("unknown", WORDS)
def test_every_parameter_has_a_rate(unknown, representation, built_in):
    small = {"grid": {"cells": 4}, "bitmap": {"resolution": 4}, "triplane": {"levels": 1}}
    config = dataclasses.replace(TINY_FIT, unknown=unknown, representation=representation)
    config = update(config, {"materials": {"albedo": small, "roughness": small}})
    scene = built_in("still" if "lighting" in unknown else "cornell")
    if {"environment", "emission"} <= WORDS[unknown]:
        scene = with_more(scene, '<emitter type="point"/>')
    problem = make_problem(scene, "visible", config, 0.2)
    state, rates = initial_state(problem), learning_rates(config, 0, 0)
    state.set_learning_rates(rates)
    assert len(state.phi) > 0
    for name in state.phi:
        word = name.partition(".")[0]
        assert float(state.phi.learning_rate(name)[0]) == pytest.approx(rates[word])
    assert {name.partition(".")[0] for name in state.phi} == WORDS[unknown]
