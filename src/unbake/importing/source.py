"""What is found in the folder of another program, before anything is written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import final

import numpy as np

from ..errors import UserError
from ..imaging.headers import CODED_SUFFIXES, SUFFIXES, HeaderError, ImageHeader, read_header
from ..io import inside, require_file
from .lens import Lens
from .raw import SUFFIXES as RAW_SUFFIXES
from .raw import Balance, is_raw, raw_header

#: Suffixes that are tried where the name of an image has none: radiance before code values.
_TRIED = tuple(s for suffix in (".exr", *CODED_SUFFIXES) for s in (suffix, suffix.upper()))


@final
@dataclass(frozen=True, eq=False)
class Shot:
    """One photograph of a source.

    Args:
        name: as the source has it: a path from the folder of its images, with slashes.
        split: "train" or "heldout"; None: the source does not say.
        image: the file.
        lens: of the photograph.
        to_world: camera to world, (4, 4) float64, OpenGL axes, in the frame of the mesh.
        mask: a file, zero where pixels do not count; None: all count.
        exposure: the photograph is radiance times this number; None: the source does not say.
        balance: white balance of camera RAW; None: that of daylight.
    """

    name: str
    split: str | None
    image: Path
    lens: Lens
    to_world: np.ndarray
    mask: Path | None = None
    exposure: float | None = None
    balance: Balance | None = None

    @property
    def coded(self) -> bool:
        """Whether the image holds code values and not radiance."""
        return self.image.suffix.lower() in CODED_SUFFIXES

    @property
    def raw(self) -> bool:
        """Whether the image is camera RAW."""
        return is_raw(self.image)


@final
@dataclass(frozen=True, eq=False)
class Source:
    """What a folder of another program holds.

    Args:
        kind: the program or layout, for people.
        shots: the photographs.
        notes: what the user should know of how it was read.
        mesh: the file of the geometry, where it belongs to the layout.
    """

    kind: str
    shots: tuple[Shot, ...]
    notes: tuple[str, ...] = ()
    mesh: Path | None = None


def image_header(path: Path) -> ImageHeader:
    """The header of a photograph or mask.

    Raises:
        UserError: it does not exist, is damaged, or of a format that is not read.
    """
    require_file(path, "image")
    if is_raw(path):
        return raw_header(path)
    if path.suffix.lower() not in (*CODED_SUFFIXES, *SUFFIXES):
        told = "the image is of a format that is not read (PNG, JPEG, TIFF, EXR, camera RAW)"
        raise UserError(told, path)
    try:
        return read_header(path)
    except HeaderError as error:
        raise UserError(f"the image cannot be read ({error})", path) from None
    except OSError as error:
        raise UserError(f"the image cannot be read ({error.strerror})", path) from None


def find_image(folder: Path, name: str, what: str, *, allow_outside: bool) -> Path:
    """The file of a folder that a name means, which may lack its suffix; it need not exist.

    Camera RAW takes the place of the photograph that a program has posed, which was made of it.

    Args:
        folder: that it must not leave.
        name: relative to the folder, from a file that others may have written.
        what: what the folder is, for the error message.
        allow_outside: accept files that lie elsewhere.

    Raises:
        UserError: the name is no path, or leads out of the folder.
    """

    def checked(name: str) -> Path:
        return inside(folder, name, name, what, allow_outside=allow_outside)

    path, given = checked(name), PurePath(name)
    if path.is_file() or given.name in ("", ".."):
        return path
    others = [given.with_name(given.name + suffix) for suffix in _TRIED]
    others += [given.with_suffix(case) for s in RAW_SUFFIXES for case in (s, s.upper())]
    found = next((other for other in others if (folder / other).is_file()), None)
    return path if found is None else checked(os.fspath(found))


def first_folder(folders: Sequence[Path]) -> Path | None:
    """The first of these folders that there is."""
    return next((folder for folder in folders if folder.is_dir()), None)
