"""How long Adam remembers large gradients, which those of the first steps are."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import tiny_fields

from unbake.config import from_toml, preset
from unbake.config.presets import with_method
from unbake.fields.domain import SurfacePoint
from unbake.fields.pieces import Piece
from unbake.fields.registry import representations
from unbake.training.adam import GrowingAdam
from unbake.training.defaults import with_method_defaults
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.transport.methods import METHODS
from unbake.transport.objective import has_radiance


def moved(optimizer, gradients):
    """How far numbers move with each of these gradients."""
    optimizer.set_learning_rate(0.01)
    key = next(iter(optimizer))
    value, found = np.array(dr.detach(optimizer[key]).array), []
    for gradient in gradients:
        dr.set_grad(optimizer[key], gradient)
        optimizer.step()
        now = np.array(dr.detach(optimizer[key]).array)
        found.append(np.abs(now - value).max())
        value = now
    return found


def test_unknowns_forget_the_first_gradients_sooner_than_the_radiance_field(built_in):
    config = with_method_defaults(replace(tiny_fields(), method="ours"), "room")
    state = initial_state(make_problem(built_in("still"), "visible", config, 0.3))
    gradients = [100.0] * 20 + [1.0] * 1000
    unknowns, radiance = (moved(o, gradients)[-1] for o in (state.phi, state.theta))
    assert unknowns == pytest.approx(0.0058, rel=0.1)
    assert radiance < 0.002


@pytest.mark.parametrize("before", [0, 5000])
@pytest.mark.parametrize("first", [0.9, 0.999, 0.9999])
def test_memory_grows_with_the_steps_to_the_usual_one(first, before):
    optimizer = GrowingAdam(0.01, {"x": dr.zeros(mi.Float, 1)}, beta_2=first)
    usual = mi.ad.Adam(0.01, {"x": dr.zeros(mi.Float, 1)}, beta_2=first)
    for each in (optimizer, usual):
        value, promoted, rate, (_, *moments) = each.state["x"]
        each.state["x"] = (value, promoted, rate, (mi.UInt32(before), *moments))
    rng = np.random.default_rng(0)
    mean = square = x = 0.0
    for step in range(before + 1, before + 201):
        gradient = float(rng.normal(1, 3))
        grown = min(1 - 1 / (0.3 * step), 0.999)
        beta = max(grown, first)
        mean, square = 0.9 * mean + 0.1 * gradient, beta * square + (1 - beta) * gradient**2
        x -= 0.01 * mean / np.sqrt(square) * np.sqrt(1 - beta**step) / (1 - 0.9**step)
        for each in (optimizer, usual):
            dr.set_grad(each["x"], gradient)
            each.step()
    assert optimizer["x"][0] == pytest.approx(x, rel=1e-3)
    assert (optimizer["x"][0] == usual["x"][0]) == (first >= 0.999)
    assert optimizer.beta_2 == first


def test_a_step_moves_with_the_beta_of_its_settings(built_in):
    config = replace(tiny_fields(), method="direct", beta2=0.999)
    state = initial_state(make_problem(built_in("still"), "visible", config, 0.3))
    assert moved(state.phi, [100.0] * 20 + [1.0] * 1000)[-1] < 0.002


@pytest.mark.parametrize("method", METHODS)
def test_methods_with_a_radiance_field_have_a_slope_and_forget_sooner(method):
    config = replace(tiny_fields(), method=method)
    found, field = with_method_defaults(config, "room"), has_radiance(config.chosen_method)
    assert (found.beta2, found.least_slope) == ((0.99, 0.01) if field else (0.999, 0))
    given = with_method_defaults(replace(config, beta2=0.5, least_slope=0.2), "room")
    assert (given.beta2, given.least_slope) == (0.5, 0.2)


def test_another_method_does_not_keep_those_of_a_run():
    run = with_method(with_method_defaults(preset("cpu"), "room"), "prb")
    assert (run.beta2, run.least_slope) == (0, -1)
    given = with_method(replace(preset("cpu"), beta2=0.5, least_slope=0.2), "prb")
    assert (given.beta2, given.least_slope) == (0.5, 0.2)


@pytest.mark.parametrize(("key", "before"), [("beta2", 0.999), ("least_slope", 0)])
def test_runs_of_earlier_versions_and_the_paper_have_the_usual_ones(key, before):
    assert getattr(preset("cpu"), key) == getattr(from_toml(""), key) <= 0
    for name in ("paper", "release"):
        assert getattr(preset(name), key) == before
    assert getattr(from_toml("format = 2\n"), key) == before
    assert getattr(from_toml(f"format = 2\n{key} = 0.1\n"), key) == 0.1


@pytest.mark.parametrize("representation", representations())
@pytest.mark.parametrize(("slope", "least"), [(-1.0, 0.0), (0.01, 0.009)])
def test_the_slope_of_the_settings_reaches_albedo_alone(representation, slope, least, built_in):
    """Searches of roughness look for the most probable numbers, which another slope would move."""
    config = replace(tiny_fields(representation), method="direct", least_slope=slope)
    materials = make_problem(built_in("still"), "visible", config, 0.3).materials
    assert least <= slope_far_below(materials["albedo"]) < 0.011
    assert slope_far_below(materials["roughness"]) < 1e-6


def slope_far_below(field):
    """The share of a gradient upwards that reaches numbers which give outputs an offset."""
    parameters = field.parameters()
    *_, offsets = (k for k in parameters if k in ("corners", "texels") or k.endswith("bias"))
    lower = dr.full(mi.Float, -30, dr.width(parameters[offsets].array))
    if dr.is_tensor_v(parameters[offsets]):
        lower = mi.TensorXf(lower, parameters[offsets].shape)
    dr.enable_grad(lower)
    field.assign(parameters | {offsets: lower})
    number = mi.UInt32(0)
    point = SurfacePoint(mi.Point3f(0.5), mi.Point2f(0.5), number, Piece(number, mi.Float(1)))
    dr.backward(-field.evaluate(point)[0])  # a descent moves it up
    return -float(np.array(dr.grad(lower).array).sum())
