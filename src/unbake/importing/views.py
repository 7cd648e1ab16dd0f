"""The photographs and the masks of a data set, written."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import mitsuba as mi
import numpy as np

from ..dataset.camera_files import frame_of
from ..dataset.data_folder import DataFolder
from ..dataset.small_views import block_of, in_blocks
from ..errors import UserError
from ..imaging.coded import encode
from ..imaging.pictures import block_means, write_exr
from ..io import write_atomically
from ..memory import size
from .lens import Lens
from .photographs import clipped_from, mask_of, pixels_of
from .source import Shot

#: Bytes of a pixel that is written anew: three channels of 16 bits, compressed.
_WRITTEN = 3


def write_view(
    data: DataFolder,
    shot: Shot,
    name: str,
    split: str,
    exposures: Mapping[str, float],
    on_mesh: np.ndarray | None,
    block: int,
    *,
    changed: bool,
) -> tuple[dict[str, Any], bool]:
    """Write the photograph and the mask of a view; returns its frame, and whether any pixel counts.

    Args:
        data: to write to.
        shot: the view.
        name: its name in the data set.
        split: its split.
        exposures: by names of photographs.
        on_mesh: pixels that alone count, (H, W) bool, also where the source has no mask.
        block: edge of the squares of pixels that become one each.
        changed: its pixels are not those of the file, which is else copied if its lens is a pinhole
            and it keeps its size.
    """
    whole, limit, exact = shot.lens.camera(shot.to_world), clipped_from(shot), None
    camera = in_blocks(whole, block)
    if shot.lens.straight and not shot.raw and not changed and block == 1:
        image = data.image(name, shot.image.suffix.lower())
        image.parent.mkdir(exist_ok=True)
        shutil.copyfile(shot.image, image)
    else:
        image = data.image(name, ".png" if shot.coded else ".exr")
        pixels = np.maximum(pixels_of(shot), 0)
        if not shot.lens.straight:
            pixels, exact = _straightened(shot.lens, pixels, whole.fl_x, limit)
        if block > 1:
            pixels, exact = _in_blocks(pixels, exact, block, limit)
        _write_picture(image, pixels)
    frame: dict[str, Any] = {
        "file_path": data.relative(image),
        "split": split,
        **frame_of(camera),
    }
    if shot.coded:
        frame["encoding"] = "srgb"
    if limit is not None:
        frame["clipped"] = limit
    if shot.name in exposures:
        frame["exposure"] = exposures[shot.name]
    mask = mask_of(shot)
    if mask is not None and not shot.lens.straight:
        straight = shot.lens.straightened(mask[..., None].astype(np.float32), whole.fl_x)
        mask = straight[..., 0] >= 1
    mask = None if mask is None else all_of(mask, block)
    masks = [one for one in (on_mesh, mask, exact) if one is not None]
    counted = np.all(masks, 0)
    if masks:
        file = data.mask(name)
        _write_codes(file, np.where(counted, 255, 0).astype(np.uint8)[..., None])
        frame["mask_path"] = data.relative(file)
    if on_mesh is not None:
        frame["mask_from"] = "mesh"
    return frame, bool(counted.any())


def block_for(shot: Shot, longest: int) -> int:
    """Pixels along an edge of the squares that become one pixel each; 1: it stays as it is.

    Args:
        shot: the photograph.
        longest: pixels that an edge may have; 0: as many as it has.
    """
    return block_of(shot.lens, longest) if longest else 1


def require_disk(folder: Path, shots: Sequence[Shot], longest: int) -> None:
    """Refuse photographs that there is no room for.

    Args:
        folder: to write to.
        shots: the photographs.
        longest: as in `block_for`.

    Raises:
        UserError: there is too little.
    """
    need, free = sum(_size(shot, block_for(shot, longest)) for shot in shots), free_disk(folder)
    if need > free:
        what = f"the photographs take about {size(need)}, {size(free)} are free"
        remedy = "Make room, give another --out, or make them smaller: --longest 2048"
        raise UserError(what, folder, remedy)


def free_disk(folder: Path) -> int:
    """Bytes that are free where a folder is."""
    return shutil.disk_usage(folder).free


def _size(shot: Shot, block: int) -> int:
    """Bytes of a photograph in the data set, rather too few: those that are copied are exact."""
    if shot.lens.straight and not shot.raw and block == 1:
        return shot.image.stat().st_size
    return _WRITTEN * shot.lens.width * shot.lens.height // block**2


def complete_masks(data: DataFolder, frames: Sequence[dict[str, Any]]) -> None:
    """Give all views a mask where any has one, so that none seems to be missing."""
    bare = [frame for frame in frames if "mask_path" not in frame]
    for frame in bare if len(bare) < len(frames) else ():
        file = data.mask(PurePosixPath(frame["file_path"]).stem)
        _write_codes(file, np.full((frame["h"], frame["w"], 1), 255, np.uint8))
        frame["mask_path"] = data.relative(file)


def _straightened(
    lens: Lens, pixels: np.ndarray, focal: float, limit: float | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """The photograph of the pinhole camera, and which of its pixels say what they say.

    A pixel between a clipped one and another is darker than the limit, and nobody knows how bright
    it should be: neither its value nor that it is clipped would be true. A pixel that
    looks beyond the photograph's edge says nothing.

    Args:
        limit: from which on channels are clipped; None: they never are.
    """
    # Alpha stays 1 where it is 1 all over, and nothing lies between clipped pixels that are none:
    # these are not resampled, and the others all at once.
    opaque = bool((pixels[..., 3] >= 1).all())
    clipped = pixels[..., :3] >= np.float32(np.inf if limit is None else limit)
    some = clipped.any(axis=(0, 1))
    values = [pixels[..., :3] if opaque else pixels, clipped[..., some].astype(np.float32)]
    found = lens.straightened(np.concatenate(values, 2), focal)
    straight, shown = np.ones((*found.shape[:2], 4), np.float32), lens.shown(focal)
    count = 3 if opaque else 4
    straight[..., :count] = found[..., :count]
    if limit is None:
        return straight, shown
    between = (found[..., count:] > 0) & (straight[..., :3][..., some] < np.float32(limit))
    exact = np.logical_not(np.any(between, axis=2))
    return straight, exact if shown is None else exact & shown


def _in_blocks(
    pixels: np.ndarray, exact: np.ndarray | None, block: int, limit: float | None
) -> tuple[np.ndarray, np.ndarray | None]:
    """The means of squares of pixels, and which of them say what they say.

    A mean of clipped pixels and others is like a pixel between them in `_straightened`.

    Args:
        exact: which pixels do; None: all.
        limit: as there.
    """
    small = block_means(pixels, block)
    told = None if exact is None else all_of(exact, block)
    if limit is None:
        return small, told
    clipped = block_means(np.asarray(pixels[..., :3] >= limit, np.float32), block)
    exact_here = np.logical_or(clipped <= 0, clipped >= 1).all(axis=2)
    # Rounding must not make a mean of clipped pixels one that is not.
    small[..., :3] = np.where(clipped >= 1, np.maximum(small[..., :3], limit), small[..., :3])
    return small, np.asarray(exact_here if told is None else told & exact_here)


def all_of(mask: np.ndarray, block: int) -> np.ndarray:
    """Which squares of so many pixels along an edge have a mask all over, (H, W) bool."""
    return mask if block == 1 else np.asarray(block_means(mask.astype(np.float32), block) >= 1)


def _write_picture(file: Path, pixels: np.ndarray) -> None:
    """Write linear RGBA, premultiplied, as 16-bit codes or OpenEXR by the suffix of the file."""
    opaque = bool((pixels[..., 3] >= 1).all())
    if file.suffix == ".exr":
        write_exr(file, pixels[..., :3] if opaque else pixels)
        return
    alpha = pixels[..., 3:]
    codes = encode(pixels[..., :3] / np.where(alpha > 0, alpha, 1))
    if not opaque:
        codes = np.concatenate([codes, np.round(65535 * alpha).astype(np.uint16)], 2)
    _write_codes(file, codes)


def _write_codes(file: Path, codes: np.ndarray) -> None:
    bitmap = mi.Bitmap(np.ascontiguousarray(codes))
    write_atomically(file, lambda p: bitmap.write(str(p), mi.Bitmap.FileFormat.PNG))
