"""The photographs of a fit, decoded once: in memory, or where they are many, in a mapped file."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import stat
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, final

import numpy as np

from ..errors import UserError
from ..io import locked, read_object, remove_unfinished, temporary_beside, write_json
from ..memory import require_memory
from .camera import Camera
from .data_folder import DataFolder
from .outliers import Outliers, without_outliers
from .views import PIXEL_BYTES, Dataset, View, read_masked

#: Photographs that take more than this, in bytes, are not held in memory but in a file of the data
#: set's folder, of which the system keeps in memory what it has room for.
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
    """Linear RGB of all pixels of several views, row by row and view after view.

    Args:
        table: float32, shape (pixels, 3): radiance, which is the image divided by its exposure; or
            (pixels, 6): radiance, and the radiance that errors are relative to, which is blurred
            over 5 x 5 pixels and knows the noise.
        chosen: numbers of the pixels to train on; None: all. Where the background is hidden,
            background pixels say nothing about the scene and only those with alpha > 0 are taken
            (the paper: at least half of them). Pixels that are masked are never taken.
        mean: mean radiance of the pixels to train on.
        outliers: pixels that were too bright and are not as in the images, by view.

    Paper: Sec. 5.4.
    """

    table: np.ndarray
    chosen: np.ndarray | None
    mean: float
    outliers: tuple[Outliers, ...] = ()

    @property
    def count(self) -> int:
        """Number of pixels to train on."""
        return len(self.table if self.chosen is None else self.chosen)

    @property
    def smoothed(self) -> bool:
        """Whether there is a blurred copy."""
        return self.table.shape[1] == _WITH_BLURRED

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
        return _fill(table, images, foreground_only)

    @staticmethod
    def load(dataset: Dataset, clip_negative: bool, *, smoothed: bool = True) -> Photographs:
        """The training views of a data set; every image is read once, also over many fits.

        Args:
            clip_negative: take negative pixels as zero.
            smoothed: keep a blurred copy, too, which doubles the memory.

        Raises:
            UserError: an image is bad, or there are too many for memory and the data set's folder
                cannot be written to.
        """
        views = dataset.train
        hidden = dataset.background == "hidden"
        some = hidden or any(view.mask is not None for view in views)
        count = sum(view.camera.width * view.camera.height for view in views)
        remedy = "Use fewer views, or smaller images"
        if count > MOST_PIXELS:
            what = f"the training views have {count:,} pixels, more than {MOST_PIXELS:,}"
            raise UserError(what, dataset.folder, remedy)
        columns = _WITH_BLURRED if smoothed else _COLUMNS
        # Views are decoded one after the other
        largest = PIXEL_BYTES * max(view.camera.width * view.camera.height for view in views)
        need = largest + min(4 * columns * count, IN_MEMORY) + 8 * count * some
        require_memory(need, "the photographs need", remedy, dataset.folder)
        if 4 * columns * count <= IN_MEMORY:
            table = np.empty((count, columns), np.float32)
            return _decode_into(table, views, clip_negative, hidden)
        return _cached(dataset, views, count, columns, clip_negative, hidden)


def _split(cameras: Sequence[Camera], pixels: np.ndarray) -> list[np.ndarray]:
    return np.split(pixels, np.cumsum([c.width * c.height for c in cameras])[:-1])


def _decode_into(
    table: np.ndarray, views: Sequence[View], clip_negative: bool, foreground_only: bool
) -> Photographs:
    """Put the images of views into a table, but for what is too bright in them."""
    outliers: list[Outliers] = []

    def images() -> Iterator[_Image]:
        for view in views:
            pixels, mask = read_masked(view, clip_negative)
            pixels, camera = pixels.reshape(-1, 4), view.camera
            counted = np.ones(len(pixels), bool) if mask is None else mask.ravel()
            if foreground_only:
                counted &= pixels[:, 3] > 0
            pixels, found = without_outliers(pixels, counted, view.name, camera.width)
            if found is not None:
                outliers.append(found)
            yield camera, _in_radiance(pixels, view), counted

    some = foreground_only or any(view.mask is not None for view in views)
    return replace(_fill(table, images(), some), outliers=tuple(outliers))


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


def _fill(table: np.ndarray, images: Iterable[_Image], some: bool) -> Photographs:
    """Put images into a table one after the other; blurred, too, if it has room for that.

    Args:
        some: whether there are pixels that do not count.
    """
    start, total, seen = 0, 0.0, []
    for camera, pixels, counted in images:
        stop = start + len(pixels)
        rgb = pixels[:, :3]
        table[start:stop, :3] = rgb
        if table.shape[1] == _WITH_BLURRED:
            # Squares of radiance beyond 1e19 are infinite: such pixels weigh nothing.
            with np.errstate(over="ignore", invalid="ignore"):
                table[start:stop, 3:] = _reference(rgb, counted, camera)
        total += float((rgb[counted] if some else rgb).sum(dtype=np.float64))
        if some:
            seen.append(start + np.flatnonzero(counted))
        start = stop
    chosen = np.concatenate(seen).astype(np.uint32) if some else None
    count = len(table) if chosen is None else len(chosen)
    return Photographs(table, chosen, total / max(3 * count, 1))


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


def _cached(
    dataset: Dataset,
    views: Sequence[View],
    count: int,
    columns: int,
    clip_negative: bool,
    hidden: bool,
) -> Photographs:
    """Photographs in a file that is made where it is missing, or made from other images."""
    data = DataFolder(dataset.folder, dataset.allow_outside)
    masks = [view.mask for view in views if view.mask is not None]
    key = {
        "images": _stamps([view.image for view in views]),
        "pixels": count,
        "columns": columns,
        "clip_negative": clip_negative,
        "foreground_only": hidden,
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
            return _find_cache(data, key) or _write_cache(data, views, key, sweep=alone)
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


def _find_cache(data: DataFolder, key: dict[str, Any]) -> Photographs | None:
    """The cached photographs of these images, if there are any."""
    found = _open_cache(data, key)
    if found is None and key["columns"] < _WITH_BLURRED:
        # A fit that asked for more has left a file that will do.
        found = _open_cache(data, key | {"columns": _WITH_BLURRED})
        if found is not None:
            found = replace(found, table=found.table[:, : key["columns"]])
    return found


def _open_cache(data: DataFolder, key: dict[str, Any]) -> Photographs | None:
    """The cached photographs, if the files are complete and as they were written."""
    try:
        if _stamp(data.cache_key) is None:
            return None
        stored = read_object(data.cache_key)
        if stored["key"] != key or not math.isfinite(stored["mean"]):
            return None
        shape = (key["pixels"], key["columns"])
        table, chosen = _mapped(data.cached_photographs, stored["table"], np.float32, shape), None
        if _chooses(key):
            shape = (stored["foreground_pixels"],)
            chosen = _mapped(data.cached_foreground, stored["foreground"], np.uint32, shape)
            if chosen.max(initial=0) >= len(table):
                return None
        outliers = tuple(Outliers(**entry) for entry in stored["outliers"])
    except (UserError, OSError, ValueError, KeyError, TypeError):
        return None
    return Photographs(table, chosen, float(stored["mean"]), outliers)


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


def _write_cache(
    data: DataFolder, views: Sequence[View], key: dict[str, Any], *, sweep: bool
) -> Photographs:
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
        made = _decode_into(table, views, key["clip_negative"], key["foreground_only"])
        table.flush()
        stored = {"key": key, "mean": made.mean, "table": _stamp(table_file)}
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
        outliers = [asdict(found) for found in made.outliers]
        write_json(data.cache_key, stored | {"outliers": outliers}, durable=True)
    finally:
        for file in (table_file, foreground_file):
            file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            data.cache.rmdir()  # if nothing was made
    table.flags.writeable = False
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
