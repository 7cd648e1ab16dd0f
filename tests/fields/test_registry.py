"""A representation from outside the package: registered with one call, then a name like others."""

import gc
from dataclasses import asdict, dataclass, replace
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_only_replayed,
    built_in_cameras,
    grey_photographs,
)

from unbake.config import FitConfig, from_toml, to_toml
from unbake.errors import UserError, require
from unbake.fields import registry
from unbake.fields.arrays import sigmoid
from unbake.fields.field import Cost, Field, FieldSpec
from unbake.fields.registry import Representation, register_representation
from unbake.fields.settings import DenseGridConfig
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep


@dataclass(frozen=True)
class StripsConfig:
    """Strips along x."""

    count: int = 256
    learning_rate: float = 0.03

    def __post_init__(self):
        require(self.count >= 1, "count", "1 or more", self.count)


class Strips(Field):
    """The same value in all of a strip: a piecewise constant function of x."""

    def __init__(self, settings: StripsConfig, spec: FieldSpec):
        self.count, self.outputs, self.bounded = settings.count, spec.outputs, spec.bounded
        self.values = dr.zeros(mi.Float, self.count * self.outputs)
        dr.make_opaque(self.values)

    def parameters(self):
        return {"values": self.values}

    def assign(self, parameters):
        self.values = parameters["values"]

    def evaluate(self, point, extra=(), engine=None):
        strip = dr.minimum(mi.UInt32(point.position.x * self.count), self.count - 1)
        first = strip * self.outputs
        found = [dr.gather(mi.Float, self.values, first + i) for i in range(self.outputs)]
        return [sigmoid(x) for x in found] if self.bounded else found

    def cost(self):
        return Cost(0, 4 * self.outputs)


@pytest.fixture
def strips(monkeypatch):
    """The representation, known by name in this test alone."""
    monkeypatch.setattr(registry, "_REPRESENTATIONS", dict(registry._REPRESENTATIONS))
    register_representation(
        Representation("strips", "strips", StripsConfig(), Strips, radiance=StripsConfig(count=2))
    )


def test_it_has_settings_that_are_read_and_checked_like_others(strips):
    text = 'format = 2\nrepresentation = "strips"\n[materials.albedo.strips]\ncount = 9\n'
    config = from_toml(text)
    assert config.material_settings == {"albedo": StripsConfig(9), "roughness": StripsConfig()}
    assert config.radiance["strips"] == StripsConfig(2)
    assert from_toml(to_toml(config)) == config
    for line, message in (
        ("count = 0", "materials.albedo.strips.count: must be 1 or more, not 0"),
        ("count = 1.0", "materials.albedo.strips.count: must be int, not float"),
        ("depth = 1", "materials.albedo.strips.depth: unknown key. Known keys: count, learning_r"),
    ):
        with pytest.raises(UserError, match=message):
            from_toml(f"[materials.albedo.strips]\n{line}")


def test_settings_may_be_choices_of_numbers_and_may_be_absent(monkeypatch):
    @dataclass(frozen=True)
    class ChoiceConfig:
        order: Literal[1, 2] = 1
        cells: int | None = None
        cut: float | None = None
        learning_rate: float = 0.1

    monkeypatch.setattr(registry, "_REPRESENTATIONS", dict(registry._REPRESENTATIONS))
    register_representation(Representation("choice", "choice", ChoiceConfig(), Strips))
    config = from_toml('representation = "choice"\n[materials.albedo.choice]\norder = 2\ncut = 3\n')
    assert config.material_settings["albedo"] == ChoiceConfig(order=2, cut=3.0)
    written = to_toml(config)
    table = written.partition("[materials.albedo.choice]")[2].partition("\n[")[0]
    assert "order = 2" in table and "cells" not in table
    assert from_toml(written) == config
    with pytest.raises(UserError, match=r"order: must be one of 1, 2, not 3"):
        from_toml("[materials.albedo.choice]\norder = 3")
    with pytest.raises(UserError, match=r"cells: must be int, not str"):
        from_toml('[materials.albedo.choice]\ncells = "x"')


