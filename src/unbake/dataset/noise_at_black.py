"""Which noise of a sensor was clipped at black, if any: told by zeros (ours).

Zeros of a dark surface in noise lie beside values above zero, each by chance; those of a shadow lie
side by side. A block of pixels with little light tells its noise by the share of its zeros p and
its mean m: light x and deviation σ are those with p = Φ(−x / σ) and m = f(x), as
`clipped_noise.py` has it. The sensor's shot and read noise are a line through σ² over x.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from ..errors import UserError
from .clipped_noise import clipped_mean
from .data_folder import DataFolder
from .spread import evenly
from .views import Dataset, SensorNoise, fitted, read_masked

#: Edge of a block, in pixels.
_EDGE = 5
#: Blocks of a view that are looked at, about.
_MOST = 1 << 14
#: Zeros of a block in which light is told from noise, at most.
_MOST_ZEROS = 13
#: The share of blocks with a few zeros from which on it matters; and their number.
_SHARE, _FEWEST = 0.05, 200
#: Zeros are noise if pairs of them side by side are at most so many times as many as by chance.
_BY_CHANCE = 1.35
#: Sets of blocks by how much light there is, and shares of zeros that tell it.
_SETS, _LEAST, _TELLING = 30, 0.05, 0.5
#: Noise clips half of all values, where there is no light. Sets with more zeros, but not of zeros
#: alone, tell that light itself is rare, as where paths do not find it; one may be chance.
_RARE, _NONE = 0.6, 0.98
#: Light of sets that differs by less of a factor, in quartiles, does not tell shot from read noise.
_WIDE = 1.5
#: Steps of least absolute deviations, and a relative error that counts as none.
_STEPS, _SMALL = 20, 0.02
#: Views that are looked at: as many as have so many pixels together, within these bounds.
_PIXELS, _FEWEST_VIEWS, _MOST_VIEWS = 1 << 22, 4, 24
#: Columns of `blocks`: light around it, its mean, its zeros, pairs of them side by side.
COLUMNS = 4


def blocks(rgb: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """What blocks of a photograph tell, a row for each of its blocks and channels.

    Args:
        rgb: in the sensor's units, (height, width, 3).
        counted: whether pixels count, (height, width).

    Returns:
        Shape (n, `COLUMNS`), of blocks that count as a whole, as those on both sides do. Where
        light differs much between these two, as at an edge, a block tells nothing.
    """
    height, width = (side // _EDGE for side in counted.shape)
    if height < 1 or width < 3:
        return np.zeros((0, COLUMNS))

    step = -(-height * width // _MOST)  # of many rows, some

    def cut(image: np.ndarray) -> np.ndarray:
        rows = image[: height * _EDGE].reshape(height, _EDGE, image.shape[1], -1)[::step]
        return rows[:, :, : width * _EDGE].reshape(len(rows), _EDGE, width, _EDGE, -1)

    values = cut(rgb)
    zero = (values <= 0).astype(np.float32)
    zeros, mean = zero.sum((1, 3)), values.mean((1, 3), dtype=np.float64)
    pairs = (zero[:, 1:] * zero[:, :-1]).sum((1, 3))
    pairs += (zero[:, :, :, 1:] * zero[:, :, :, :-1]).sum((1, 3))
    whole = cut(counted).min((1, 3))[..., 0] > 0
    whole = whole[:, 1:-1] & whole[:, :-2] & whole[:, 2:]
    around = 0.5 * (mean[:, :-2] + mean[:, 2:])
    alike = np.abs(mean[:, :-2] - mean[:, 2:]) <= around
    columns = (around, mean[:, 1:-1], zeros[:, 1:-1], pairs[:, 1:-1])
    return np.stack([column[whole[..., None] & alike] for column in columns], 1)


def told_noise(rows: np.ndarray) -> SensorNoise | None:
    """The noise that was clipped at black, about.

    Args:
        rows: of the blocks of all views.

    Returns:
        To three digits. None where there is none, or so little that it does not matter; and where
        zeros have another cause: shadows, or pictures of a path tracer whose paths found no light.
    """
    around, mean, zeros, pairs = rows.T
    some = (zeros >= 1) & (zeros <= _MOST_ZEROS)
    if some.sum() < max(_FEWEST, _SHARE * len(rows)):
        return None
    ways, pixels = 2 * _EDGE * (_EDGE - 1), _EDGE**2
    chance = ways / (pixels * (pixels - 1)) * (zeros * (zeros - 1))[some].sum()
    if pairs[some].sum() > _BY_CHANCE * chance:
        return None
    # Sets are by what is beside a block: by its own mean, noise would choose them.
    sets = np.array_split(np.argsort(around, kind="stable"), _SETS)
    share, light = (np.array([x[one].mean() for one in sets]) for x in (zeros / pixels, mean))
    telling = (share > _LEAST) & (share < _TELLING)
    if telling.sum() < 2 or ((share > _RARE) & (share < _NONE)).sum() > 1:
        return None
    z = np.array([-NormalDist().inv_cdf(p) for p in share[telling].tolist()])
    deviation = light[telling] / clipped_mean(z, 1.0)
    line = np.stack([z * deviation, np.ones_like(z)], 1) / deviation[:, None] ** 2
    if not np.isfinite(line).all():
        return None
    shot, square = _solved(line)
    low, high = np.quantile(z * deviation, (0.25, 0.75))
    if shot < 0 or high < _WIDE * low:
        shot, square = 0.0, _solved(line[:, 1:])[0]
    # Without a part that all light has, zeros are where there was none.
    if square < 0.25 * float(deviation.min()) ** 2:
        return None
    return SensorNoise(float(f"{shot:.3g}"), float(f"{square**0.5:.3g}"))


def _solved(rows: np.ndarray) -> list[float]:
    """The unknowns by which rows are 1, by least absolute deviations: a set may hold an edge."""
    weight, found = np.ones(len(rows)), np.zeros(rows.shape[1])
    for _ in range(_STEPS):
        found = np.linalg.lstsq(weight[:, None] * rows, weight, rcond=None)[0]
        weight = 1 / np.sqrt(np.maximum(np.abs(rows @ found - 1), _SMALL))
    return found.tolist()


def found_noise(dataset: Dataset, clip_negative: bool = False) -> SensorNoise | None:
    """The noise that was clipped at black in training views whose noise nobody tells, about.

    Pictures that were rendered have no sensor, unless `unbake degrade` gave them one.

    Args:
        clip_negative: take negative pixels as zero.

    Returns:
        None where an image cannot be read, too: whoever reads them all says which.
    """
    views = [view for view in dataset.train if view.noise is None]
    degraded = DataFolder(dataset.folder).degraded_file.exists()
    if not views or (dataset.render and not degraded):
        return None
    size = max(1, views[0].camera.width * views[0].camera.height)
    most = min(max(_PIXELS // size, _FEWEST_VIEWS), _MOST_VIEWS)
    rows = []
    for view in evenly(views, most):
        try:
            pixels, mask = read_masked(view, clip_negative)
        except UserError:
            return None
        rows.append(blocks(pixels[..., :3], fitted(pixels, mask, dataset.background)))
    return told_noise(np.concatenate(rows))
