"""How well the photographs tell each quantity: slope and noise of the loss's gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from rich.console import Console
from rich.table import Table

from ..config import FitConfig
from ..dataset.fingerprint import changed, fingerprint
from ..errors import UserError
from ..evaluation.evaluate import require_true_materials
from ..fields.materials import Materials
from ..fields.network import Network
from ..io import write_json
from ..machine import machine
from ..training.problem import Problem, pixels_of
from ..training.recovered import load_run
from ..training.run_folder import RunFolder
from ..training.schedule import learning_rates
from ..training.state import State, initial_state
from ..training.step import TrainingStep, without_garbage_collection
from ..version import VERSION
from .towards_truth import WAY, TowardsTruth, towards_truth

#: Batches that a noise can be told from.
FEWEST = 2

Gradients = dict[str, np.ndarray]


@dataclass(frozen=True)
class Part:
    """Some parameters of a field, such as a level of its hash grid."""

    title: str
    pieces: tuple[tuple[str, slice], ...]  #: names of arrays in all gradients, and entries of these


@dataclass
class Spread:
    """Mean and noise of a gradient over batches, added up batch by batch."""

    count: int = 0
    total: np.ndarray | float = 0.0  #: sum of the gradients, shape (entries,)
    squares: float = 0.0  #: sum of their squared norms

    def add(self, gradient: np.ndarray) -> None:
        """Add that of a batch, shape (entries,)."""
        self.count += 1
        self.total = self.total + gradient
        self.squares += float(gradient @ gradient)

    def signal_to_noise(self) -> float:
        """Norm of the expected gradient over that of the noise of one batch.

        The squared norm of a mean has a share of the noise in it, which is taken away; where it is
        no larger than that share, the result is zero. Zero, too, where all gradients are zero.
        """
        n, total = self.count, np.asarray(self.total)
        of_mean = float(total @ total) / n**2
        noise = max(0.0, (self.squares - n * of_mean) / (n - 1))
        return float(np.sqrt(max(0.0, of_mean - noise / n) / noise)) if noise > 0 else 0.0


@dataclass
class _Measured:
    """What is gathered over batches."""

    slopes: dict[str, list[float]]  #: by quantity
    spreads: dict[str, dict[str, Spread]]  #: by quantity and part
    parts: dict[str, list[Part]]
    left_out: int = field(default=0)  #: batches whose gradients are not finite

    @staticmethod
    def of(materials: Materials) -> _Measured:
        parts = {name: list(_parts(name, materials)) for name in materials}
        spreads = {name: {part.title: Spread() for part in own} for name, own in parts.items()}
        return _Measured({name: [] for name in materials}, spreads, parts)

    def add(self, gradients: Gradients) -> None:
        if not all(np.isfinite(gradient).all() for gradient in gradients.values()):
            self.left_out += 1
            return
        for name, slopes in self.slopes.items():
            slopes.append(float(gradients[f"{name}.{WAY}"][0]))
            for part in self.parts[name]:
                pieces = [gradients[key][entries] for key, entries in part.pieces]
                self.spreads[name][part.title].add(np.concatenate(pieces))


def bench_gradients(
    run: Path,
    config: FitConfig,
    batches: int,
    out: Path | None,
    console: Console,
    *,
    allow_outside: bool = False,
) -> dict:
    """Measure the gradients of the loss where a run has come to, over batches of its own settings.

    The slope of a quantity is the derivative of the loss by t at t = 0, as the quantity goes from
    what was fitted to what is true, (1 − t) · fitted + t · true, everywhere at once. A slope below
    zero points the right way. It reaches the loss through BSDFs alone, so that regularizers have
    none. Signal to noise is that of one batch: mean over standard deviation.

    The gradients by the parameters of the fields are told as norms: that of the expected gradient
    over that of one batch's noise.

    Args:
        run: folder of a fit.
        config: its settings, maybe with another number of pixels and samples.
        batches: how many to measure; their random numbers are those of no step of the run.
        out: JSON file to write.
        console: shows the results.
        allow_outside: read files of the data set and its scene that lie outside of its folder.

    Returns:
        The content of the file.

    Raises:
        UserError: the run cannot be read or has no unknown materials, the true ones are not known,
            the batch does not fit the memory, or next to all gradients are not finite.
    """
    if not config.learns_materials:
        what = f"the run recovered {config.unknown}, and no materials"
        raise UserError(what, run, "Give a run of `unbake fit` with --unknown materials")
    recovered = load_run(run, allow_outside=allow_outside)
    dataset = recovered.dataset
    require_true_materials(dataset)
    origin = RunFolder(run).origin()
    data_changed = changed(origin.fingerprint, fingerprint(dataset))
    if data_changed:
        told = f"warning: other {', '.join(data_changed)} than the run was fit to"
        console.print(told, style="yellow", soft_wrap=True)
    pixels = pixels_of(dataset, config, clip_negative=recovered.clip_negative)
    pixels = pixels.at_level(origin.photographs_level)
    problem = towards_truth(recovered)
    assert problem.materials is not None
    step = TrainingStep(problem, pixels, config)
    measured = _Measured.of(problem.materials)
    first = recovered.progress.step
    for gradients in _gradients(step, problem, config, range(first, first + batches)):
        measured.add(gradients)
    if batches - measured.left_out < FEWEST:
        what = f"the gradients of {measured.left_out} of {batches} batches are not finite"
        raise UserError(what, run, "Fit again with lower learning rates")
    result = {"unbake": VERSION, "machine": machine(), "data": dataset.folder.name}
    result |= {"method": config.method, "steps": first, "batches": batches - measured.left_out}
    result |= {"left_out": measured.left_out, "data_changed": data_changed}
    result["settings"] = {
        "pixels": config.pixels,
        "spp": config.spp,
        "radiance_spp": config.radiance_samples,
        "estimator": config.chosen_estimator,
        "representation": config.representation,
    }
    result["quantities"] = {name: _row(name, measured) for name in measured.slopes}
    _print(result, console)
    if out is not None:
        write_json(out, result)
    return result


def _gradients(
    step: TrainingStep, problem: Problem, config: FitConfig, numbers: range
) -> Iterator[Gradients]:
    """The gradients of batches by the parameters of the materials, by name."""
    state = initial_state(problem)
    step.plan(state)
    step.require_memory(state)
    # The state stays as it is, and so does the scale of a loss in half precision.
    scale = 1.0 if state.scale is None else float(state.scale[0])
    of_batch: Callable[[Any, State], dict] = step.gradients
    if step.recordable:
        of_batch = dr.freeze(step.gradients)
    rates = learning_rates(config, 0, 0.0)  # no step is taken with them
    for number in numbers:
        with without_garbage_collection():
            found = of_batch(step.prepare(state, number, rates), state)
            dr.sync_thread()
        yield {name: np.array(g.array, np.float64).ravel() / scale for name, g in found.items()}


def _parts(name: str, materials: Materials) -> Iterator[Part]:
    """The parts of a quantity's field: levels of a grid, a network, what is shared, or arrays."""
    towards = materials[name]
    assert isinstance(towards, TowardsTruth)
    inner, everything = towards.field, slice(None)
    keys = list(inner.parameters())
    if not isinstance(inner, Network):
        yield from (Part(key, ((f"{name}.{key}", everything),)) for key in keys)
        return
    grid = inner.grid
    for level in range(grid.n_levels):
        ends = (grid.level_offset(i) * grid.n_features_per_level for i in (level, level + 1))
        cells = round(grid.base_resolution * grid.per_level_scale**level)
        title = f"grid, {cells} cells"
        yield Part(title, ((f"{name}.grid", slice(*ends)),))
    layers = tuple((f"{name}.{key}", everything) for key in inner.perceptron.parameters())
    yield Part("network", layers)
    if inner.pieces is None:
        return
    # No step moves the colours and places of each piece.
    still = ("own_colours.", "places.", "placed")
    keys = [key for key in inner.pieces.parameters() if not key.startswith(still)]
    own = [(f"{name}.{key}", everything) for key in keys]
    shared = [piece for piece in own if piece[0].endswith(".colours")]
    yield Part("pieces", tuple(piece for piece in own if piece not in shared))
    if shared:
        yield Part("colours", tuple(shared))


