"""Figure 3: the step time of every method on each scene."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..acquisition.settings import CaptureSettings
from ..comparison.bench_methods import bench_methods
from ..comparison.method_variant import MethodVariant
from ..config import FitConfig
from .experiment import Experiment, ExperimentContext, ExperimentResult, save_figure
from .jobs import Findings, Job
from .scenes import PaperScene, scenes_at
from .tables import markdown

#: By name. Methods that follow paths are measured with both estimators: two passes, as in Mitsuba,
#: and split halves in one pass. The others have one pass, too.
METHODS = {
    "ours": MethodVariant("ours"),
    "no prior": MethodVariant("no-prior"),
    "direct": MethodVariant("direct"),
    "PRB": MethodVariant("prb", estimator="two-pass"),
    "PRB, split halves": MethodVariant("prb", estimator="split-halves"),
    "AD-PT": MethodVariant("ad-pt", estimator="two-pass"),
    "AD-PT, split halves": MethodVariant("ad-pt", estimator="split-halves"),
}
#: Seconds per step, read off the bars of the paper (RTX 3090).
PUBLISHED: Mapping[str, Mapping[str, float]] = {
    "STAIRCASE": {"ours": 0.86, "PRB": 3.2, "AD-PT": 2.55, "no prior": 0.78, "direct": 0.53},
    "LIVING ROOM": {"ours": 0.78, "PRB": 1.7, "AD-PT": 1.55},
    "KITCHEN": {"ours": 0.76, "PRB": 1.9, "AD-PT": 1.6},
    "VEACH DOOR": {"ours": 0.69, "PRB": 0.9, "AD-PT": 1.0},
    "LEGO": {"ours": 1.5, "PRB": 3.5, "AD-PT": 2.6},
    "HOTDOG": {"ours": 0.68, "PRB": 0.85, "AD-PT": 0.75},
    "FICUS": {"ours": 0.71, "PRB": 0.58, "AD-PT": 0.45},
}


def _jobs(context: ExperimentContext) -> list[Job]:
    steps = context.pick(4, 24, 60)
    jobs = []
    for scene in scenes_at(context):
        scene.require(context)
        # The step time does not depend on the noise of the photographs, but on their resolution,
        # which fields are as fine as.
        shots = dataclasses.replace(scene.capture_settings(context), spp=1)
        config = scene.settings(context)
        jobs.append(
            Job(
                scene.folder,
                {"steps": steps, "methods": [v.name for v in METHODS.values()]}
                | {"fit": dataclasses.asdict(config)}
                | scene.described(context, shots),
                functools.partial(_measure, context, scene, shots, config, steps),
                context.pick(25.0, 130.0, None),
            )
        )
    return jobs


def _measure(
    context: ExperimentContext,
    scene: PaperScene,
    shots: CaptureSettings,
    config: FitConfig,
    steps: int,
) -> Findings:
    data = scene.captured(context, shots)
    variants = list(METHODS.values())
    result = bench_methods(data, variants, config, steps, None, context.console)
    kept = ("milliseconds_per_step", "path_depth", "estimator", "error")
    rows = zip(METHODS, result["rows"], strict=True)
    return {name: {k: row[k] for k in kept if k in row} for name, row in rows}


def _result(context: ExperimentContext, findings: Mapping[str, Findings]) -> ExperimentResult:
    rows, lines = [], []
    for scene in scenes_at(context):
        measured, published = findings[scene.folder], PUBLISHED.get(scene.name, {})
        times = {name: measured[name].get("milliseconds_per_step") for name in METHODS}
        ours, cells = times["ours"], []
        for name in METHODS:
            row = {"scene": scene.label, "method": name, "milliseconds": times[name]}
            row |= {key: measured[name].get(key) for key in ("estimator", "path_depth")}
            if times[name] and ours:
                row["times_ours"] = times[name] / ours
            if name in published:
                row["published_times_ours"] = published[name] / published["ours"]
            rows.append(row | {"error": measured[name].get("error")})
            if name != "ours":
                cells.append(_ratio(row))
        depth = measured["PRB"].get("path_depth")
        lines.append([scene.label, depth, "failed" if ours is None else f"{ours:.0f} ms", *cells])
    others = [f"{name} / ours" for name in METHODS if name != "ours"]
    caption = (
        "PRB and AD-PT have two passes, as in Mitsuba, or split halves in one pass; the others "
        "have one pass. In brackets: the bars of the paper, on its scenes "
        "and an RTX 3090, with two passes and a depth of 15.\n\n"
    )
    table = markdown(["scene", "path depth", "ours", *others], lines)
    return ExperimentResult(rows, caption + table, lambda path: _draw(path, rows))


def _ratio(row: Mapping[str, Any]) -> str:
    text = f"{row['times_ours']:.2f}" if "times_ours" in row else "failed"
    if "published_times_ours" not in row:
        return text
    return f"{text} ({row['published_times_ours']:.2f})"


def _draw(path: Path, rows: list[dict]) -> None:
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure = Figure(figsize=(1.2 + 1.4 * len(scenes), 3), layout="constrained")
    width = 0.85 / len(METHODS)
    panel = figure.subplots()
    for number, method in enumerate(METHODS):
        at = {
            scenes.index(row["scene"]) + width * (number - (len(METHODS) - 1) / 2): row
            for row in rows
            if row["method"] == method
        }
        measured = {x: row["times_ours"] for x, row in at.items() if "times_ours" in row}
        panel.bar(list(measured), list(measured.values()), 0.9 * width, label=method)
        published = {
            x: row["published_times_ours"] for x, row in at.items() if "published_times_ours" in row
        }
        panel.plot(list(published), list(published.values()), "k_", markersize=7)
    panel.set_xticks(range(len(scenes)), scenes, fontsize=7)
    panel.set_ylabel("step time / ours\n(–: the paper)")
    panel.legend(fontsize=7)
    save_figure(figure, path)


EXPERIMENT = Experiment("fig3", "Step time by scene (Fig. 3)", _jobs, _result, by_scene=True)
