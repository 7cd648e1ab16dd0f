"""Fits of several methods on a scene of the paper, for Figures 6, 7 and 8."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from ..comparison.compare import compare
from ..comparison.method_variant import MethodVariant
from ..config import FitConfig, method_defaults
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..evaluation.settings import EvaluationSettings
from ..imaging.metrics import mean_psnr, psnr
from ..imaging.pictures import block_means, montage, read_exr, shown
from ..quantities import DEFAULT_QUANTITIES, QUANTITIES
from ..report.display import require_same_size, rgb
from ..training.run_folder import RunFolder
from ..training.validation import psnr_keys
from .experiment import ExperimentContext
from .jobs import Findings, Job, digest
from .scenes import PaperScene

#: The methods of the ablation, from direct illumination to ours, by their title.
ABLATION = {
    "direct": "direct",
    "+ prior": "with-prior",
    "+ stop gradient": "with-stop-gradient",
    "+ second bounce": "with-second-bounce",
    "+ LHS (ours)": "ours",
}
#: Rows of a picture, for each view.
ROWS = ("render", *DEFAULT_QUANTITIES)
MATERIALS = tuple(psnr_keys(DEFAULT_QUANTITIES))
QUALITIES = (*MATERIALS, "render_psnr")


@final
@dataclass(frozen=True)
class SceneFits:
    """Fits of several methods on a scene, with their evaluation.

    Args:
        scene: the scene.
        methods: names of methods, in the order of the picture's columns.
        config: settings of all fits, including their length.
        spp: samples per pixel of the final renderings.
    """

    scene: PaperScene
    methods: Sequence[str]
    config: FitConfig
    spp: int

    @staticmethod
    def of(context: ExperimentContext, scene: PaperScene, methods: Iterable[str]) -> SceneFits:
        """Fits with the length of the scale: the paper's steps, or a time on a CPU."""
        config = dataclasses.replace(
            scene.settings(context),
            seconds=context.pick(0.0, 120.0 if scene.room else 60.0, 0.0),
            steps=context.pick(6, 1, scene.steps),
            score_seconds=context.pick(0.2, 10.0, 60.0),
            checkpoint_seconds=120.0,
        )
        return SceneFits(scene, list(methods), config, spp=context.pick(2, 32, 128))

    def settings(self, context: ExperimentContext) -> dict[str, Any]:
        """Everything that the findings depend on."""
        return self._described(context) | {"methods": list(self.methods)}

    def runs(self, context: ExperimentContext) -> Path:
        """The folder of the runs. Experiments with the same settings share it."""
        return context.work / "runs" / f"{self.scene.folder}-{digest(self._described(context))}"

    def _described(self, context: ExperimentContext) -> dict[str, Any]:
        fits = {"fit": asdict(self.config), "defaults": method_defaults.as_json(), "spp": self.spp}
        return fits | self.scene.described(context)

    def jobs(self, context: ExperimentContext) -> list[Job]:
        """Jobs that render the data set, fit the methods and evaluate them."""
        work = functools.partial(self.fitted, context)
        count = len(self.methods)
        # Compiling and evaluation of each method.
        seconds = context.pick(2.0 * count, 30.0 * count, None)
        waits = count * self.config.seconds
        fits = Job(self.scene.folder, self.settings(context), work, seconds, waits)
        return [self.scene.capture(context), fits]

    def fitted(self, context: ExperimentContext) -> Findings:
        """Fit and evaluate the methods, as `unbake compare` does.

        Returns:
            By method: its row of the comparison, with the metrics of each view as `per_view`.

        Raises:
            UserError: a method failed. The same call continues with it.
        """
        out = self.runs(context)
        result = compare(
            self.scene.captured(context),
            [MethodVariant.of(method) for method in self.methods],
            out,
            self.config,
            evaluation=EvaluationSettings(spp=self.spp, train_views=0),
            console=context.console,
        )
        kept = ("steps", "samples", "seconds", "milliseconds_per_step", "heldout", "score")
        findings = {}
        for method, row in result["methods"].items():
            if "error" in row:
                raise UserError(f"{method} failed: {row['error']}")
            metrics = self.run(context, method).metrics()
            findings[method] = {k: row[k] for k in (*kept, "environment") if k in row}
            findings[method]["per_view"] = metrics["per_view"]
        return findings

    def run(self, context: ExperimentContext, method: str) -> RunFolder:
        """The run of a method."""
        return RunFolder(self.runs(context) / method)

    def heldout(self, context: ExperimentContext) -> Sequence[View]:
        """The held-out views."""
        return Dataset.load(self.scene.data(context)).heldout

    def row(self, context: ExperimentContext, method: str, fit: Findings) -> dict[str, Any]:
        """Length of a fit and its mean PSNRs, as a row of data."""
        length = {key: fit[key] for key in ("steps", "samples", "seconds")}
        *_, mean = self.qualities(context, method, fit)
        return {"method": method, "scene": self.scene.label} | length | mean

    def qualities(
        self, context: ExperimentContext, method: str, fit: Findings
    ) -> list[dict[str, Any]]:
        """PSNRs of a method in each held-out view, followed by their means over the views.

        Renderings are averaged over blocks of pixels, multiplied by the photograph's `exposure` and
        clipped to [0,1]. Single pixels are mostly noise in scenes with difficult light, and scenes
        may be brighter than 1 everywhere. `unbake evaluate` does neither.
        """
        rows, size = [], context.pick(1, 4, 4)
        for view, metrics in zip(self.heldout(context), fit["per_view"], strict=True):
            file = self.run(context, method).picture(view.split, view.name, "render")
            photograph, rendering = read_exr(view.image), read_exr(file)[..., :3]
            require_same_size(rendering, photograph, file)
            scale = exposure(photograph)
            ours, theirs = (
                np.clip(block_means(p[..., :3], size) * scale, 0, 1)
                for p in (rendering, photograph)
            )
            whole = block_means(_foreground(photograph).astype(float), size) >= 1
            rows.append(
                {"views": view.name}
                | {key: metrics[key] for key in MATERIALS}
                | {"render_psnr": psnr(ours, theirs, whole) if whole.any() else None}
            )
        mean = {key: mean_psnr(r[key] for r in rows) for key in QUALITIES}
        return [*rows, {"views": "mean of held-out"} | mean]

    def picture(self, context: ExperimentContext, views: Sequence[int]) -> np.ndarray:
        """Held-out views, a column for each method and the truth on the right.

        Args:
            views: numbers of held-out views, each with the rows of `ROWS`.
        """
        sheet = []
        for view in (self.heldout(context)[number] for number in views):
            scale = exposure(read_exr(view.image))
            truth = {"render": view.image, **view.truth}
            for quantity in ROWS:
                runs = (self.run(context, method) for method in self.methods)
                files = [run.picture(view.split, view.name, quantity) for run in runs]
                factor = scale if quantity == "render" else 1.0
                columns = (*files, truth.get(quantity))
                sheet.append([_cell(file, quantity, factor, view) for file in columns])
        return montage(sheet)