def _row(name: str, measured: _Measured) -> dict:
    slopes = np.array(measured.slopes[name])
    deviation = float(slopes.std(ddof=1))
    return {
        "slope": float(slopes.mean()),
        "standard_error": deviation / len(slopes) ** 0.5,
        "signal_to_noise": float(abs(slopes.mean())) / deviation if deviation else 0.0,
        "parts": [
            {
                "part": title,
                "entries": int(np.size(spread.total)),
                "signal_to_noise": spread.signal_to_noise(),
            }
            for title, spread in measured.spreads[name].items()
        ],
    }


def _print(result: dict, console: Console) -> None:
    s = result["settings"]
    left_out = f", {result['left_out']} more were not finite" if result["left_out"] else ""
    console.print(
        f"{result['method']} after {result['steps']:,} steps: {result['batches']} batches of "
        f"{s['pixels']} pixels x {s['spp']} samples, {s['estimator']}{left_out}"
    )
    console.print("Slope of the loss from fitted to true materials; signal/noise of one batch:")
    table = Table("quantity")
    for column in ("slope", "standard error", "signal/noise"):
        table.add_column(column, justify="right")
    for name, row in result["quantities"].items():
        numbers = f"{row['slope']:.2e}", f"{row['standard_error']:.1e}"
        table.add_row(name, *numbers, f"{row['signal_to_noise']:.2f}")
    console.print(table)
    console.print("Gradients by the parameters of the fields; signal/noise of one batch, as norms:")
    table = Table("field", "parameters")
    for column in ("entries", "signal/noise"):
        table.add_column(column, justify="right")
    for name, row in result["quantities"].items():
        for part in row["parts"]:
            numbers = f"{part['entries']:,}", f"{part['signal_to_noise']:.3f}"
            table.add_row(name, part["part"], *numbers)
        table.add_section()
    console.print(table)
