"""A PyTorch module as a field: the same values, gradients and fits as the perceptron of Dr.Jit."""

import gc
import sys
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, built_in_cameras, grey_photographs, seeded

from unbake.errors import UserError
from unbake.fields import registry
from unbake.fields.domain import SurfacePoint
from unbake.fields.field import Cost, Field, FieldSpec
from unbake.fields.perceptron import Perceptron
from unbake.fields.registry import Representation, register_representation
from unbake.fields.torch import TorchField
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep

RATES = {"albedo": 0.02, "roughness": 0.02, "radiance": 0.02}
LANES = 500


@dataclass(frozen=True)
class Settings:
    width: int = 16
    learning_rate: float = 0.01


def build(inputs, outputs, width=16):
    nn = pytest.importorskip("torch").nn
    layers = [nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(width, outputs))


def make(settings, spec):
    return TorchField(lambda *sizes: build(*sizes, settings.width), spec)


class Plain(Field):
    """The same function by Dr.Jit: parameters have the names and first values of the module's."""

    def __init__(self, settings, spec):
        self.perceptron = Perceptron(
            3 + spec.extra, settings.width, 2, spec, np.random.default_rng(0)
        )
        found = make(settings, spec).parameters()
        if spec.bounded:
            found["4.bias"] = found["4.bias"] + float(np.log(spec.initial / (1 - spec.initial)))
        dr.make_opaque(found)
        self.assign(found)

    def parameters(self):
        return dict(self._parameters)

    def assign(self, parameters):
        self._parameters = {key: parameters[key] for key in parameters}
        layers = {}
        for i in range(3):
            weights, bias = (parameters[f"{2 * i}.{word}"] for word in ("weight", "bias"))
            column = mi.TensorXf(bias.array, (dr.width(bias.array), 1))
            layers |= {f"{i}.weights": weights, f"{i}.bias": column}
        self.perceptron.assign(layers)

    def evaluate(self, point, extra=(), engine=None):
        return self.perceptron.evaluate([*point.position, *extra], engine)

    def cost(self):
        return Cost(self.perceptron.multiply_adds, 0)


def values_and_gradients(field, found):
    """Outputs, and gradients of the parameters and the inputs by name."""
    parameters = {key: type(value)(value) for key, value in field.parameters().items()}
    dr.enable_grad(parameters, found)
    field.assign(parameters)
    values = field.evaluate(SurfacePoint(mi.Point3f(found[:3])), found[3:])
    dr.backward(sum((i + 1) * dr.sum(v * v) for i, v in enumerate(values)))
    gradients = {key: np.array(dr.grad(value)) for key, value in parameters.items()}
    gradients["inputs"] = np.array([np.array(dr.grad(x)) for x in found])
    return np.array([np.array(v) for v in values]), gradients


def inputs(count, seed=1):
    sampler = seeded(seed, LANES)
    found = [sampler.next_1d() for _ in range(count)]
    dr.eval(found)
    return found


@pytest.mark.parametrize(("extra", "outputs", "bounded"), [(0, 3, True), (12, 6, False)])
def test_values_and_gradients_are_those_of_the_same_perceptron_in_drjit(extra, outputs, bounded):
    pytest.importorskip("torch")
    spec = FieldSpec(outputs, extra, bounded=bounded, initial=0.3, seed=4)
    values, gradients = values_and_gradients(make(Settings(), spec), inputs(3 + extra))
    expected, exact = values_and_gradients(Plain(Settings(), spec), inputs(3 + extra))
    assert values.shape == (outputs, LANES) and np.ptp(values) > 0.01
    np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-6)
    assert gradients.keys() == exact.keys() >= {"0.weight", "4.bias", "inputs"}
    for name, gradient in gradients.items():
        scale = np.abs(exact[name]).max()
        assert scale > 0, name
        np.testing.assert_allclose(gradient, exact[name], atol=1e-5 * scale, err_msg=name)


