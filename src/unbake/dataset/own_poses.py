"""Whether photographs agree better with poses of others, or other focal lengths, than their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np

from .alignment import (
    AGREEING,
    LEAST,
    MARGIN,
    Alignment,
    alignment,
    cut_out,
    drawn_edges,
    edge_scores,
    photograph_edges,
    with_edges,
)
from .camera import Camera
from .mistakes import Mistake
from .small_views import SmallView
from .spread import evenly

#: Poses that photographs are compared with, at most, and photographs that this needs.
_POSES, _FEWEST = 128, 6
#: The best of so many other poses has a score of up to 0.3 by chance, where photographs have few
#: edges that are edges of the geometry.
_BY_CHANCE = 0.4
#: Factors of focal lengths that are tried, and those around the best one.
_FACTORS = (0.8, 0.85, 0.9, 0.95, 1.05, 1.1, 1.15, 1.2, 1.25)
_AROUND = (0.96, 0.98, 1.0, 1.02, 1.04)
#: The least error that is told: a smaller one moves edges of small pictures by less than a pixel.
_LEAST_ERROR = 0.07
#: Alpha shows outlines of the geometry, and not what masks hide, if pixels that show a surface, or
#: see one, do both by such a share.
_OUTLINED = 0.5
#: Focal lengths are better if the score is larger by so much: where outlines of cut-outs agree
#: better, too, and by edges alone for shorter and for longer ones. Edges of a bumpy mesh fill its
#: outline, so that a larger one agrees better with the outline in photographs.
_MARGIN_OF_OUTLINES, _MARGIN_SHORTER, _MARGIN_LONGER = 0.05, 0.05, MARGIN


def compared(
    scene: mi.Scene, views: Sequence[SmallView], cameras: Sequence[Camera]
) -> Alignment | None:
    """Compare poses with those of common mistakes, with each other, and focal lengths with others.

    Args:
        scene: that the photographs show.
        views: at low resolution; some of them are looked at, spread evenly.
        cameras: of all small views, also of those that are not among `views`.

    Returns:
        None where it cannot be told: too few views, too small, or without edges.
    """
    found = alignment(scene, views)
    if found is None or found.best is not None:
        return found
    views = with_edges(views)
    edges = [photograph_edges(view) for view in views]
    own = [view.camera for view in views]
    ((drawn, hits),) = drawn_edges(scene, own, [Mistake(())])
    given = edge_scores(edges, drawn)
    return (
        _with_poses_of_others(scene, edges, given, cameras, found)
        or _with_other_lenses(scene, views, edges, given, hits, found)
        or found
    )


def _with_poses_of_others(
    scene: mi.Scene,
    edges: list[np.ndarray],
    given: np.ndarray,
    cameras: Sequence[Camera],
    found: Alignment,
) -> Alignment | None:
    """What was found, with the share of photographs that poses of others suit better; or None.

    Views of symmetric objects look alike, and then no other pose is clearly better.

    Args:
        scene: that the photographs show.
        edges: of the photographs.
        given: their scores with their own poses.
        cameras: of all views.
        found: with the poses as they are.
    """
    if len(edges) < _FEWEST:
        return None
    ((drawn, _),) = drawn_edges(scene, evenly(cameras, _POSES), [Mistake(())])
    best = given.copy()
    for i, picture in enumerate(edges):
        alike = [other for other in drawn if other.shape == picture.shape]
        scores = edge_scores([picture] * len(alike), alike)
        best[i] = max(given[i], scores.max(initial=given[i]))
    clearly = float((best - given > MARGIN).mean())
    if clearly >= AGREEING and best.mean() > _BY_CHANCE:
        return replace(found, elsewhere=clearly, best=float(best.mean()))
    return None


def _with_other_lenses(
    scene: mi.Scene,
    views: Sequence[SmallView],
    edges: list[np.ndarray],
    given: np.ndarray,
    hits: list[np.ndarray],
    found: Alignment,
) -> Alignment | None:
    """What was found, with the factor of focal lengths that are clearly better; or None.

    Args:
        scene: that the photographs show.
        views: that are compared.
        edges: of the photographs.
        given: their scores with their own lenses.
        hits: whether their pixels see a surface.
        found: with the poses as they are.
    """
    shown = [view.alpha > 0.5 for view in views]
    outlines = _overlaps(hits, shown)
    clear = cut_out(views) and bool(outlines.mean() > _OUTLINED)

    def better(factors: Sequence[float]) -> list[tuple[float, float]]:
        """Mean scores and factors of those that are clearly better."""
        told = []
        cameras = [_zoomed(view.camera, factor) for factor in factors for view in views]
        ((drawn, seen),) = drawn_edges(scene, cameras, [Mistake(())])
        for k, factor in enumerate(factors):
            part = slice(k * len(views), (k + 1) * len(views))
            scores = edge_scores(edges, drawn[part])
            margin = _MARGIN_SHORTER if factor < 1 else _MARGIN_LONGER
            margin = _MARGIN_OF_OUTLINES if clear else margin
            gains = [scores - given] + [_overlaps(seen[part], shown) - outlines] * clear
            agree = all(g.mean() > 0 and (g > 0).mean() >= AGREEING for g in gains)
            if agree and gains[0].mean() > margin and scores.mean() > LEAST:
                told.append((float(scores.mean()), factor))
        return told

    coarse = better(_FACTORS)
    if not coarse:
        return None
    near = max(coarse)[1]
    score, factor = max(better([near * step for step in _AROUND]))
    return None if abs(factor - 1) < _LEAST_ERROR else replace(found, focal=factor, best=score)


def _overlaps(hits: Sequence[np.ndarray], shown: Sequence[np.ndarray]) -> np.ndarray:
    """Pixels that see a surface and show one, of those that do either; one number a view."""
    return np.array(
        [float((h & s).sum() / max((h | s).sum(), 1)) for h, s in zip(hits, shown, strict=True)]
    )


def _zoomed(camera: Camera, factor: float) -> Camera:
    return replace(camera, fl_x=camera.fl_x * factor, fl_y=camera.fl_y * factor)
