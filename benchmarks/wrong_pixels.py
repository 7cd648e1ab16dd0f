"""Whether batches should follow the pixels that are still wrong.

    python benchmarks/wrong_pixels.py --data DATA [DATA ...] --out FILE.json
        [--share 0.5] [--seeds 0 1 2] [--steps 1200]

Each fit is made as usual, with pixels of all views alike, and with some of each batch where the
error is large. Every 200 steps 16 batches are rendered twice and compared with the photographs:
products of two errors have no noise of the rendering. Blocks of 9 x 9 pixels are then drawn as
likely as their mean error is large. Scores are PSNRs in dB of linear RGB, mean over held-out views.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from unittest.mock import patch

import here

import numpy as np
from rich.console import Console
from variants import SCORES, described

from unbake import backend

backend.activate()

from unbake.config import preset  # noqa: E402
from unbake.dataset.pixels import PixelBatch  # noqa: E402
from unbake.evaluation.evaluate import evaluate  # noqa: E402
from unbake.evaluation.settings import EvaluationSettings  # noqa: E402
from unbake.experiments.seeds import across_seeds  # noqa: E402
from unbake.io import write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.training import beginning  # noqa: E402
from unbake.training.loop import fit  # noqa: E402
from unbake.training.step import TrainingStep  # noqa: E402

#: Steps between looks for what is wrong, batches of a look, and the edge of a block in pixels.
EVERY, BATCHES, EDGE = 200, 16, 9
#: Pixels are drawn from so many times as many, and a block counts as if it had so many readings of
#: the mean error more.
CANDIDATES, PRIOR = 8, 2
#: More blocks than any view has along an edge.
_STRIDE = 1 << 16


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--share", type=float, default=0.5, help="of a batch, where errors are")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    about = {
        "machine": machine(),
        "length": {"steps": args.steps},
        "data": {data.name: described(data) for data in args.data},
        "seeds": args.seeds,
        "share": args.share,
    }
    runs: dict[tuple[str, float], list[dict[str, float]]] = {}
    for seed, data, share in product(args.seeds, args.data, (0.0, args.share)):
        scores = scored(data, share, seed, args.steps)
        runs.setdefault((data.name, share), []).append(scores)
        told = ", ".join(f"{key} {value:.2f}" for key, value in scores.items())
        print(f"{data.name}, {share:.0%}, seed {seed}: {told}", flush=True)
        rows = [
            {"data": name, "share": own} | across_seeds(found, found[0]) | {"runs": found}
            for (name, own), found in runs.items()
        ]
        write_json(args.out, about | {"rows": rows})


def scored(data: Path, share: float, seed: int, steps: int) -> dict[str, float]:
    """The scores of a fit with this share of its batches where errors are."""

    class Step(Following):
        followed = share

    config = replace(preset("cpu"), steps=steps, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        with patch.object(beginning, "TrainingStep", Step):
            fit(data, run, config, console=Console(quiet=True))
        metrics = evaluate(run, EvaluationSettings(train_views=0))
    return {key: metrics["heldout"][key] for key in SCORES}


class Following(TrainingStep):
    """A step with some of its pixels where the last look found the largest errors."""

    followed = 0.5
    _errors: np.ndarray | None = None  # of each block

    def __init__(self, *words):
        super().__init__(*words)
        self.batch_loss._drawn = partial(self._followed, self.batch_loss._drawn)

    def __call__(self, state, number, rates):
        """Take a step, and look for what is wrong first where it is time."""
        if self.followed and number and number % EVERY == 0:
            self._look(state, number)
        return super().__call__(state, number, rates)

    def _look(self, state: Any, number: int) -> None:
        rng = np.random.default_rng([self.config.seed, number])
        found: list[tuple[np.ndarray, np.ndarray]] = []
        for _ in range(BATCHES):
            drawn, seed = (int(n) for n in rng.integers(1 << 31, size=2))
            numbers, colours = self.pixels.draw(drawn, self.config.pixels).read()
            batch = PixelBatch.of(numbers, colours[:, :3])
            halves = self.probe(state, self.pixels.rays, batch, seed).astype(np.float64)
            first, second = (half - colours[:, :3] for half in np.moveaxis(halves, 1, 0))
            reference = colours[:, 3:].astype(np.float64)
            errors = (first * second / (reference**2 + self.config.loss_epsilon)).mean(1)
            found.append((numbers, np.clip(np.nan_to_num(errors), -1, 1)))
        numbers, errors = (np.concatenate(parts) for parts in zip(*found, strict=True))
        blocks = self._blocks(numbers)
        total, count = (np.bincount(blocks, weight) for weight in (errors, np.ones_like(errors)))
        means = (total + PRIOR * errors.mean()) / (count + PRIOR)
        every = len(self.pixels.rays._first) * _STRIDE
        self._errors = np.full(every, max(errors.mean(), 0.0))
        self._errors[: len(means)] = np.maximum(means, 0)

    def _blocks(self, numbers: np.ndarray) -> np.ndarray:
        layout = np.array(self.pixels._layout)
        view = np.searchsorted(layout[:, 0], numbers, "right") - 1
        first, width, _ = layout[view].T
        row, column = np.divmod(numbers.astype(np.int64) - first, width)
        return view * _STRIDE + row // EDGE * int(_STRIDE**0.5) + column // EDGE

    def _followed(self, plain, seed, probe):
        """The pixels of a step: `plain` draws them without a look."""
        if probe is not None or self._errors is None:
            return plain(seed, probe)
        size, some = self.config.pixels, round(self.followed * self.config.pixels)
        rng = np.random.default_rng(seed)
        numbers, colours = self.pixels.draw(seed, (1 + CANDIDATES) * size).read()
        weight = self._errors[self._blocks(numbers[size:])]
        weight += 1e-9 * (weight.mean() + 1e-9)  # enough of them have some weight
        picked = rng.choice(CANDIDATES * size, some, replace=False, p=weight / weight.sum())
        chosen = np.concatenate([np.arange(size - some), size + picked])
        return PixelBatch.of(numbers[chosen], colours[chosen])


if __name__ == "__main__":
    main()
