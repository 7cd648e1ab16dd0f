"""The sRGB curve, and its inverse.

Source: IEC 61966-2-1.
"""

from __future__ import annotations

import numpy as np

#: Below these values the curve and its inverse are straight lines.
_DARK, _DARK_CODE = 0.0031308, 0.04045


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear values in [0, 1] to values of the sRGB curve, of the same shape and precision."""
    bright = 1.055 * np.power(np.maximum(linear, _DARK), 1 / 2.4) - 0.055
    return np.where(linear <= _DARK, 12.92 * linear, bright)


def from_srgb(value: np.ndarray) -> np.ndarray:
    """The inverse of `to_srgb`."""
    bright = np.power((np.maximum(value, _DARK_CODE) + 0.055) / 1.055, 2.4)
    return np.where(value <= _DARK_CODE, value / 12.92, bright)
