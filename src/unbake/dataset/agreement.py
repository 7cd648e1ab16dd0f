"""Whether views agree on the brightness of the surface points that they share.

Under light that stands still, matte surfaces look equally bright from everywhere. So the ratio of
two photographs at points that both see tells the ratio of their exposures, and a ratio that depends
on how surfaces are turned towards the cameras tells that light turned with these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .pair_ratios import PairRatios, levels
from .small_views import Seen, SmallView

#: Points of a view that are compared, and views that share enough of them, at most.
_POINTS, _PARTNERS = 400, 12
#: Views in which points are looked for, at most: of many views, most show other things.
_LOOKED_AT = 120
#: Points that a pair of views must share, and that all must share to tell of light.
_FEWEST_SHARED, _FEWEST_FOR_LIGHT = 24, 400
#: Points beyond which a pair of views says no more.
_MOST_COUNTED = 200
#: A pixel is not compared if its neighbours differ by more than so many stops from it.
_STEEP = 1.0
#: Ratios count as at most so many stops.
_MOST_STOPS = 3.0
#: Cosine of the angle between normals of what is taken for the same point.
_SAME_NORMAL = 0.9


@dataclass(frozen=True, eq=False)
class SharedPoints:
    """Surface points that two views see, (n,) each.

    Args:
        first, second: numbers of the views.
        stops: how much brighter the point is in the second one, log2.
        before, after: its normal in the axes of the first and of the second camera, (n, 3).
    """

    first: np.ndarray
    second: np.ndarray
    stops: np.ndarray
    before: np.ndarray
    after: np.ndarray


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of views relative to each other.

    Args:
        stops: of each view, the median of those that are known being 0; NaN where it is not known.
        pairs: of views that share enough points.
    """

    stops: np.ndarray
    pairs: int

    @property
    def spread(self) -> float:
        """Stops from the darkest to the brightest exposure; 0 where none is known."""
        known = self.stops[np.isfinite(self.stops)]
        return float(np.ptp(known)) if len(known) else 0.0


@dataclass(frozen=True)
class TurningLight:
    """How much of what differs between views is explained by light that turns with the cameras.

    Args:
        explained: share of the variance of the ratios, in [0, 1].
        stops: standard deviation of the explained part.
    """

    explained: float
    stops: float


