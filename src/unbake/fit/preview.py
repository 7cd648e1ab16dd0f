"""Pictures of the materials while they are learned, and how far they are from the truth."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import numpy as np

from ..data.batches import CameraRays
from ..data.views import Dataset, View, read_image
from ..imaging.metrics import psnr
from ..imaging.pictures import montage, to_bytes, tonemap, write_png
from ..transport.render import render_materials
from .checkpoint import Progress
from .problem import Problem

SAMPLES = 4


class Preview:
    """Renders albedo and roughness of one view, a held-out one if there is any.

    Raises:
        UserError: a truth image of that view cannot be read.
    """

    def __init__(self, problem: Problem, dataset: Dataset, folder: Path) -> None:
        self._problem = problem
        self._folder = folder
        self._view: View = (dataset.heldout or dataset.train)[0]
        self._rays = CameraRays.of([self._view.camera])
        self._truth: tuple[np.ndarray, np.ndarray] | None = None
        if self._view.albedo is not None and self._view.roughness is not None:
            self._truth = self._read(self._view.albedo), self._read(self._view.roughness)

    def show(self, progress: Progress) -> list[dict]:
        """Write `step-NNNNNN.png`; with truth at hand, give one line for the log."""
        shape = (self._view.camera.height, self._view.camera.width)
        albedo, roughness, coverage = render_materials(
            self._problem.world, self._rays.through, self._rays.pixels, SAMPLES, seed=0
        )
        albedo, roughness = albedo.reshape(*shape, 3), roughness.reshape(shape)
        tiles = [[tonemap(albedo), _grey(roughness)]]
        lines = []
        if self._truth is not None:
            true_albedo, true_roughness = self._truth
            mask = (true_albedo[..., 3] >= 1) & (coverage.reshape(shape) >= 1)
            tiles.append([tonemap(true_albedo[..., :3]), _grey(true_roughness[..., 0])])
            if mask.any():
                validation = {
                    "split": self._view.split,
                    "albedo_psnr": psnr(albedo, true_albedo[..., :3], mask),
                    "roughness_psnr": psnr(roughness, true_roughness[..., 0], mask),
                }
                lines = [{**asdict(progress), "validation": validation}]
        write_png(self._folder / f"step-{progress.step:06d}.png", montage(tiles))
        return lines

    def _read(self, image: Path) -> np.ndarray:
        width, height = self._view.camera.width, self._view.camera.height
        return read_image(image, width, height).reshape(height, width, 4)


def _grey(values: np.ndarray) -> np.ndarray:
    return to_bytes(np.repeat(values[..., None], 3, -1))
