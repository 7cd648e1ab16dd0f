"""What tests of several folders share: small scenes and rays, stand-ins for fields, a Z-test.

Import it from test modules alone, which are read once the Mitsuba variant is set.
"""

from __future__ import annotations

import os
import runpy
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from statistics import NormalDist
from threading import Barrier
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from safetensors.numpy import load_file

from unbake.acquisition import built_in
from unbake.config import FitConfig, GridConfig, NetworkConfig, RegularizationConfig, update
from unbake.config.migration import FORMAT
from unbake.dataset.camera import Camera
from unbake.dataset.pixels import CameraRays, PixelSource
from unbake.fields.materials import Material
from unbake.quantities import QUANTITIES
from unbake.ranks import Ranks
from unbake.training.loop import fit
from unbake.training.state import State
from unbake.training.step import TrainingStep
from unbake.transport.methods import method_named
from unbake.transport.operator import attach_material, bounce
from unbake.transport.path_sample import Requirements
from unbake.transport.path_tracer import path_traced
from unbake.transport.samplers import PathSampler, SamplerContext, make_sampler
from unbake.transport.vertex import SceneView, find_vertex

#: Names of browsers in which tests open pages, as the judges of glTF files know them.
BROWSERS: tuple[str, ...] = runpy.run_path(
    str(Path(__file__).parents[1] / "benchmarks" / "gltf_judges.py")
)["BROWSERS"]
#: Starts several processes of one command, where MPI is installed.
MPIEXEC = shutil.which("mpiexec", path=f"{Path(sys.executable).parent}:{os.environ['PATH']}")
needs_mpi = pytest.mark.skipif(
    MPIEXEC is None or find_spec("mpi4py") is None, reason="mpiexec and mpi4py are not installed"
)


def found_browser() -> str | None:
    """The first of the browsers that is installed; None: there is none."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


#: The smallest network that still has a hash table and a hidden layer.
TINY = NetworkConfig(
    grid=GridConfig(levels=2, features=2, table_log2=8, base_resolution=2), width=8, hidden=1
)
_SIZES = {key: value for key, value in asdict(TINY).items() if key != "learning_rate"}
#: A fit of a few dozen pixels with tiny networks, and the usual learning rates.
TINY_FIT = update(
    FitConfig(pixels=32, spp=4, regularization=RegularizationConfig(albedo_smoothness=0.0)),
    {
        "materials": {name: {"neural": _SIZES} for name in QUANTITIES},
        "radiance": {"neural": _SIZES},
    },
)


_TRIPLANE = {"levels": 2, "features": 2, "base_resolution": 3, "width": 8}


def tiny_fields(representation="neural", radiance="neural") -> FitConfig:
    """Settings of a tiny fit whose fields are small in every representation."""
    small = update(
        TINY_FIT,
        {
            "materials": {
                "albedo": {
                    "grid": {"cells": 5},
                    "bitmap": {"resolution": 6},
                    "triplane": _TRIPLANE,
                },
                "roughness": {
                    "grid": {"cells": 3},
                    "bitmap": {"resolution": 4},
                    "triplane": _TRIPLANE,
                },
            },
            "radiance": {"grid": {"cells": 4}, "triplane": _TRIPLANE},
        },
    )
    return replace(small, representation=representation, radiance_representation=radiance)


def of_format(text: str, version: int) -> str:
    """A settings file that unbake writes today, as if it were of an earlier format."""
    now = f"format = {FORMAT}\n"
    assert text.count(now) == 1
    return text.replace(now, f"format = {version}\n")


# ------------------------------------------------------------------------------------ rays


def globe(around: int, up: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and triangles of a sphere of radius 1; at a seam two vertices are at each place."""
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, around + 1), np.linspace(-1, 1, up + 1))
    r = np.sqrt(1 - z**2)
    positions = np.stack([r * np.cos(angle), r * np.sin(angle), z], -1).reshape(-1, 3)
    positions[around :: around + 1] = positions[:: around + 1]
    corner = (np.arange(up)[:, None] * (around + 1) + np.arange(around)).ravel()
    across = corner + around + 2
    quads = np.stack([corner, corner + 1, across, corner, across, across - 1], 1)
    return positions, quads.reshape(-1, 3)


