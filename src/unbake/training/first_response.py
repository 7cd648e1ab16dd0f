"""Where an unknown response begins: at what photographs of the same points tell of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from ..fields.camera import GAMMA, PIECES

#: Logs of exposures that differ by less do not tell the response, but their noise would.
_APART = 0.2
#: Photographs of points that are shown with such exposures, without which it stays as it is.
_FEWEST = 200
#: The most points that are taken, and where gains are unknown.
_POINTS, _FEWER_POINTS = 1 << 16, 1 << 14
#: Weights against a photograph of a point: of the curvature of a curve's deviation and of its size
#: at white, which few photographs tell, where gains are known and where they are not.
_TOLD, _UNTOLD = (1e-2, 3e-4), (1e-3, 3e-3)
#: Those of its size elsewhere, and of gains.
_SIZE, _GAINS = 1e-6, 1e-6
#: Steps of the least absolute deviations, and the deviation that counts as none.
_STEPS, _NOISE = 40, 0.02
#: Light that photographs are explained by, as code values, where white is 1 if f(P) = P.
_BRIGHTEST = 2.0
#: The least and the largest slope of a curve and of its logarithm, where those of f(P) = P are 1.
_FLATTEST, _STEEPEST = 0.1, 5.0
#: The largest change of a log radiance, and of a log gain, in a step.
_FARTHEST = 0.5
#: Ends of the pieces of a curve, as code values of light.
_ENDS = round(PIECES * _BRIGHTEST) + 1
#: Terms of log vignetting: r², r⁴, r⁶.
_TERMS = 3


@final
@dataclass(frozen=True, eq=False)
class SeenPoints:
    """Points as several photographs show them, in one channel.

    Args:
        point: number of the point that a photograph shows, shape (n,), as of all that follows.
        view: of the photograph.
        radius2: squared distance from its middle; 1 is that of a corner.
        logs: of the photograph's value.
        gains: logs of its exposure, and of what else makes it brighter, as far as is known.
        bound: 1 where the value is the least that can be, because it is clipped; -1 where it is the
            most, because it is too dark to be told from black; else 0.
    """

    point: np.ndarray
    view: np.ndarray
    radius2: np.ndarray
    logs: np.ndarray
    gains: np.ndarray
    bound: np.ndarray

    def some(self, kept: np.ndarray) -> SeenPoints:
        """Some of the photographs, with their points numbered anew."""
        names = ("view", "radius2", "logs", "gains", "bound")
        point = np.unique(self.point[kept], return_inverse=True)[1]
        return SeenPoints(point, **{name: getattr(self, name)[kept] for name in names})


@final
@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """What photographs of the same points tell of their camera.

    Args:
        curve: the response, as one of `CameraModel.curves`; None: they do not tell it.
        gains: logs, over those that were told, by view, the first 0; None: they are known.
        falloff: a, b and c of log v = a r² + b r⁴ + c r⁶; None: it is known.
    """

    curve: np.ndarray | None
    gains: np.ndarray | None = None
    falloff: np.ndarray | None = None


def first_response(seen: SeenPoints, views: int = 0, vignetting: bool = False) -> CameraEstimate:
    """The response that explains photographs of the same points best, and their gains.

    With f(u^2.2) = v^2.2, the code value u of a point of radiance L in a photograph of gain g is

        log u = m + B(exp m),  m = log(g L) / 2.2

    with B linear between the ends of pieces. B, L and what is unknown of g are found together by
    least absolute deviations of log u, by Gauss and Newton's method with L eliminated: shine and
    what the mesh lacks are few of the photographs. Points weigh less the less their photographs
    agree, as those that shine. The noise is in u. The other way around, with g explained by u,
    noise would make curves too flat (regression dilution). Of values that are bounds only
    deviations beyond them count; where gains are known, points that any photograph shows clipped
    are left out. Where gains hardly differ, photographs do not tell the response.

    Gains and exponent of the response explain the same: with gains unknown, it is the curve's
    smoothness, and white that stays white, that decides.

    Args:
        views: how many there are, each with an unknown gain; 0: gains are known.
        vignetting: whether it is unknown.
    """
    nothing = CameraEstimate(
        None, np.zeros(views) if views else None, np.zeros(3) if vignetting else None
    )
    seen = seen.some(_comparable(seen, clipped=views > 0))
    # Points are in the order of views.
    order = np.random.default_rng(0).permutation(seen.point.max(initial=-1) + 1)
    seen = seen.some(order[seen.point] < (_FEWER_POINTS if views else _POINTS))
    if (seen.bound == 0).sum() < _FEWEST:
        return nothing
    found = _Fit(seen, views, vignetting).solved()
    falloff = found[len(found) - _TERMS :] * GAMMA if vignetting else None
    gains = (found[_ENDS:][:views] - found[_ENDS]) * GAMMA if views else None
    return CameraEstimate(_curve(found[:_ENDS]), gains, falloff)


class _Fit:
    """Code values of photographs, explained."""

    def __init__(self, seen: SeenPoints, views: int, vignetting: bool) -> None:
        self._seen, self._points = seen, int(seen.point.max()) + 1
        self._code, self._gain = seen.logs / GAMMA, seen.gains / GAMMA
        #: Of unknowns beside the curve that are in m: their numbers, and what they count.
        self._inside: list[tuple[np.ndarray, np.ndarray]] = []
        if views:
            self._inside.append((_ENDS + seen.view, np.ones_like(self._code)))
        terms = range(_TERMS if vignetting else 0)
        for i in terms:
            number = np.full(len(self._code), _ENDS + views + i)
            self._inside.append((number, seen.radius2 ** (i + 1)))
        size = np.full(_ENDS + views + len(terms), _GAINS)
        size[:_ENDS] = _SIZE
        curvature, size[PIECES] = _UNTOLD if views else _TOLD
        size[PIECES // 2] = 1
        size[_ENDS : _ENDS + min(views, 1)] = 1
        bend = np.diff(np.eye(_ENDS, len(size)), 2, axis=0)
        self._prior = len(self._code) * (curvature * bend.T @ bend + np.diag(size))

    def solved(self) -> np.ndarray:
        """The unknowns: B at the ends of pieces, then gains by view, then terms of vignetting."""
        point, count = self._seen.point, len(self._prior)
        found = np.zeros(count)
        radiance = self._of_points(self._code - self._gain) / np.bincount(point)
        for _ in range(_STEPS):
            m = radiance[point] + self._gain
            m += sum(found[number] * value for number, value in self._inside)
            light = _BRIGHTEST / (_ENDS - 1)
            place = np.clip(np.exp(m) / light, 0, (_ENDS - 1) * (1 - 1e-9))
            piece = place.astype(int)
            after = place - piece
            low, high = found[piece], found[piece + 1]
            error = self._code - m - (1 - after) * low - after * high
            weight = self._weight(error)
            slope = np.clip(1 + place * (high - low), _FLATTEST, _STEEPEST)

            # The Jacobian by the unknowns has few entries in a row; that by radiance is the slope.
            entries = [(piece, 1 - after), (piece + 1, after)]
            entries += [(number, slope * value) for number, value in self._inside]
            normal, right = np.zeros(count * count), np.zeros(count)
            mixed = np.zeros(self._points * count)
            for number, value in entries:
                weighted = weight * value
                right += np.bincount(number, weighted * error, count)
                place = point * count + number
                mixed += np.bincount(place, weighted * slope, len(mixed))
                for other, its in entries:
                    normal += np.bincount(number * count + other, weighted * its, len(normal))
            normal, mixed = normal.reshape(count, count), mixed.reshape(-1, count)
            own = self._of_points(weight * slope**2) + 1e-9
            wanted = self._of_points(weight * slope * error) / own
            normal -= (mixed / own[:, None]).T @ mixed
            right -= mixed.T @ wanted
            prior = self._prior * weight.mean()
            step = np.linalg.solve(normal + prior, right - prior @ found)
            step[_ENDS:] = np.clip(step[_ENDS:], -_FARTHEST, _FARTHEST)
            found += step
            radiance += np.clip(wanted - mixed @ step / own, -_FARTHEST, _FARTHEST)
        return found

    def _weight(self, error: np.ndarray) -> np.ndarray:
        """Weights with which squares are absolute deviations, in units of a point's spread."""
        counted = error * self._seen.bound >= 0
        size = np.abs(error)
        spread = self._of_points(counted * size) / np.bincount(self._seen.point)
        return counted / (np.maximum(size, _NOISE) * (spread + _NOISE)[self._seen.point] ** 2)

    def _of_points(self, values: np.ndarray) -> np.ndarray:
        return np.bincount(self._seen.point, values, self._points)


