"""The photographs of a fit, decoded once: in memory, or where they are many, in a mapped file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np

from ..errors import UserError
from ..io import read_object, write_json
from .camera import Camera
from .data_folder import DataFolder
from .views import Dataset, View, read_image

#: Photographs that take more than this, in bytes, are not held in memory but in a file of the data
#: set's folder, of which the system keeps in memory what it has room for.
IN_MEMORY = 512 << 20
#: Linear RGB; and the same of the photograph blurred, where a fit asks for it.
_COLUMNS, _WITH_BLURRED = 3, 6
#: Half the edge of the blur, in pixels.
_RADIUS = 2
#: Blurred photographs are no darker than this share of the photograph, so that no pixel weighs
#: more than 1 / share² = 16 times as much in the relative loss as it does relative to itself. The
#: blur is there against noise, and noise does not make a pixel four times as bright as the mean
#: around it. A brighter one is a firefly, which weighed up to 25² = 625 times as much.
DARKEST_BLUR = 0.25


@final
@dataclass(frozen=True, eq=False)
class Photographs:
    """Linear RGB of all pixels of several views, row by row and view after view.

    Args:
        table: float32, shape (pixels, 3): radiance; or (pixels, 6): radiance, and radiance blurred
            over those of 5 x 5 pixels that can be trained on, no darker than `DARKEST_BLUR` of it.
        chosen: numbers of the pixels to train on; None: all. Where the background is hidden,
            background pixels say nothing about the scene and only those with alpha > 0 are taken
            (the paper: at least half of them).
        mean: mean radiance of the pixels to train on.

    Paper: Sec. 5.4.
    """

    table: np.ndarray
    chosen: np.ndarray | None
    mean: float

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
        images = zip(cameras, _split(cameras, np.c_[rgb, alpha]), strict=True)
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
        count = sum(view.camera.width * view.camera.height for view in views)
        columns = _WITH_BLURRED if smoothed else _COLUMNS
        if 4 * columns * count <= IN_MEMORY:
            table = np.empty((count, columns), np.float32)
            return _fill(table, _decoded(views, clip_negative), hidden)
        return _cached(dataset, views, count, columns, clip_negative, hidden)


def _split(cameras: Sequence[Camera], pixels: np.ndarray) -> list[np.ndarray]:
    return np.split(pixels, np.cumsum([c.width * c.height for c in cameras])[:-1])


def _decoded(views: Sequence[View], clip_negative: bool) -> Iterator[tuple[Camera, np.ndarray]]:
    for view in views:
        camera = view.camera
        yield camera, read_image(view.image, camera.width, camera.height, clip_negative)


def _fill(
    table: np.ndarray, images: Iterable[tuple[Camera, np.ndarray]], foreground_only: bool
) -> Photographs:
    """Put images, RGBA, into a table one after the other; blurred, too, if it has room for that."""
    start, total, seen = 0, 0.0, []
    for camera, pixels in images:
        stop = start + len(pixels)
        rgb, foreground = pixels[:, :3], pixels[:, 3] > 0
        table[start:stop, :3] = rgb
        if table.shape[1] == _WITH_BLURRED:
            counts = foreground if foreground_only else np.ones_like(foreground)
            table[start:stop, 3:] = _blurred(rgb, counts, camera)
        counted = rgb[foreground] if foreground_only else rgb
        total += float(counted.sum(dtype=np.float64))
        if foreground_only:
            seen.append(start + np.flatnonzero(foreground))
        start = stop
    chosen = np.concatenate(seen).astype(np.uint32) if foreground_only else None
    count = len(table) if chosen is None else len(chosen)
    return Photographs(table, chosen, total / max(3 * count, 1))


def _blurred(rgb: np.ndarray, counts: np.ndarray, camera: Camera) -> np.ndarray:
    """The mean of those of the 5 x 5 pixels around each one that count; itself where none does.

    Args:
        rgb: of one view, shape (pixels, 3).
        counts: whether a pixel counts, shape (pixels,). Background that is hidden is black, and
            says nothing about the noise of the foreground.
    """
    weight = counts.astype(np.float32)[:, None]
    share = _window_means(weight, camera)
    blurred = _window_means(rgb * weight, camera) / np.where(share > 0, share, 1)
    return np.maximum(np.where(share > 0, blurred, rgb), DARKEST_BLUR * rgb)


def _window_means(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """The mean of 5 x 5 pixels around each one, edges repeated; shape (pixels, channels)."""
    image = pixels.reshape(camera.height, camera.width, -1)
    padded = np.pad(image, ((_RADIUS, _RADIUS), (_RADIUS, _RADIUS), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * _RADIUS + 1,) * 2, (0, 1))
    return windows.mean((-2, -1), dtype=np.float32).reshape(len(pixels), -1)


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
    data = DataFolder(dataset.folder)
    key = {
        "images": [[str(v.image), v.image.stat().st_mtime_ns] for v in views if v.image.is_file()],
        "pixels": count,
        "columns": columns,
        "clip_negative": clip_negative,
        "foreground_only": hidden,
        # What the blurred copy is; files that do not say it blurred across the foreground's edge.
        "blur": {"radius": _RADIUS, "darkest": DARKEST_BLUR, "within": "pixels to train on"},
    }
    found = _open_cache(data, key)
    if found is None and columns < _WITH_BLURRED:
        # A fit that asked for more has left a file that will do.
        found = _open_cache(data, key | {"columns": _WITH_BLURRED})
        if found is not None:
            found = replace(found, table=found.table[:, :columns])
    if found is None:
        try:
            _write_cache(data, views, key)
        except OSError as error:
            raise UserError(
                f"the decoded photographs cannot be written ({error.strerror})",
                data.cache,
                f"They take {4 * columns * count / 1e9:.1f} GB. Make room, or the folder writable",
            ) from None
        found = _open_cache(data, key)
    if found is None:
        raise UserError("the decoded photographs cannot be read back", data.cache, "Remove it")
    return found


def _open_cache(data: DataFolder, key: dict) -> Photographs | None:
    """The cached photographs, if the files are complete and of these images."""
    try:
        stored = read_object(data.cache_key)
        if stored != {"key": key, "mean": stored["mean"]}:
            return None
        table, chosen = np.load(data.cached_photographs, mmap_mode="r"), None
        if key["foreground_only"]:
            chosen = np.load(data.cached_foreground, mmap_mode="r")
    except (UserError, OSError, ValueError, KeyError):
        return None
    return Photographs(table, chosen, stored["mean"])


def _write_cache(data: DataFolder, views: Sequence[View], key: dict) -> None:
    data.cache.mkdir(exist_ok=True)
    # The key is written last: without it the rest is taken for unfinished.
    data.cache_key.unlink(missing_ok=True)
    path = data.cached_photographs
    table = np.lib.format.open_memmap(path, "w+", np.float32, (key["pixels"], key["columns"]))
    try:
        _reserve(path)
    except OSError:
        path.unlink()
        raise
    made = _fill(table, _decoded(views, key["clip_negative"]), key["foreground_only"])
    table.flush()
    if made.chosen is not None:
        np.save(data.cached_foreground, made.chosen)
    write_json(data.cache_key, {"key": key, "mean": made.mean})


def _reserve(path: Path) -> None:
    """Take the room of a file at once: a mapped file that finds the disk full kills the process."""
    if hasattr(os, "posix_fallocate"):  # not on macOS
        with open(path, "r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
