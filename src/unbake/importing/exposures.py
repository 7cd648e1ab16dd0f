"""How much light photographs took, from their source, their EXIF or from a table."""

from __future__ import annotations

import csv
import math
from collections.abc import Collection, Mapping, Sequence
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
#: Stops from which on exposures that are not used differ noticeably; cameras have steps of a third.
_NOTICEABLE = 0.1

#: What a photograph tells: seconds x ISO / 100, and its f-number; None: it tells none.
_Told = tuple[float, float | None]


def exposures_of(shots: Sequence[Shot]) -> tuple[dict[str, float], str]:
    """Exposures by the names of photographs, and a line that tells of them.

    They are what the source says. Else EXIF tells: an exposure is seconds x ISO / 100 / f-number²,
    relative to the geometric mean over the photographs, so that the product of all is 1. There are
    none where a photograph does not tell seconds and ISO, or where all are the same. An f-number
    that none of them tells, as with old lenses, is taken to be the same. The line is a warning
    where some photographs tell nothing and the others differ.
    """
    said = {shot.name: shot.exposure for shot in shots if shot.exposure is not None}
    if said:
        return said, f"exposures: {_spread(said)}, by the source"
    taken = [shot for shot in shots if shot.coded or shot.raw]
    if not taken:
        return {}, "exposures: not told, photographs are taken for radiance in one unit"
    found = {shot.name: (_of_raw if shot.raw else _exif)(shot.image) for shot in taken}
    told = {name: values for name, values in found.items() if values is not None}
    if len(told) < len(shots):
        return {}, _lacking("time and ISO", told, told, shots)
    with_number = {name for name, (_, number) in told.items() if number is not None}
    if with_number and len(with_number) < len(shots):
        return {}, _lacking("an f-number", with_number, told, shots)
    absolute = {name: _exposure(values) for name, values in told.items()}
    relative = _relative(absolute)
    if max(relative.values()) / min(relative.values()) < 1 + _SAME:
        return {}, "exposures: the same in all photographs, by EXIF"
    return relative, f"exposures: {_spread(relative)}, by EXIF"


def _lacking(
    what: str, having: Collection[str], told: Mapping[str, _Told], shots: Sequence[Shot]
) -> str:
    """A line of exposures that are not used, as some photographs do not tell what they need.

    Args:
        what: they do not tell.
        having: names of those that tell it.
        told: what is known of photographs, by name.
        shots: all photographs.
    """
    same = "all are taken to be the same"
    if not having:
        return f"exposures: no photograph tells {what} in EXIF; {same}"
    line = f"exposures: {len(having)} of {len(shots)} tell {what} in EXIF"
    with_number = [_exposure(values) for values in told.values() if values[1] is not None]
    without = [_exposure(values) for values in told.values() if values[1] is None]
    stops = max(math.log2(max(group) / min(group)) for group in (with_number, without) if group)
    if stops < _NOTICEABLE:
        return f"{line}; {same}"
    others = named([shot.name for shot in shots if shot.name not in having])
    remedy = "Give a table with --exposures table.csv, or fit with --exposures per-image"
    apart = f"{same}, although some are {stops:.1f} stops apart"
    return f"warning: {line}, but not {others}; {apart}. {remedy}"


def _exposure(values: _Told) -> float:
    return values[0] / (values[1] or 1.0) ** 2


def read_table(file: Path, shots: Sequence[Shot], faults: Faults) -> tuple[dict[str, float], str]:
    """Exposures from a table of `name,exposure`, and a line that tells of them.

    Names are those of images, with or without suffix, and folders at their beginning. A line of
    several photographs is a fault. Values are taken as they are, and may be fractions (1/60).
    Columns may be separated by semicolons, as Excel does where numbers have a decimal comma.

    Args:
        file: the table, whose first line is `name,exposure` or `name;exposure`.
        shots: photographs, each of which needs a line.
        faults: all that is wrong is added to it.

    Raises:
        UserError: the file cannot be read.
    """
    # Excel's "CSV UTF-8" begins with a byte order mark
    text = read_text(file).removeprefix("\ufeff")
    semicolons = ";" in text.partition("\n")[0]
    try:
        rows = list(csv.reader(StringIO(text), delimiter=";" if semicolons else ","))
    except csv.Error as error:
        raise UserError(f"the table cannot be read ({error})", file) from None
    header = tuple(cell.strip().lower() for cell in rows[0]) if rows else ()
    if header != _COLUMNS:
        faults.add(f"the first line of the table is not {','.join(_COLUMNS)}", file)
        return {}, ""
    table: dict[str, float | None] = {}  # None: its line is a fault
    for number, row in enumerate(rows[1:], 2):
        if not any(cell.strip() for cell in row):
            continue
        name, value = row[0].strip(), None
        if len(row) == 2:
            value = _positive(row[1].replace(",", ".") if semicolons else row[1])
        if value is None:
            what = f"a line of the table {file.name} is no name and positive number"
            faults.add(what, f"line {number}", "Write numbers as 0.5 or 1/60")
            table.setdefault(name, None)
        elif table.setdefault(name, value) not in (None, value):
            faults.add(f"the table {file.name} has two exposures of a photograph", name)
    used: dict[str, list[str]] = {}
    for shot in {shot.name: shot for shot in shots}.values():
        key = _line_of(shot, table)
        if key is None:
            faults.add(f"the table {file.name} has no line for a photograph", shot.name)
        else:
            used.setdefault(key, []).append(shot.name)
    for key, names in used.items():
        if len(names) > 1:
            what = (
                f"the table {file.name} has one line, {printable(key)!r}, for several photographs"
            )
            faults.add(what, named(names), "Name them with their folders and suffix")
    values = {name: table[key] for key, names in used.items() for name in names}
    known = {name: value for name, value in values.items() if value is not None}
    return known, f"exposures: {_spread(known)}, by {file.name}" if known else ""


def _line_of(shot: Shot, table: Mapping[str, object]) -> str | None:
    """What the table calls a photograph: the longest name first; None where it has no line."""
    suffixes = (shot.image.suffix, "")
    keys = [
        str(key) for end in ends_of(shot.name) for key in (end, *map(end.with_suffix, suffixes))
    ]
    return next((key for key in (shot.name, *keys) if key in table), None)


def _positive(word: str) -> float | None:
    """A positive number, or a fraction, as cameras show times; None: it is neither."""
    try:
        top, *bottom = map(float, word.split("/"))
        value = top / bottom[0] if bottom else top
    except (ValueError, ZeroDivisionError):
        return None
    if len(bottom) > 1:
        return None
    low, high = MEASURABLE
    return value if low <= value <= high else None


def _relative(absolute: Mapping[str, float]) -> dict[str, float]:
    mean = math.exp(sum(map(math.log, absolute.values())) / len(absolute))
    return {name: value / mean for name, value in absolute.items()}


def _spread(exposures: Mapping[str, float]) -> str:
    low, high = min(exposures.values()), max(exposures.values())
    return f"{low:.3g} to {high:.3g} ({math.log2(high / low):.1f} stops apart)"


def _exif(image: Path) -> _Told | None:
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


def _of_raw(image: Path) -> _Told | None:
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
