"""Run folders and their data, read back for a report: numbers, settings, log, views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from unbake.config.tables import flattened
from unbake.dataset.spread import evenly
from unbake.dataset.views import Dataset, View
from unbake.errors import UserError, printable, quoted
from unbake.quantities import DEFAULT_QUANTITIES
from unbake.training.run_folder import RunFolder

#: Splits of the data in the order of the page.
SHOWN_SPLITS = ("heldout", "train")
#: The setting of which only methods with a radiance field make use.
_SEARCHES = "roughness_search.times"
TRAINING_VIEWS = 4  # shown on a page: a few suffice to see overfitting
#: Of held-out views: most; least; and pictures of views of all runs, as all are in one file.
HELDOUT_VIEWS, FEWEST_HELDOUT, HELDOUT_PICTURES = 24, 4, 48


@final
@dataclass(frozen=True)
class EvaluatedRun:
    """The contents of an evaluated run folder; `label` is its name on the page.

    A run of no steps has untrained fields, and an empty log.
    """

    folder: RunFolder
    label: str
    metrics: dict[str, Any]
    config: dict[str, Any]
    log: list[dict[str, Any]]
    taken: int  #: steps that the log tells of; more than were evaluated where the fit went on
    machines: tuple[Mapping[str, Any], ...] = ()  #: that took the steps; empty: nobody wrote it

    @property
    def untrained(self) -> bool:
        """Whether nothing was learned."""
        return self.metrics.get("steps") == 0

    def setting(self, key: str) -> Any:
        """A setting by its dotted key, None where the run has none; searches as they are made."""
        value = self.config.get(key)
        searches = self.metrics.get("radiance", "") is not None  # old runs do not tell
        return 0 if key == _SEARCHES and value and not searches else value

    def optimizes(self, quantity: str) -> bool:
        """Whether a quantity was unknown to the run, so that it has images or numbers of it."""
        unknown = str(self.metrics.get("unknown", "materials"))
        match quantity:
            case "render":
                return True
            case "environment":
                return "lighting" in unknown
            case "emission":
                return "emission" in unknown
            case _:
                known = self.metrics.get("quantities", DEFAULT_QUANTITIES)
                return "materials" in unknown and quantity in known

    def view(self, name: str) -> dict[str, Any]:
        """The numbers of one view; empty where this run was not evaluated on it."""
        return next((row for row in self.metrics["per_view"] if row["name"] == name), {})


@final
@dataclass(frozen=True)
class ShownView:
    """One posed image of the data set; `truth` holds the quantities that have ground truth."""

    name: str
    split: str
    truth: dict[str, Path]
    source: View


def labels(runs: Sequence[str | Path]) -> list[tuple[Path, str]]:
    """Folder names, preceded by as many parent folders as make them unique."""
    paths = [Path(run).resolve() for run in runs]
    if len(set(paths)) < len(paths):
        raise UserError("a run is given twice", remedy="Name each run folder once")
    depth = 1
    while len({path.parts[-depth:] for path in paths}) < len(paths):
        depth += 1
    return [
        (Path(run), "/".join(path.parts[-depth:])) for run, path in zip(runs, paths, strict=True)
    ]


def read_run(path: Path, label: str) -> EvaluatedRun:
    """Read an evaluated run folder: its metrics, settings (keys dotted) and log.

    Raises:
        UserError: it was not evaluated, or a file is missing or malformed.
    """
    folder = RunFolder(path)
    metrics_file, evaluate = folder.metrics_file, folder.evaluate_again
    metrics = folder.metrics()
    for key, kind in {"method": str, "data": str, "per_view": list}.items():
        if not isinstance(metrics.get(key), kind):
            raise UserError(f"`{key}` is missing or of the wrong type", metrics_file, evaluate)
    if not all(isinstance(row, dict) and "name" in row for row in metrics["per_view"]):
        raise UserError("a view of `per_view` has no name", metrics_file, evaluate)
    for key, kind in {"environment": dict, "emission": list}.items():
        if not isinstance(metrics.get(key), kind | None):
            raise UserError(f"`{key}` is of the wrong type", metrics_file, evaluate)
    emitters = metrics.get("emission") or ()
    if not all(isinstance(row, dict) and isinstance(row.get("name"), str) for row in emitters):
        raise UserError("a light of `emission` has no name", metrics_file, evaluate)
    if "emission" in str(metrics.get("unknown")) and not emitters:
        raise UserError("`emission` has no light", metrics_file, evaluate)
    settings = dict(flattened(folder.settings_table()))
    untrained = metrics.get("steps") == 0
    log = [] if untrained and not folder.log_file.is_file() else folder.log()
    taken = int(log[-1].get("step", 0)) if log else 0
    machines: tuple[Mapping[str, Any], ...] = ()
    with suppress(UserError):  # a page may be of runs without it
        machines = folder.origin().machines
    log = [] if untrained else log
    return EvaluatedRun(folder, label, metrics, settings, log, taken, machines)


def made_of(manifest: dict[str, Any], where: Path, runs: list[EvaluatedRun]) -> int:
    """The number of the run that a folder of an export or of pictures was made of.

    Args:
        manifest: of the folder; it names the run.
        where: its file.
        runs: those of the page.

    Raises:
        UserError: it is none of them.
    """
    told = manifest.get("run")
    named = told.get("folder") if isinstance(told, dict) else None
    if not isinstance(named, str):
        raise UserError("names no run", where, "Make it again")
    resolved = [run.folder.path.resolve() for run in runs]
    if Path(named) in resolved:
        return resolved.index(Path(named))
    same = [i for i, path in enumerate(resolved) if path.name == Path(named).name]
    if len(same) == 1 and not Path(named).exists():  # the run was moved
        return same[0]
    raise UserError(f"was made of another run ({printable(named)})", where, "Name that run as well")


def data_folder(runs: list[EvaluatedRun]) -> Path:
    """The one data set that all runs were evaluated on; UserError where they differ or it is gone.

    A relative `data` of an evaluation starts at the run folder.
    """
    folders = [run.folder.data(run.metrics["data"]).resolve() for run in runs]
    for run, folder in zip(runs, folders, strict=True):
        if folder != folders[0]:
            raise UserError(
                f"this run was evaluated on other data than {runs[0].folder.path}",
                run.folder.path,
                "Write one report for each data set",
            )
    if not folders[0].is_dir():
        first = runs[0].folder.path
        again = f"unbake fit DATA --out {quoted(first)} --resume; then unbake evaluate"
        raise UserError(
            f"the data this run was evaluated on is gone ({folders[0]})",
            first,
            f"Put it back, or tell where it is now: {again} {quoted(first)}",
        )
    return folders[0]


def read_views(dataset: Dataset, runs: list[EvaluatedRun]) -> list[ShownView]:
    """The evaluated held-out views, then training views: some of many, evenly spaced.

    The more runs there are, the fewer held-out views.

    Raises:
        UserError: an evaluated view is missing from the data set.
    """
    evaluated = {row["name"] for run in runs for row in run.metrics["per_view"]}
    unknown = evaluated - {view.name for view in dataset.views}
    if unknown:
        raise UserError(
            f"the data has no view named {sorted(unknown)[0]}, which was evaluated",
            dataset.folder,
            f"{runs[0].folder.evaluate_again} again",
        )
    heldout = [_view(view) for view in dataset.heldout if view.name in evaluated]
    training = [_view(view) for view in dataset.train if view.name in evaluated]
    shown = max(FEWEST_HELDOUT, min(HELDOUT_VIEWS, HELDOUT_PICTURES // len(runs)))
    return evenly(heldout, shown) + evenly(training, TRAINING_VIEWS)


def _view(view: View) -> ShownView:
    return ShownView(view.name, view.split, {"render": view.image, **view.truth}, view)