def at_equal_samples(fits: Mapping[str, Findings]) -> dict[str, dict[str, float | None]]:
    """PSNRs of all methods after the samples of the method that took the fewest.

    PSNR is interpolated linearly over samples between two scores.

    Returns:
        By method: `samples`, and a PSNR by key; None if the method has no scores.
    """
    fewest = min(fit["samples"] for fit in fits.values())
    equal: dict[str, dict[str, float | None]] = {}
    for method, fit in fits.items():
        each = fit["samples"] / fit["steps"]
        equal[method] = {"samples": fewest}
        for key in MATERIALS:
            scores = [(p["step"] * each, p[key]) for p in fit["score"] if p.get(key) is not None]
            x, y = zip(*scores, strict=True) if scores else ((), ())
            equal[method][key] = float(np.interp(fewest, x, y)) if scores else None
    return equal


def _cell(file: Path | None, quantity: str, factor: float, view: View) -> np.ndarray:
    """A picture times a factor, as its quantity is displayed; grey if there is none."""
    if file is None or not file.is_file():
        return np.full((view.camera.height, view.camera.width, 3), 128, np.uint8)
    pixels, _ = rgb(file)
    display = QUANTITIES[quantity].display if quantity in QUANTITIES else "colour"
    return shown(factor * pixels, display)


def exposure(photograph: np.ndarray) -> float:
    """The factor with which 95 % of the photograph's foreground is at most 1."""
    values = photograph[_foreground(photograph)][:, :3].max(-1)
    return 1 / max(float(np.percentile(values, 95)), 1e-6) if len(values) else 1.0


def _foreground(photograph: np.ndarray) -> np.ndarray:
    shape = photograph.shape[:2]
    return photograph[..., 3] >= 1 if photograph.shape[-1] == 4 else np.ones(shape, bool)
