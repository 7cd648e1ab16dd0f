"""How much light photographs took, from their source, their EXIF or from a table."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

from ..dataset.views import MEASURABLE
from ..errors import UserError, named, printable
from ..imaging.pillow import opened
from ..io import read_text
from .faults import Faults
from .raw import raw_exposure
from .source import Shot, ends_of

#: The directory of EXIF that tells of the exposure, and its tags: seconds, ISO, f-number.
_DIRECTORY, _SECONDS, _ISO, _APERTURE = 0x8769, 0x829A, 0x8827, 0x829D
_COLUMNS = ("name", "exposure")
#: Exposures that differ by less than this, relative, are the same.
_SAME = 1e-6


def exposures_of(shots: Sequence[Shot]) -> tuple[dict[str, float], str]:
    """Exposures by the names of photographs, and a line that tells of them.

    They are what the source says. Else EXIF tells: an exposure is seconds x ISO / 100 / f-number²,
    relative to the geometric mean over the photographs, so that the product of all is 1. There are
    none where a photograph does not tell seconds and ISO, or where all are the same. An f-number
    that none of them tells, as with old lenses, is taken to be the same.
    """
    said = {shot.name: shot.exposure for shot in shots if shot.exposure is not None}
    if said:
        return said, f"exposures: {_spread(said)}, by the source"
    taken = [shot for shot in shots if shot.coded or shot.raw]
    if not taken:
        return {}, "exposures: not told, photographs are taken for radiance in one unit"
    found = {shot.name: (_of_raw if shot.raw else _exif)(shot.image) for shot in taken}
    told = [values for values in found.values() if values is not None]
    if len(told) < len(shots):
        missing = "no photograph tells" if not told else f"{len(told)} of {len(shots)} tell"
        return {}, f"exposures: {missing} time and ISO in EXIF; all are taken to be the same"
    apertures = {name for name, values in found.items() if values and values[1] is not None}
    if apertures and len(apertures) < len(shots):
        few = f"{len(apertures)} of {len(shots)} tell"
        return {}, f"exposures: {few} an f-number in EXIF; all are taken to be the same"
    absolute = {
        name: values[0] / (values[1] or 1.0) ** 2 for name, values in found.items() if values
    }
    relative = _relative(absolute)
    if max(relative.values()) / min(relative.values()) < 1 + _SAME:
        return {}, "exposures: the same in all photographs, by EXIF"
    return relative, f"exposures: {_spread(relative)}, by EXIF"


def read_table(file: Path, shots: Sequence[Shot], faults: Faults) -> tuple[dict[str, float], str]:
    """Exposures from a table of comma separated `name,exposure`, and a line that tells of them.

    Names are those of images, with or without suffix, and folders at their beginning. A line of
    several photographs is a fault. Values are taken as they are.

    Args:
        file: the table, whose first line is `name,exposure`.
        shots: photographs, each of which needs a line.
        faults: all that is wrong is added to it.

    Raises:
        UserError: the file cannot be read.
    """
    # Excel's "CSV UTF-8" begins with a byte order mark
    lines = StringIO(read_text(file).removeprefix("\ufeff"))
    try:
        rows = list(csv.reader(lines))
    except csv.Error as error:
        raise UserError(f"the table cannot be read ({error})", file) from None
    header = tuple(cell.strip().lower() for cell in rows[0]) if rows else ()
    if header != _COLUMNS:
        faults.add(f"the first line of the table is not {','.join(_COLUMNS)}", file)
        return {}, ""
    table: dict[str, float] = {}
    for number, row in enumerate(rows[1:], 2):
        if not row:
            continue
        value = _positive(row[1]) if len(row) == 2 else None
        if value is None:
            faults.add("a line of the table is no name and positive number", f"line {number}")
        elif table.setdefault(row[0].strip(), value) != value:
            faults.add("the table has two exposures of a photograph", row[0].strip())
    used: dict[str, list[str]] = {}
    for name in dict.fromkeys(shot.name for shot in shots):
        key = _line_of(name, table)
        if key is None:
            faults.add("the table of exposures has no line for a photograph", name)
        else:
            used.setdefault(key, []).append(name)
    for key, names in used.items():
        if len(names) > 1:
            what = (
                f"the table of exposures has one line, {printable(key)!r}, for several photographs"
            )
            faults.add(what, named(names), "Name them with their folders and suffix")
    known = {name: table[key] for key, names in used.items() for name in names}
    return known, f"exposures: {_spread(known)}, by {file.name}" if known else ""


def _line_of(name: str, table: Mapping[str, float]) -> str | None:
    """What the table calls a photograph: the longest name first; None where it has no line."""
    keys = [str(key) for end in ends_of(name) for key in (end, end.with_suffix(""))]
    return next((key for key in (name, *keys) if key in table), None)


def _positive(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    low, high = MEASURABLE
    return value if low <= value <= high else None


def _relative(absolute: Mapping[str, float]) -> dict[str, float]:
    mean = math.exp(sum(map(math.log, absolute.values())) / len(absolute))
    return {name: value / mean for name, value in absolute.items()}


def _spread(exposures: Mapping[str, float]) -> str:
    low, high = min(exposures.values()), max(exposures.values())
    return f"{low:.3g} to {high:.3g} ({math.log2(high / low):.1f} stops apart)"


def _exif(image: Path) -> tuple[float, float | None] | None:
    """Seconds x ISO / 100, and the f-number; None where it is not told."""
    try:
        with opened(image) as file:
            tags = file.getexif().get_ifd(_DIRECTORY)
        seconds, iso = _value(tags.get(_SECONDS)), _value(tags.get(_ISO))
        aperture = _value(tags.get(_APERTURE))
    except UserError:
        raise
    except Exception:  # EXIF that is damaged raises whatever Pillow meets
        return None
    if seconds is None or iso is None:
        return None
    return seconds * iso / 100, aperture


def _of_raw(image: Path) -> tuple[float, float | None] | None:
    """The same of camera RAW."""
    try:
        seconds, iso, aperture = map(_value, raw_exposure(image))
    except UserError:  # that it cannot be read is told elsewhere
        return None
    return None if seconds is None or iso is None else (seconds * iso / 100, aperture)


def _value(tag: Any) -> float | None:
    """A positive number of a tag; some cameras write lists of one."""
    if isinstance(tag, tuple | list):
        tag = tag[0] if tag else None
    value = None if tag is None else float(tag)
    return value if value is not None and 0 < value < math.inf else None
