"""Charts of a run's log: matplotlib figures, and the SVG of them that a page holds.

matplotlib is imported by the functions that draw: its import takes longer than `unbake --help`.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, final
from xml.etree import ElementTree

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axis import YAxis
    from matplotlib.figure import Figure

#: CSS variables of the page and their colours in light mode, which are those of the figures.
COLOURS = {
    "soft": "#615e58", "hair": "#ebe8e1",
    "c0": "#1f62b0", "c1": "#c8500f", "c2": "#12806a", "c3": "#8f3aa8",
    "c4": "#96700a", "c5": "#4f5b6b", "c6": "#c01c4a", "c7": "#557a12",
}  # fmt: skip
BINS = 120  # more points than this are summarised, one point a bin
_RUNS = 8  # colours of runs; further runs have the same ones and dashed curves
_SIZE = (400, 250)  # pixels
_EDGES = {"left": 50 / 400, "right": 388 / 400, "bottom": 38 / 250, "top": 240 / 250}
_TICKS = 6  # wanted on a linear axis
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_STYLE = {
    "axes.edgecolor": COLOURS["soft"],
    "axes.axisbelow": True,
    "axes.spines.left": False,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.labelcolor": COLOURS["soft"],
    "font.size": 12,
    "grid.color": COLOURS["hair"],
    "grid.linewidth": 1,
    "lines.linewidth": 1.7,
    "lines.markersize": 5.2,
    "xtick.color": COLOURS["soft"],
    "ytick.color": COLOURS["soft"],
    "ytick.major.size": 0,
    "ytick.minor.size": 0,
    # Text stays text, in the font of the page.
    "svg.fonttype": "none",
}

Record = dict[str, Any]


@final
@dataclass(frozen=True)
class _Curve:
    """Points of one run, with a lower and an upper edge where several were summarised."""

    run: int
    x: np.ndarray
    y: np.ndarray
    low: np.ndarray | None
    high: np.ndarray | None

    def positive(self) -> _Curve:
        """What a logarithmic axis can show of it."""
        kept = self.y > 0
        x, y = self.x[kept], self.y[kept]
        if self.low is None or self.high is None or not kept.any():
            return _Curve(self.run, x, y, None, None)
        low, high = self.low[kept], self.high[kept]
        edges = np.concatenate([y, low, high])
        floor = edges[edges > 0].min()
        return _Curve(self.run, x, y, np.maximum(low, floor), np.maximum(high, floor))


def chart(
    logs: Sequence[list[Record]],
    x_key: str,
    x_title: str,
    y_of: Callable[[Record], object],
    logarithmic: bool,
) -> Figure | None:
    """Draw one quantity of several logs over steps or seconds.

    More than 120 points of a run are summarised in equal intervals of x: the line is their mean,
    the band reaches from their 10th to their 90th percentile. Means are arithmetic on a logarithmic
    axis, too: estimates without bias may be below zero, and stay so only in their mean.

    Args:
        logs: one list of log records a run.
        x_key: the key of the x value in a record.
        x_title: the x axis' title with its unit.
        y_of: gives a record's value; what is no finite number is left out.
        logarithmic: whether y is logarithmic; points that are not positive are then left out, and
            a band whose lower edge is not positive reaches down to the lowest number of its curve.

    Returns:
        A figure whose curves have the group ids `run-0`, `run-1`, …; None where no run has a value
        that the axis can show.
    """
    curves = [_curve(run, log, x_key, y_of) for run, log in enumerate(logs)]
    if logarithmic:
        curves = [curve.positive() for curve in curves]
    curves = [curve for curve in curves if len(curve.x)]
    return _draw(curves, x_title, logarithmic) if curves else None


def not_positive(
    logs: Sequence[list[Record]], x_key: str, y_of: Callable[[Record], object]
) -> list[tuple[int, int]]:
    """How many points of each run a chart with a logarithmic axis leaves out, and of how many."""
    curves = [_curve(run, log, x_key, y_of) for run, log in enumerate(logs)]
    return [(int(np.count_nonzero(curve.y <= 0)), len(curve.y)) for curve in curves]


def inline_svg(figure: Figure, title: str, labels: Sequence[str]) -> str:
    """A figure as an `<svg>` element for the page, the same for the same figure.

    Colours become the page's CSS variables, so that they follow its light and dark mode, and fonts
    are left to the page.

    Args:
        figure: from `chart`.
        title: names the chart to screen readers, and makes ids unique on the page.
        labels: names of the runs, told where the mouse is on a curve.
    """
    file = io.StringIO()
    with _style({"svg.hashsalt": title}):
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(file, format="svg", transparent=True, metadata=nothing)
    root = ElementTree.fromstring(file.getvalue())
    for element in root.iter():
        _for_html(element)
    for parent in list(root.iter()):
        for child in list(parent):
            # A style element would hold for the whole page.
            if child.tag in ("metadata", "style"):
                parent.remove(child)
    for element in root.iter():
        run = re.fullmatch(r"run-(\d+)", element.get("id", ""))
        if run:
            name = ElementTree.Element("title")
            name.text = labels[int(run[1])]
            element.insert(0, name)
    _without_unused_ids(root)
    root.attrib = {"viewBox": root.get("viewBox", ""), "role": "img", "aria-label": title}
    name = ElementTree.Element("title")
    name.text = title
    root.insert(0, name)
    return ElementTree.tostring(root, encoding="unicode")


def _curve(run: int, log: list[Record], x_key: str, y_of: Callable[[Record], object]) -> _Curve:
    """The points of a run, summarised where they are many."""
    return _summarise(run, *_points(log, x_key, y_of))


def _points(
    log: list[Record], x_key: str, y_of: Callable[[Record], object]
) -> tuple[np.ndarray, np.ndarray]:
    """Finite points in the order of x.

    A run that went on from a checkpoint repeats steps: the last record of an x counts.
    """
    points: dict[float, float] = {}
    for record in log:
        x, y = record.get(x_key), y_of(record)
        if not (isinstance(x, int | float) and isinstance(y, int | float)):
            continue
        if math.isfinite(x) and math.isfinite(y):
            points[float(x)] = float(y)
    ordered = sorted(points.items())
    return np.array([x for x, _ in ordered]), np.array([y for _, y in ordered])


def _summarise(run: int, x: np.ndarray, y: np.ndarray) -> _Curve:
    if len(x) <= BINS:
        return _Curve(run, x, y, None, None)
    edges = np.linspace(x[0], x[-1], BINS + 1)
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, BINS - 1)
    groups = [index == i for i in np.unique(index)]
    mean, low, high = np.array([(y[g].mean(), *np.percentile(y[g], (10, 90))) for g in groups]).T
    return _Curve(run, np.array([x[g].mean() for g in groups]), mean, low, high)


def _draw(curves: list[_Curve], x_title: str, logarithmic: bool) -> Figure:
    with _style({}):
        from matplotlib.figure import Figure
        from matplotlib.ticker import FuncFormatter, MaxNLocator

        # One unit of the SVG is a 72nd of an inch to matplotlib and a pixel to the page.
        figure = Figure(figsize=(_SIZE[0] / 72, _SIZE[1] / 72), dpi=72)
        axes = figure.add_axes(_axes_rectangle())
        for curve in curves:
            colour = COLOURS[f"c{curve.run % _RUNS}"]
            # Nothing lies outside the axes, and clip paths are references by url.
            if curve.low is not None and curve.high is not None:
                band = {"color": colour, "alpha": 0.14, "linewidth": 0, "clip_on": False}
                axes.fill_between(curve.x, curve.low, curve.high, **band)
            dashes = "--" if curve.run >= _RUNS else "-"
            (line,) = axes.plot(curve.x, curve.y, dashes, color=colour, clip_on=False)
            line.set(marker="o", markevery=[len(curve.x) - 1], gid=f"run-{curve.run}")
            line.set(solid_joinstyle="round", solid_capstyle="round", markeredgewidth=0)
        first = min(0.0, min(float(c.x.min()) for c in curves))
        last = max(float(c.x.max()) for c in curves)
        axes.set_xlim(first, last if last > first else first + 1)
        axes.set_xlabel(x_title)
        axes.xaxis.set_major_locator(MaxNLocator(_TICKS, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
        axes.grid(axis="y", clip_on=False)
        axes.margins(y=0.05)
        axes.autoscale(axis="y")
        if logarithmic:
            axes.set_yscale("log")
            _decades(axes.yaxis)
        else:
            axes.yaxis.set_major_locator(MaxNLocator(_TICKS, steps=[1, 2, 5, 10]))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _short(value)))
    return figure


def _axes_rectangle() -> tuple[float, float, float, float]:
    e = _EDGES
    return e["left"], e["bottom"], e["right"] - e["left"], e["top"] - e["bottom"]


def _decades(axis: YAxis) -> None:
    """Ticks of a logarithmic axis: powers of ten, and 2 and 5 times them where few fit."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    low, high = np.log10(axis.get_view_interval())
    if high - low > 2:
        axis.set_major_locator(LogLocator(numticks=8))
    elif high - low > 0.7:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    else:
        axis.set_major_locator(MaxNLocator(_TICKS, steps=[1, 2, 5, 10]))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: _power(value)))


