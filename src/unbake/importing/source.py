"""What is found in the folder of another program, before anything is written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePath, PurePosixPath
from typing import final

import numpy as np

from ..errors import UserError, named
from ..imaging.headers import CODED_SUFFIXES, SUFFIXES, HeaderError, ImageHeader, read_header
from ..imaging.pillow import opened
from ..io import inside, require_file
from .faults import Faults
from .lens import Lens
from .raw import SUFFIXES as RAW_SUFFIXES
from .raw import Balance, is_cut, is_raw, raw_header
from .world import World

#: Suffixes that are tried where the name of an image has none: radiance before code values.
_TRIED = tuple(s for suffix in (".exr", *CODED_SUFFIXES) for s in (suffix, suffix.upper()))
#: What is wrong with a photograph that is not there, as `require_file` says it.
MISSING = "the image does not exist"
#: Suffixes of masks.
_MASKS = (".png", ".PNG")
#: Difference of the factors of width and height that rounding may cause, at most.
_ROUNDED = 0.02
#: The tag of EXIF.
_ORIENTATION = 0x0112


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
    def size(self) -> tuple[int, int]:
        """Width and height of the photograph, in pixels."""
        return self.lens.width, self.lens.height

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
class Reading:
    """How the files of a source are found.

    Args:
        images: folder of the images instead of that of the source; None: that of the source.
        allow_outside: read files that lie outside of their folder.
        keep_applied_transform: leave cameras in the frame of nerfstudio's file.
        leave_out_missing: go on without photographs that do not exist.
        other_masks: masks that frames name may be missing: others take their place.
        present: names of those that exist; `has` adds to it, and to the next one.
        missing: files of those that do not, by name.
        contradicting: names of those whose focal length and angle of view are not of one camera.
        scaled: names of those whose pose has a scale, which is taken out.
    """

    images: Path | None = None
    allow_outside: bool = False
    keep_applied_transform: bool = False
    leave_out_missing: bool = False
    other_masks: bool = False
    present: list[str] = field(default_factory=list)
    missing: dict[str, Path] = field(default_factory=dict)
    contradicting: list[str] = field(default_factory=list)
    scaled: list[str] = field(default_factory=list)

    def has(self, image: Path, name: str) -> bool:
        """Whether there is a photograph; false where it is missing and left out.

        Args:
            image: its file.
            name: that the source has for it.

        Raises:
            UserError: it is missing and not left out, or is no file.
        """
        try:
            require_file(image, "image")
        except UserError as error:
            if error.what == MISSING:
                self.missing[name] = image
                if self.leave_out_missing:
                    return False
            raise
        self.present.append(name)
        return True

    def tell_missing(self, faults: Faults) -> None:
        """Say what may help where photographs do not exist, once all of them are known."""
        if not self.missing:
            return
        if self.present:
            faults.remedy(MISSING, "--leave-out-missing imports the others")
            return
        folder = os.path.commonpath([file.parent.absolute() for file in self.missing.values()])
        remedy = f"None is in {folder}: name their folder with --images"
        if self.leave_out_missing:
            faults.add("no photograph of the source exists", remedy=remedy)
        else:
            faults.remedy(MISSING, remedy)

    def notes(self) -> tuple[str, ...]:
        """What was left out, and what cameras contradict themselves in, for people."""
        notes = []
        if self.missing:
            count = len(self.missing)
            what = "one photograph does" if count == 1 else f"{count} photographs do"
            notes.append(f"{what} not exist, left out: {named(sorted(self.missing))}")
        if self.contradicting:
            names = named(sorted(self.contradicting))
            notes.append(
                "warning: focal length (fl_x, fl_y) and angle of view (camera_angle_x, "
                f"camera_angle_y) differ, the first is taken: {names}. Remove the wrong one"
            )
        if self.scaled:
            notes.append(f"poses have a scale, which is taken out: {named(sorted(self.scaled))}")
        return tuple(notes)


@final
@dataclass(frozen=True, eq=False)
class Source:
    """What a folder of another program holds.

    Args:
        kind: the program or layout, for people.
        shots: the photographs.
        notes: what the user should know of how it was read.
        mesh: the file of the geometry, where it belongs to the layout.
        masks: the folder of masks, where it belongs to the layout.
        world: the frame that cameras are in.
    """

    kind: str
    shots: tuple[Shot, ...]
    notes: tuple[str, ...] = ()
    mesh: Path | None = None
    masks: Path | None = None
    world: World = field(default_factory=World)


def image_header(path: Path) -> ImageHeader:
    """The header of a photograph or mask.

    Raises:
        UserError: it does not exist, is damaged, of a format that is not read, or not the whole
            picture, which cameras are for.
    """
    require_file(path, "image")
    if is_raw(path):
        return raw_header(path)
    if path.suffix.lower() not in (*CODED_SUFFIXES, *SUFFIXES):
        told = "the image is of a format that is not read (PNG, JPEG, TIFF, EXR, camera RAW)"
        raise UserError(told, path)
    try:
        header = read_header(path)
    except HeaderError as error:
        raise UserError(f"the image cannot be read ({error})", path) from None
    except OSError as error:
        raise UserError(f"the image cannot be read ({error.strerror})", path) from None
    if not header.whole:
        what = "the image is not the whole picture: its data window is not its display window"
        raise UserError(what, path, "Write it whole: without crop, border region or overscan")
    return header


def find_image(
    folder: Path, name: str, what: str, *, allow_outside: bool, exact: bool = False
) -> Path:
    """The file of a folder that a name means, which may lack its suffix; it need not exist.

    Its suffix may be of another case, as `.JPG` and `.jpg`. Camera RAW takes the place of the
    photograph that a program has posed, which was made of it. So does a photograph in another
    format, where only one has the name.

    Args:
        folder: that it must not leave.
        name: relative to the folder, from a file that others may have written.
        what: what the folder is, for the error message.
        allow_outside: accept files that lie elsewhere.
        exact: no other format takes its place: beside a mask there may be the photograph of its
            name, and beside a photograph that is left out its mask.

    Raises:
        UserError: the name is no path, or leads out of the folder.
    """

    def checked(name: str) -> Path:
        return inside(folder, name, name, what, allow_outside=allow_outside)

    path, given = checked(name), PurePath(name)
    if path.is_file() or given.name in ("", ".."):
        return path
    others = [given.with_name(given.name + suffix) for suffix in _TRIED]
    if given.suffix.lower() in (*CODED_SUFFIXES, *SUFFIXES):
        others += _cases(given, given.suffix.lower())
    others += [other for suffix in RAW_SUFFIXES for other in _cases(given, suffix)]
    found = next((other for other in others if (folder / other).is_file()), None)
    if found is None and not exact:
        found = _in_another_format(folder, given)
    return path if found is None else checked(os.fspath(found))


def _cases(path: PurePath, suffix: str) -> list[PurePath]:
    """A path with another suffix, in small and in capital letters."""
    return [path.with_suffix(case) for case in (suffix, suffix.upper())]


def _in_another_format(folder: Path, given: PurePath) -> PurePath | None:
    """The photograph with the name of another, but for its suffix; None: there is not just one."""
    if given.suffix.lower() not in CODED_SUFFIXES:
        return None
    found = [
        next((case for case in _cases(given, suffix) if (folder / case).is_file()), None)
        for suffix in CODED_SUFFIXES
    ]
    there = [other for other in found if other is not None]
    return there[0] if len(there) == 1 else None


def masks_in(source: Source, folder: Path | None, reading: Reading, faults: Faults) -> Source:
    """Give photographs the masks of a folder.

    Masks of `a/0001.jpg` are `a/0001.jpg.png`, as COLMAP has them, or `a/0001.png`; or the same
    without folders at the beginning, unless several photographs would have one mask then. A folder
    of the source's own that has none of them is told.

    Args:
        source: with photographs.
        folder: comes before masks that the source names; None: the source's own folder, where it
            has one, for photographs without a mask.
        reading: whether masks may lie outside of the folder.
        faults: a folder that is none, or has no mask of any photograph, and masks of several
            photographs are added to it.
    """
    given = folder is not None
    folder = folder or source.masks
    if folder is None:
        return source
    if not folder.is_dir():
        faults.add("there is no folder of masks", folder)
        return source
    if not source.shots:
        return source
    shots = []
    found: dict[Path, list[str]] = {}
    for shot in source.shots:
        mask = None
        if given or shot.mask is None:
            with faults.collected(shot.name):
                mask = _mask_of(shot, folder, reading)
        if mask is not None:
            found.setdefault(mask, []).append(shot.name)
        shots.append(replace(shot, mask=mask or shot.mask))
    for mask, names in found.items():
        if len(names) > 1:
            what = f"the mask has the name of several photographs: {named(names)}"
            faults.add(what, mask, "Put masks into folders as the photographs are in")
    bare = [shot.name for shot in shots if shot.mask is None]
    if len(bare) == len(shots):
        what, named_as = "no photograph has a mask in the folder", PurePosixPath(bare[0]).name
        remedy = f"They are named as {named_as}.png"
        if not given:
            return replace(source, notes=(*source.notes, f"{what} {folder.name}. {remedy}"))
        faults.add(what, folder, remedy)
        return source
    count = "one photograph has" if len(bare) == 1 else f"{len(bare)} photographs have"
    note = (f"{count} no mask: {named(bare)}",) if bare else ()
    return replace(source, shots=tuple(shots), notes=(*source.notes, *note))


def _mask_of(shot: Shot, folder: Path, reading: Reading) -> Path | None:
    for end in ends_of(shot.name):
        stems = (end, end.with_suffix(shot.image.suffix), end.with_suffix(""))
        for name in (f"{stem}{case}" for stem in stems for case in _MASKS):
            if (folder / name).is_file():
                outside = reading.allow_outside
                return inside(folder, name, name, "folder of masks", allow_outside=outside)
    return None


def ends_of(name: str) -> list[PurePosixPath]:
    """A path in folders, and the same without folders at its beginning: the longest one first."""
    parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..")]
    return [PurePosixPath(*parts[first:]) for first in range(len(parts))]


def first_folder(folders: Sequence[Path]) -> Path | None:
    """The first of these folders that there is."""
    return next((folder for folder in folders if folder.is_dir()), None)


def suited(lens: Lens, image: Path) -> Lens:
    """The lens of a camera for its image, which may have been made smaller or larger as a whole.

    Camera RAW has some pixels at its edges that the photograph lacks; `read_raw` cuts them off.

    Raises:
        UserError: the image has another shape, or cannot be read.
    """
    header = image_header(image)
    size = (header.width, header.height)
    if size == (lens.width, lens.height):
        return lens
    if is_raw(image) and is_cut(size, (lens.width, lens.height)):
        return lens
    if not is_raw(image) and same_shape(size, (lens.width, lens.height)):
        return lens.scaled(*size)
    what = f"its camera is for {lens.width} x {lens.height} pixels, it has {size[0]} x {size[1]}"
    if not is_raw(image) and same_shape((size[1], size[0]), (lens.width, lens.height)):
        if orientation(image) in (5, 6, 7, 8):
            told = f"{what}; its EXIF says that it is to be turned"
            remedy = "Save the photographs turned (ImageMagick: mogrify -auto-orient)"
            raise UserError(told, image, remedy)
        told = f"{what}; it was turned by 90 degrees, perhaps by an editor that follows EXIF"
        raise UserError(told, image, "Turn it back, or give the photograph that was posed")
    raise UserError(what, image, "Give the photographs that were posed, whole or scaled as a whole")


def same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size is the other times a factor, but for rounding by a pixel."""
    factors = [a / b for a, b in zip(size, other, strict=True)]
    if max(factors) > (1 + _ROUNDED) * min(factors):
        return False
    low = max((a - 1) / b for a, b in zip(size, other, strict=True))
    high = min((a + 1) / b for a, b in zip(size, other, strict=True))
    return low <= high


def orientation(image: Path) -> int:
    """How an image's EXIF asks to turn or mirror it, from 1 to 8; 1: it does not."""
    if image.suffix.lower() not in CODED_SUFFIXES:
        return 1
    try:
        with opened(image) as file:
            told = file.getexif().get(_ORIENTATION)
    except Exception:  # EXIF that is damaged raises whatever Pillow meets
        return 1
    return told if isinstance(told, int) and 1 <= told <= 8 else 1
