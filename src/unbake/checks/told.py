"""What was found of a data set, in a row a check: for a screen and for a page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..dataset.alignment import MARGIN
from ..dataset.findings import Check
from ..errors import printable
from .check import CheckedView, DataCheck
from .pictures import percentage

#: The checks in the order in which they are told, and those that each row stands for.
ROWS: dict[str, tuple[Check, ...]] = {
    "files": ("files", "size", "scene", "media", "masks", "hot pixels"),
    "geometry": ("geometry", "units", "normals"),
    "alignment": ("alignment",),
    "exposure": ("exposure",),
    "light": ("light",),
    "pixels": ("clipped", "black", "noise"),
    "blur": ("blur",),
    "coverage": ("coverage",),
    "duplicates": ("duplicates",),
}
_UNKNOWN = "cannot be told"


def told_rows(result: DataCheck) -> list[tuple[str, str, str]]:
    """Check, verdict and numbers; the verdict is ok, hint, warning, error or a dash."""
    numbers = {
        "files": _files(result),
        "geometry": _geometry(result),
        "alignment": _alignment(result),
        "exposure": _exposure(result),
        "light": _light(result),
        "pixels": _pixels(result),
        "blur": _blur(result),
        "coverage": _coverage(result),
        "duplicates": _duplicates(result),
    }
    rows = []
    for row, checks in ROWS.items():
        told = numbers[row]
        levels = {finding.level for finding in result.findings if finding.check in checks}
        verdict = next((level for level in ("error", "warning", "hint") if level in levels), None)
        if verdict is None:
            verdict = "ok" if told is not None else "—"
        rows.append((row, verdict, _UNKNOWN if told is None else told))
    return rows


def _files(result: DataCheck) -> str | None:
    if result.dataset is None:
        return None
    sizes = {(v.camera.width, v.camera.height) for v in result.dataset.views}
    size = " x ".join(map(str, next(iter(sizes)))) if len(sizes) == 1 else f"{len(sizes)} sizes of"
    train, heldout = len(result.dataset.train), len(result.dataset.heldout)
    return f"{train} training and {heldout} held-out views, {size} pixels"


def _geometry(result: DataCheck) -> str | None:
    views = [view for view in result.views if view.share is not None]
    if not views:
        return None
    shares = [view.share or 0.0 for view in views]
    worst = _lowest(views, shares)
    told = f"{100 * float(np.mean(shares)):.0f} % of the pixels see a surface"
    return told if min(shares) > 0.995 else f"{told}; {worst}: {100 * min(shares):.0f} %"


def _lowest(views: Sequence[CheckedView], values: Sequence[float]) -> str:
    return printable(views[int(np.argmin(values))].view.name, 24)


def _alignment(result: DataCheck) -> str | None:
    found = result.alignment
    if found is None:
        return None
    told = f"edges agree by {found.score:.2f}"
    if found.best is None:
        if found.score < MARGIN:
            return f"edges hardly agree ({found.score:.2f}): they tell nothing of poses"
        return f"{told}; no other poses or lenses are better"
    if found.focal is not None:
        return f"{told}, by {found.best:.2f} with focal lengths times {found.focal:.2f}"
    return f"{told}, by {found.best:.2f} with other poses"


def _exposure(result: DataCheck) -> str | None:
    if result.exposures is None or not result.exposures.pairs:
        return None
    return f"views differ by up to {result.exposures.spread:.2f} stops"


def _light(result: DataCheck) -> str | None:
    if result.light is None:
        return None
    share = 100 * result.light.explained
    return f"{share:.0f} % of what differs turns with the cameras"


def _pixels(result: DataCheck) -> str | None:
    if not result.views:
        return None
    clipped, black = (
        percentage(float(np.mean(values)))
        for values in (
            [v.facts.clipped for v in result.views],
            [v.facts.black for v in result.views],
        )
    )
    return f"{clipped} of those of surfaces clipped, {black} black"


def _blur(result: DataCheck) -> str | None:
    if sum(v.facts.detail is not None for v in result.views) < 4:
        return None
    soft = any(finding.check == "blur" for finding in result.findings)
    return "some views are less sharp" if soft else "all views are alike"


def _coverage(result: DataCheck) -> str | None:
    if result.coverage is None:
        return None
    none, one, two, more = (f"{100 * share:.0f}" for share in result.coverage)
    return f"unseen {none} %, by 1 view {one} %, by 2 views {two} %, by more {more} %"


def _duplicates(result: DataCheck) -> str | None:
    if not result.views:
        return None
    return f"{result.duplicates} pair{'s' * (result.duplicates != 1)}"
