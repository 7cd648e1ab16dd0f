"""The photographs of a fit, decoded once: in memory, or where they are many, in a mapped file.

With several processes each holds some views (`shares.py`). Those are decoded by each for itself
where they go to memory. The file is one of all views, which any number of processes can map: each
looks at the part with its own views.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, final

import numpy as np

from ..errors import UserError
from ..io import locked, read_object, remove_unfinished, temporary_beside, write_json
from ..memory import require_memory
from ..ranks import Ranks
from .camera import Camera
from .data_folder import DataFolder
from .outliers import Outliers, without_outliers
from .shares import Share, dealt
from .views import PIXEL_BYTES, Dataset, View, read_masked

#: Photographs of a process that take more than this, in bytes, are not held in memory but in a file
#: of the data set's folder, of which the system keeps in memory what it has room for.
IN_MEMORY = 512 << 20
#: Linear RGB; and the same of the photograph blurred, where a fit asks for it.
_COLUMNS, _WITH_BLURRED = 3, 6
#: Half the edge of the blur, in pixels.
_RADIUS = 2
#: A mask whose response to constant and to linear images is zero, and has the variance of the noise
#: (Immerkær 1996, Fast Noise Variance Estimation).
_NOISE = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32) / 6
#: Pixels are numbered in 32 bits.
MOST_PIXELS = (1 << 32) - 1
#: An image with its camera: linear RGBA, shape (pixels, 4), and whether pixels count, (pixels,).
_Image = tuple[Camera, np.ndarray, np.ndarray]


@final
@dataclass(frozen=True, eq=False)
class Photographs:
    """Linear RGB of the pixels of several views, row by row and view after view.

    With several processes, each may hold some of the views. Pixels are numbered over all views, and
    so are the places of those to train on among them.

    Args:
        table: float32, shape (pixels, 3): radiance, which is the image divided by its exposure; or
            (pixels, 6): radiance, and the radiance that errors are relative to, which is blurred
            over 5 x 5 pixels and knows the noise. Of the views that this process holds.
        chosen: numbers of the pixels to train on, of the same views; None: all. Where the
            background is hidden, background pixels say nothing about the scene and only those with
            alpha > 0 are taken (the paper: at least half of them). Pixels that are masked are never
            taken.
        mean: mean radiance of the pixels to train on, of all views.
        outliers: pixels that were too bright and are not as in the images, by view, of all views.
        share: what this process holds; None: all.

    Paper: Sec. 5.4.
    """

    table: np.ndarray
    chosen: np.ndarray | None
    mean: float
    outliers: tuple[Outliers, ...] = ()
    share: Share | None = None

    @property
    def count(self) -> int:
        """Number of pixels to train on, of all views."""
        if self.share is not None:
            return int(self.share.first_places[-1])
        return len(self.table if self.chosen is None else self.chosen)

    @property
    def pixels(self) -> range:
        """Numbers of the pixels that this process holds."""
        if self.share is None:
            return range(len(self.table))
        return self.share.own(self.share.first_pixels)

    @property
    def places(self) -> range:
        """Places of the pixels that this process holds among those to train on."""
        return range(self.count) if self.share is None else self.share.own(self.share.first_places)

    @property
    def smoothed(self) -> bool:
        """Whether there is a blurred copy."""
        return self.table.shape[1] == _WITH_BLURRED

    def own_numbers(self, places: np.ndarray) -> np.ndarray:
        """Numbers of pixels by their places among those to train on, of those that it holds."""
        return places if self.chosen is None else self.chosen[places - self.places.start]

    def own_rows(self, numbers: np.ndarray) -> np.ndarray:
        """Rows of the table of pixels that this process holds, shape (n, columns)."""
        return self.table[numbers - self.pixels.start]

    def numbers(self, places: np.ndarray) -> np.ndarray:
        """Numbers of pixels of any view, by their places; all processes ask for the same."""
        if self.share is None:
            return self.own_numbers(places)
        return self.share.looked_up(places, self.share.first_places, self.own_numbers)

    def radiance(self, numbers: np.ndarray) -> np.ndarray:
        """Linear RGB of pixels of any view, shape (n, 3); all processes ask for the same."""
        start = self.pixels.start

        def look(own: np.ndarray) -> np.ndarray:
            return self.table[own - start, :3]

        if self.share is None:
            return look(numbers)
        return self.share.looked_up(numbers, self.share.first_pixels, look)

    def joined(self, work: Callable[[], np.ndarray]) -> np.ndarray:
        """What each process tells of the pixels that it holds, in their order; see `Ranks`."""
        return work() if self.share is None else self.share.ranks.joined(work)

    @property
    def bytes(self) -> int:
        """Memory that the pixels take, unless they lie in a file."""
        held = [a for a in (self.table, self.chosen) if a is not None]
        return sum(a.nbytes for a in held if not isinstance(a, np.memmap))

    @staticmethod
    def of(
        cameras: Sequence[Camera],
        rgb: np.ndarray,
        alpha: np.ndarray,
        *,
        foreground_only: bool,
        smoothed: bool = True,
    ) -> Photographs:
        """Photographs that are in memory already.

        Args:
            cameras: one a view.
            rgb: linear RGB of all views' pixels, row by row, view after view, shape (pixels, 3).
            alpha: coverage of the same pixels, shape (pixels,).
            foreground_only: train only on pixels with alpha > 0.
            smoothed: keep a blurred copy, too.
        """
        table = np.empty((len(rgb), _WITH_BLURRED if smoothed else _COLUMNS), np.float32)
        images = [
            (camera, pixels, (pixels[:, 3] > 0) | (not foreground_only))
            for camera, pixels in zip(cameras, _split(cameras, np.c_[rgb, alpha]), strict=True)
        ]
        return _fill(table, images, foreground_only).photographs()

    @staticmethod
    def load(
        dataset: Dataset,
        clip_negative: bool,
        *,
        smoothed: bool = True,
        ranks: Ranks | None = None,
    ) -> Photographs:
        """The training views of a data set; every image is read once, also over many fits.

        Args:
            clip_negative: take negative pixels as zero.
            smoothed: keep a blurred copy, too, which doubles the memory.
            ranks: processes that deal the views among them and all call this, no more than there
                are views; None: this one holds all.

        Raises:
            UserError: an image is bad, or there are too many for memory and the data set's folder
                cannot be written to.
        """
        ranks = ranks or Ranks()
        plan = _Plan.of(dataset, clip_negative, _WITH_BLURRED if smoothed else _COLUMNS, ranks.size)
        found = ranks.together(lambda: plan.load(ranks.rank, ranks.here), math.inf)
        if ranks.size == 1:
            return found.photographs()
        every = [_Told(**told) for told in ranks.told(asdict(found.told))]
        counts = np.concatenate([told.counts for told in every])
        share = Share(ranks, plan.first_views, np.array(plan.sizes), counts)
        return found.photographs(every, share)


@dataclass(frozen=True)
class _Told:
    """What is known of the views of a process; serializable."""

    sums: list[float]  # of the pixels to train on and their channels, by view
    counts: list[int]  # of the pixels to train on, by view
    outliers: list[dict[str, Any]]


@dataclass(frozen=True, eq=False)
class _Decoded:
    """Decoded views: their table and numbers, and what all processes come to know of them."""

    table: np.ndarray
    chosen: np.ndarray | None
    told: _Told

    def photographs(
        self, every: Sequence[_Told] | None = None, share: Share | None = None
    ) -> Photographs:
        """The photographs that these are, or those that they are a share of.

        Args:
            every: what is known of the views of each process; None: this one holds all.
            share: what it holds.
        """
        every = every or [self.told]
        # One after the other, so that the mean is the same however views are dealt
        total = reduce(add, (value for told in every for value in told.sums), 0.0)
        count = sum(sum(told.counts) for told in every)
        outliers = tuple(Outliers(**found) for told in every for found in told.outliers)
        return Photographs(self.table, self.chosen, total / max(3 * count, 1), outliers, share)

    def part(self, views: slice, pixels: slice, names: Collection[str]) -> _Decoded:
        """Some of these views, with these pixels and names."""
        chosen, told = self.chosen, self.told
        if chosen is not None:
            chosen = chosen[slice(*np.searchsorted(chosen, (pixels.start, pixels.stop)))]
        outliers = [found for found in told.outliers if found["view"] in names]
        told = _Told(told.sums[views], told.counts[views], outliers)
        return _Decoded(self.table[pixels], chosen, told)


@dataclass(frozen=True)
class _Plan:
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
    def of(dataset: Dataset, clip_negative: bool, columns: int, ranks: int) -> _Plan:
        """The plan for so many processes."""
        sizes = [view.camera.width * view.camera.height for view in dataset.train]
        return _Plan(dataset, clip_negative, columns, dealt(sizes, ranks), sizes)

    @property
    def hidden(self) -> bool:
        """Whether only the foreground counts."""
        return self.dataset.background == "hidden"

    @property
    def chooses(self) -> bool:
        """Whether there are pixels that are not trained on, in any view."""
        return self.hidden or any(view.mask is not None for view in self.dataset.train)

    def load(self, rank: int, here: int) -> _Decoded:
        """The views of a process.

        Args:
            rank: its number.
            here: processes on this machine.
        """
        views, folder = self.dataset.train, self.dataset.folder
        remedy = "Use fewer views, or smaller images"
        if sum(self.sizes) > MOST_PIXELS:
            what = f"the training views have {sum(self.sizes):,} pixels, more than {MOST_PIXELS:,}"
            raise UserError(what, folder, remedy)
        first = np.cumsum([0, *self.sizes])[self.first_views]
        most = int(np.diff(first).max())
        own, pixels = (
            slice(*bounds[rank : rank + 2].tolist()) for bounds in (self.first_views, first)
        )
        # Views are decoded one after the other
        held = min(4 * self.columns * most, IN_MEMORY)
        need = here * (PIXEL_BYTES * max(self.sizes) + held + 8 * most * self.chooses)
        require_memory(need, "the photographs need", remedy, folder)
        if 4 * self.columns * most > IN_MEMORY:
            found = _cached(self)
            return found.part(own, pixels, {view.name for view in views[own]})
        table = np.empty((pixels.stop - pixels.start, self.columns), np.float32)
        return self.decode_into(table, views[own], pixels.start)

    def decode_into(self, table: np.ndarray, views: Sequence[View], first: int = 0) -> _Decoded:
        """Put the images of views into a table, but for what is too bright in them.

        Args:
            first: number of the first pixel of the table.
        """
        outliers: list[dict[str, Any]] = []

        def images() -> Iterator[_Image]:
            for view in views:
                pixels, mask = read_masked(view, self.clip_negative)
                pixels, camera = pixels.reshape(-1, 4), view.camera
                counted = np.ones(len(pixels), bool) if mask is None else mask.ravel()
                if self.hidden:
                    counted &= pixels[:, 3] > 0
                pixels, found = without_outliers(pixels, counted, view.name, camera.width)
                if found is not None:
                    outliers.append(asdict(found))
                yield camera, _in_radiance(pixels, view), counted

        made = _fill(table, images(), self.chooses, first)
        return replace(made, told=replace(made.told, outliers=outliers))


def _split(cameras: Sequence[Camera], pixels: np.ndarray) -> list[np.ndarray]:
    return np.split(pixels, np.cumsum([c.width * c.height for c in cameras])[:-1])


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


def _fill(table: np.ndarray, images: Iterable[_Image], some: bool, first: int = 0) -> _Decoded:
    """Put images into a table one after the other; blurred, too, if it has room for that.

    Args:
        some: whether there are pixels that do not count.
        first: number of the first pixel of the table.
    """
    start, sums, counts, seen = 0, [], [], []
    for camera, pixels, counted in images:
        stop = start + len(pixels)
        rgb = pixels[:, :3]
        table[start:stop, :3] = rgb
        if table.shape[1] == _WITH_BLURRED:
            # Squares of radiance beyond 1e19 are infinite: such pixels weigh nothing.
            with np.errstate(over="ignore", invalid="ignore"):
                table[start:stop, 3:] = _reference(rgb, counted, camera)
        sums.append(float((rgb[counted] if some else rgb).sum(dtype=np.float64)))
        counts.append(int(counted.sum()) if some else len(pixels))
        if some:
            seen.append(first + start + np.flatnonzero(counted))
        start = stop
    chosen = np.concatenate(seen).astype(np.uint32) if some else None
    return _Decoded(table, chosen, _Told(sums, counts, []))


def _reference(rgb: np.ndarray, counts: np.ndarray, camera: Camera) -> np.ndarray:
    """The radiance that errors of a pixel are relative to (ours).

    √(mean² + noise² + peak²): the mean of those of the 5 x 5 pixels around each one that count; the
    standard deviation of their noise; and how much brighter the pixel is than every other of the
    3 x 3, as fireflies are. The first two have next to nothing of the pixel's own noise in them, so
    that errors are not weighed by their sign. Where photographs are noisy they weigh less.

    Args:
        rgb: of one view, linear, shape (pixels, 3).
        counts: whether a pixel counts, shape (pixels,). Background that is hidden is black, and
            says nothing about the noise of the foreground.
    """
    shape = (camera.height, camera.width, -1)
    image, weight = rgb.reshape(shape), counts.astype(np.float32).reshape(shape)
    mean = _mean_of_counted(image, weight)
    mean = np.where(np.isnan(mean), image, mean)
    # Pixels that do not count are no peaks, and no noise is told from them.
    known = np.where(weight > 0, image, mean)
    response, inside = np.zeros_like(known), np.ones_like(weight)
    first, second = (np.full_like(known, -np.inf) for _ in range(2))
    neighbours = zip(_NOISE.ravel(), _around(known, 1), _around(weight, 1), strict=True)
    for share, there, counted in neighbours:
        response += share * there
        inside *= counted
        np.maximum(second, np.minimum(first, there), out=second)
        np.maximum(first, there, out=first)
    noise = np.nan_to_num(_mean_of_counted(response**2, inside))
    peak = np.maximum(known - second, 0)
    return np.sqrt(mean**2 + noise + peak**2).reshape(rgb.shape)


def _mean_of_counted(image: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The mean of those of 5 x 5 pixels around each one that have weight 1; NaN where none has."""
    if weight.all():
        return _window_sums(image) / np.float32((2 * _RADIUS + 1) ** 2)
    share = _window_sums(weight)
    return _window_sums(image * weight) / np.where(share > 0, share, np.nan)


