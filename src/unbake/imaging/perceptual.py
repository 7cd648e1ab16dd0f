"""How alike two pictures look: SSIM and FLIP."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np

from .metrics import require_alike
from .srgb import from_srgb
from .windows import bands

#: Pixels per degree of visual angle: a display of 0.7 m and 3840 pixels, seen from 0.7 m.
PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
#: Of SSIM: the standard deviation and the reach of its window in pixels, and its constants.
_SIGMA, _REACH = 1.5, 5
_C1, _C2 = 0.01**2, 0.03**2
#: Of FLIP: exponents of colours and of features, where colour errors bend, and the width of edges.
_QC, _QF, _PC, _PT, _EDGE = 0.7, 0.5, 0.4, 0.95, 0.082
#: Of FLIP: contrast sensitivities of luminance, red-green and blue-yellow, each a sum of
#: Gaussians: (weight, width).
_SENSITIVITY = (
    ((1.0, 0.0047),),
    ((1.0, 0.0053),),
    ((34.1, 0.04), (13.5, 0.025)),
)
_TO_XYZ = np.array(
    [
        [10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794],
        [2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897],
        [1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382],
    ]
)
_WHITE = _TO_XYZ.sum(1)


def ssim(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Structural similarity of each pixel, the mean over channels.

    The window is a Gaussian of 11 x 11 pixels with σ = 1.5, K₁ = 0.01, K₂ = 0.03 and a range of 1;
    pictures are mirrored at their borders.

    Args:
        image: (H, W, C), in [0, 1], such as sRGB values.
        reference: what it is compared with, the same shape and space.

    Returns:
        (H, W) float64, from −1 to 1; 1: equal.

    Raises:
        ValueError: the shapes differ.

    Source: Wang et al., Image Quality Assessment (2004).
    """
    require_alike(image, reference)
    return _in_bands(_ssim, image, reference, _REACH)


