"""Fits of several methods on a scene of the paper, for Figures 6, 7 and 8."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from ..comparison.compare import UNTRAINED, YARDSTICKS, compare
from ..comparison.method_variant import MethodVariant
from ..config import FitConfig, method_defaults
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..evaluation.settings import EvaluationSettings
from ..imaging.metrics import mean_psnr, psnr
from ..imaging.pictures import block_means, montage, read_exr, shown
from ..quantities import DEFAULT_QUANTITIES, QUANTITIES
from ..report.display import require_same_size, rgb
from ..training.defaults import with_defaults
from ..training.run_folder import RunFolder
from ..training.validation import psnr_keys
from .experiment import ExperimentContext
from .jobs import Findings, Job, digest
from .scenes import PaperScene
from .seeds import across_seeds

#: The methods of the ablation, from direct illumination to ours, by their title.
ABLATION = {
    "direct": "direct",
    "+ prior": "with-prior",
    "+ prior, one squared sample (the authors' way)": "with-biased-prior",
    "+ stop gradient": "with-stop-gradient",
    "+ second bounce": "with-second-bounce",
    "+ LHS (ours)": "ours",
}
#: Rows of a picture, for each view.
ROWS = ("render", *DEFAULT_QUANTITIES)
MATERIALS = tuple(psnr_keys(DEFAULT_QUANTITIES))
QUALITIES = (*MATERIALS, "render_psnr")
LENGTH = ("steps", "samples", "seconds", "milliseconds_per_step")

#: Seconds that a fit takes beside its training: compiling, scores and evaluation.
_OVERHEAD = 25.0


@final
@dataclass(frozen=True)
class Fit:
    """The fit of a method with a seed.

    Args:
        run: its folder.
        found: its row of the comparison, with the metrics of each view as `per_view`.
    """

    seed: int
    run: RunFolder
    found: Findings


@final
@dataclass(frozen=True)
class SceneFits:
    """Fits of several methods on a scene with several seeds, and their evaluation.

    Args:
        scene: the scene.
        methods: names of methods, in the order of the picture's columns.
        config: settings of all fits, including their length, but for the seed.
        spp: samples per pixel of the final renderings.
        seeds: each is a comparison of its own. Pictures are of the first.
    """

    scene: PaperScene
    methods: Sequence[str]
    config: FitConfig
    spp: int
    seeds: Sequence[int] = (0,)

    @staticmethod
    def of(
        context: ExperimentContext,
        scene: PaperScene,
        methods: Iterable[str],
        seeds: int | None = None,
    ) -> SceneFits:
        """Fits with the length of the scale: the paper's steps, or a time on a CPU.

        Args:
            seeds: number of seeds where the context has none; None: three at cpu scale.
        """
        config = dataclasses.replace(
            scene.settings(context),
            seconds=context.pick(0.0, 120.0 if scene.room else 60.0, 0.0),
            steps=context.pick(6, 1, scene.steps),
            score_seconds=context.pick(0.2, 10.0, 60.0),
            checkpoint_seconds=120.0,
        )
        numbers = range(context.seeds or seeds or context.pick(1, 3, 1))
        return SceneFits(scene, list(methods), config, context.pick(2, 32, 128), tuple(numbers))

    # -------------------------------------------------------------------------------- Jobs

    def settings(
        self, context: ExperimentContext, seed: int, methods: Sequence[str]
    ) -> dict[str, Any]:
        """Everything that the findings of a seed depend on."""
        return self._described(context, seed) | {"methods": list(methods)}

    def runs(self, context: ExperimentContext, seed: int) -> Path:
        """The folder of a seed's runs. Experiments with the same settings share it."""
        described = digest(self._described(context, self.config.seed))
        return context.work / "runs" / f"{self.scene.folder}-{described}" / f"seed-{seed}"

    def _described(self, context: ExperimentContext, seed: int) -> dict[str, Any]:
        fits = {"fit": asdict(self._config(seed)), "defaults": method_defaults.as_json()}
        return fits | {"spp": self.spp} | self.scene.described(context)

    def jobs(self, context: ExperimentContext) -> list[Job]:
        """Jobs that render the data set, and fit and evaluate the methods, one for each seed."""
        count = len(self.methods)
        beside = _OVERHEAD * (count + 1)  # with the untrained fields
        jobs = [self.scene.capture(context)]
        for seed in self.seeds:
            work = functools.partial(self.fitted, context, seed)
            settings = self.settings(context, seed, self.methods)
            seconds = context.pick(2.0 * count, beside, None)
            waits = count * self.config.seconds
            group = self.scene.folder
            # Pictures and metrics of the runs are read again.
            files = [RunFolder(self.runs(context, seed) / m).metrics_file for m in self.methods]
            jobs.append(Job(self._job(seed), settings, work, seconds, waits, files, group))
        return jobs

    def jobs_at_equal_samples(
        self, context: ExperimentContext, slow: str, methods: Sequence[str]
    ) -> list[Job]:
        """Jobs that fit methods again, with the samples that a slow one traced; after `jobs`."""
        jobs = []
        for seed in self.seeds:
            work = functools.partial(self.fitted_at_equal_samples, context, seed, slow, methods)
            settings = self.settings(context, seed, methods) | {"samples_of": slow}
            # How much quicker than the slow one they are depends on the scene.
            count = len(methods)
            fits = _OVERHEAD * (count + 1) + count * self.config.seconds / 3
            seconds = context.pick(2.0 * count, fits, None)
            group, name = self.scene.folder, self._job(seed, equal=True)
            jobs.append(Job(name, settings, work, seconds, group=group))
        return jobs

    def fitted(self, context: ExperimentContext, seed: int) -> Findings:
        """Fit and evaluate the methods, as `unbake compare` does.

        Returns:
            By method, and of the fields before their first step as `untrained`: its row of the
            comparison, with the metrics of each view as `per_view`.

        Raises:
            UserError: a method failed. The same call continues with it.
        """
        return self._compared(context, self.runs(context, seed), self.methods, self._config(seed))

    def fitted_at_equal_samples(
        self, context: ExperimentContext, seed: int, slow: str, methods: Sequence[str]
    ) -> Findings:
        """The same of methods with as many camera samples as a slow one traced in its time.

        Their schedules have this length: rates decay until the last sample.

        Raises:
            UserError: a method failed, or the slow one was not fitted.
        """
        samples = RunFolder(self.runs(context, seed) / slow).metrics()["samples"]
        config, dataset = self._config(seed), Dataset.load(self.scene.captured(context))
        own = [MethodVariant.of(name).settings(config) for name in methods]
        steps = steps_of(samples, [with_defaults(settings, dataset) for settings in own])
        # Searches of roughness would be samples that other methods do not have.
        search = dataclasses.replace(config.roughness_search, times=0)
        config = dataclasses.replace(
            config, steps=steps, seconds=0.0, score_seconds=0.0, roughness_search=search
        )
        return self._compared(context, self._equal_runs(context, seed, steps), methods, config)

    def _compared(
        self, context: ExperimentContext, out: Path, methods: Sequence[str], config: FitConfig
    ) -> Findings:
        data, variants = self.scene.captured(context), [MethodVariant.of(name) for name in methods]
        evaluation = EvaluationSettings(spp=self.spp, train_views=0)
        result = compare(
            data,
            variants,
            out,
            config,
            evaluation=evaluation,
            ceiling=context.scale != "smoke",
            console=context.console,
        )
        kept = (*LENGTH, "estimator", "heldout", "score", "environment", YARDSTICKS)
        findings = {}
        for name, row in {UNTRAINED: result[UNTRAINED], **result["methods"]}.items():
            if "error" in row:
                raise UserError(f"{name} failed: {row['error']}")
            findings[name] = {key: row[key] for key in kept if key in row}
            findings[name]["per_view"] = RunFolder(out / name).metrics()["per_view"]
        return findings

    def _config(self, seed: int) -> FitConfig:
        return dataclasses.replace(self.config, seed=seed)

    def _job(self, seed: int, *, equal: bool = False) -> str:
        return f"{self.scene.folder}-{seed}" + ("-equal-samples" if equal else "")

    def _equal_runs(self, context: ExperimentContext, seed: int, steps: int) -> Path:
        return self.runs(context, seed) / f"equal-samples-{steps}"

    # ----------------------------------------------------------------------------- Findings

    def fits(
        self, context: ExperimentContext, findings: Mapping[str, Findings], method: str
    ) -> list[Fit]:
        """The fits of a method, or of "untrained", one for each seed."""
        return [
            Fit(s, RunFolder(self.runs(context, s) / method), findings[self._job(s)][method])
            for s in self.seeds
        ]

    def fits_at_equal_samples(
        self, context: ExperimentContext, findings: Mapping[str, Findings], method: str
    ) -> list[Fit]:
        """The fits of a method with the samples of a slow one, one for each seed."""
        fits = []
        for seed in self.seeds:
            found = findings[self._job(seed, equal=True)][method]
            folder = self._equal_runs(context, seed, found["steps"])
            fits.append(Fit(seed, RunFolder(folder / method), found))
        return fits

    def heldout(self, context: ExperimentContext) -> Sequence[View]:
        """The held-out views."""
        return Dataset.load(self.scene.data(context)).heldout

    def rows(
        self, context: ExperimentContext, fits: Sequence[Fit], **head: object
    ) -> list[dict[str, Any]]:
        """Length, mean PSNRs and errors of lighting of fits, as rows of data.

        Args:
            fits: of a method, one for each seed.
            head: begins each row.

        Returns:
            First the mean over seeds, with the sample standard deviation of each number as KEY_sd
            and the number of `seeds`; then a row for each `seed`.
        """
        told = dict(head) | {"scene": self.scene.label}
        if "estimator" in fits[0].found:
            told["estimator"] = fits[0].found["estimator"]
        per_seed = []
        for fit in fits:
            *_, means = self.qualities(context, fit)
            light = fit.found.get("environment") or {}
            length = {key: fit.found[key] for key in LENGTH if key in fit.found}
            per_seed.append({"seed": fit.seed} | means | light | length)
        keys = [key for key in per_seed[0] if key not in ("seed", "views")]
        mean = {"seeds": len(fits), "views": per_seed[0]["views"]} | across_seeds(per_seed, keys)
        return [told | row for row in (mean, *per_seed)]

    def qualities(self, context: ExperimentContext, fit: Fit) -> list[dict[str, Any]]:
        """PSNRs of a fit in each held-out view, followed by their means over the views.

        Renderings are averaged over blocks of pixels, multiplied by the photograph's `exposure` and
        clipped to [0,1]. Single pixels are mostly noise in scenes with difficult light, and scenes
        may be brighter than 1 everywhere. `unbake evaluate` does neither.
        """
        rows, size = [], context.pick(1, 4, 4)
        for view, metrics in zip(self.heldout(context), fit.found["per_view"], strict=True):
            file = fit.run.picture(view.split, view.name, "render")
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
                | {key: metrics[key] for key in MATERIALS if key in metrics}
                | {"render_psnr": psnr(ours, theirs, whole) if whole.any() else None}
            )
        mean = {key: mean_psnr(r[key] for r in rows) for key in QUALITIES if key in rows[0]}
        return [*rows, {"views": "mean of held-out"} | mean]

    def picture(self, context: ExperimentContext, views: Sequence[int]) -> np.ndarray:
        """Held-out views of the first seed, a column for each method and the truth on the right.

        Args:
            views: numbers of held-out views, each with the rows of `ROWS`.
        """
        sheet, folder = [], self.runs(context, self.seeds[0])
        for view in (self.heldout(context)[number] for number in views):
            scale = exposure(read_exr(view.image))
            truth = {"render": view.image, **view.truth}
            for quantity in ROWS:
                runs = (RunFolder(folder / method) for method in self.methods)
                files = [run.picture(view.split, view.name, quantity) for run in runs]
                factor = scale if quantity == "render" else 1.0
                columns = (*files, truth.get(quantity))
                sheet.append([_cell(file, quantity, factor, view) for file in columns])
        return montage(sheet)


def steps_of(samples: int, configs: Sequence[FitConfig]) -> int:
    """Steps in which fits trace a number of camera samples, to the nearest step.

    Raises:
        ValueError: the fits trace different numbers of samples in a step.
    """
    each = {config.samples_per_step for config in configs}
    if len(each) != 1:
        raise ValueError(f"steps of {sorted(each)} samples cannot have the same length")
    return max(1, round(samples / each.pop()))


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
