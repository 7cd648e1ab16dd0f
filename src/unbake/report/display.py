"""Formatting of numbers, and exposure and error scales shared by the images of all runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unbake.errors import UserError
from unbake.imaging import pictures
from unbake.imaging.coded import read_picture
from unbake.imaging.headers import CODED_SUFFIXES
from unbake.imaging.pictures import percentile
from unbake.report.runs import EvaluatedRun

LONGEST_SIDE = 640  # pixels of an embedded picture: keeps a page of 24 views near 50 MB
DASH = "—"
Choice = Callable[[Iterable[float]], float]  # max or min


# ------------------------------------------------------------------------------------------ numbers


def number(value: object) -> float | None:
    """A number as float; None for NaN and for what is no number."""
    if not isinstance(value, int | float) or math.isnan(value):
        return None
    return float(value)


def decibels(value: float | None) -> str:
    """A PSNR with two digits, and a dash for None."""
    if value is None:
        return DASH
    return f"−{-value:.2f}" if value < 0 else f"{value:.2f}"


def similar(scores: Mapping[str, Any]) -> str:
    """SSIM and FLIP in a few words; empty where there are none."""
    names = {"SSIM": "render_ssim", "FLIP": "render_flip"}
    found = {name: number(scores.get(key)) for name, key in names.items()}
    return ", ".join(f"{name} {value:.3f}" for name, value in found.items() if value is not None)


def fraction(value: float | None) -> str:
    """A score in [0, 1] with three digits; a dash for None."""
    return DASH if value is None else f"{value:.3f}"


def percent(value: float | None) -> str:
    """A fraction in percent with two digits, without the sign; a dash for None."""
    return DASH if value is None else f"{100 * value:.2f}"


def count(value: object) -> str:
    """A whole number in few characters: millions and more by their unit; a dash for no number."""
    known = number(value)
    if known is None:
        return DASH
    for unit, size in (("G", 1e9), ("M", 1e6)):
        if known >= 0.9995 * size:  # what is rounded up to it, too
            return f"{known / size:.3g}\N{NO-BREAK SPACE}{unit}"
    return f"{known:,.0f}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def seconds(value: object) -> str:
    """Seconds with one digit below 100, else as `count`; a dash for no number."""
    known = number(value)
    if known is None:
        return DASH
    return f"{known:.1f}" if known < 100 else count(round(known))


def best(values: Iterable[float | None], choose: Choice = max) -> float | None:
    """The best of at least two values, else None."""
    known = [value for value in values if value is not None]
    return choose(known) if len(known) > 1 else None


def marked(
    values: Sequence[float | None], write: Callable[[float | None], str], choose: Choice = max
) -> list[dict[str, Any]]:
    """Values as text, with the best of them marked."""
    chosen = best(values, choose)
    return [{"text": write(v), "best": v is not None and v == chosen} for v in values]


# ----------------------------------------------------------------------------------------- pictures


def evaluated(run: EvaluatedRun, picture: Path) -> Path:
    """A picture that the run's evaluation left; UserError if it is gone."""
    if not picture.is_file():
        again = f"{run.folder.evaluate_again} again"
        raise UserError("an evaluated picture is gone", picture, again)
    return picture


def rgb(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) linear RGB and (H, W) bool, True where alpha (if any) is 1.

    Photographs may hold code values of the sRGB curve; all other pictures are OpenEXR.
    """
    coded = path.suffix.lower() in CODED_SUFFIXES
    pixels = read_picture(path) if coded else pictures.read_exr(path)
    if pixels.shape[2] < 3:
        pixels = pixels[..., :1].repeat(3, axis=2)
    mask = pixels[..., 3] >= 1 if pixels.shape[2] > 3 else np.ones(pixels.shape[:2], bool)
    return pixels[..., :3], mask


def error(image: np.ndarray, reference: np.ndarray, path: Path) -> np.ndarray:
    """`absolute_error` of a picture, (H, W); UserError where its size is not the reference's."""
    require_same_size(image, reference, path)
    return pictures.absolute_error(image, reference)


def require_same_size(image: np.ndarray, reference: np.ndarray, path: Path) -> None:
    """Refuse a picture read from a file that does not have the size of its ground truth.

    Raises:
        UserError: the sizes differ.
    """
    if image.shape[:2] != reference.shape[:2]:
        raise UserError(
            f"the picture has {image.shape[1]} x {image.shape[0]} pixels, "
            f"its ground truth {reference.shape[1]} x {reference.shape[0]}",
            path,
            "Evaluate the run again",
        )


def tonemapped(linear: np.ndarray, exposure: float) -> str:
    """Linear RGB as a picture to embed, at an exposure in stops."""
    small = pictures.shrink(linear, LONGEST_SIDE)
    return pictures.png_data_uri(pictures.tonemap(small, exposure))


def shrunk(values: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Errors (H, W) and their mask, averaged down to the size of an embedded picture."""
    inside = pictures.shrink(mask, LONGEST_SIDE) >= 0.5
    return pictures.shrink(values, LONGEST_SIDE), inside


def painted(values: np.ndarray, scale: float, mask: np.ndarray) -> str:
    """Errors (H, W) as a false-colour picture to embed; `scale` is the brightest colour."""
    small, inside = shrunk(values, mask)
    return pictures.png_data_uri(pictures.false_colour(small, scale, inside))


def error_scale(errors: list[list[np.ndarray]]) -> float:
    """The upper end of the error scale of all runs.

    It is the 97th percentile of the best run, rounded up to 1, 2 or 5 times 10^n: with that of the
    worst run, errors of all others would be black.
    """
    high = np.array([percentile(parts, 97) for parts in errors])
    high = high[high > 1e-6]  # not of a run without errors
    return _round_up(float(high.min())) if len(high) else 0.01


def _round_up(value: float) -> float:
    decade = 10.0 ** math.floor(math.log10(value))
    return next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * (1 - 1e-9))
