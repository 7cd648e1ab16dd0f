"""How far recovered materials are from the truth, view by view, also while they are learned."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..dataset.ground_truth import GroundTruth
from ..dataset.pixels import CameraRays
from ..dataset.views import View
from ..imaging.metrics import mean_psnr, psnr
from ..quantities import ALIGNED
from ..transport.render import render_materials
from .problem import Problem

#: Camera samples a pixel of a score in training.
SAMPLES = 4

#: Recovered and true albedo of a view, (H, W, 3), and the pixels that count, (H, W) bool.
Albedos = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class MaterialBuffers:
    """The recovered materials that a view sees."""

    values: Mapping[str, np.ndarray]  # by quantity, (H, W, channels)
    coverage: np.ndarray  # (H, W): fraction of samples that see a material that is optimized

    @staticmethod
    def of(problem: Problem, views: Sequence[View], spp: int, seed: int) -> list[MaterialBuffers]:
        """The present values of the fields, view by view, from `spp` camera samples a pixel."""
        rays = CameraRays.of([view.camera for view in views])
        values, coverage = render_materials(
            problem.scene_view, rays.through, rays.pixels, spp, seed=seed
        )
        seen, first = [], 0
        for view in views:
            h, w = view.camera.height, view.camera.width
            part = slice(first, first + h * w)
            first += h * w
            own = {name: value[part].reshape(h, w, -1) for name, value in values.items()}
            seen.append(MaterialBuffers(own, coverage[part].reshape(h, w)))
        return seen

    def mask(self, truth: GroundTruth) -> np.ndarray:
        """The pixels that count, (H, W) bool: the whole pixel sees an optimized, known material."""
        return truth.known & (self.coverage >= 1)

    def psnr(self, truth: GroundTruth) -> dict[str, float | None]:
        """PSNR in dB, linear and not clipped; keys such as `albedo_psnr`.

        None where no pixel counts, and where the truth is not known.

        Raises:
            UserError: a value is not finite.

        Paper: Sec. 6, Fig. 6.
        """
        mask = self.mask(truth)
        scores = dict.fromkeys(psnr_keys(self.values))
        for name, value in self.values.items():
            if name in truth.values and mask.any():
                scores[f"{name}_psnr"] = psnr(value, truth.values[name], mask)
        return scores


def known_pixels(seen: MaterialBuffers | None, truth: GroundTruth | None) -> np.ndarray | None:
    """The pixels whose materials are compared with the truth, (H, W) bool; None without truth.

    Args:
        seen: the recovered materials; None where they are known.
    """
    if truth is None:
        return None
    return truth.known if seen is None else seen.mask(truth)


def albedos(seen: MaterialBuffers | None, truth: GroundTruth | None) -> Albedos | None:
    """Recovered and true albedo of a view, and where they count; None where one is not known."""
    if seen is None or truth is None or "albedo" not in truth.values:
        return None
    return seen.values["albedo"], truth.values["albedo"], seen.mask(truth)


def aligned(views: Sequence[Albedos | None]) -> tuple[np.ndarray | None, list[float | None]]:
    """Albedo where photographs leave its scale open: after the best factor of each channel.

    Photographs may determine albedo and lighting only up to a common factor.

    Args:
        views: as from `albedos`.

    Returns:
        The factors, one for all views (None where no pixel counts), and PSNRs of views in dB.
    """
    counted = [(found[mask], true[mask]) for found, true, mask in filter(None, views)]
    if not any(len(found) for found, _ in counted):
        return None, [None] * len(views)
    above = sum((found * true).sum(0) for found, true in counted)
    scale = above / np.maximum(sum((found**2).sum(0) for found, _ in counted), 1e-12)
    scores: list[float | None] = []
    for view in views:
        counts = view is not None and view[2].any()
        scores.append(psnr(view[0] * scale, view[1], view[2]) if view and counts else None)
    return scale, scores


def psnr_keys(quantities: Iterable[str]) -> list[str]:
    """Names of the PSNRs of quantities, in metrics and logs."""
    return [f"{name}_psnr" for name in quantities]


class Score:
    """Scores the materials on views with ground truth, which is read once.

    Args:
        problem: with the materials.
        views: to score them on.
        shares_scale: photographs may tell albedo but for a factor (`FitConfig.shares_scale`): there
            is a score of aligned albedo, too.

    Raises:
        UserError: a truth image cannot be read.
    """

    def __init__(
        self, problem: Problem, views: Sequence[View], *, shares_scale: bool = False
    ) -> None:
        self._problem = problem
        self._shares_scale = shares_scale
        pairs = [(view, GroundTruth.of(view, problem.materials)) for view in views]
        self._views = [view for view, truth in pairs if truth is not None]
        self._truths = [truth for _, truth in pairs if truth is not None]

    def measure(self, spp: int = SAMPLES, seed: int = 0) -> dict[str, float | int | None]:
        """Means over the views: `views`, and PSNRs of the unknown quantities in dB.

        With the same seed every score has the same samples: scores differ by what was learned.
        """
        seen = MaterialBuffers.of(self._problem, self._views, spp, seed) if self._views else []
        rows = [s.psnr(truth) for s, truth in zip(seen, self._truths, strict=True)]
        keys = psnr_keys(self._problem.materials or ())
        means = {key: mean_psnr(row[key] for row in rows) for key in keys}
        if self._shares_scale:
            pairs = [albedos(s, truth) for s, truth in zip(seen, self._truths, strict=True)]
            means[ALIGNED] = mean_psnr(aligned(pairs)[1])
        return {"views": len(rows)} | means
