"""Previews of a running fit: pictures, and errors of the materials against the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..dataset.ground_truth import GroundTruth
from ..dataset.lighting import ROWS, true_environment
from ..dataset.small_views import block_of, small_camera
from ..dataset.views import Dataset, View
from ..imaging.pictures import montage, shown, tonemap, write_png
from ..quantities import QUANTITIES
from .checkpoint import Progress
from .problem import Problem
from .run_folder import RunFolder, require_no_link
from .validation import SAMPLES, MaterialBuffers

#: Longer side of a picture in pixels, at most: a photograph may have 24 million, and a preview of
#: all of them would take longer than many steps.
_LONGEST = 512


class Preview:
    """Shows the unknowns: materials in one view, a held-out one if there is any; light as a whole.

    Raises:
        UserError: a truth image of that view, or of the environment, cannot be read.
    """

    def __init__(self, problem: Problem, dataset: Dataset, run: RunFolder) -> None:
        self._problem = problem
        self._run = run
        view: View = (dataset.heldout or dataset.train)[0]
        materials = problem.materials
        self._truth = None if materials is None else GroundTruth.of(view, materials)
        # Truth is compared pixel by pixel. Where there is none, a smaller picture is rendered.
        small = replace(view, camera=small_camera(view.camera, _LONGEST))
        self._view = small if self._truth is None else view
        known = None
        if problem.environment is not None:
            known = true_environment(dataset.folder, allow_outside=dataset.allow_outside)
        self._environment = [] if known is None else [[tonemap(known)]]

    @property
    def has_truth(self) -> bool:
        """Whether it compares materials with the truth."""
        return self._truth is not None

    def show(self, progress: Progress) -> list[dict]:
        """Show the present values of the fields.

        Materials and the environment map go to one picture, above the truth where that is known.
        Lights have no picture.

        Returns:
            Lines for the log: materials against the truth, and the strength of lights.
        """
        sheets, found = [], []
        if self._problem.materials is not None:
            tiles, values = self._materials()
            sheets.append([montage(tiles)])
            found += [values] if values else []
        if self._problem.environment is not None:
            map_ = tonemap(self._problem.environment.to_latlong(ROWS))
            sheets.append([montage([[map_], *self._environment])])
        if self._problem.emission is not None:
            strengths = np.array(self._problem.emission.values).T.tolist()
            found.append(
                {"emission": dict(zip(self._problem.emitter_names, strengths, strict=True))}
            )
        if sheets:
            require_no_link(self._run.previews)
            write_png(self._run.preview(progress.step), montage(sheets, gap=0))
        return [{**progress.counted(), "validation": values} for values in found]

    def _materials(self) -> tuple[list[list[np.ndarray]], dict[str, Any]]:
        """Pictures of them and of the truth; PSNRs where there is truth."""
        (seen,) = MaterialBuffers.of(self._problem, [self._view], SAMPLES, seed=0)
        every = block_of(self._view.camera, _LONGEST)

        def tile(value: np.ndarray, name: str) -> np.ndarray:
            return shown(value[::every, ::every], QUANTITIES[name].display)

        tiles = [[tile(value, name) for name, value in seen.values.items()]]
        if self._truth is None:
            return tiles, {}
        nothing = np.full((*seen.coverage[::every, ::every].shape, 3), 128, np.uint8)
        true = {name: tile(value, name) for name, value in self._truth.values.items()}
        tiles.append([true.get(name, nothing) for name in seen.values])
        scores = {k: v for k, v in seen.psnr(self._truth).items() if v is not None}
        return tiles, {"split": self._view.split} | scores if scores else {}
