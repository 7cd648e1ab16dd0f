"""Figure 5: time and memory of a step in the cube over the length of paths."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import final

import drjit as dr

from ..acquisition.built_in import write_scene
from ..acquisition.capture import capture
from ..acquisition.settings import CaptureSettings
from ..comparison.method_variant import MethodVariant
from ..config import FitConfig, PathConfig, PriorName, update
from ..dataset.views import Dataset
from ..errors import UserError
from ..memory import lacks_memory
from ..profiling.phases import kernel_history, milliseconds
from ..scene.edit import to_principled
from ..scene.parse import parse, write
from ..training.fresh_fit import FreshFit, begin_fit
from ..training.memory import peak_bytes
from ..transport.methods import METHODS
from .experiment import Experiment, ExperimentContext, ExperimentResult, save_figure
from .jobs import Findings, Job, digest
from .table2 import PUBLISHED as PATHS
from .tables import markdown


@final
@dataclass(frozen=True)
class _Curve:
    """A method of the figure."""

    name: str
    variant: str
    prior: PriorName = "extra-bounce"
    #: Whether the loop over bounces is one kernel (a megakernel) or one kernel for each bounce.
    #: Ours and AD-PT have no such loop.
    symbolic: bool = True
    #: Milliseconds per step in the paper's figure: RTX 3090, 256² pixels x 16 samples, grids of
    #: 256³.
    published: str = ""


#: Dr.Jit cannot replay it: a step is traced anew each time, which takes longer than its kernels.
TRACED = "PRB, a kernel a bounce"
CURVES = (
    _Curve("ours", "ours:grid", published="110, mega kernels 98"),
    _Curve("one bounce", "ours:grid", "one-bounce", published="75, mega kernels 64"),
    _Curve("PRB, one kernel", "prb:grid:two-pass", published="up to 531"),
    _Curve("PRB, one kernel, split halves", "prb:grid:split-halves"),
    _Curve(TRACED, "prb:grid:two-pass", symbolic=False, published="up to 4272"),
    _Curve("AD-PT", "ad-pt:grid:two-pass", published="1742 at 0.95, then out of memory"),
    _Curve("AD-PT, split halves", "ad-pt:grid:split-halves"),
)
#: How often each method is measured: a machine whose speed changes then affects all of them.
TURNS = 2


def _jobs(context: ExperimentContext) -> list[Job]:
    albedos = context.pick([0.3, 0.7], list(PATHS), list(PATHS))
    cost = {0.3: 60, 0.5: 70, 0.7: 90, 0.9: 170, 0.95: 270, 0.97: 390}
    settings = {
        "grid": context.pick(8, 64, 256),
        "pixels": context.pick(64, 1024, 65536),
        "spp": context.pick(4, 16, 16),
        "steps": context.pick(2, 6, 10),
    }
    return [
        Job(
            f"albedo-{albedo}",
            settings
            | {"albedo": albedo, "max_depth": PATHS[albedo][0]}
            | {"curves": [curve.name for curve in CURVES]},
            lambda albedo=albedo: _measure(context, albedo, **settings),
            context.pick(8.0, cost[albedo], None),
        )
        for albedo in albedos
    ]


def _measure(
    context: ExperimentContext, albedo: float, *, grid: int, pixels: int, spp: int, steps: int
) -> Findings:
    dataset = _cube(context, albedo)
    shared = FitConfig(
        pixels=pixels,
        spp=spp,
        radiance_spp=0,
        radiance_representation="grid",
        path=PathConfig(max_depth=PATHS[albedo][0], rr_depth=1, planned_gain=1.0),
    )
    cells = {"grid": {"cells": grid}}
    fields = {"materials": dict.fromkeys(shared.quantities, cells), "radiance": cells}
    shared = update(shared, fields)
    findings: Findings = {curve.name: {"seconds": []} for curve in CURVES}
    for turn in range(context.pick(1, TURNS, TURNS)):
        for curve in CURVES:
            row = findings[curve.name]
            if "error" in row:
                continue
            config = MethodVariant.of(curve.variant).settings(shared)
            if METHODS[config.method].takes_prior:
                config = replace(config, prior=curve.prior)
            try:
                with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, curve.symbolic):
                    measured = _steps(dataset, config, albedo, steps, frozen=curve.symbolic)
            except (UserError, RuntimeError) as error:
                if isinstance(error, RuntimeError) and not lacks_memory(error):
                    raise
                row["error"] = str(error)
                context.tell(f"albedo {albedo}, {curve.name}: {error}")
                continue
            row["seconds"] += measured.seconds
            row["kernel_seconds"] = row.get("kernel_seconds", []) + measured.kernel_seconds
            row["memory"] = measured.memory
            median = f"{1e3 * statistics.median(measured.seconds):.0f} ms"
            context.tell(f"turn {turn + 1}, albedo {albedo}, {curve.name}: {median}")
    return findings


def _cube(context: ExperimentContext, albedo: float) -> Dataset:
    """A small data set of the cube with nearly Lambertian walls.

    The fits optimize `principled` BSDFs. Without a specular lobe, and with the initial roughness of
    0.5, these are nearly Lambertian, and paths are as long as in Table 2.
    """
    small = CaptureSettings(views=8, held_out=0, resolution=32, spp=4, max_depth=16)
    folder = context.work / "data" / f"cube-{albedo}-{digest(asdict(small))}"
    if not folder.exists():
        scenes = context.work / "scenes"
        scene = parse(write_scene("cube", scenes / f"cube-{albedo}", albedo=albedo))
        to_principled(scene)
        for node in scene.principled_nodes():
            node.props["roughness"] = 0.5
            node.props["specular"] = 0.0
            node.props["main_specular_sampling_rate"] = 0.0
        matte = scenes / f"cube-{albedo}-matte"
        matte.mkdir(parents=True, exist_ok=True)
        path = write(scene, matte)
        capture(str(path), folder, small, tell=lambda line: None)
    return Dataset.load(folder)


@final
@dataclass(frozen=True)
class _Steps:
    """Steps after warm-up."""

    seconds: list[float]
    kernel_seconds: list[float]  #: sums over the kernels of further steps
    memory: int | None  #: bytes that a step adds to those of the fit


def _steps(
    dataset: Dataset, config: FitConfig, albedo: float, steps: int, *, frozen: bool
) -> _Steps:
    """Measure steps, and further ones kernel by kernel.

    `dr.freeze` cannot record evaluated loops (Dr.Jit 1.5): such steps are traced anew each time.
    """
    gc.collect()
    dr.flush_malloc_cache()
    fit = begin_fit(dataset, config)
    _paint(fit, albedo)
    constant: dict[str, float] = dict.fromkeys((*config.quantities, "radiance"), 0.0)

    def step(number: int) -> None:
        if frozen:
            fit.step(fit.state, number, constant)
        else:
            fit.state.set_learning_rates(constant)
            fit.step.unfrozen(fit.state, number)
        dr.sync_thread()

    for number in range(4):
        step(number)
    memory = peak_bytes(lambda: step(4))
    times = []
    for number in range(5, 5 + steps):
        start = time.perf_counter()
        step(number)
        times.append(time.perf_counter() - start)
    in_kernels = []
    for number in range(5 + steps, 5 + steps + min(steps, 3)):
        with kernel_history() as kernels:
            step(number)
        in_kernels.append(milliseconds(kernels) / 1e3)
    return _Steps(times, in_kernels, memory)


def _paint(fit: FreshFit, albedo: float) -> None:
    """Set the grid of the albedo to that of the walls, which determines the length of paths."""
    raw = math.log(albedo / (1 - albedo))
    for name, value in list(fit.state.phi.items()):
        if name.startswith("albedo"):
            fit.state.phi[name] = dr.full(type(value), raw, value.shape)


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    rows = []
    for job, methods in findings.items():
        good = {name: m for name, m in methods.items() if "error" not in m}
        times, kernels = (
            {name: statistics.median(m[key]) for name, m in good.items()}
            for key in ("seconds", "kernel_seconds")
        )
        for name, measured in methods.items():
            row = {"albedo": float(job.removeprefix("albedo-")), "method": name}
            if name in good:
                memory = measured["memory"]
                row["milliseconds"] = 1e3 * times[name]
                row["milliseconds_in_kernels"] = 1e3 * kernels[name]
                row["times_ours"] = times[name] / times["ours"] if "ours" in good else None
                row["times_ours_in_kernels"] = (
                    kernels[name] / kernels["ours"] if "ours" in good else None
                )
                row["memory_mb"] = None if memory is None else memory / 1e6
            rows.append(row | {"error": measured.get("error")})
    albedos = sorted({row["albedo"] for row in rows})

    def line(title: str, name: str, key: str, digits: int) -> list[str | None]:
        cells = {row["albedo"]: row for row in rows if row["method"] == name}
        return [title, *(_cell(cells[albedo], key, digits) for albedo in albedos)]

    titles = ["method", *(f"{albedo:g}" for albedo in albedos)]
    milliseconds, multiples, memory = [], [], []
    for curve in CURVES:
        name = curve.name
        if name == TRACED:
            title = f"{name}, traced anew each step, in Python"
            milliseconds += [
                [*line(title, name, "milliseconds", 0), curve.published],
                [*line(f"{name}, its kernels alone", name, "milliseconds_in_kernels", 0), ""],
            ]
            title = f"{name}, its kernels over those of ours"
            multiples.append(line(title, name, "times_ours_in_kernels", 2))
        else:
            milliseconds.append([*line(name, name, "milliseconds", 0), curve.published])
            multiples.append(line(name, name, "times_ours", 2))
        memory.append(line(name, name, "memory_mb", 0))
    tables = [
        f"{title}, at an albedo of:\n\n{markdown(columns, lines)}"
        for title, columns, lines in (
            ("Milliseconds of a step", [*titles, "the paper"], milliseconds),
            ("As multiples of ours", titles, multiples),
            ("Memory of a step, MB", titles, memory),
        )
    ]
    return ExperimentResult(rows, "\n\n".join(tables), lambda path: _draw(path, rows))


def _cell(row: Mapping[str, object], key: str, digits: int) -> str | None:
    if row["error"]:
        return "out of memory" if "memory" in str(row["error"]) else "failed"
    value = row.get(key)
    return None if value is None else f"{value:.{digits}f}"


def _draw(path: Path, rows: list[dict]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    panels = figure.subplots(1, 2)
    for number, curve in enumerate(CURVES):
        measured = [row for row in rows if row["method"] == curve.name]
        for panel, key in zip(panels, ("milliseconds", "memory_mb"), strict=True):
            known = [row for row in measured if row.get(key) is not None]
            x, y = [row["albedo"] for row in known], [row[key] for row in known]
            panel.plot(x, y, color=f"C{number}", marker=".", label=curve.name)
            failed = [row["albedo"] for row in measured if row["error"]]
            if failed and y:
                panel.plot(failed, [max(y)] * len(failed), "x", color=f"C{number}")
    for panel, title in zip(panels, ("ms per step", "MB per step"), strict=True):
        panel.set(xlabel="albedo of the walls", ylabel=title, yscale="log")
        panel.grid(alpha=0.3)
    panels[1].legend(fontsize=7)
    save_figure(figure, path)


EXPERIMENT = Experiment(
    "fig5", "A step in the cube over the length of paths (Fig. 5)", _jobs, _result
)
