"""Noise of a sensor that was clipped at black makes dark surfaces brighter than they are (ours).

A sensor's value of little light is now and then below zero. A file holds zero instead. So the mean
of what it holds is not the light x but, where noise is normal with the standard deviation σ,

    f(x) = E max(0, x + σ n) = x Φ(x / σ) + σ φ(x / σ),

which is 0.4 σ where there is no light (the Tobit model, Tobin 1958). All views of a surface agree
on that, and a fit would explain it by albedo.
"""

from __future__ import annotations

import math
from statistics import NormalDist

import numpy as np

from ..imaging.windows import bands, mean_of_counted
from .camera import Camera
from .views import SensorNoise

#: Half the edge of the window that tells how much light there is, in pixels.
RADIUS = 2
#: From so many standard deviations on, nothing is clipped.
BRIGHT = 4.0
#: Entries of the table of f.
_TABLE = 513
_NORMAL = NormalDist()


def without_clipped_noise(
    rgb: np.ndarray,
    counted: np.ndarray,
    camera: Camera,
    sensor: SensorNoise | None,
    limit: float = math.inf,
) -> np.ndarray:
    """A photograph less what its clipped noise adds to it on average.

    How much that is depends on the light alone, which the mean of the 5 x 5 pixels around each one
    tells by the inverse of f. What is taken away is the same for all values of a window, so that
    noise stays as it is: values may now be below zero, as they were in the sensor.

    Args:
        rgb: linear, in the units of the noise, shape (pixels, 3).
        counted: whether pixels count, shape (pixels,).
        camera: of the photograph.
        sensor: what its noise is; None: nobody has told.
        limit: value from which on the photograph is clipped, and stays as it is.

    Returns:
        The same photograph where noise is not known, has no part that is the same for all light, or
        was not clipped: a value is below zero.
    """
    if sensor is None or not sensor.read or not counted.any() or ((rgb < 0).any(1) & counted).any():
        return rgb
    shape = (camera.height, camera.width, -1)
    image, weight = rgb.reshape(shape), counted.astype(np.float32).reshape(shape)
    light, clipped = _means(sensor)
    found = np.empty_like(image)
    for band, needed, made in bands(camera.height, RADIUS):
        with np.errstate(over="ignore", invalid="ignore"):  # what is infinite is no dark mean
            mean = mean_of_counted(image[needed], weight[needed], RADIUS)[made]
            added = mean - np.interp(mean, clipped, light)
        dark = (mean < clipped[-1]) & (image[band] < limit)
        found[band] = image[band] - np.where(dark, added, 0).astype(np.float32)
    return found.reshape(rgb.shape)


def _means(sensor: SensorNoise) -> tuple[np.ndarray, np.ndarray]:
    """Light x in rising order, and f(x)."""
    half = 0.5 * BRIGHT**2 * sensor.shot
    brightest = half + math.sqrt(half**2 + (BRIGHT * sensor.read) ** 2)  # x = BRIGHT σ(x)
    light = brightest * np.linspace(0, 1, _TABLE) ** 2
    deviation = np.sqrt(sensor.shot * light + sensor.read**2)
    return light, clipped_mean(light, deviation)


def clipped_mean(light: np.ndarray, deviation: np.ndarray | float) -> np.ndarray:
    """f(x), the mean of what files hold of light x in noise of the deviation σ, shape (n,)."""
    z = light / deviation
    share, density = (np.array([of(x) for x in z.tolist()]) for of in (_NORMAL.cdf, _NORMAL.pdf))
    return light * share + deviation * density