def _window_sums(image: np.ndarray) -> np.ndarray:
    """The sum of 5 x 5 pixels around each one, edges repeated; (height, width, channels)."""
    for axis in (0, 1):
        image = reduce(np.add, _along(image, axis, _RADIUS))
    return image


def _around(image: np.ndarray, radius: int) -> Iterator[np.ndarray]:
    """The image moved to every place of a window, row by row, edges repeated."""
    for moved in _along(image, 0, radius):
        yield from _along(moved, 1, radius)


def _along(image: np.ndarray, axis: int, radius: int) -> Iterator[np.ndarray]:
    """The image moved along an axis by -radius to radius pixels, edges repeated."""
    padded = np.pad(image, [(radius, radius) if i == axis else (0, 0) for i in range(3)], "edge")
    for start in range(2 * radius + 1):
        part = slice(start, start + image.shape[axis])
        yield padded[part] if axis == 0 else padded[:, part]


# ------------------------------------------------------------------------------- The mapped file


def _cached(plan: _Plan) -> _Decoded:
    """All views in a file that is made where it is missing, or made from other images."""
    dataset, views = plan.dataset, plan.dataset.train
    data = DataFolder(dataset.folder, dataset.allow_outside)
    masks = [view.mask for view in views if view.mask is not None]
    key = {
        "images": _stamps([view.image for view in views]),
        "pixels": sum(plan.sizes),
        "columns": plan.columns,
        "clip_negative": plan.clip_negative,
        "foreground_only": plan.hidden,
        **({"masks": _stamps(masks)} if masks else {}),
        # What the blurred copy is; files that do not say it blurred across the foreground's edge.
        "blur": {"radius": _RADIUS, "within": "pixels to train on", "with": "noise and peaks"},
    }
    if any(view.exposure != 1 for view in views):
        key["exposures"] = [view.exposure for view in views]
    data.require_own_cache()
    found = _find_cache(data, key)
    if found is not None:
        return found
    try:
        with locked(data.path) as alone:
            # Another fit may have made it meanwhile
            return _find_cache(data, key) or _write_cache(data, plan, key, sweep=alone)
    except OSError as error:
        raise UserError(
            f"the decoded photographs cannot be written ({error.strerror})",
            data.cache,
            f"They take {_size(key) / 1e9:.1f} GB. Make room, or the folder writable",
        ) from None