def built_in_cameras(name: str, size: int, views: int = 1) -> list[Camera]:
    """Training cameras of a built-in scene, `size` pixels square."""
    return [
        Camera.look_at(c["origin"], c["target"], c["up"], c["fov"], size, size)
        for c in built_in.default_cameras(name, views, 0)
    ]


def with_more(scene: Path, text: str) -> Path:
    """The scene with something at its end, in a file beside it."""
    more = scene.with_name("more.xml")
    more.write_text(scene.read_text().replace("</scene>", f"{text}</scene>"))
    return more


def pixel_rays(cameras: list[Camera], spp: int, seed: int) -> mi.Ray3f:
    """Jittered rays through every pixel, `spp` consecutive lanes a pixel."""
    rays = CameraRays.of(cameras)
    sampler = seeded(seed, rays.pixels * spp)
    ray = rays.through(dr.arange(mi.UInt32, rays.pixels * spp) // spp, sampler.next_2d())
    dr.eval(ray)
    return ray


def random_values(fields, seed: int = 0, scale: float = 0.7) -> dict[str, mi.Float | mi.TensorXf]:
    """Random parameters for fields, large ones: those of untrained fields are nearly zero."""
    rng = np.random.default_rng(seed)
    return {
        k: type(v)(rng.normal(0, scale, v.shape).astype(np.float32))
        for k, v in fields.parameters().items()
    }


def randomised(fields, seed: int = 0, scale: float = 0.7) -> dict[str, mi.Float | mi.TensorXf]:
    """Give fields random parameters, with gradients enabled; returns these."""
    values = random_values(fields, seed, scale)
    dr.enable_grad(values)
    fields.assign(values)
    return values


def seeded(seed: int, lanes: int) -> mi.Sampler:
    """A sampler that is ready to draw from."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, lanes)
    return sampler


def grey_photographs(cameras: list[Camera], value: float = 0.3) -> PixelSource:
    """Training pixels with a little texture, as a fit wants them."""
    count = sum(c.width * c.height for c in cameras)
    rgb = value * np.random.default_rng(7).uniform(0.5, 1.5, (count, 3))
    return PixelSource.of(cameras, rgb, np.ones(count), foreground_only=False)


# ------------------------------------------------------------------------- several processes


class _Done:
    """A request of MPI that is done."""

    def Test(self) -> bool:
        return True


class _Member:
    """A communicator of threads, which stand for processes."""

    def __init__(self, rank: int, slots: list[np.ndarray | None], barrier: Barrier) -> None:
        self.rank, self.size, self._slots, self._barrier = rank, len(slots), slots, barrier

    def Iallgather(self, own: np.ndarray, rows: np.ndarray) -> _Done:
        for row, array in zip(rows, self._exchanged(own), strict=True):
            assert array.shape == row.shape and array.dtype == row.dtype
            row[...] = array
        return _Done()

    def Iallreduce(self, own: np.ndarray, total: np.ndarray) -> _Done:
        total[...] = sum(self._exchanged(own))
        return _Done()

    def Ibcast(self, array: np.ndarray, root: int) -> _Done:
        array[...] = self._exchanged(array)[root]
        return _Done()

    def _exchanged(self, own: np.ndarray) -> list[np.ndarray]:
        self._slots[self.rank] = own.copy()
        self._barrier.wait()
        found = list(self._slots)
        self._barrier.wait()
        return found


def on_ranks(count: int, work: Callable[[Ranks], Any]) -> list[Any]:
    """What some work comes to on each of several ranks, which are threads of this process."""
    slots, barrier = [None] * count, Barrier(count, timeout=20)
    ranks = [Ranks(_Member(rank, slots, barrier), here=count) for rank in range(count)]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(work, ranks))


# ----------------------------------------------------------------------------- training steps


@contextmanager
def nothing_compiled() -> Iterator[None]:
    """A block in which kernels are launched, all of which were compiled before.

    What is recorded and replayed is recorded again if the history of kernels is switched on in
    between: do that around all of it.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        yield
        dr.sync_thread()
        kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
        dr.kernel_history_clear()
    assert kernels, "the history was not recorded"
    compiled = [k for k in kernels if not k["cache_hit"] or k["cache_disk"]]
    assert not compiled, [{n: v for n, v in k.items() if n != "ir"} for k in compiled]


def assert_only_replayed(step, state, rates, steps: int = 4) -> None:
    """Take three steps of a fresh fit, then some more: they compile and trace nothing."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for i in range(3):
            step(state, i, rates(i))
        recorded = step.recordings()
        with nothing_compiled():
            for i in range(3, 3 + steps):
                terms = step(state, i, rates(i))
                assert float(terms["skipped"][0]) == 0
    assert step.recordings() == recorded <= 3


def parameters_of(state: State) -> dict[str, np.ndarray]:
    """Copies of all parameters φ and θ by name, each as one row of numbers."""
    return {
        f"{name}.{key}": np.array(value).ravel().copy()
        for name, optimizer in state.optimizers()
        for key, value in optimizer.items()
    }


def assert_frozen_as_unfrozen(
    one: tuple[TrainingStep, State],
    other: tuple[TrainingStep, State],
    rates: Callable[[int], dict[str, float]],
    *,
    of_terms: dict[str, float],
    atol: float,
) -> list[dict[str, float]]:
    """Take five steps of two equal fits, those of one frozen: both learn the same.

    Every parameter is trained.

    Args:
        rates: learning rates of a step.
        of_terms: how far loss terms may be apart, `rtol` and `atol`.
        atol: how far parameters may be apart, beside an `rtol` of 1e-4.

    Returns:
        The loss terms of each frozen step.
    """
    (frozen, state_a), (unfrozen, state_b) = one, other
    before, taken = parameters_of(state_a), []
    for i in range(5):
        a = frozen(state_a, i, rates(i))
        state_b.set_learning_rates(rates(i))
        b = unfrozen.unfrozen(state_b, i)
        assert a.keys() == b.keys()
        for term in a:
            pair = float(a[term][0]), float(b[term][0])
            np.testing.assert_allclose(*pair, **of_terms, err_msg=term)
        taken.append({term: float(value[0]) for term, value in a.items()})
    after_a, after_b = parameters_of(state_a), parameters_of(state_b)
    for name, values in after_a.items():
        assert (values != before[name]).any(), f"{name} was not trained"
        np.testing.assert_allclose(values, after_b[name], rtol=1e-4, atol=atol, err_msg=name)
    # Each step has random numbers of its own, in the recording too.
    assert len({terms["photometric"] for terms in taken}) == len(taken)
    # The last steps were replayed: the comparison was not one of two traced steps.
    assert frozen.recordings() < 5
    return taken


def losses_of_light(
    light, optimizer, scene_view, rays, target: mi.Color3f, *, frozen: bool
) -> list:
    """Six steps that fit unknown light to one colour of all pixels, recorded or not.

    Args:
        light: an environment map or strengths of lights, whose parameters the optimizer owns.
    """
    sampler = mi.load_dict({"type": "independent"})

    def step(scene, sampler, optimizer, rays, seed):
        sampler.seed(seed, dr.width(rays))
        light.assign(dict(optimizer.items()))
        light.prepare()
        here = scene_view.with_scene(scene)
        first = find_vertex(here, rays, mi.Bool(True), sampler)
        taken = bounce(here, attach_material(here, first), sampler)
        seen = taken.direct + taken.weight * taken.next.emitted
        loss = dr.mean(dr.mean(dr.square(seen - target)))
        dr.backward(loss)
        optimizer.step(eval=False)
        dr.eval(optimizer, loss)
        return loss

    run = dr.freeze(step) if frozen else step
    losses = [
        run(scene_view.scene, sampler, optimizer, rays, dr.opaque(mi.UInt32, 7 + i))[0]
        for i in range(6)
    ]
    if frozen:
        assert run.n_recordings <= 2
    return losses


def enable_gradients(problem):
    """Make all parameters of both fields take gradients, from zero; φ and θ by name."""
    φ, θ = problem.materials.parameters(), problem.radiance.parameters()
    for parameters in (φ, θ):
        dr.disable_grad(parameters)
        dr.enable_grad(parameters)
    problem.materials.assign(φ)
    problem.radiance.assign(θ)
    return φ, θ


def pieces(bounces: int, residuals: int) -> Requirements:
    """What k bounces, so many residuals and the LHS loss read; left-hand sides are attached."""
    left, right = range(1, max(residuals, 1) + 1), range(2, residuals + 2)
    attached = frozenset(left)
    return Requirements(bounces, residuals, attached, frozenset(right) - attached)


# ------------------------------------------------------------------------- stand-ins for fields


class ConstantMaterials:
    """The same material everywhere, as parameters: a stand-in for `Materials`."""

    carried = True

    def __init__(
        self,
        albedo: float | mi.Color3f,
        roughness: float | mi.Float = 0.5,
        metallic: float | None = None,
    ) -> None:
        self.albedo, self.roughness = mi.Color3f(albedo), mi.Float(roughness)
        self.metallic = None if metallic is None else mi.Float(metallic)

    def stand_alone(self) -> None:
        """As `Materials` do: textures evaluate the materials themselves from now on."""
        self.carried = False

    def values(self) -> tuple:
        """Its fields: none."""
        return ()

    def __iter__(self):
        names = ("albedo", "roughness", "metallic")
        return iter(names if self.metallic is not None else names[:2])

    def evaluate_one(self, name: str, si: mi.SurfaceInteraction3f, valid: mi.Bool):
        return self.evaluate(si, valid)[name]

    def evaluate(
        self, si: mi.SurfaceInteraction3f, valid: mi.Bool, engine: str | None = None
    ) -> Material:
        lanes = dr.zeros(mi.Float, dr.width(si.p))
        return {name: getattr(self, name) + lanes for name in self}


class ConstantRadiance:
    """A radiance field that is the same everywhere: a stand-in for `RadianceField`."""

    def __init__(self, value: float) -> None:
        self.value = mi.Color3f(value)

    def evaluate(self, p, w, n, albedo, valid, engine=None) -> mi.Color3f:
        return dr.select(valid, self.value, 0)


class PathTracedRadiance:
    """The exact radiance field, one path a lookup: a stand-in for `RadianceField`."""

    def __init__(self, scene_view, seed: int, max_depth: int) -> None:
        self.scene_view, self.seed, self.max_depth = scene_view, seed, max_depth

    def evaluate(self, p, w, n, albedo, valid, engine=None) -> mi.Color3f:
        # Look at the point from very near, and take away the light that it emits itself.
        with dr.suspend_grad():
            ray = mi.Ray3f(dr.select(valid, p + 1e-4 * w, 1e6), -w)
            dr.eval(ray)
            self.seed += 1
            sees = find_vertex(self.scene_view, ray, valid, seeded(0, dr.width(p)))
            total = path_traced(
                self.scene_view,
                ray,
                self.seed,
                max_depth=self.max_depth,
                rr_depth=5,
                hide_emitters=False,
            )
            return dr.select(valid, total - sees.emitted, 0)


def planned_sampler(
    method: str,
    scene_view: SceneView,
    ray: mi.Ray3f,
    spp: int,
    *,
    max_depth: int,
    bounces: int = 1,
    radiance: object = None,
    read_by_scene: Callable[[], dict] = dict,
) -> PathSampler:
    """The path sampler of a method, without Russian roulette, planned with these camera rays."""
    context = SamplerContext(
        method_named(method),
        scene_view,
        radiance,
        hide_emitters=False,
        spp=spp,
        bounces=bounces,
        max_depth=max_depth,
        rr_depth=max_depth,
        planned_gain=1.0,
        read_by_scene=read_by_scene,
    )
    sampler = make_sampler(context)
    if sampler.keeps_paths:
        with sampler.prepared():
            sampler.plan(scene_view.scene, ray, seeded(0, dr.width(ray)))
    return sampler


# ------------------------------------------------------------------------------------ statistics


def stock_path(
    scene: mi.Scene,
    ray: mi.Ray3f,
    seed: int,
    *,
    max_depth: int,
    rr_depth: int = 5,
    hide_emitters: bool = False,
    integrator: str = "path",
) -> mi.Color3f:
    """Radiance along rays by Mitsuba's own path tracer, one sample a lane.

    Args:
        integrator: `volpath` where opacities are fractions: see `path_integrator`.
    """
    integrator = mi.load_dict(
        {
            "type": integrator,
            "max_depth": max_depth,
            "rr_depth": rr_depth,
            "hide_emitters": hide_emitters,
        }
    )
    with dr.suspend_grad():
        ray = mi.RayDifferential3f(ray)
        radiance, _, _ = integrator.sample(scene, seeded(seed, dr.width(ray)), ray, None, True)
        dr.eval(radiance)
    return mi.Color3f(radiance)


def assert_same_expectation(ours: mi.Color3f, theirs: mi.Color3f, spp: int) -> None:
    """Paired Z-test of every pixel and channel, and of the image as a whole.

    As Mitsuba tests its renders: significance 1 % with Šidák's correction, at least 99.75 % of the
    pixels accepted. The mean of the image, far less noisy, must agree within 3.5 σ.

    Args:
        ours, theirs: samples of the same rays from other random numbers, `spp` consecutive lanes a
            pixel. (Where rays differ inside pixels, most of the noise is theirs.)
    """
    a, b = (np.array(x).reshape(3, -1, spp).astype(np.float64) for x in (ours, theirs))
    assert np.isfinite(a).all() and np.isfinite(b).all()
    assert a.max() > 0, "a black image proves nothing"
    difference = (a - b).mean(-1)
    variance = (a - b).var(-1, ddof=1) / spp
    # Pixels without noise, such as black ones, must agree to rounding.
    z = difference / np.sqrt(variance + (1e-5 * (a.mean(-1) + 1e-3)) ** 2)
    alpha = 1 - (1 - 0.01) ** (1 / z.size)
    accepted = (np.abs(z) < NormalDist().inv_cdf(1 - alpha / 2)).mean()
    whole = difference.sum(-1) / np.sqrt(variance.sum(-1) + 1e-12)
    report = (
        f"accepted {accepted:.4%}, largest |z| {np.abs(z).max():.2f}, z of the image {whole}, "
        f"means {a.mean((1, 2))} and {b.mean((1, 2))}, rms z {np.sqrt((z**2).mean()):.3f}"
    )
    print(report)
    assert accepted >= 0.9975, report
    assert np.abs(whole).max() < 3.5, report


def student_quantile(probability: float, freedom: int) -> float:
    """Quantile of Student's t distribution, to 1 % from 10 degrees of freedom on.

    Abramowitz and Stegun, 26.7.5.
    """
    z = NormalDist().inv_cdf(probability)
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    third = (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384
    return z + first / freedom + second / freedom**2 + third / freedom**3


def assert_same_mean(
    batches: np.ndarray,
    expected: np.ndarray,
    error: np.ndarray,
    names: list[str],
    tests: int,
) -> np.ndarray:
    """Z-test of the means of independent batches, each against a reference with a standard error.

    Significance 1 % over all tests of a matrix, with Šidák's correction.

    Args:
        batches: (batches, numbers).
        expected, error: (numbers,).
        names: of the numbers.
        tests: numbers that are compared in the whole matrix.

    Returns:
        The relative deviations that would have been rejected, (numbers,).
    """
    assert np.isfinite(batches).all() and np.isfinite(expected).all()
    count = len(batches)
    spread = np.sqrt(batches.var(0, ddof=1) / count + error**2)
    z = (batches.mean(0) - expected) / spread
    alpha = 1 - (1 - 0.01) ** (1 / tests)
    limit = student_quantile(1 - alpha / 2, count - 1)
    seen = limit * spread / np.abs(expected)
    rows = zip(names, batches.mean(0), expected, z, seen, strict=True)
    report = "\n".join(
        f"{n}: {a:.5g} and {b:.5g}, z {c:.2f}, sees {d:.2%}" for n, a, b, c, d in rows
    )
    print(report)
    assert np.abs(z).max() < limit, f"a |z| exceeds {limit:.2f}\n{report}"
    return seen


# --------------------------------------------------------------- whole fits, and work on one thread


@contextmanager
def one_thread() -> Iterator[None]:
    """Sums come in one order, so that equal work gives equal numbers.

    Scenes are to be loaded before: OpenEXR waits for ever for a second thread.
    """
    threads = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
        dr.sync_thread()
    finally:
        dr.set_thread_count(threads)


@contextmanager
def one_thread_from_first_step() -> Iterator[None]:
    """A block of fits whose steps are taken on one thread, so that equal fits agree bit by bit.

    What is loaded before the first step has all threads: see `one_thread`.
    """
    plain, threads = TrainingStep.__call__, dr.thread_count()

    def call(self, *words):
        dr.set_thread_count(1)
        return plain(self, *words)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingStep, "__call__", call)
        try:
            yield
        finally:
            dr.set_thread_count(threads)


def at_step(monkeypatch: pytest.MonkeyPatch, step: int, act: Callable[[], object]) -> None:
    """Do something before a step of a fit, once."""
    plain, done = TrainingStep.__call__, []

    def call(self, state, number, *rates):
        if number == step and not done:
            done.append(True)
            act()
        return plain(self, state, number, *rates)

    monkeypatch.setattr(TrainingStep, "__call__", call)


def interrupt_at(monkeypatch: pytest.MonkeyPatch, *steps: int) -> None:
    """Press Ctrl-C during each of some steps of a fit, once."""
    for step in steps:
        at_step(monkeypatch, step, lambda: signal.raise_signal(signal.SIGINT))


def last_state(run: Path) -> dict[str, np.ndarray]:
    """The arrays of a run's newest checkpoint."""
    last = sorted((run / "checkpoints").glob("step-*"))[-1]
    return load_file(last / "state.safetensors")


def whole_and_in_parts(
    data: Path, folder: Path, settings: FitConfig, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], TrainingStep]:
    """What a fit of one thread ends with, and one that is stopped after five steps and resumed.

    Their runs are `whole` and `parts` in the folder. The step is that of the whole one.
    """
    plain, taken = TrainingStep.__call__, []

    def noted(self, *words):
        taken.append(self)
        return plain(self, *words)

    def train(name, **more):
        with one_thread_from_first_step():
            return fit(data, folder / name, settings, **more).step

    with monkeypatch.context() as patch:
        patch.setattr(TrainingStep, "__call__", noted)
        assert train("whole") == settings.steps
    with monkeypatch.context() as patch:
        interrupt_at(patch, 4)
        assert train("parts") == 5
    assert train("parts", resume=True) == settings.steps
    return last_state(folder / "whole"), last_state(folder / "parts"), taken[0]
