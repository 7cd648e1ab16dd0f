"""Run folders and their data, read back for a report: numbers, settings, log, views."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, final

import numpy as np

from unbake.errors import UserError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

TRUTHS = ("albedo", "roughness")
TRAINING_VIEWS = 4  # what was trained on says little about quality; a few views show overfitting


@final
@dataclass(frozen=True)
class Run:
    """What one run folder says about itself; `label` is its name on the page."""

    path: Path
    label: str
    metrics: dict[str, Any]
    config: dict[str, Any]
    log: list[dict[str, Any]]

    def optimizes(self, quantity: str) -> bool:
        """Whether the run has pictures or numbers of a quantity, rather than knew it."""
        unknown = str(self.metrics.get("unknown", "materials"))
        match quantity:
            case "render":
                return True
            case "environment":
                return "lighting" in unknown
            case "emission":
                return unknown == "emission"
            case _:
                return "materials" in unknown

    def view(self, name: str) -> dict[str, Any]:
        """The numbers of one view; empty where this run was not evaluated on it."""
        return next((row for row in self.metrics["per_view"] if row["name"] == name), {})


@final
@dataclass(frozen=True)
class View:
    """One posed picture of the data; `truth` lacks the quantities nobody knows."""

    name: str
    split: str
    truth: dict[str, Path]


def labels(runs: Sequence[Path]) -> list[tuple[Path, str]]:
    """Folder names; where two are alike, as many parent folders before them as tell them apart."""
    paths = [Path(run).resolve() for run in runs]
    if len(set(paths)) < len(paths):
        raise UserError("a run is given twice", remedy="Name each run folder once")
    depth = 1
    while len({path.parts[-depth:] for path in paths}) < len(paths):
        depth += 1
    return [
        (Path(run), "/".join(path.parts[-depth:])) for run, path in zip(runs, paths, strict=True)
    ]


def read_run(path: Path, label: str) -> Run:
    """Read an evaluated run folder: its metrics, settings (keys dotted) and log.

    Raises:
        UserError: it was not evaluated, or a file is missing or malformed.
    """
    metrics_file = path / "evaluation" / "metrics.json"
    evaluate = f"Run `unbake evaluate {path}`"
    metrics = read_json(metrics_file, evaluate)
    for key, kind in {"method": str, "data": str, "per_view": list}.items():
        if not isinstance(metrics.get(key), kind):
            raise UserError(f"`{key}` is missing or of the wrong type", metrics_file, evaluate)
    if not all(isinstance(row, dict) and "name" in row for row in metrics["per_view"]):
        raise UserError("a view of `per_view` has no name", metrics_file, evaluate)
    for key, kind in {"environment": dict, "emission": list}.items():
        if not isinstance(metrics.get(key), kind | None):
            raise UserError(f"`{key}` is of the wrong type", metrics_file, evaluate)
    lights = metrics.get("emission") or ()
    if not all(isinstance(row, dict) and isinstance(row.get("name"), str) for row in lights):
        raise UserError("a light of `emission` has no name", metrics_file, evaluate)
    if metrics.get("unknown") == "emission" and not lights:
        raise UserError("`emission` has no light", metrics_file, evaluate)
    config_file = path / "config.toml"
    try:
        config = tomllib.loads(config_file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UserError(
            f"the settings cannot be read ({error})", config_file, "Give the folder of a run"
        ) from error
    return Run(path, label, metrics, dict(_flatten(config)), read_log(path / "log.jsonl"))


def read_json(path: Path, remedy: str) -> dict[str, Any]:
    """Read a JSON object; the UserError of a missing or malformed file names `remedy`."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise UserError("there is no such file", path, remedy) from error
    except (OSError, ValueError) as error:
        raise UserError(f"the file cannot be read ({error})", path, remedy) from error
    if not isinstance(content, dict):
        raise UserError("the file does not hold a JSON object", path, remedy)
    return content


def read_log(path: Path) -> list[dict[str, Any]]:
    """The log's lines; a torn last line, as a killed run leaves it, is left out.

    Raises:
        UserError: there is no log, or a line before the last is not JSON.
    """
    if not path.is_file():
        raise UserError("the run has no log", path, "Give the folder of a run")
    texts = [text for text in path.read_text(encoding="utf-8").splitlines() if text.strip()]
    lines = []
    for number, text in enumerate(texts, start=1):
        try:
            lines.append(json.loads(text))
        except ValueError as error:
            if number < len(texts):
                raise UserError(f"line {number} is not JSON", path) from error
    return [line for line in lines if isinstance(line, dict)]


def data_folder(runs: list[Run]) -> Path:
    """The one data set that all runs were evaluated on; UserError where they differ or it is gone.

    A relative `data` in metrics.json starts at the run folder.
    """
    folders = [(run.path / run.metrics["data"]).resolve() for run in runs]
    for run, folder in zip(runs, folders, strict=True):
        if folder != folders[0]:
            raise UserError(
                f"this run was evaluated on other data than {runs[0].path}",
                run.path,
                "Write one report for each data set",
            )
    if not folders[0].is_dir():
        raise UserError(
            f"the data this run was evaluated on is gone ({folders[0]})",
            runs[0].path,
            f"Put it back, or run `unbake evaluate {runs[0].path}` on its new place",
        )
    return folders[0]


def read_views(data: Path, transforms: dict[str, Any], runs: list[Run]) -> list[View]:
    """Every evaluated held-out view, then at most four training views, evenly spaced.

    Raises:
        UserError: a view was evaluated that the data lacks, or a path leads out of the data.
    """
    evaluated = {row["name"] for run in runs for row in run.metrics["per_view"]}
    frames = transforms.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise UserError("`frames` is missing or not a list of frames", data / "transforms.json")
    views = [view for view in (_view(data, f) for f in frames) if view.name in evaluated]
    unknown = evaluated - {view.name for view in views}
    if unknown:
        raise UserError(
            f"the data has no view named {sorted(unknown)[0]}, which was evaluated",
            data / "transforms.json",
            f"Run `unbake evaluate {runs[0].path}` again",
        )
    training = [view for view in views if view.split == "train"]
    if len(training) > TRAINING_VIEWS:
        chosen = np.linspace(0, len(training) - 1, TRAINING_VIEWS).round().astype(int)
        training = [training[i] for i in chosen]
    return [view for view in views if view.split == "heldout"] + training


def _view(data: Path, frame: dict[str, Any]) -> View:
    file = PurePosixPath(str(frame.get("file_path", "")))
    if not file.name or file.is_absolute() or ".." in file.parts:
        raise UserError(
            f"`file_path` {str(file)!r} does not lie inside the data", data / "transforms.json"
        )
    known = {kind: data / "truth" / kind / f"{file.stem}.exr" for kind in TRUTHS}
    truth = {kind: path for kind, path in known.items() if path.is_file()}
    return View(file.stem, frame.get("split", "train"), {"render": data / file, **truth})


def _flatten(table: dict[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
