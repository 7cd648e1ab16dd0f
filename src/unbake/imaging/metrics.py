"""PSNR of images against their ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from unbake.errors import UserError

#: dB of equal pictures, and the most that there is: JSON has no infinity.
HIGHEST = 120.0


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio of a picture in dB, with peak 1, on linear and unclamped values.

    PSNR = 10 log10(1 / MSE), where MSE is the mean of (image − reference)² over the masked pixels
    and all channels, in double precision. Values are not clamped, tone-mapped or rescaled.

    Args:
        image: (H, W) or (H, W, C), linear.
        reference: the ground truth, same shape and space.
        mask: (H, W) bool; None: all pixels.

    Returns:
        dB, `HIGHEST` at most, which two equal pictures have.

    Raises:
        UserError: a pixel inside the mask is not finite, as after a fit that diverged.
        ValueError: the shapes differ, or the mask is empty.

    Source: PSNR as reported in Paper: Sec. 6, Fig. 6.
    """
    image, reference = np.asarray(image), np.asarray(reference)
    require_alike(image, reference)
    if mask is not None:
        image, reference = _select(image, mask), _select(reference, mask)
    if image.size == 0:
        raise ValueError("no pixel to compare: the mask is empty")
    finite = np.isfinite(image) & np.isfinite(reference)
    if not finite.all():
        bad = int(np.count_nonzero(~finite))
        raise UserError(f"{bad} of {finite.size} compared values are not finite")
    mse = float(np.mean(np.square(image.astype(np.float64) - reference.astype(np.float64))))
    return HIGHEST if mse == 0 else min(-10 * math.log10(mse), HIGHEST)


def require_alike(image: np.ndarray, reference: np.ndarray) -> None:
    """Check that two arrays are pictures of equal size, (H, W) or (H, W, C).

    Raises:
        ValueError: they are not.
    """
    if image.shape != reference.shape or image.ndim not in (2, 3):
        raise ValueError(
            f"a picture of shape {image.shape} cannot be compared with one of {reference.shape}: "
            "both must be (H, W) or (H, W, C) of equal size"
        )


def mean_psnr(values: Iterable[float | None]) -> float | None:
    """Mean over views of their PSNR, in dB.

    Args:
        values: one dB value a view; None for a view without ground truth, which is left out.

    Returns:
        The arithmetic mean of the dB values (not the PSNR of the pooled error), or None where no
        view has a value.
    """
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def _select(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The (N,) or (N, C) pixels inside the mask."""
    mask = np.asarray(mask)
    if mask.dtype != np.bool_ or mask.shape != picture.shape[:2]:
        raise ValueError(
            f"a {mask.dtype} mask of shape {mask.shape} does not fit a picture of shape "
            f"{picture.shape}: a mask is (H, W) and boolean"
        )
    return picture[mask]
