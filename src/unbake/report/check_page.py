"""One self-contained HTML page of what `unbake data check` found."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jinja2
import mitsuba as mi
import numpy as np

from ..checks.check import CheckedView, DataCheck
from ..checks.pictures import percentage
from ..checks.told import told_rows
from ..dataset.alignment import geometry_edges
from ..dataset.camera import Camera
from ..dataset.small_views import seen_by, small_view
from ..dataset.spread import evenly
from ..dataset.views import read_masked
from ..imaging import pictures
from ..io import write_text
from . import charts, display

TEMPLATE = Path(__file__).with_name("check.html.jinja")
#: Pixels along the longer side of an overlay, and views that have one.
_LONGEST, _MOST = 400, 12
#: Strength from which on an edge is drawn, and its colour, 8-bit sRGB.
_EDGE, _COLOUR = 0.25, (255, 90, 0)
#: Width of a bar of the histogram in stops, and bars on either side of the middle.
_STOPS, _BARS = 0.25, 12


def write_check(result: DataCheck, out: str | Path, *, clip_negative: bool = False) -> Path:
    """Write the page; it contains its pictures and loads nothing from elsewhere.

    Args:
        result: of the check.
        out: the page's file; it appears complete or not at all.
        clip_negative: as in the check.

    Returns:
        `out`.

    Raises:
        UserError: the page cannot be written, or a photograph was removed meanwhile.
    """
    out = Path(out)
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(TEMPLATE.read_text(encoding="utf-8"))
    page = template.render(
        result=result,
        name=result.folder.absolute().name,
        rows=told_rows(result),
        overlays=_overlays(result, clip_negative),
        exposures=_histogram(result),
        views=[_row(result, i) for i in range(len(result.views))],
        colours=charts.COLOURS,
        edge=_COLOUR,
    )
    write_text(out, page)
    return out


def _row(result: DataCheck, number: int) -> dict[str, Any]:
    """A view's numbers, as text."""
    view = result.views[number]
    stops = None if result.exposures is None else float(result.exposures.stops[number])
    return {
        "name": view.view.name,
        "split": view.view.split,
        "size": f"{view.view.camera.width} x {view.view.camera.height}",
        "share": display.DASH if view.share is None else f"{100 * view.share:.0f} %",
        "stops": display.DASH if stops is None or np.isnan(stops) else f"{stops:+.2f}",
        "clipped": percentage(view.facts.clipped),
        "black": percentage(view.facts.black),
        "detail": display.DASH if view.facts.detail is None else f"{view.facts.detail:+.2f}",
    }


def _overlays(result: DataCheck, clip_negative: bool) -> list[dict[str, Any]]:
    """Photographs with the edges of the geometry, as posed and as posed better."""
    if result.scene is None or not result.views:
        return []
    views = evenly(result.views, _MOST)
    exposure = pictures.fitting_exposure([pictures.sample(v.small.rgb.mean(axis=2)) for v in views])
    mistake = result.alignment.mistake if result.alignment is not None else None
    return [_overlay(result.scene, view, exposure, mistake, clip_negative) for view in views]


def _overlay(
    scene: mi.Scene, view: CheckedView, exposure: float, mistake: Any, clip_negative: bool
) -> dict[str, Any]:
    camera = view.view.camera
    pixels = read_masked(view.view, clip_negative)[0].reshape(-1, 4)
    small = small_view(view.view.name, camera, pixels[:, :3], None, _LONGEST)
    shown = pictures.tonemap(small.rgb, exposure)
    better = None
    if mistake is not None:
        better = _drawn(scene, mistake.corrected(small.camera), shown)
    return {
        "name": view.view.name,
        "width": small.camera.width,
        "height": small.camera.height,
        "photograph": pictures.png_data_uri(shown),
        "given": _drawn(scene, small.camera, shown),
        "better": better,
    }


def _drawn(scene: mi.Scene, camera: Camera, picture: np.ndarray) -> str:
    """A darkened picture with the edges that a camera sees."""
    (seen,) = seen_by(scene, [camera])
    edges = geometry_edges(camera, seen.distance, seen.normal, blurred=False)
    strength = np.clip((edges - _EDGE) / _EDGE, 0, 1)[..., None]
    mixed = (1 - strength) * 0.75 * picture + strength * np.array(_COLOUR)
    return pictures.png_data_uri(np.round(mixed).astype(np.uint8))


def _histogram(result: DataCheck) -> list[dict[str, Any]]:
    """Views by exposure, in bars of a quarter of a stop."""
    if result.exposures is None:
        return []
    known = result.exposures.stops[np.isfinite(result.exposures.stops)]
    if not len(known):
        return []
    bar = np.clip(np.round(known / _STOPS), -_BARS, _BARS).astype(int)
    first, last = min(int(bar.min()), -2), max(int(bar.max()), 2)
    counts = np.bincount(bar - first, minlength=last - first + 1)
    return [
        {"stops": f"{_STOPS * (first + i):+.2f}", "count": int(n), "share": n / counts.max()}
        for i, n in enumerate(counts)
    ]
