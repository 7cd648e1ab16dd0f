"""What is told of a photograph by its pixels alone: clipping, black pixels, sharpness."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..imaging.pictures import block_means

#: Pixels along the shorter side from which on sharpness is told.
_SHORTEST = 32
#: A view is blurred if its fine detail is so many times weaker, beside its coarse detail, than that
#: of the median view: as a power of two.
BLURRED = 2.0
#: Views that sharpness is compared among, at least.
_FEWEST = 4


@dataclass(frozen=True)
class PictureFacts:
    """What the pixels of a photograph tell.

    Args:
        clipped: share of the pixels of surfaces that are clipped, in [0, 1].
        black: share of the pixels of surfaces that are zero in all channels.
        detail: log2 of fine beside coarse detail; None where that cannot be told.
        digest: stands for the pixels: equal pictures have equal ones.
    """

    clipped: float
    black: float
    detail: float | None
    digest: str


def percentage(share: float) -> str:
    """A share in [0, 1] in percent: 0.12 %, 1.2 %, 12 %, 100 %."""
    percent = 100 * share
    return f"{percent:.2g} %" if percent < 9.95 else f"{percent:.0f} %"


def picture_facts(
    rgb: np.ndarray, surface: np.ndarray, counted: np.ndarray, limit: float | None
) -> PictureFacts:
    """Look at all pixels of a photograph.

    Args:
        rgb: as in the file, decoded, (height, width, 3).
        surface: pixels that show a surface which emits no light, (height, width) bool.
        counted: pixels that are fitted, (height, width) bool.
        limit: value from which on a channel is clipped; None: if many surfaces share exactly the
            largest value of the picture, it counts as the limit.
    """
    shown = rgb[surface & counted]
    clipped = black = 0.0
    if len(shown):
        top = float(rgb[counted].max()) if limit is None else limit
        full = (shown >= top).any(axis=1)
        # One pixel is the brightest of any picture.
        if top > 0 and (limit is not None or full.sum() > 1):
            clipped = float(full.mean())
        black = float((shown <= 0).all(axis=1).mean())
    digest = hashlib.sha256(rgb.astype(np.float32).tobytes()).hexdigest()
    return PictureFacts(clipped, black, _detail(rgb, counted), digest)


def blurred(facts: Sequence[PictureFacts]) -> list[int]:
    """The numbers of the views that are less sharp than the others."""
    known = [(i, f.detail) for i, f in enumerate(facts) if f.detail is not None]
    if len(known) < _FEWEST:
        return []
    values = np.array([value for _, value in known])
    middle = float(np.median(values))
    usual = 1.4826 * float(np.median(np.abs(values - middle)))
    limit = middle - max(BLURRED, 4 * usual)
    return [i for i, value in known if value < limit]


def _detail(rgb: np.ndarray, counted: np.ndarray) -> float | None:
    """log2 of the variance of the Laplacian, beside the same at half the resolution.

    Blur takes fine detail away and leaves coarse detail, whatever the picture shows. Pixels where
    the Laplacian is that of a step are left out by taking logarithms of brightness, which bounds
    them, and medians of blocks would hide what little detail there is.
    """
    if min(rgb.shape[:2]) < _SHORTEST or not counted.any():
        return None
    luminance = rgb.mean(axis=-1)
    positive = luminance[counted & (luminance > 0)]
    if not len(positive):
        return None
    logarithm = np.log(luminance + 0.1 * float(np.median(positive)))
    fine = _laplacian_variance(logarithm, counted)
    coarse = _laplacian_variance(block_means(logarithm, 2), block_means(counted, 2) > 0.99)
    return float(np.log2(fine / coarse)) if fine > 1e-12 and coarse > 1e-12 else None


def _laplacian_variance(picture: np.ndarray, counted: np.ndarray) -> float:
    inner = slice(1, -1)
    total = picture[2:, inner] + picture[:-2, inner] + picture[inner, 2:] + picture[inner, :-2]
    laplacian = total - 4 * picture[inner, inner]
    whole = counted[2:, inner] & counted[:-2, inner] & counted[inner, 2:] & counted[inner, :-2]
    values = laplacian[whole & counted[inner, inner]]
    return float(values.var()) if len(values) > 16 else 0.0
