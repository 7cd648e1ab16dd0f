"""The page's section on cameras: exposures, white balances and places that were fitted."""

from __future__ import annotations

from typing import Any

from unbake.report import display
from unbake.report.runs import EvaluatedRun

#: Numbers of an image: column and format.
_COLUMNS = {
    "stops": ("Exposure, stops", "{:+.2f}"),
    "red": ("Red", "{:.3f}"),
    "blue": ("Blue", "{:.3f}"),
    "pixels": ("Moved, pixels", "{:.2f}"),
    "degrees": ("Turned, degrees", "{:.3f}"),
    "shift": ("Shifted, world units", "{:.4f}"),
}
_LENS = {"fl_x": "focal length", "cx": "cx", "cy": "cy"}
_CHANNELS = ("red", "green", "blue")


def camera_section(runs: list[EvaluatedRun]) -> dict[str, Any] | None:
    """The contents of the section; None if no run fitted anything of its cameras.

    `columns` and `rows` are of images, with a cell for each run and column; `lines` tell what all
    images of a run share.
    """
    said = [run.metrics.get("camera") or {} for run in runs]
    if not any(said):
        return None
    images = [{row["name"]: row for row in found.get("images") or ()} for found in said]
    columns = [
        {"run": i, "key": key, "title": title}
        for i, named in enumerate(images)
        for key, (title, _) in _COLUMNS.items()
        if any(key in row for row in named.values())
    ]
    rows = []
    for name in dict.fromkeys(name for named in images for name in named):
        known = next(named[name] for named in images if name in named)
        cells = [
            _text(images[c["run"]].get(name, {}).get(c["key"]), _COLUMNS[c["key"]][1])
            for c in columns
        ]
        rows.append({"name": name, "split": known.get("split", ""), "cells": cells})
    lines = [
        (run.label, line) for run, found in zip(runs, said, strict=True) for line in _of(found)
    ]
    return {"columns": columns, "rows": rows, "lines": lines}


def _of(found: dict[str, Any]) -> list[str]:
    """What all images of a run share."""
    told = []
    if balance := found.get("white_balance"):
        red, blue = (_text(balance.get(key), "{:.3f}") for key in ("red", "blue"))
        told.append(f"white balance: red {red}, blue {blue}, relative to green")
    if terms := found.get("vignetting"):
        a, b, c = (_text(terms.get(key), "{:+.3f}") for key in "abc")
        told.append(f"vignetting: 1 {a} r² {b} r⁴ {c} r⁶")
    if curves := found.get("response"):
        known = [curve for curve in map(curves.get, _CHANNELS) if curve]
        dark, white = (
            ", ".join(_text(curve[place * (len(curve) - 1) // 4], "{:.3f}") for curve in known)
            for place in (1, 4)
        )
        what = "response: f(u^2.2)^(1/2.2) of red, green, blue"
        told.append(f"{what} is {dark} at u = 0.25, and {white} at u = 1")
    if found.get("moved_pixels") is not None:
        told.append(f"poses: corrected by {_text(found['moved_pixels'], '{:.2f}')} pixels")
    for lens in found.get("intrinsics") or ():
        pairs = {title: [lens.get(k) for k in (key, f"told_{key}")] for key, title in _LENS.items()}
        values = (
            f"{title} {_text(now, '{:.3f}')} (told {_text(told_, '{:.3f}')})"
            for title, (now, told_) in pairs.items()
        )
        told.append(f"intrinsics: {', '.join(values)}")
    return told


def _text(value: object, form: str) -> str:
    known = display.number(value)
    return display.DASH if known is None else form.format(known).replace("-", "−")