def _power(value: float) -> str:
    if 1e-3 <= value < 1e4:
        return f"{value:g}"
    factor, exponent = f"{value:e}".split("e")
    power = "10" + str(int(exponent)).translate(_SUPERSCRIPTS)
    return power if float(factor) == 1 else f"{float(factor):g}·{power}"


def _short(value: float) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g} M"
    text = f"{value:g}" if abs(value) < 1e4 else f"{value:,.0f}".replace(",", "\u202f")
    return text.replace("-", "−")


@contextmanager
def _style(more: dict[str, Any]) -> Iterator[None]:
    """Draw with the defaults of matplotlib and our style, whatever a user's matplotlibrc says."""
    from matplotlib import style

    with style.context(["default", _STYLE | more], after_reset=True):
        yield


def _for_html(element: ElementTree.Element) -> None:
    """Drop namespaces, fonts, white space and digits; colours become CSS variables."""
    element.tag = element.tag.rpartition("}")[2]
    element.attrib = {key.rpartition("}")[2]: v for key, v in element.attrib.items()}
    if "style" in element.attrib:
        style = "; ".join(s for s in element.attrib["style"].split("; ") if "font" not in s)
        for variable, colour in COLOURS.items():
            style = style.replace(colour, f"var(--{variable})")
        element.set("style", style)
    for key in {"d", "x", "y"} & set(element.attrib):
        coordinates = re.sub(r"\d+\.\d+", lambda m: f"{float(m[0]):.2f}", element.attrib[key])
        element.set(key, coordinates.strip().replace("  ", " "))
    element.tail = None
    if element.tag != "text":
        element.text = None


def _without_unused_ids(root: ElementTree.Element) -> None:
    used = {element.get("href", "")[1:] for element in root.iter()}
    for element in root.iter():
        if element.get("id") not in used:
            element.attrib.pop("id", None)
