"""A PyTorch module as a field beside the same perceptron by Dr.Jit: deviation and time.

    python benchmarks/torch_field.py [--out FILE]

Both evaluate the same weights at the same points, and differentiate a weighted sum of the outputs
to the weights and inputs. Then training steps of the demo, whose materials are such perceptrons of
the position: with PyTorch a step is traced each time, with Dr.Jit it is replayed. They take turns,
so that the ratio of their times holds where the machine does other work as well. Needs PyTorch.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from here import ROOT

import numpy as np

import unbake

unbake.activate()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
import torch  # noqa: E402

from unbake.acquisition import built_in  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402

RESULT = ROOT / "benchmarks" / "results" / "torch-field.json"
POINTS, EXTRA, OUTPUTS, WIDTH = 8192, 12, 6, 32


def module(inputs: int, outputs: int) -> torch.nn.Module:
    """Two hidden layers, as the default network of L_θ has."""
    nn = torch.nn
    layers = [nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(WIDTH, outputs))


@dataclass(frozen=True)
class Settings:
    """Of a field of materials, by either library."""

    learning_rate: float = 0.01


class Plain(unbake.Field):
    """The perceptron of the position by Dr.Jit."""

    def __init__(self, settings: Settings, spec: unbake.FieldSpec) -> None:
        self.perceptron = unbake.Perceptron(3, WIDTH, 2, spec, np.random.default_rng(spec.seed))
        self.parameters, self.assign = self.perceptron.parameters, self.perceptron.assign

    def evaluate(self, point, extra=(), engine=None):
        """Outputs at points."""
        return self.perceptron.evaluate(list(point.position), engine)

    def cost(self) -> unbake.Cost:
        """The products of all layers."""
        return unbake.Cost(self.perceptron.multiply_adds, 0)


class Contest:
    """Both fields with the same weights, and points to evaluate them at."""

    def __init__(self) -> None:
        spec = unbake.FieldSpec(OUTPUTS, EXTRA, seed=1)
        self.torch = unbake.TorchField(module, spec)
        self.perceptron = unbake.Perceptron(3 + EXTRA, WIDTH, 2, spec, np.random.default_rng(0))
        given = self.torch.parameters()
        own = {}
        for i in range(3):
            own[f"{i}.weights"] = mi.TensorXf(given[f"{2 * i}.weight"])
            bias = given[f"{2 * i}.bias"]
            own[f"{i}.bias"] = mi.TensorXf(bias.array, (bias.shape[0], 1))
        dr.enable_grad(given, own)
        dr.eval(given, own)
        self.torch.assign(given)
        self.perceptron.assign(own)
        self.given, self.own = list(given.values()), list(own.values())
        rng = np.random.default_rng(2)
        self.inputs = [mi.Float(row) for row in rng.random((3 + EXTRA, POINTS), np.float32)]
        self.weights = [mi.Float(row) for row in rng.random((OUTPUTS, POINTS), np.float32)]
        dr.enable_grad(self.inputs)
        dr.eval(self.inputs, self.weights)

    def by_torch(self) -> list[mi.Float]:
        """Outputs of the module."""
        point = unbake.SurfacePoint(mi.Point3f(self.inputs[:3]))
        return self._with_gradients(self.torch.evaluate(point, self.inputs[3:]), self.given)

    def by_drjit(self) -> list[mi.Float]:
        """Outputs of the perceptron."""
        return self._with_gradients(self.perceptron.evaluate(self.inputs), self.own)

    def _with_gradients(self, values: list[mi.Float], parameters: list) -> list[mi.Float]:
        """The outputs; their gradients are left in parameters and inputs."""
        dr.backward(sum(dr.sum(w * v) for w, v in zip(self.weights, values, strict=True)))
        gradients = [dr.grad(x) for x in (*parameters, *self.inputs)]
        dr.eval(values, gradients)
        dr.clear_grad(parameters)
        dr.clear_grad(self.inputs)
        return [*values, *gradients]


def deviations(contest: Contest) -> dict[str, float]:
    """Largest differences of outputs and gradients, relative to the largest number of an array."""
    found = []
    for of_torch, of_drjit in zip(contest.by_torch(), contest.by_drjit(), strict=True):
        a, b = np.array(of_torch).ravel(), np.array(of_drjit).ravel()
        found.append(float(np.abs(a - b).max() / np.abs(b).max()))
    return {"values": max(found[:OUTPUTS]), "gradients": max(found[OUTPUTS:])}


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Mean time of a call, of several in a row."""
    begin = time.perf_counter()
    for _ in range(repeats):
        call()
        dr.sync_thread()
    return 1000 * (time.perf_counter() - begin) / repeats


def training_step(scene: Path, name: str, make: Callable) -> Callable[[], object]:
    """A function that takes a training step, with materials of this kind."""
    unbake.register_representation(unbake.Representation(name, name, Settings(), make))
    config = replace(unbake.preset("cpu"), representation=name)
    cameras = [
        unbake.Camera.look_at(c["origin"], c["target"], c["up"], c["fov"], 64, 64)
        for c in built_in.default_cameras("demo", 4, 0)
    ]
    rgb = np.random.default_rng(0).uniform(0.1, 0.5, (4 * 64 * 64, 3))
    pixels = unbake.PixelSource.of(cameras, rgb, np.ones(len(rgb)), foreground_only=False)
    problem = unbake.make_problem(scene, "visible", config, 0.3)
    state, step = unbake.initial_state(problem), unbake.TrainingStep(problem, pixels, config)
    rates, numbers = unbake.learning_rates(config, 200, 0.1), iter(range(1 << 30))
    return lambda: step(state, next(numbers), rates)


def in_turns(calls: dict[str, Callable[[], object]], turns: int, repeats: int) -> dict:
    """Median times, and how many times as long as Dr.Jit PyTorch takes."""
    for call in calls.values():
        milliseconds(call, repeats)
    times = [
        {name: milliseconds(call, repeats) for name, call in calls.items()} for _ in range(turns)
    ]
    ratios = sorted(turn["torch"] / turn["drjit"] for turn in times)
    return {
        "milliseconds": {name: statistics.median(turn[name] for turn in times) for name in calls},
        "torch_over_drjit": statistics.median(ratios),
        "range": [ratios[0], ratios[-1]],
        "turns": turns,
    }


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--turns", type=int, default=15)
    parser.add_argument("--repeats", type=int, default=20)
    args = parser.parse_args()
    contest = Contest()
    deviation = deviations(contest)
    calls = {"torch": contest.by_torch, "drjit": contest.by_drjit}
    evaluation = in_turns(calls, args.turns, args.repeats)

    def make(settings: Settings, spec: unbake.FieldSpec) -> unbake.TorchField:
        return unbake.TorchField(module, spec)

    with tempfile.TemporaryDirectory() as folder:
        scene = built_in.write_scene("demo", Path(folder) / "demo")
        makers = {"torch": make, "drjit": Plain}
        steps = {name: training_step(scene, name, maker) for name, maker in makers.items()}
        step = in_turns(steps, args.turns, max(4, args.repeats // 4))
    result = {
        "machine": machine() | {"torch": torch.__version__, "threads": torch.get_num_threads()},
        "points": POINTS,
        "layers": [3 + EXTRA, WIDTH, WIDTH, OUTPUTS],
        "largest_relative_deviation": deviation,
        "evaluation_with_gradients": evaluation,
        "training_step": step,
    }
    write_json(args.out, result)
    print(result)


if __name__ == "__main__":
    main()
