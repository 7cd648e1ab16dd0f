"""The mapped file of decoded photographs, which is made once, also over many fits.

It has all views, whatever a fit's processes hold of them, so that any number of these can map it.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import stat
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UserError
from ..io import locked, read_object, remove_unfinished, temporary_beside, write_json
from .clipped_noise import BRIGHT
from .clipped_noise import RADIUS as BLACK_RADIUS
from .data_folder import DataFolder
from .decoding import PEAK, RADIUS, WITH_BLURRED, Decoded, Plan, Totals


def in_file(plan: Plan) -> Decoded:
    """All views in a file that is made where it is missing, or made from other images."""
    dataset, views = plan.dataset, plan.dataset.train
    data = DataFolder(dataset.folder, dataset.allow_outside)
    # Which view has which mask counts, too.
    masks = [[] if view.mask is None else _stamps([view.mask]) for view in views]
    key = {
        "images": _stamps([view.image for view in views]),
        "pixels": sum(plan.sizes),
        "columns": plan.columns,
        "clip_negative": plan.clip_negative,
        "foreground_only": plan.hidden,
        **({"masks": masks, "alpha of masks": "counts"} if any(masks) else {}),
        # What the blurred copy is; files that do not say it blurred across the foreground's edge.
        "blur": {"radius": RADIUS, "within": "pixels to train on", "with": "noise and peaks"},
    }
    if any(view.image.suffix.lower() in (".jpg", ".jpeg") for view in views):
        key["colour of JPEG"] = "sharp"
    if any(view.exposure != 1 for view in views):
        key["exposures"] = [view.exposure for view in views]
    if any(view.noise is not None for view in views):
        key["noise"] = [None if view.noise is None else asdict(view.noise) for view in views]
        key["black"] = {"radius": BLACK_RADIUS, "bright": BRIGHT, "less": "what noise adds"}
        key["reference"] = {"of": "others", "peaks": PEAK}
        if any(view.clipped is not None for view in views):
            key["clipped"] = [view.clipped for view in views]
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


def _write_cache(data: DataFolder, plan: Plan, key: dict[str, Any], *, sweep: bool) -> Decoded:
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
        stored = {"key": key, **asdict(made.totals), "table": _stamp(table_file)}
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
