"""The mapped file of decoded photographs, which is made once, also over many fits.

It has all views, whatever a fit's processes hold of them, so that any number of these can map it.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import shutil
import stat
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError, printable
from ..io import locked, read_object, remove_unfinished, temporary_beside, write_json
from ..memory import free_bytes, size
from ..progress import silent
from .clipped_noise import BRIGHT
from .clipped_noise import RADIUS as BLACK_RADIUS
from .data_folder import DataFolder
from .decoding import PEAK, RADIUS, WITH_BLURRED, Decoded, Plan, Totals
from .image_files import JPEG
from .views import may_ring

#: Share of the free memory up to which the system is to read ahead in a mapped file.
_FITTING = 0.5
#: Bytes of files that are told before they are written.
_MUCH = 1e9
#: Key of what is left out of JPEG files; see `views.may_ring`.
_RINGING = "beside clipped values of JPEG"


class Unwritable(Exception):
    """Why the file cannot be made, and what would help."""

    def __init__(self, why: UserError) -> None:
        super().__init__(str(why))
        self.why = why


def in_file(
    plan: Plan,
    decode: Callable[..., tuple[np.ndarray | None, Totals]],
    tell: Callable[[str], None] = silent,
) -> Decoded:
    """All views in a file that is made where it is missing, or made from other images.

    Args:
        plan: of all views.
        decode: called as `Plan.decode_into`, without its plan, where the file is made.
        tell: called with where the file is and how large, if it is large and is made.

    Raises:
        Unwritable: there is no room for it, or the folder cannot be written to.
        UserError: of `decode`, or of files in the place of the folder's own ones.
    """
    data = DataFolder(plan.dataset.folder, plan.dataset.allow_outside)
    key = _key(plan, data)
    data.require_own_cache()
    found = _find_cache(data, key)
    if found is not None:
        return found
    try:
        with locked(data.path) as alone:
            # Another fit may have made it meanwhile
            found = _find_cache(data, key)
            return found or _write_cache(data, plan, key, decode, tell, sweep=alone)
    except OSError as error:
        why = UserError(
            f"the decoded photographs cannot be written ({error.strerror})",
            data.cache,
            f"They take {_size(key) / 1e9:.1f} GB. Make room, or the folder writable",
        )
        raise Unwritable(why) from None


def expect_random(array: np.ndarray) -> None:
    """Tell the system that rows of a mapped file will be read at random from now on.

    Where memory has no room for it, what is asked for is then read alone, and not what stands
    around it, some hundred thousand bytes a row. Until then whole views are looked at.
    """
    free, mapped = free_bytes(), getattr(array, "_mmap", None)
    if free is not None and mapped is not None and len(mapped) > _FITTING * free:
        mapped.madvise(mmap.MADV_RANDOM)


def _key(plan: Plan, data: DataFolder) -> dict[str, Any]:
    """What the file is made of."""
    views, folder = plan.dataset.train, data.path
    # Which view has which mask counts, too.
    masks = [[] if view.mask is None else _stamps([view.mask], folder) for view in views]
    key = {
        "images": _stamps([view.image for view in views], folder),
        "pixels": sum(plan.sizes),
        "columns": plan.columns,
        "clip_negative": plan.clip_negative,
        "foreground_only": plan.hidden,
        **({"masks": masks, "alpha of masks": "counts"} if any(masks) else {}),
        # What the blurred copy is; files that do not say it blurred across the foreground's edge.
        "blur": {
            "radius": RADIUS,
            "within": "other pixels to train on",
            "with": "their noise, and peaks",
            "peaks": PEAK,
        },
    }
    if any(view.image.suffix.lower() in JPEG for view in views):
        key["colour of JPEG"] = "by regression"
    if any(may_ring(view) for view in views):
        key[_RINGING] = [view.clipped for view in views]
    if any(view.exposure != 1 for view in views):
        key["exposures"] = [view.exposure for view in views]
    if any(view.noise is not None for view in views):
        key["noise"] = [None if view.noise is None else asdict(view.noise) for view in views]
        key["black"] = {"radius": BLACK_RADIUS, "bright": BRIGHT, "less": "what noise adds"}
        if any(view.clipped is not None for view in views):
            key["clipped"] = [view.clipped for view in views]
    return key


def _stamps(files: Sequence[Path], folder: Path) -> list[list[Any]]:
    """The names of files, and their size and time; in a folder, however it is called."""
    root, found = folder.resolve(), []
    for file in files:
        if file.is_file():
            path, about = file.resolve(), file.stat()
            name = path.relative_to(root) if path.is_relative_to(root) else path
            found.append([os.fspath(name), about.st_size, about.st_mtime_ns])
    return found


def _chooses(key: dict[str, Any]) -> bool:
    """Whether there are pixels that are not trained on."""
    return key["foreground_only"] or "masks" in key or _RINGING in key


def _find_cache(data: DataFolder, key: dict[str, Any]) -> Decoded | None:
    """The cached photographs of these images, if there are any."""
    found = _open_cache(data, key)
    if found is None and key["columns"] < WITH_BLURRED:
        # A fit that asked for more has left a file that will do.
        found = _open_cache(data, key | {"columns": WITH_BLURRED})
        if found is not None:
            found = replace(found, table=found.table[:, : key["columns"]])
    return found


def _open_cache(data: DataFolder, key: dict[str, Any]) -> Decoded | None:
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
        totals = Totals(stored["sums"], stored["counts"], stored["hot_pixels"])
        found = Decoded(table, chosen, totals)
        if len(table if chosen is None else chosen) != sum(totals.counts):
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


def _write_cache(
    data: DataFolder,
    plan: Plan,
    key: dict[str, Any],
    decode: Callable[..., tuple[np.ndarray | None, Totals]],
    tell: Callable[[str], None],
    *,
    sweep: bool,
) -> Decoded:
    """Decode photographs into new files, which then take their names.

    Files are never written anew in place: other fits may have mapped them, and those that map a
    file that shrinks die by SIGBUS.

    Args:
        sweep: remove what killed fits have left, as no other one writes.
    """
    data.cache.mkdir(exist_ok=True)
    files = data.cached_photographs, data.cached_foreground
    table_file, foreground_file = map(temporary_beside, files)
    numbers_file = temporary_beside(data.cached_foreground)  # until their count is known
    try:
        if sweep:
            remove_unfinished(data.cache)
        # What is there is of other images: its room comes free when no fit uses it any more
        for file in (data.cache_key, *files):
            file.unlink(missing_ok=True)
        _require_disk(data.cache, _size(key))
        if _size(key) > _MUCH:
            count = len(plan.dataset.train)
            where = printable(data.cache, 1000)
            tell(f"decoding {count} photographs, once, into {where}: {size(_size(key))}")
        shape = (key["pixels"], key["columns"])
        table = np.lib.format.open_memmap(table_file, "w+", np.float32, shape)
        _reserve(table_file)
        stored: dict[str, Any] = {"key": key}
        if _chooses(key):
            with numbers_file.open("xb") as numbers:
                _, totals = decode(table, plan.dataset.train, keep=numbers.write)
            stored |= _write_numbers(numbers_file, foreground_file, sum(totals.counts))
        else:
            _, totals = decode(table, plan.dataset.train)
        table.flush()
        del table  # a mapping that was written to stays in memory as a whole
        # Others may write files of these names next: what was written is looked at from here on.
        chosen = np.load(foreground_file, mmap_mode="r") if _chooses(key) else None
        made = Decoded(np.load(table_file, mmap_mode="r"), chosen, totals)
        stored |= {**asdict(totals), "table": _stamp(table_file)}
        if _chooses(key):
            foreground_file.rename(data.cached_foreground)
        table_file.rename(data.cached_photographs)
        # The key is written last: without it the rest is taken for unfinished.
        write_json(data.cache_key, stored, durable=True)
    finally:
        for file in (table_file, foreground_file, numbers_file):
            file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            data.cache.rmdir()  # if nothing was made
    return made


def _write_numbers(numbers: Path, path: Path, count: int) -> dict[str, Any]:
    """Make an array of numbers in a file, and return what is stored of it.

    Args:
        numbers: a file with nothing else.
        path: of the array.
        count: of the numbers.
    """
    header = {"descr": "<u4", "fortran_order": False, "shape": (count,)}
    with path.open("xb") as file, numbers.open("rb") as source:
        np.lib.format.write_array_header_1_0(file, header)
        shutil.copyfileobj(source, file)
        file.flush()
        os.fsync(file.fileno())
    return {"foreground": _stamp(path), "foreground_pixels": count}


def _size(key: dict[str, Any]) -> int:
    """Bytes that the files take at most; numbers of pixels lie there twice for a moment."""
    return 4 * key["pixels"] * (key["columns"] + 2 * _chooses(key))


def _require_disk(folder: Path, need: int) -> None:
    free = shutil.disk_usage(folder).free
    if need > free:
        what = f"the decoded photographs take {need / 1e9:.1f} GB, {free / 1e9:.1f} GB are free"
        raise Unwritable(UserError(what, folder, "Make room, or use fewer or smaller images"))


def _reserve(path: Path) -> None:
    """Take the room of a file at once: a mapped file that finds the disk full kills the process."""
    if hasattr(os, "posix_fallocate"):  # not on macOS
        with open(path, "r+b") as file:
            os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