def shared_points(views: Sequence[SmallView], seen: Sequence[Seen], seed: int = 0) -> SharedPoints:
    """Points that pairs of views share, of surfaces that emit no light.

    Args:
        views: at low resolution.
        seen: what their pixels see.
    """
    rng = np.random.default_rng(seed)
    logs = [np.log2(np.maximum(view.rgb.mean(axis=-1), 1e-30)) for view in views]
    usable = [_usable(*each) for each in zip(views, logs, seen, strict=True)]
    rows = []
    axes = [view.camera.to_world[:3, :3] for view in views]
    for i, found in enumerate(seen):
        chosen = np.flatnonzero(usable[i])
        chosen = rng.permutation(chosen)[:_POINTS]
        others = rng.permutation([j for j in range(len(views)) if j != i])[:_LOOKED_AT]
        partners = 0
        for j in others.tolist():
            if partners == _PARTNERS:
                break
            at, matched = _matched(views[j], seen[j], usable[j], found, chosen)
            here = chosen[matched]
            partners += len(here) >= _FEWEST_SHARED
            rows.append(
                (
                    np.full(len(here), i),
                    np.full(len(here), j),
                    logs[j].ravel()[at] - logs[i].ravel()[here],
                    found.normal[here] @ axes[i],
                    found.normal[here] @ axes[j],
                )
            )
    if not rows:
        none = np.zeros(0)
        return SharedPoints(none.astype(int), none.astype(int), none, *np.zeros((2, 0, 3)))
    return SharedPoints(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def exposures(points: SharedPoints, views: int) -> Exposures:
    """Exposures that explain the medians of the ratios of all pairs, by least squares.

    Views that no chain of pairs connects with the largest group have none.
    """
    pairs = PairRatios.of(points.first, points.second, points.stops[:, None], _FEWEST_SHARED)
    group = _largest_group(pairs.first, pairs.second, views)
    pairs = pairs.some(group[pairs.first] & group[pairs.second])
    stops = np.full(views, np.nan)
    if not len(pairs.first):
        return Exposures(stops, 0)
    members = np.flatnonzero(group)
    place = np.zeros(views, int)
    place[members] = np.arange(len(members))
    weight = np.minimum(pairs.counts, _MOST_COUNTED).astype(np.float64)
    found = levels(place[pairs.first], place[pairs.second], pairs.logs, weight)[:, 0]
    stops[members] = found - np.median(found)
    return Exposures(stops, len(pairs.first))


def turning_light(points: SharedPoints, found: Exposures) -> TurningLight | None:
    """Explain ratios by a brightness that depends on the normal in the axes of the camera.

    Only what depends on how a surface is turned to the side, up or down counts: how it is turned
    towards the camera matters under any light, for glossy surfaces.

    Args:
        points: that views share.
        found: their exposures, which are taken out.

    Returns:
        None where views share too few points, or all see them under the same angle.
    """
    stops = points.stops - (found.stops[points.second] - found.stops[points.first])
    known = np.isfinite(stops)
    if known.sum() < _FEWEST_FOR_LIGHT:
        return None
    stops = np.clip(stops[known], -_MOST_STOPS, _MOST_STOPS)
    change = _directional(points.after[known]) - _directional(points.before[known])
    nuisance, sideways = change[:, :2], change[:, 2:]
    rest = stops - nuisance @ np.linalg.lstsq(nuisance, stops, rcond=None)[0]
    own = sideways - nuisance @ np.linalg.lstsq(nuisance, sideways, rcond=None)[0]
    if (own.std(axis=0) < 0.05).all() or rest.std() < 1e-6:
        return None
    explained = own @ np.linalg.lstsq(own, rest, rcond=1e-3)[0]
    total = float((rest**2).mean())
    share = 1 - float(((rest - explained) ** 2).mean()) / total
    return TurningLight(max(share, 0.0), float(np.sqrt((explained**2).mean())))


def _directional(normal: np.ndarray) -> np.ndarray:
    """Functions of normals in camera axes, (n, 6): two towards the camera, four to the sides."""
    x, y, z = normal.T
    return np.stack([z, z * z, x, y, x * x - y * y, x * y], axis=1)


def _usable(view: SmallView, brightness: np.ndarray, seen: Seen) -> np.ndarray:
    """Pixels whose brightness, a logarithm, is that of one surface point, (pixels,) bool."""
    steep = np.zeros(brightness.shape)
    for axis in (0, 1):
        line, out = np.moveaxis(brightness, axis, 0), np.moveaxis(steep, axis, 0)
        step = np.abs(np.diff(line, axis=0))
        out[:-1] = np.maximum(out[:-1], step)
        out[1:] = np.maximum(out[1:], step)
    whole = (steep < _STEEP) & (view.alpha > 0.999) & (view.rgb.mean(axis=-1) > 0)
    whole &= view.clipped == 0
    return whole.ravel() & np.isfinite(seen.distance) & ~seen.emits


def _matched(
    view: SmallView, there: Seen, usable: np.ndarray, here: Seen, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a view that see the points of another one, and which of the points these are."""
    camera = view.camera
    numbers = camera.pixel_of(here.position[chosen])
    matched = np.flatnonzero(numbers >= 0)
    at, wanted = numbers[matched], chosen[matched]
    depth = (camera.origin - here.position[wanted]) @ camera.to_world[:3, 2]
    # The centre of the pixel is at most 0.71 pixels away, more on surfaces seen at an angle.
    away = np.linalg.norm(there.position[at] - here.position[wanted], axis=1)
    near = away < 3 * depth / camera.fl_x
    same = (there.normal[at] * here.normal[wanted]).sum(axis=1) > _SAME_NORMAL
    good = near & same & usable[at]
    return at[good], matched[good]


def _largest_group(first: np.ndarray, second: np.ndarray, views: int) -> np.ndarray:
    """The views of the largest group that pairs connect, (views,) bool."""
    label = np.arange(views)
    for _ in range(views):
        low = np.minimum(label[first], label[second])
        new = label.copy()
        np.minimum.at(new, first, low)
        np.minimum.at(new, second, low)
        if np.array_equal(new, label):
            break
        label = new
    sizes = np.bincount(label, minlength=views)
    return (label == np.argmax(sizes)) & (sizes.max() > 1)