@pytest.mark.parametrize("key", ["representation", "radiance_representation"])
def test_settings_of_one_that_is_not_registered_are_refused_by_its_name(strips, key, monkeypatch):
    text = to_toml(from_toml(f'{key} = "strips"\n[materials.albedo.strips]\ncount = 9\n'))
    assert "strips]" in text
    monkeypatch.delitem(registry._REPRESENTATIONS, "strips")
    said = rf"^settings: {key}: must be one of neural, .*, not 'strips'. A name of your own must be"
    with pytest.raises(UserError, match=said) as error:
        from_toml(text)
    assert "\n" not in str(error.value)


def test_a_settings_file_does_not_name_it_without_need(strips):
    assert "strips" not in to_toml(FitConfig())


@pytest.mark.parametrize("radiance", ["neural", "strips"])
def test_it_trains_and_its_step_is_replayed(strips, built_in, radiance):
    # Scenes of earlier tests must not be freed while this one is recorded and replayed.
    gc.collect()
    config = replace(TINY_FIT, representation="strips", radiance_representation=radiance)
    problem = make_problem(built_in("cornell"), "visible", config, 0.2)
    assert all(isinstance(field, Strips) for field in problem.materials.values())
    pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)
    before = {key: np.array(value) for key, value in state.phi.items()}
    assert_only_replayed(step, state, lambda i: {"albedo": 0.1, "roughness": 0.1, "radiance": 0.1})
    for key, old in before.items():
        assert (np.array(state.phi[key]) != old).any(), key


def test_the_command_line_takes_it(strips, unbake, cornell, tiny, tmp_path):
    run = tmp_path / "run"
    words = ("--out", run, "--settings", tiny, "--representation", "strips", "--steps", 4)
    done = unbake("fit", cornell, *words)
    assert done.status == 0, done.err
    assert 'representation = "strips"' in (run / "config.toml").read_text()
    assert unbake("evaluate", run, "--spp", 4, "--train-views", 0).status == 0
    done = unbake("fit", cornell, "--out", tmp_path / "other", "--representation", "wave")
    assert done.status == 2
    assert "must be one of neural, grid, bitmap, triplane, strips, not 'wave'" in done.err


@pytest.mark.parametrize(
    ("bad", "error", "message"),
    [
        ({"name": "neural"}, ValueError, "there is a representation named 'neural' already"),
        ({"name": "a.b"}, ValueError, "'a.b' is not a name"),
        ({"settings": StripsConfig}, TypeError, "not an instance of a dataclass"),
        ({"settings": FieldSpec(1)}, TypeError, "have no learning_rate"),
    ],
)
def test_what_cannot_be_a_representation_is_refused(strips, bad, error, message):
    row = {"name": "mine", "title": "mine", "settings": StripsConfig(), "make": Strips} | bad
    with pytest.raises(error, match=message):
        register_representation(Representation(**row))


def test_the_same_again_is_no_error(strips):
    register_representation(registry.representation("strips"))
    register_representation(replace(registry.representation("neural")))


def test_settings_of_another_representation_are_refused():
    with pytest.raises(UserError, match="neural: must be a NetworkConfig, not DenseGrid"):
        FitConfig(materials={"albedo": {"neural": DenseGridConfig()}})
    with pytest.raises(
        UserError, match=r"no representation named 'mesh'\. There are neural, grid, bitmap"
    ):
        FitConfig(materials={"albedo": {"mesh": DenseGridConfig()}})


def test_no_representation_of_that_name():
    with pytest.raises(
        UserError, match=r"no representation named .mesh.\. There are neural, grid, "
    ):
        registry.representation("mesh")


@pytest.mark.parametrize("name", ["neural", "grid", "bitmap", "triplane"])
@pytest.mark.parametrize("initial", [0.1, 0.5, 0.9])
def test_an_untrained_field_has_its_initial_value(name, initial):
    from unbake.fields.domain import SurfacePoint

    row = registry.representation(name)
    spec = FieldSpec(outputs=3, bounded=True, initial=initial, materials=("one",))
    field = row.field(row.settings, spec)
    x = dr.linspace(mi.Float, 0, 1, 50)
    point = SurfacePoint(mi.Point3f(x, 1 - x, 0.5), mi.Point2f(x, 0.3), dr.zeros(mi.UInt32, 50))
    np.testing.assert_allclose(np.array(field.evaluate(point)), initial, atol=0.03)
    assert asdict(field.cost())["bytes"] > 0