def _ssim(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    offsets = np.arange(-_REACH, _REACH + 1)
    window = np.exp(-0.5 * (offsets / _SIGMA) ** 2)
    window /= window.sum()

    def mean(values: np.ndarray) -> np.ndarray:
        return _filtered(values, window, window, "symmetric")

    a, b = (x.astype(np.float64) for x in (image, reference))
    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    above = (2 * mean_a * mean_b + _C1) * (2 * covariance + _C2)
    below = (mean_a**2 + mean_b**2 + _C1) * (variance_a + variance_b + _C2)
    return (above / below).mean(axis=2)


def flip(
    image: np.ndarray, reference: np.ndarray, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> np.ndarray:
    """LDR-FLIP of each pixel: how visible the difference is when flipping between two pictures.

    Args:
        image: (H, W, 3), sRGB values in [0, 1].
        reference: what it is compared with, the same shape and space.
        pixels_per_degree: of visual angle.

    Returns:
        (H, W) float64 in [0, 1]; 0: no difference is seen.

    Raises:
        ValueError: the shapes differ.

    Source: Andersson et al., FLIP: A Difference Evaluator for Alternating Images (2020).
    """
    require_alike(image, reference)

    def compare(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
        return _flip(image, reference, pixels_per_degree)

    return _in_bands(compare, image, reference, _reach(pixels_per_degree))


def _flip(image: np.ndarray, reference: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    both = [_opponent(from_srgb(x.astype(np.float64))) for x in (image, reference)]
    seen = [_perceived(x, pixels_per_degree) for x in both]
    green, blue = (_uniform(_TO_XYZ @ np.eye(3)[i]) for i in (1, 2))
    largest = float(_distance(green, blue)) ** _QC
    colour = _distance(*seen) ** _QC
    bend = _PC * largest
    colour = np.where(
        colour < bend,
        _PT / bend * colour,
        _PT + (colour - bend) / (largest - bend) * (1 - _PT),
    )
    features = []
    for kernel in _feature_kernels(pixels_per_degree):
        found = [_magnitude((x[..., :1] + 16) / 116, *kernel) for x in both]
        features.append(np.abs(found[0] - found[1]))
    feature = np.clip((np.maximum(*features) / math.sqrt(2)) ** _QF, 0, 1)
    return colour ** (1 - feature)


def _in_bands(
    compare: Callable[[np.ndarray, np.ndarray], np.ndarray],
    image: np.ndarray,
    reference: np.ndarray,
    reach: int,
) -> np.ndarray:
    """A comparison (H, W) of two pictures, made of bands of rows: the whole needs much memory.

    Args:
        reach: rows above and below a pixel that are looked at.
    """
    found = np.empty(image.shape[:2])
    for rows, needed, inside in bands(len(image), reach):
        found[rows] = compare(image[needed], reference[needed])[inside]
    return found


def _reach(pixels_per_degree: float) -> int:
    """Rows around a pixel that FLIP looks at."""
    (along, _), *_ = _feature_kernels(pixels_per_degree)
    return max(_blur(pixels_per_degree), len(along) // 2)


def _blur(pixels_per_degree: float) -> int:
    """Pixels around each one that contrast sensitivity takes in."""
    widest = max(width for terms in _SENSITIVITY for _, width in terms)
    return math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * pixels_per_degree)


def _filtered(
    values: np.ndarray,
    down: np.ndarray,
    across: np.ndarray,
    border: Literal["symmetric", "edge"],
) -> np.ndarray:
    """(H, W, C) correlated with the outer product of two kernels of odd length."""
    for axis, kernel in ((0, down), (1, across)):
        reach, size = len(kernel) // 2, values.shape[axis]
        pad = [(0, 0)] * values.ndim
        pad[axis] = (reach, reach)
        padded = np.pad(values, pad, mode=border)
        values = np.zeros_like(values)
        for number, weight in enumerate(kernel):
            values += weight * padded.take(range(number, number + size), axis)
    return values


def _opponent(linear: np.ndarray) -> np.ndarray:
    """Linear RGB to YCxCz: luminance, red against green, blue against yellow."""
    x, y, z = np.moveaxis(linear @ _TO_XYZ.T / _WHITE, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], -1)


def _perceived(opponent: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """What contrast sensitivity leaves of a picture, (H, W, 3) in a uniform colour space."""
    reach = _blur(pixels_per_degree)
    squares = (np.arange(-reach, reach + 1) / pixels_per_degree) ** 2
    channels = []
    for number, terms in enumerate(_SENSITIVITY):
        channel, total = np.zeros((*opponent.shape[:2], 1)), 0.0
        for weight, width in terms:
            kernel = np.exp(-(math.pi**2) * squares / width)
            scale = weight * math.sqrt(math.pi / width)
            channel += scale * _filtered(opponent[..., [number]], kernel, kernel, "edge")
            total += scale * kernel.sum() ** 2
        channels.append(channel[..., 0] / total)
    y, cx, cz = channels
    y = (y + 16) / 116
    xyz = np.stack([cx / 500 + y, y, y - cz / 200], -1) * _WHITE
    linear = np.clip(xyz @ np.linalg.inv(_TO_XYZ).T, 0, 1)
    return _uniform(linear @ _TO_XYZ.T)


def _uniform(xyz: np.ndarray) -> np.ndarray:
    """XYZ to L*a*b* whose colours fade with luminance (Hunt)."""
    ratio, bend = xyz / _WHITE, 6 / 29
    curve = np.where(ratio > bend**3, np.cbrt(np.maximum(ratio, 0)), ratio / (3 * bend**2) + 4 / 29)
    x, y, z = np.moveaxis(curve, -1, 0)
    light = 116 * y - 16
    return np.stack([light, 0.01 * light * 500 * (x - y), 0.01 * light * 200 * (y - z)], -1)


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """HyAB: of lightness by itself, and of the two other axes together."""
    return np.abs(a[..., 0] - b[..., 0]) + np.hypot(a[..., 1] - b[..., 1], a[..., 2] - b[..., 2])


def _feature_kernels(pixels_per_degree: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernels that find edges and points: one along their direction, one across."""
    deviation = 0.5 * _EDGE * pixels_per_degree
    reach = math.ceil(3 * deviation)
    x = np.arange(-reach, reach + 1)
    bell = np.exp(-0.5 * (x / deviation) ** 2)
    kernels = []
    for along in (-x * bell, ((x / deviation) ** 2 - 1) * bell):
        negative, positive = -along[along < 0].sum(), along[along > 0].sum()
        along = along / np.where(along < 0, negative, positive)
        kernels.append((along, bell / bell.sum()))
    return kernels


def _magnitude(values: np.ndarray, along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """The length of the two responses, along x and along y, (H, W)."""
    x = _filtered(values, across, along, "edge")
    y = _filtered(values, along, across, "edge")
    return np.hypot(x, y)[..., 0]
