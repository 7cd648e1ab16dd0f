"""Where an unknown response begins: at what photographs of the same points tell of it."""

from __future__ import annotations

import numpy as np

from ..fields.camera import GAMMA, PIECES

#: Logs of exposures that differ by less do not tell the response, but their noise would.
_APART = 0.2
#: Pairs of photographs of a point without which a response stays as it is.
_FEWEST = 200
#: Weights of curvature and of size of a curve's deviation, against a pair.
_CURVATURE, _SIZE = 1e-3, 1e-6
#: Steps of the least absolute deviations, and the deviation that counts as none.
_STEPS, _NOISE = 15, 0.02
#: The least slope of a curve, where that of f(P) = P is 1.
_FLATTEST = 0.1


def first_response(photographs: np.ndarray, exposures: np.ndarray) -> np.ndarray:
    """The response that explains photographs of the same points best, channel by channel.

    With f(u^2.2) = (u exp D(u))^2.2, two photographs of a point say that

        log u₂ + D(u₂) − log u₁ − D(u₁) = log(e₂ / e₁) / 2.2

    which is linear in D at the ends of the pieces. It is solved by least absolute deviations: shine
    and what the mesh lacks are few of the pairs. Where exposures hardly differ, D is 0.

    Args:
        photographs: logs of the values of two photographs, (2, n, channels); NaN where they tell
            nothing.
        exposures: logs of the second exposure over the first, (n, channels).

    Returns:
        As `CameraModel.curves`, of these channels.
    """
    channels = range(photographs.shape[-1])
    return np.stack([_curve(photographs[..., i], exposures[:, i]) for i in channels])


def _curve(photographs: np.ndarray, exposures: np.ndarray) -> np.ndarray:
    places = np.linspace(0, 1, PIECES + 1)
    told = np.isfinite(photographs).all(0) & (np.abs(exposures) > _APART)
    if told.sum() < _FEWEST:
        return places
    logs, ratio = photographs[:, told] / GAMMA, exposures[told] / GAMMA
    first, second = (_weights(np.exp(log)) for log in logs)
    matrix, right = second - first, ratio - (logs[1] - logs[0])
    bend = np.diff(np.eye(PIECES + 1), 2, axis=0)
    prior = len(ratio) * (_CURVATURE * bend.T @ bend + _SIZE * np.eye(PIECES + 1))
    middle = np.zeros(PIECES + 1)
    middle[PIECES // 2] = 1
    prior += len(ratio) * np.outer(middle, middle)
    weight, found = np.ones(len(ratio)), np.zeros(PIECES + 1)
    for _ in range(_STEPS):
        normal = matrix.T @ (weight[:, None] * matrix) + prior * weight.mean()
        found = np.linalg.solve(normal, matrix.T @ (weight * right))
        weight = 1 / np.maximum(np.abs(matrix @ found - right), _NOISE)
    slopes = np.diff(places * np.exp(found - found[PIECES // 2]))
    heights = np.cumsum([0, *np.maximum(slopes, _FLATTEST / PIECES)])
    return 0.5 * heights / heights[PIECES // 2]


def _weights(u: np.ndarray) -> np.ndarray:
    """How much the ends of the pieces count at places u in [0, 1], (n, ends)."""
    place = np.clip(u, 0, 1) * PIECES
    piece = np.minimum(place.astype(int), PIECES - 1)
    weights = np.zeros((len(u), PIECES + 1))
    lane = np.arange(len(u))
    weights[lane, piece] = 1 - (place - piece)
    weights[lane, piece + 1] = place - piece
    return weights
