"""Whether edges of the geometry lie where photographs have edges, and which poses are better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from ..scene import free_space
from .camera import Camera
from .mistakes import Mistake, all_mistakes
from .small_views import SmallView, seen_by, small_view, view_rays
from .spread import evenly

#: Views that are compared, at most, and how many are needed to tell that others are better.
MOST_VIEWS, FEWEST_VIEWS = 8, 3
#: Pixels along the shorter side of a view, below which edges cannot be told from noise.
SHORTEST_SIDE = 24
#: Other poses are better if their score is larger by so much, and in as many of the views.
MARGIN, AGREEING = 0.1, 0.75
#: The least score by which other poses are better: the best of many has more than 0.1 by chance.
LEAST = 0.2
#: Poses whose edges agree by so much are most likely right, even if others agree better: a scene
#: may look alike from several sides.
_GOOD = 0.55
#: Of other poses, the simplest mistake counts whose score is nearly the best.
_NEARLY = 0.03
#: All mistakes are tried on so many views, of at most 36 pixels, and so many of them on all views.
_FEW_VIEWS, _LIKELY = 4, 20
#: And that sees surface in so many fewer of the pixels that show some, at most: a cut-out tells
#: two poses apart that have much the same edges.
_UNCOVERED = 0.03
#: Poses of nearly as good a score, that see less than this share of the surface that others see, do
#: not count: from below, a ground has much the same edges, and hides all that stands on it.
_ALIKE, _HARDLY = 0.15, 0.1
#: The share of the surface below which poses as they are may be such, and points that tell it.
#: Close views of a large scene see one or two per cent.
_UNSEEN, _POINTS = 0.005, 512
#: The mesh may be turned about its own centre if that is so many of its diagonals from the origin.
_OFF_ORIGIN = 0.02
#: Relative jump of inverse depth, and jump of normals, that are a whole edge.
_JUMP, _CREASE = 0.1, 0.5
#: Photographs may be mirrored: what is told, and the axis of the picture that is turned round.
_MIRRORED = {
    "mirrored top to bottom": 0,
    "mirrored left to right": 1,
}


@dataclass(frozen=True)
class Alignment:
    """How well edges of the geometry and of photographs agree.

    The score is the correlation of both over the pixels of a view, in [-1, 1], averaged over views.

    Args:
        views: number of views that have edges.
        score: with the poses as they are.
        share: of these views' pixels that see a surface, in [0, 1].
        mistake: what the poses were written with, if they are clearly better without.
        mirrored: how photographs are mirrored, if they clearly are.
        best: the score without the mistake; None where there is none.
        best_share: of pixels that see a surface without the mistake.
        elsewhere: share of the photographs that agree with poses of others, if most of them do
            clearly better than with their own.
        focal: factor of focal lengths with which edges agree clearly better.
        unseen: whether that is told by the surface: with the poses as they are nearly none is seen
            but for a ground, and edges agree about as well without the mistake.
    """

    views: int
    score: float
    share: float
    mistake: Mistake | None = None
    mirrored: str | None = None
    best: float | None = None
    best_share: float | None = None
    elsewhere: float | None = None
    focal: float | None = None
    unseen: bool = False

    @property
    def plausible(self) -> bool:
        """Whether the poses are most likely right, though others agree better."""
        return self.mistake is not None and not self.unseen and self.score >= _GOOD


def alignment(scene: mi.Scene, views: Sequence[SmallView]) -> Alignment | None:
    """Compare the poses with those that common mistakes would have made of the right ones.

    Args:
        scene: that the photographs show.
        views: at low resolution; some of them are looked at, spread evenly.

    Returns:
        None where it cannot be told: too few views, too small, or without edges.
    """
    views = with_edges(views)
    if not views:
        return None
    edges = [photograph_edges(view) for view in views]
    cameras = [view.camera for view in views]
    mistakes = _likely(scene, views)
    shown = [view.alpha > 0.5 for view in views]
    (drawn, hits), *others = drawn_edges(scene, cameras, [Mistake(()), *mistakes])
    share = _share(hits)
    own = _Other(edge_scores(edges, drawn), _share(hits, shown), share)
    result = Alignment(len(views), own.score, share)
    tried: list[_Other] = []
    for told, axis in _MIRRORED.items():
        mirrored = [np.flip(e, axis) for e in edges]
        covered = _share(hits, [np.flip(s, axis) for s in shown])
        tried.append(_Other(edge_scores(mirrored, drawn), covered, share, mirrored=told))
    for mistake, (found, seen) in zip(mistakes, others, strict=True):
        scores, covered = edge_scores(edges, found), _share(seen, shown)
        tried.append(_Other(scores, covered, _share(seen), mistake))
    better = [other for other in tried if _clearly_better(other.scores, own.scores)]
    unseen = not better
    if unseen:
        better = _that_see_more(scene, cameras, own, tried)
    elif cut_out(views):
        # Poses as they are may cover more of what is shown than any others
        most = max(own.covered, *(other.covered for other in better))
        better = [other for other in better if other.covered >= most - _UNCOVERED]
    if not unseen:
        better = _that_see(scene, cameras, own, better)
    if not better:
        return result
    top = max(other.score for other in better)
    best = next(other for other in better if other.score >= top - _NEARLY)
    return replace(
        result,
        mistake=best.mistake,
        mirrored=best.mirrored,
        best=best.score,
        best_share=best.share,
        unseen=unseen,
    )


def with_edges(views: Sequence[SmallView]) -> list[SmallView]:
    """Views that can be compared, spread evenly; none where they are too few to tell."""
    usable = [v for v in views if min(v.rgb.shape[:2]) >= SHORTEST_SIDE]
    usable = [v for v in usable if photograph_edges(v).std() > 1e-6]
    return evenly(usable, MOST_VIEWS) if len(usable) >= FEWEST_VIEWS else []


def cut_out(views: Sequence[SmallView]) -> bool:
    """Whether alpha tells, from photographs, where surfaces are seen and where none is."""
    least = min(float((view.alpha > 0.5).mean()) for view in views)
    return least < 1 - _UNCOVERED and not any(view.of_mesh for view in views)


@dataclass(frozen=True, eq=False)
class _Other:
    """Poses without a mistake, or photographs that are mirrored back.

    Args:
        scores: of the views.
        covered: share of the pixels that show a surface, and see one.
        share: of all pixels that see one.
    """

    scores: np.ndarray
    covered: float
    share: float
    mistake: Mistake | None = None
    mirrored: str | None = None

    @property
    def score(self) -> float:
        """The mean score."""
        return float(self.scores.mean())


def _that_see(
    scene: mi.Scene, cameras: Sequence[Camera], own: _Other, better: Sequence[_Other]
) -> list[_Other]:
    """Those of the better poses that do not see far less of the surface than others as good.

    Args:
        scene: that the photographs show.
        cameras: with the poses as they are.
        own: these.
        better: others, of clearly better scores.
    """
    if not better:
        return []
    least = max(other.score for other in better) - _ALIKE
    alike = [other for other in (own, *better) if other.score >= least]
    shares = _surface_seen(scene, cameras, alike)
    hardly = {id(o) for o, s in zip(alike, shares, strict=True) if s < _HARDLY * max(shares)}
    return [other for other in better if id(other) not in hardly]


def _that_see_more(
    scene: mi.Scene, cameras: Sequence[Camera], own: _Other, tried: Sequence[_Other]
) -> list[_Other]:
    """Poses of much the same score, where poses as they are see nearly nothing but a ground.

    Args:
        scene: that the photographs show.
        cameras: with the poses as they are.
        own: these.
        tried: others.
    """
    alike = [other for other in tried if other.score > max(LEAST, own.score - _ALIKE)]
    if not alike:
        return []
    (least,) = _surface_seen(scene, cameras, [own])
    if least >= _UNSEEN:
        return []
    shares = _surface_seen(scene, cameras, alike)
    most = max(shares)
    if least >= _HARDLY * most:
        return []
    return [other for other, share in zip(alike, shares, strict=True) if share >= _HARDLY * most]


def _surface_seen(
    scene: mi.Scene, cameras: Sequence[Camera], others: Sequence[_Other]
) -> list[float]:
    """The share of the surface but for its ground that cameras see, of each of the poses."""
    low, high, _ = free_space.extent(scene, lamps=False)
    points = free_space.sample_surface(scene, _POINTS, 0, within=(low, high))
    if not len(points.position):
        return [1.0] * len(others)
    found = []
    for other in others:
        seen = np.zeros(len(points.position), dtype=bool)
        for given in cameras:
            camera = given if other.mistake is None else other.mistake.corrected(given)
            framed = np.flatnonzero(~seen & (camera.pixel_of(points.position) >= 0))
            shown = free_space.visibility(scene, camera.origin[None], points.of(framed))
            seen[framed] = shown[0]
        found.append(float(seen.mean()))
    return found


def _share(hits: Sequence[np.ndarray], shown: Sequence[np.ndarray] | None = None) -> float:
    """The mean share of pixels, or of those that are shown, that see a surface; 0 of none."""
    if shown is None:
        return float(np.mean([hit.mean() for hit in hits]))
    found = [hit[s].mean() for hit, s in zip(hits, shown, strict=True) if s.any()]
    return float(np.mean(found)) if found else 0.0


def _likely(scene: mi.Scene, views: Sequence[SmallView]) -> list[Mistake]:
    """The mistakes that are worth a closer look, simple ones first: by few views of few pixels."""
    few = [_smaller(view) for view in views[:: max(1, len(views) // _FEW_VIEWS)][:_FEW_VIEWS]]
    edges = [photograph_edges(view) for view in few]
    mistakes = all_mistakes(_middle(scene))
    found = drawn_edges(scene, [view.camera for view in few], mistakes)
    scores = [float(edge_scores(edges, drawn).mean()) for drawn, _ in found]
    kept = np.sort(np.argsort(scores)[::-1][:_LIKELY])
    return [mistakes[i] for i in kept]


def _middle(scene: mi.Scene) -> np.ndarray | None:
    """The centre of the box around all shapes, (3,); None where it is the origin."""
    box = scene.bbox()
    low, high = np.ravel(box.min).astype(np.float64), np.ravel(box.max).astype(np.float64)
    middle, size = 0.5 * (low + high), np.linalg.norm(high - low)
    return middle if np.linalg.norm(middle) > _OFF_ORIGIN * size else None


def _smaller(view: SmallView) -> SmallView:
    rgb, alpha = view.rgb.reshape(-1, 3), view.alpha.ravel()
    small = small_view(view.name, view.camera, rgb, alpha, SHORTEST_SIDE * 3 // 2)
    return replace(small, of_mesh=view.of_mesh)


def _clearly_better(scores: np.ndarray, given: np.ndarray) -> bool:
    gain = scores - given
    agree = (gain > 0).mean() >= AGREEING
    return bool(gain.mean() > MARGIN and scores.mean() > LEAST and agree)


def drawn_edges(
    scene: mi.Scene, cameras: Sequence[Camera], mistakes: Sequence[Mistake]
) -> list[tuple[list[np.ndarray], list[np.ndarray]]]:
    """What cameras see without each mistake: edges, and whether pixels see a surface."""
    corrected = [m.corrected(camera) for m in mistakes for camera in cameras]
    seen = seen_by(scene, corrected)
    found = []
    for i in range(0, len(corrected), len(cameras)):
        pairs = list(zip(corrected, seen, strict=True))[i : i + len(cameras)]
        hits = [np.isfinite(s.distance).reshape(c.height, c.width) for c, s in pairs]
        found.append(([geometry_edges(c, s.distance, s.normal) for c, s in pairs], hits))
    return found


def edge_scores(photographed: list[np.ndarray], drawn: list[np.ndarray]) -> np.ndarray:
    """The correlation of edges, one number a view; 0 where the geometry has none."""
    found = []
    for picture, edges in zip(photographed, drawn, strict=True):
        a, b = picture - picture.mean(), edges - edges.mean()
        norm = np.sqrt((a * a).sum() * (b * b).sum())
        found.append(float((a * b).sum() / norm) if norm > 1e-9 else 0.0)
    return np.array(found)


def photograph_edges(view: SmallView) -> np.ndarray:
    """Slope of the logarithm of brightness, blurred: (height, width), in [0, 1]."""
    luminance = view.rgb.mean(axis=-1)
    # Behind a scene that hides its background JPEG files are nearly black, and not black.
    positive = luminance[(luminance > 0) & (view.alpha > 0)]
    floor = 0.05 * float(np.median(positive)) if len(positive) else 1.0
    logarithm = np.log(np.maximum(luminance, 0) + floor)
    slope = np.hypot(*np.gradient(logarithm))
    if not view.of_mesh:
        slope += np.hypot(*np.gradient(view.alpha))
    top = float(np.quantile(slope, 0.98))
    return _blurred(np.minimum(slope / top, 1)) if top > 1e-9 else np.zeros_like(slope)


def geometry_edges(
    camera: Camera, distance: np.ndarray, normal: np.ndarray, *, blurred: bool = True
) -> np.ndarray:
    """Edges of what is seen: jumps and folds of depth, creases of normals; (height, width).

    On a plane the inverse of depth is a linear function of the pixel, so that its second
    differences vanish also where the plane is seen from its edge.

    Args:
        camera: of the picture.
        distance: along the rays through the pixels, (pixels,), infinite where nothing is seen.
        normal: (pixels, 3), zero there.
        blurred: over 3 x 3 pixels, to be compared with those of photographs.
    """
    shape = (camera.height, camera.width)
    cosine = -view_rays(camera)[:, 2]
    inverse = (1 / (distance * cosine)).reshape(shape)
    facing = normal.reshape(*shape, 3)
    strength = np.zeros(shape)
    for axis in (0, 1):
        line = np.moveaxis(inverse, axis, 0)
        along = np.moveaxis(facing, axis, 0)
        out = np.moveaxis(strength, axis, 0)
        middle = np.abs(line[2:] - 2 * line[1:-1] + line[:-2])
        largest = np.maximum(np.maximum(line[2:], line[:-2]), line[1:-1])
        jump = middle / np.maximum(_JUMP * largest, 1e-30)
        crease = np.linalg.norm(along[2:] - along[:-2], axis=-1) / _CREASE
        out[1:-1] = np.maximum(out[1:-1], np.minimum(np.maximum(jump, crease), 1))
    return _blurred(strength) if blurred else strength


def _blurred(picture: np.ndarray) -> np.ndarray:
    """The mean of 3 x 3 pixels with weights 1, 2, 1; edges repeated."""
    for axis in (0, 1):
        padded = np.pad(picture, [(1, 1) if i == axis else (0, 0) for i in range(2)], "edge")
        first, last = (slice(None, -2), slice(2, None))
        parts = [padded[s] if axis == 0 else padded[:, s] for s in (first, slice(1, -1), last)]
        picture = 0.25 * parts[0] + 0.5 * parts[1] + 0.25 * parts[2]
    return picture
