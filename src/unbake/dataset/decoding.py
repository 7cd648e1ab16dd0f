"""Photographs as a fit learns from them: decoded, in units of the scene, with a blurred copy."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, final

import numpy as np

from ..errors import UserError
from ..imaging.windows import around, mean_of_counted
from .camera import Camera
from .clipped_noise import without_clipped_noise
from .hot_pixels import without_hot_pixels
from .shares import dealt
from .views import Dataset, SensorNoise, View, fitted, read_masked

#: Linear RGB; and the same of the photograph blurred, where a fit asks for it.
COLUMNS, WITH_BLURRED = 3, 6
#: Half the edge of the blur, in pixels.
RADIUS = 2
#: A mask whose response to constant and to linear images is zero, and has the variance of the noise
#: (Immerkær 1996, Fast Noise Variance Estimation).
_NOISE = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32) / 6
#: So many standard deviations of known noise are no peak.
PEAK = 3.0
#: An image with its camera: linear RGB, shape (pixels, 3), and whether pixels count, (pixels,);
#: then its noise, if that is known.
Image = tuple[Camera, np.ndarray, np.ndarray, SensorNoise | None]


@final
@dataclass(frozen=True)
class Totals:
    """Sums over the pixels of views, which processes exchange; serializable.

    Args:
        sums: of the pixels to train on and their channels, by view.
        counts: of the pixels to train on, by view.
        hot_pixels: as `HotPixels` has them.
    """

    sums: list[float]
    counts: list[int]
    hot_pixels: list[dict[str, Any]]


@final
@dataclass(frozen=True, eq=False)
class Decoded:
    """Decoded views.

    Args:
        table: as in `Photographs`.
        chosen: the same.
        totals: of the views.
    """

    table: np.ndarray
    chosen: np.ndarray | None
    totals: Totals

    def part(self, views: slice, pixels: slice, names: Collection[str]) -> Decoded:
        """Some of these views, with these pixels and names."""
        chosen, totals = self.chosen, self.totals
        if chosen is not None:
            chosen = chosen[stretch(chosen, pixels.start, pixels.stop)]
        hot_pixels = [found for found in totals.hot_pixels if found["view"] in names]
        totals = Totals(totals.sums[views], totals.counts[views], hot_pixels)
        return Decoded(self.table[pixels], chosen, totals)


@final
@dataclass(frozen=True, eq=False)
class Plan:
    """How the training views of a data set are decoded.

    Args:
        dataset: of the views.
        clip_negative: take negative pixels as zero.
        columns: of the table.
        first_views: of each process, and of all; see `dealt`.
        sizes: pixels of each view.
    """

    dataset: Dataset
    clip_negative: bool
    columns: int
    first_views: np.ndarray
    sizes: list[int]

    @staticmethod
    def of(dataset: Dataset, clip_negative: bool, columns: int, ranks: int) -> Plan:
        """The plan for so many processes."""
        sizes = [view.camera.width * view.camera.height for view in dataset.train]
        return Plan(dataset, clip_negative, columns, dealt(sizes, ranks), sizes)

    @property
    def hidden(self) -> bool:
        """Whether only the foreground counts."""
        return self.dataset.background == "hidden"

    @property
    def chooses(self) -> bool:
        """Whether there are pixels that are not trained on, in any view."""
        return self.hidden or any(view.mask is not None for view in self.dataset.train)

    def decode_into(self, table: np.ndarray, views: Sequence[View], first: int = 0) -> Decoded:
        """Put the images of views into a table, but for what is too bright in them.

        Args:
            first: number of the first pixel of the table.
        """
        hot_pixels: list[dict[str, Any]] = []

        def images() -> Iterator[Image]:
            for view in views:
                pixels, mask = read_masked(view, self.clip_negative)
                counted = fitted(pixels, mask, self.dataset.background).ravel()
                pixels, camera = pixels.reshape(-1, 4), view.camera
                pixels, found = without_hot_pixels(pixels, counted, view.name, camera.width)
                if found is not None:
                    hot_pixels.append(asdict(found))
                noise = None if view.noise is None else view.noise.divided(view.exposure)
                radiance = _in_radiance(pixels, view)
                rgb = without_clipped_noise(radiance[:, :3], counted, camera, noise, view.limit)
                yield camera, rgb, counted, noise

        made = fill(table, images(), self.chooses, first)
        return replace(made, totals=replace(made.totals, hot_pixels=hot_pixels))


def _in_radiance(pixels: np.ndarray, view: View) -> np.ndarray:
    """The pixels of a photograph, RGBA, divided by its exposure.

    Errors are relative to a squared reference plus ε (`RelativeL2`). Dividing the photograph and
    its reference by the exposure e is the same as multiplying the rendering by e, if ε is
    multiplied by e², too: (eI − G)² / (R² + e²ε) = (I − G/e)² / (R²/e² + ε). So ε is a radiance of
    the scene: a surface that is exposed twice weighs as much in both photographs, and a data set
    weighs its pixels as if all had been taken alike. That a photograph of less light is noisier
    is in the reference, which knows the noise. L_θ learns from the same pixels, in units of the
    scene.
    """
    if view.exposure == 1:
        return pixels
    pixels = pixels.copy()
    with np.errstate(over="ignore"):
        pixels[:, :3] /= np.float32(view.exposure)
    if not np.isfinite(pixels).all():
        what = f"an exposure of {view.exposure:g} makes pixels infinite"
        raise UserError(what, view.image, "Correct 'exposure' of its frame")
    return pixels


def stretch(chosen: np.ndarray, start: int, stop: int) -> slice:
    """Where the numbers from one to another lie among those of pixels to train on.

    Numbers of 64 bits would be compared with a copy of all of them.

    Args:
        chosen: numbers of pixels in rising order.
        start, stop: numbers of pixels, or of all.
    """
    ends = np.minimum((start, stop), np.iinfo(chosen.dtype).max).astype(chosen.dtype)
    return slice(*np.searchsorted(chosen, ends).tolist())


def fill(table: np.ndarray, images: Iterable[Image], some: bool, first: int = 0) -> Decoded:
    """Put images into a table one after the other; blurred, too, if it has room for that.

    Args:
        some: whether there are pixels that do not count.
        first: number of the first pixel of the table.
    """
    start, sums, counts, seen = 0, [], [], []
    for camera, rgb, counted, noise in images:
        stop = start + len(rgb)
        table[start:stop, :3] = rgb
        if table.shape[1] == WITH_BLURRED:
            # Squares of radiance beyond 1e19 are infinite: such pixels weigh nothing.
            with np.errstate(over="ignore", invalid="ignore"):
                table[start:stop, 3:] = _reference(rgb, counted, camera, noise)
        sums.append(float((rgb[counted] if some else rgb).sum(dtype=np.float64)))
        counts.append(int(counted.sum()) if some else len(rgb))
        if some:
            seen.append((first + start + np.flatnonzero(counted)).astype(np.uint32))
        start = stop
    chosen = np.concatenate(seen) if some else None
    return Decoded(table, chosen, Totals(sums, counts, []))


def _reference(
    rgb: np.ndarray, counts: np.ndarray, camera: Camera, sensor: SensorNoise | None
) -> np.ndarray:
    """The radiance that errors of a pixel are relative to (ours).

    √(mean² + noise² + peak²): the mean of those of the 5 x 5 pixels around each one that count; the
    standard deviation of their noise; and how much brighter the pixel is than every other of the
    3 x 3, as fireflies are. The first two have next to nothing of the pixel's own noise in them, so
    that errors are not weighed by their sign. Where photographs are noisy they weigh less.

    Noise that is known may be larger than the light. Then the mean is that of the others alone, and
    a peak is what exceeds them by more than noise does: one pixel of nine is the brightest.

    Args:
        rgb: of one view, linear, shape (pixels, 3).
        counts: whether a pixel counts, shape (pixels,). Background that is hidden is black, and
            says nothing about the noise of the foreground.
        sensor: whose noise it is; None: it is told from the neighbours of a pixel.
    """
    shape = (camera.height, camera.width, -1)
    image, weight = rgb.reshape(shape), counts.astype(np.float32).reshape(shape)
    mean = mean_of_counted(image, weight, RADIUS, others=sensor is not None)
    mean = np.where(np.isnan(mean), image, mean)
    # Pixels that do not count are no peaks, and no noise is told from them.
    known = np.where(weight > 0, image, mean)
    first, second = (np.full_like(known, -np.inf) for _ in range(2))
    for there in around(known, 1):
        np.maximum(second, np.minimum(first, there), out=second)
        np.maximum(first, there, out=first)
    if sensor is None:
        noise = _noise_around(known, weight)
    else:
        noise = sensor.variance(mean)
        second += PEAK * np.sqrt(noise)
    peak = np.maximum(known - second, 0)
    return np.sqrt(mean**2 + noise + peak**2).reshape(rgb.shape)


def _noise_around(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The variance of the noise of the 5 x 5 pixels around each one, as far as neighbours tell it.

    Args:
        image: shape (height, width, channels).
        weight: 1 where a pixel counts, else 0, shape (height, width, 1).
    """
    response, inside = np.zeros_like(image), np.ones_like(weight)
    for share, there, counted in zip(
        _NOISE.ravel(), around(image, 1), around(weight, 1), strict=True
    ):
        response += share * there
        inside *= counted
    return np.nan_to_num(mean_of_counted(response**2, inside, RADIUS))