def _stamps(files: Sequence[Path]) -> list[list[Any]]:
    """The names of files and when they were written."""
    return [[str(file), file.stat().st_mtime_ns] for file in files if file.is_file()]


def _chooses(key: dict[str, Any]) -> bool:
    """Whether there are pixels that are not trained on."""
    return key["foreground_only"] or "masks" in key


def _find_cache(data: DataFolder, key: dict[str, Any]) -> _Decoded | None:
    """The cached photographs of these images, if there are any."""
    found = _open_cache(data, key)
    if found is None and key["columns"] < _WITH_BLURRED:
        # A fit that asked for more has left a file that will do.
        found = _open_cache(data, key | {"columns": _WITH_BLURRED})
        if found is not None:
            found = replace(found, table=found.table[:, : key["columns"]])
    return found


def _open_cache(data: DataFolder, key: dict[str, Any]) -> _Decoded | None:
    """The cached photographs, if the files are complete and as they were written."""
    try:
        if _stamp(data.cache_key) is None:
            return None
        stored = read_object(data.cache_key)
        if stored["key"] != key or not all(map(math.isfinite, stored["sums"])):
            return None
        shape = (key["pixels"], key["columns"])
        table, chosen = _mapped(data.cached_photographs, stored["table"], np.float32, shape), None
        if _chooses(key):
            shape = (stored["foreground_pixels"],)
            chosen = _mapped(data.cached_foreground, stored["foreground"], np.uint32, shape)
            if chosen.max(initial=0) >= len(table):
                return None
        told = _Told(stored["sums"], stored["counts"], stored["outliers"])
        found = _Decoded(table, chosen, told)
        if found.photographs().count != sum(told.counts):
            return None
    except (UserError, OSError, ValueError, KeyError, TypeError):
        return None
    return found


