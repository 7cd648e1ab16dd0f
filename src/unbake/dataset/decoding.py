"""Photographs as a fit learns from them: decoded, in units of the scene, with a blurred copy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, final

import numpy as np

from ..errors import UserError
from ..imaging.windows import around, bands, mean_of_counted
from ..memory import free_bytes
from ..progress import each_told, silent
from ..threads import in_order, usable_cores
from .camera import Camera
from .clipped_noise import without_clipped_noise
from .hot_pixels import without_hot_pixels
from .image_files import PIXEL_BYTES
from .shares import dealt
from .views import Dataset, SensorNoise, View, fitted, leaves_out, read_masked

#: Linear RGB; and the same of the photograph blurred, where a fit asks for it.
COLUMNS, WITH_BLURRED = 3, 6
#: Half the edge of the blur, in pixels.
RADIUS = 2
#: Rows above and below a pixel that its reference depends on: the mean of pixels that do not count
#: stands for them in the response of `_NOISE`, whose squares have a mean, too.
_REACH = 2 * RADIUS + 1
#: A mask whose response to constant and to linear images is zero, and has the variance of the noise
#: (Immerkær 1996, Fast Noise Variance Estimation).
_NOISE = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32) / 6
#: Share of the free memory that views may take which are decoded at once.
_OF_FREE = 0.5
#: So many standard deviations of noise are no peak.
PEAK = 5.0
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
        return self.hidden or any(leaves_out(view) for view in self.dataset.train)

    def decode_into(
        self,
        table: np.ndarray,
        views: Sequence[View],
        first: int = 0,
        *,
        processes: int = 1,
        held: int = 0,
        keep: Callable[[np.ndarray], None] | None = None,
        tell: Callable[[str], None] = silent,
    ) -> tuple[np.ndarray | None, Totals]:
        """Put the images of views into a table, but for what is too bright in them.

        Several are decoded at once, as many as there are cores and there is memory for.

        Args:
            first: number of the first pixel of the table.
            processes: that decode on this machine.
            held: bytes of each that are to stay, such as of the table.
            keep: takes the numbers of the pixels to train on, view after view; None: they are
                returned, if there are any.
            tell: called with how many are decoded, every few seconds.

        Returns:
            `Decoded.chosen` and `Decoded.totals`.
        """

        def put(view: View, start: int) -> Filled:
            pixels, mask = read_masked(view, self.clip_negative)
            counted = fitted(pixels, mask, self.dataset.background, view).ravel()
            pixels, camera = pixels.reshape(-1, 4), view.camera
            pixels, found = without_hot_pixels(pixels, counted, view.name, camera.width)
            noise = None if view.noise is None else view.noise.divided(view.exposure)
            radiance = _in_radiance(pixels, view)
            rgb = without_clipped_noise(radiance[:, :3], counted, camera, noise, view.limit)
            rows, image = table[start : start + len(rgb)], (camera, rgb, counted, noise)
            filled = fill_rows(rows, image, self.chooses, first + start)
            return filled if found is None else replace(filled, hot_pixels=asdict(found))

        sizes = [view.camera.width * view.camera.height for view in views]
        starts = np.cumsum([0, *sizes])[:-1].tolist()
        coded = all(view.encoding == "srgb" for view in views)
        at_once = decoded_at_once(
            len(views), max(sizes, default=1), coded=coded, processes=processes, held=held
        )
        made = in_order(put, list(zip(views, starts, strict=True)), at_once)

        def line(number: int) -> str:
            return f"decoding photographs: {number} of {len(views)}"

        return joined(each_told(made, len(views), line, tell), self.chooses, keep)


def decoded_at_once(
    count: int, largest: int, *, coded: bool, processes: int = 1, held: int = 0
) -> int:
    """How many images are decoded at once.

    Files of radiance are read one after the other: Mitsuba reads each in threads of its own, and
    two of them may wait for each other.

    Args:
        count: of the images.
        largest: pixels of the largest one.
        coded: whether all of them have code values.
        processes: that decode on this machine.
        held: bytes of each that are to stay.
    """
    if not coded:
        return 1
    free, cores = free_bytes(), usable_cores() // processes
    each = processes * PIXEL_BYTES * largest
    fitting = cores if free is None else int(_OF_FREE * (free - processes * held) / each)
    return max(1, min(count, cores, fitting))


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


@final
@dataclass(frozen=True, eq=False)
class Filled:
    """What is told of a view that was put into a table.

    Args:
        sum: of the pixels to train on and their channels.
        count: of the pixels to train on.
        numbers: of these, where not all are; uint32.
        hot_pixels: as `HotPixels` has them, if there are any.
    """

    sum: float
    count: int
    numbers: np.ndarray | None
    hot_pixels: dict[str, Any] | None = None


def fill_rows(rows: np.ndarray, image: Image, some: bool, first: int) -> Filled:
    """Put an image into rows of a table; blurred, too, if these have room for that.

    Args:
        some: whether there are pixels that do not count, in any image.
        first: number of the first pixel.
    """
    camera, rgb, counted, noise = image
    rows[:, :3] = rgb
    if rows.shape[1] == WITH_BLURRED:
        _put_reference(rows[:, 3:], rgb, counted, camera, noise)
    if not some:
        return Filled(float(rgb.sum(dtype=np.float64)), len(rgb), None)
    numbers = (first + np.flatnonzero(counted)).astype(np.uint32)
    return Filled(float(rgb[counted].sum(dtype=np.float64)), len(numbers), numbers)


def joined(
    made: Iterable[Filled], some: bool, keep: Callable[[np.ndarray], None] | None = None
) -> tuple[np.ndarray | None, Totals]:
    """The numbers and the totals of views that were put into a table one after the other.

    Args:
        some: whether there are pixels that do not count, in any image.
        keep: takes the numbers view after view; None: they are returned, if there are any.
    """
    totals, held = Totals([], [], []), []
    for filled in made:
        totals.sums.append(filled.sum)
        totals.counts.append(filled.count)
        if filled.hot_pixels is not None:
            totals.hot_pixels.append(filled.hot_pixels)
        if filled.numbers is not None:
            (keep or held.append)(filled.numbers)
    chosen = np.concatenate(held) if some and keep is None else None
    return chosen, totals


def _put_reference(
    out: np.ndarray,
    rgb: np.ndarray,
    counts: np.ndarray,
    camera: Camera,
    sensor: SensorNoise | None,
) -> None:
    """What `_reference` makes of a view, put into rows of a table; other arguments as there."""
    shape = (camera.height, camera.width, -1)
    image, weight = rgb.reshape(shape), counts.astype(np.float32).reshape(shape)
    for band, needed, made in bands(camera.height, _REACH):
        rows = slice(band.start * camera.width, band.stop * camera.width)
        # Squares of radiance beyond 1e19 are infinite: such pixels weigh nothing.
        with np.errstate(over="ignore", invalid="ignore"):
            found = _reference(image[needed], weight[needed], sensor)[made]
            out[rows] = found.reshape(-1, 3)


def _reference(image: np.ndarray, weight: np.ndarray, sensor: SensorNoise | None) -> np.ndarray:
    """The radiance that errors of a pixel are relative to (ours).

    √(mean² + noise² + peak²): the mean of those of the 5 x 5 pixels around each one that count; the
    standard deviation of their noise; and by how much the pixel is brighter than every other of the
    3 x 3 and than noise may make it, as fireflies are. Where photographs are noisy they weigh less.

    Neither mean nor noise knows the pixel itself: where its own noise made it brighter it would
    weigh less, and the scene would come out too dark.

    Args:
        image: linear RGB of one view, or of some of its rows, shape (rows, columns, 3).
        weight: 1 where a pixel counts, else 0, shape (rows, columns, 1). Background that is hidden
            is black, and says nothing about the noise of the foreground.
        sensor: whose noise it is; None: it is told from the neighbours of a pixel.

    Returns:
        Of the shape of the image; right where `_REACH` rows above and below are known, too.
    """
    mean = mean_of_counted(image, weight, RADIUS, without=0)
    mean = np.where(np.isnan(mean), image, mean)
    # Pixels that do not count are no peaks, and no noise is told from them.
    known = np.where(weight > 0, image, mean)
    noise = _noise_around(known, weight) if sensor is None else sensor.variance(mean)
    first, second = (np.full_like(known, -np.inf) for _ in range(2))
    for there in around(known, 1):
        np.maximum(second, np.minimum(first, there), out=second)
        np.maximum(first, there, out=first)
    peak = np.maximum(known - second - PEAK * np.sqrt(noise), 0)
    return np.sqrt(mean**2 + noise + peak**2)


def _noise_around(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The variance of the noise around each pixel, as far as those that do not see it tell it.

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
    return np.nan_to_num(mean_of_counted(response**2, inside, RADIUS, without=1))
