"""Methods against each other on the paper's scenes: what Figures 6, 7 and 8 have in common."""

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
from ..config import FitConfig
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..evaluation.evaluate import EvaluationSettings
from ..imaging.metrics import mean_psnr, psnr
from ..imaging.pictures import block_means, montage, read_exr, to_bytes, tonemap
from ..report.display import require_same_size, rgb
from ..training.run_folder import RunFolder
from .experiment import ExperimentContext
from .jobs import Findings, Job, digest
from .scenes import PaperScene

#: The ablation, from direct illumination to ours; Figures 7 and 8.
ABLATION = {
    "direct": "direct",
    "+ prior": "with-prior",
    "+ stop gradient": "with-stop-gradient",
    "+ second bounce": "with-second-bounce",
    "+ LHS (ours)": "ours",
}
#: What is shown of a view, from top to bottom.
SHOWN = ("render", "albedo", "roughness")
MATERIALS = ("albedo_psnr", "roughness_psnr")
QUALITIES = (*MATERIALS, "render_psnr")


@final
@dataclass(frozen=True)
class SceneFits:
    """Methods that are fitted to a scene, and evaluated.

    Args:
        scene: what they see.
        methods: of `unbake fit`, in the order of the picture's columns.
        config: settings of all, with their length.
        spp: samples a pixel of the final renderings.
    """

    scene: PaperScene
    methods: Sequence[str]
    config: FitConfig
    spp: int

    @staticmethod
    def of(context: ExperimentContext, scene: PaperScene, methods: Iterable[str]) -> SceneFits:
        """Fits that last as long as cpu scale has time for, or take the paper's steps."""
        config = dataclasses.replace(
            scene.settings(context),
            seconds=context.pick(0.0, 120.0 if scene.room else 60.0, 0.0),
            steps=context.pick(6, 1, scene.steps),
            score_seconds=context.pick(0.2, 10.0, 60.0),
            checkpoint_seconds=120.0,
        )
        return SceneFits(scene, list(methods), config, spp=context.pick(2, 32, 128))

    def settings(self, context: ExperimentContext) -> dict[str, Any]:
        """All that decides what is found."""
        fits = {"methods": list(self.methods), "fit": asdict(self.config), "spp": self.spp}
        return fits | self.scene.described(context)

    def runs(self, context: ExperimentContext) -> Path:
        """The folder of the runs: other settings have another one, experiments share it."""
        described = self.scene.described(context) | {"fit": asdict(self.config), "spp": self.spp}
        return context.work / "runs" / f"{self.scene.folder}-{digest(described)}"

    def jobs(self, context: ExperimentContext) -> list[Job]:
        """Jobs that render the data set, fit the methods and evaluate them."""
        work = functools.partial(self.fitted, context)
        many = len(self.methods)
        # Compiling and evaluation, a method.
        seconds = context.pick(2.0 * many, 30.0 * many, None)
        waits = many * self.config.seconds
        fits = Job(self.scene.folder, self.settings(context), work, seconds, waits)
        return [self.scene.capture(context), fits]

    def fitted(self, context: ExperimentContext) -> Findings:
        """Fit and evaluate, as `unbake compare` does; what was found of each method.

        Raises:
            UserError: a method failed. The same call goes on with it.
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
        found = {}
        for method, row in result["methods"].items():
            if "error" in row:
                raise UserError(f"{method} failed: {row['error']}")
            metrics = self.run(context, method).metrics()
            found[method] = {k: row[k] for k in (*kept, "environment") if k in row}
            found[method]["per_view"] = metrics["per_view"]
        return found

    def run(self, context: ExperimentContext, method: str) -> RunFolder:
        """The run of a method."""
        return RunFolder(self.runs(context) / method)

    def heldout(self, context: ExperimentContext) -> Sequence[View]:
        """The held-out views."""
        return Dataset.load(self.scene.data(context)).heldout

    def row(self, context: ExperimentContext, method: str, found: Findings) -> dict[str, Any]:
        """What tables say of a method: its length, and means over the held-out views."""
        length = {key: found[key] for key in ("steps", "samples", "seconds")}
        *_, mean = self.qualities(context, method, found)
        return {"method": method, "scene": self.scene.label} | length | mean

    def qualities(
        self, context: ExperimentContext, method: str, row: Findings
    ) -> list[dict[str, Any]]:
        """PSNRs of a method in each held-out view, and last their means over the views.

        Renderings are means of blocks of pixels, multiplied by the photograph's `exposure` and
        clipped to [0,1]. By itself, each pixel is mostly noise where light is hard to find, and
        other than for `unbake evaluate`, a scene may be brighter than 1 all over.
        """
        rows, size = [], context.pick(1, 4, 4)
        for view, known in zip(self.heldout(context), row["per_view"], strict=True):
            file = self.run(context, method).picture(view.split, view.name, "render")
            photograph, found = read_exr(view.image), read_exr(file)[..., :3]
            require_same_size(found, photograph, file)
            scale = exposure(photograph)
            images = [block_means(p[..., :3], size) * scale for p in (found, photograph)]
            images = [np.clip(image, 0, 1) for image in images]
            whole = block_means(_foreground(photograph).astype(float), size) >= 1
            rows.append(
                {"views": view.name}
                | {key: known[key] for key in MATERIALS}
                | {"render_psnr": psnr(*images, whole) if whole.any() else None}
            )
        mean = {key: mean_psnr(r[key] for r in rows) for key in QUALITIES}
        return [*rows, {"views": "mean of held-out"} | mean]

    def picture(self, context: ExperimentContext, views: Sequence[int]) -> np.ndarray:
        """Held-out views as each method sees them, the truth on the right.

        Args:
            views: numbers of held-out views, each with rows for what is `SHOWN`.
        """
        sheet = []
        for view in (self.heldout(context)[number] for number in views):
            scale = exposure(read_exr(view.image))
            truth = {"render": view.image, "albedo": view.albedo, "roughness": view.roughness}
            for what in SHOWN:
                runs = (self.run(context, method) for method in self.methods)
                found = [run.picture(view.split, view.name, what) for run in runs]
                factor = scale if what == "render" else 1.0
                sheet.append([_cell(path, what, factor, view) for path in (*found, truth[what])])
        return montage(sheet)


def at_equal_samples(found: Mapping[str, Findings]) -> dict[str, dict[str, float | None]]:
    """Scores of all methods when each had as many samples as the one that took the fewest.

    Between two scores, PSNR is a straight line over samples.
    """
    fewest = min(row["samples"] for row in found.values())
    at: dict[str, dict[str, float | None]] = {}
    for method, row in found.items():
        each = row["samples"] / row["steps"]
        at[method] = {"samples": fewest}
        for key in MATERIALS:
            known = [(p["step"] * each, p[key]) for p in row["score"] if p.get(key) is not None]
            x, y = zip(*known, strict=True) if known else ((), ())
            at[method][key] = float(np.interp(fewest, x, y)) if known else None
    return at


def _cell(file: Path | None, what: str, factor: float, view: View) -> np.ndarray:
    """A picture times a factor, in sRGB but for roughness; grey where there is none."""
    if file is None or not file.is_file():
        return np.full((view.camera.height, view.camera.width, 3), 128, np.uint8)
    pixels, _ = rgb(file)
    return to_bytes(pixels) if what == "roughness" else tonemap(factor * pixels)


def exposure(photograph: np.ndarray) -> float:
    """What to multiply a picture with so that 95 % of the photograph's pixels are at most 1."""
    seen = photograph[_foreground(photograph)][:, :3].max(-1)
    return 1 / max(float(np.percentile(seen, 95)), 1e-6) if len(seen) else 1.0


def _foreground(photograph: np.ndarray) -> np.ndarray:
    shape = photograph.shape[:2]
    return photograph[..., 3] >= 1 if photograph.shape[-1] == 4 else np.ones(shape, bool)