def _mapped(path: Path, stamp: list[int], kind: type, shape: tuple[int, ...]) -> np.ndarray:
    """An array in a file, if it is the one that has this stamp; a `ValueError` otherwise."""
    if _stamp(path) != stamp:
        raise ValueError(path)
    array = np.load(path, mmap_mode="r")
    # Another fit may have replaced the file in between
    if _stamp(path) != stamp or array.dtype != kind or array.shape != shape:
        raise ValueError(path)
    return array


def _stamp(path: Path) -> list[int] | None:
    """Size and time of a file, which change when it is written to; None for links and pipes."""
    found = path.lstat()
    return [found.st_size, found.st_mtime_ns] if stat.S_ISREG(found.st_mode) else None


def _write_cache(data: DataFolder, plan: _Plan, key: dict[str, Any], *, sweep: bool) -> _Decoded:
    """Decode photographs into new files, which then take their names.

    Files are never written anew in place: other fits may have mapped them, and those that map a
    file that shrinks die by SIGBUS.

    Args:
        sweep: remove what killed fits have left, as no other one writes.
    """
    data.cache.mkdir(exist_ok=True)
    files = data.cached_photographs, data.cached_foreground
    table_file, foreground_file = map(temporary_beside, files)
    try:
        if sweep:
            remove_unfinished(data.cache)
        # What is there is of other images: its room comes free when no fit uses it any more
        for file in (data.cache_key, *files):
            file.unlink(missing_ok=True)
        _require_disk(data.cache, _size(key))
        shape = (key["pixels"], key["columns"])
        table = np.lib.format.open_memmap(table_file, "w+", np.float32, shape)
        _reserve(table_file)
        made = plan.decode_into(table, plan.dataset.train)
        table.flush()
        # A mapping that was written to stays in memory as a whole, and others look at a part.
        made = replace(made, table=np.load(table_file, mmap_mode="r"))
        del table
        stored = {"key": key, **asdict(made.told), "table": _stamp(table_file)}
        if made.chosen is not None:
            with foreground_file.open("xb") as file:
                np.save(file, made.chosen)
                file.flush()
                os.fsync(file.fileno())
            stored |= {
                "foreground": _stamp(foreground_file),
                "foreground_pixels": len(made.chosen),
            }
            made = replace(made, chosen=np.load(foreground_file, mmap_mode="r"))
            foreground_file.rename(data.cached_foreground)
        table_file.rename(data.cached_photographs)
        # The key is written last: without it the rest is taken for unfinished.
        write_json(data.cache_key, stored, durable=True)
    finally:
        for file in (table_file, foreground_file):
            file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            data.cache.rmdir()  # if nothing was made
    return made


def _size(key: dict[str, Any]) -> int:
    """Bytes that the files take at most."""
    return 4 * key["pixels"] * (key["columns"] + _chooses(key))


def _require_disk(folder: Path, need: int) -> None:
    free = shutil.disk_usage(folder).free
    if need > free:
        raise UserError(
            f"the decoded photographs take {need / 1e9:.1f} GB, {free / 1e9:.1f} GB are free",
            folder,
            "Make room, or use fewer or smaller images",
        )


def _reserve(path: Path) -> None:
    """Take the room of a file at once: a mapped file that finds the disk full kills the process."""
    if hasattr(os, "posix_fallocate"):  # not on macOS
        with open(path, "r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