def _curve(deviation: np.ndarray) -> np.ndarray:
    """The response of a deviation B."""
    light, places = np.linspace(0, _BRIGHTEST, _ENDS), np.linspace(0, 1, PIECES + 1)
    codes = light * np.exp(deviation - deviation[PIECES // 2])
    codes = np.cumsum([0, *np.maximum(np.diff(codes), _FLATTEST * light[1])])
    slopes = np.maximum(np.diff(np.interp(places, codes, light)), _FLATTEST / PIECES)
    heights = np.cumsum([0, *slopes])
    return 0.5 * heights / heights[PIECES // 2]


def _comparable(seen: SeenPoints, *, clipped: bool) -> np.ndarray:
    """Whether the point of a photograph is shown by others, with gains that differ.

    Args:
        clipped: whether some may be clipped there. Noise decides which are, and taken for bounds
            they made curves of path traced rooms too low near white. But where gains are unknown,
            they tell the exponent.
    """
    count, told = seen.point.max(initial=-1) + 1, seen.bound == 0
    least, most = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(least, seen.point[told], seen.gains[told])
    np.maximum.at(most, seen.point[told], seen.gains[told])
    apart = most > least + _APART
    if not clipped:
        apart[seen.point[seen.bound == 1]] = False
    return apart[seen.point]


def log_falloff(terms: np.ndarray, radius2: np.ndarray) -> np.ndarray:
    """Log vignetting at squared radii, by its terms as `CameraEstimate` has them."""
    return radius2 * (terms[0] + radius2 * (terms[1] + radius2 * terms[2]))