def test_an_untrained_field_is_near_its_initial_value_and_its_seed_decides():
    torch = pytest.importorskip("torch")
    state = torch.random.get_rng_state()

    def zero(inputs, outputs):
        module = build(inputs, outputs)
        torch.nn.init.zeros_(module[-1].weight)
        torch.nn.init.zeros_(module[-1].bias)
        return module

    fields = [TorchField(zero, FieldSpec(2, bounded=True, initial=0.2, seed=s)) for s in (1, 1, 2)]
    point = SurfacePoint(mi.Point3f(inputs(3)))
    np.testing.assert_allclose(np.array(fields[0].evaluate(point)), 0.2, atol=1e-6)
    first = [np.array(field.parameters()["0.weight"]) for field in fields]
    np.testing.assert_array_equal(first[0], first[1])
    assert (first[0] != first[2]).all()
    assert (torch.random.get_rng_state() == state).all()


@pytest.fixture
def torch_representation(monkeypatch):
    """Representations by either library, known by name in this test alone."""
    pytest.importorskip("torch")
    monkeypatch.setattr(registry, "_REPRESENTATIONS", dict(registry._REPRESENTATIONS))
    for name, maker in (("torch", make), ("plain", Plain)):
        row = Representation(name, name, Settings(), maker, radiance=Settings())
        register_representation(row)


@pytest.mark.parametrize("radiance", [True, False], ids=["both", "materials"])
def test_it_trains_as_the_same_perceptron_does_without_being_recorded(
    torch_representation, built_in, radiance
):
    gc.collect()
    losses, found = {}, {}
    for name in ("plain", "torch"):
        config = replace(TINY_FIT, representation=name)
        if radiance:
            config = replace(config, radiance_representation=name)
        problem = make_problem(built_in("cornell"), "visible", config, 0.2)
        pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
        step, state = TrainingStep(problem, pixels, config), initial_state(problem)
        first = {key: np.array(value) for key, value in state.phi.items()}
        terms = [step(state, i, RATES) for i in range(5)]
        losses[name] = [[float(value[0]) for value in t.values()] for t in terms]
        found[name] = {key: np.array(value) for key, value in state.phi.items()}
        assert all((found[name][key] != value).any() for key, value in first.items())
        assert (step.recordings() == 0) == (name == "torch")
    np.testing.assert_allclose(losses["torch"], losses["plain"], rtol=1e-3, atol=1e-5)
    for key, value in found["torch"].items():
        np.testing.assert_allclose(value, found["plain"][key], atol=2e-3, err_msg=key)


def test_a_run_is_saved_and_evaluated(torch_representation, unbake, cornell, tiny, tmp_path):
    run = tmp_path / "run"
    words = ("--settings", tiny, "--representation", "torch")
    done = unbake("fit", cornell, "--out", run, "--steps", 3, *words)
    assert done.status == 0, done.err
    done = unbake("evaluate", run, "--spp", 4, "--train-views", 0)
    assert done.status == 0, done.err


def test_paths_that_mitsuba_follows_refuse_it_in_one_line(
    torch_representation, unbake, cornell, tiny, tmp_path
):
    words = ("--settings", tiny, "--representation", "torch", "--method", "prb", "--steps", 2)
    done = unbake("fit", cornell, "--out", tmp_path / "run", *words)
    assert done.status == 2
    assert "the field of albedo cannot be evaluated inside of loops" in done.err
    assert "Traceback" not in done.err


def test_without_pytorch_there_is_a_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match=r'no PyTorch.*pip install "unbake\[torch\]"'):
        make(Settings(), FieldSpec(1))


def test_parameters_are_single_precision():
    torch = pytest.importorskip("torch")
    with pytest.raises(TypeError, match=r"0\.weight is torch.float64, not torch.float32"):
        TorchField(lambda i, o: torch.nn.Sequential(torch.nn.Linear(i, o)).double(), FieldSpec(1))
