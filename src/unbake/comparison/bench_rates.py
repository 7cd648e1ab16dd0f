"""Learning rates and estimators of methods, found by fits with several of each.

The file of results is the record: it is written after each trial, and the trials that it holds are
not repeated.
"""

from __future__ import annotations

import gc
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, final

import drjit as dr
import numpy as np
from rich.console import Console

from ..config import FitConfig, to_toml
from ..config.method_defaults import MethodDefaults
from ..dataset.lighting import ROWS, true_environment
from ..dataset.scene_kind import SceneKind
from ..dataset.views import Dataset
from ..errors import UserError
from ..evaluation.lighting import recovered_emitters, relight_psnr
from ..formats import check_format
from ..io import read_object, write_json
from ..machine import machine
from ..quantities import QUANTITIES
from ..training.defaults import with_defaults
from ..training.fresh_fit import FreshFit, begin_fit, compile_kernels
from ..training.schedule import learning_rates
from ..training.validation import Score
from .method_variant import MethodVariant
from .rate_search import LEAST, MARGIN, STEP, Estimator, Trial, beats, best_trial
from .tables import print_rates

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: The newest format of the file that can be read, and the one that is written.
FORMAT = 1
#: Camera samples a pixel of a score.
SPP = 16
#: The estimator of methods that follow paths where they were published, and in Mitsuba.
PUBLISHED: Estimator = "two-pass"
#: Steps between looks at the clock, which wait for the machine.
TIME_EVERY = 4

DEFINITIONS = {
    "factors": "multiples of the learning rates of the fields, by unknown",
    "score": "mean of the numbers in dB of a trial: PSNRs of materials over all held-out views, "
    f"PSNR of balls that are relit by the environment, -20 log10 of the relative error of lights; "
    f"{SPP} samples a pixel; mean over the seeds",
    "best": f"from the fields' own rates, one unknown after the other is moved by factors of "
    f"{STEP} for as long as the score grows by {MARGIN} dB or more; then the other estimator "
    "needs as much; and once again if anything moved. Of the trial that is found, the estimator "
    "and then the rates are taken if they are better than the published estimator and the fields' "
    "own rates by more than the standard deviation of the difference over seeds",
    "seconds": "of the steps, whose kernels were compiled before",
}

Row = dict[str, Any]


def bench_rates(
    data: Sequence[Path | str],
    variants: Sequence[MethodVariant],
    shared: FitConfig,
    out: Path | str,
    console: Console,
    seeds: Sequence[int] = (0,),
) -> Row:
    """Search the learning rates of methods, and the estimator of those that follow paths.

    A search begins with the fields' own rates; see `best_trial`. Its trials are fits of the length
    that the settings say, one for each seed, scored at their end. The same call goes on after the
    fits that `out` has.

    Args:
        data: folders of data sets, each with true materials or light.
        variants: the methods.
        shared: settings of all fits. Factors of rates are not taken from there; an estimator other
            than `auto` is not searched.
        out: JSON file to write; searches of other methods and data sets that it has are kept.
        console: shows progress and a table.
        seeds: of the fits of a trial, whose scores are averaged. More of them may be given later.

    Returns:
        The content of the file.

    Raises:
        UserError: a data set cannot be used or has no truth to judge by, or the file has the same
            search with other settings.
    """
    out = Path(out)
    result = _read(out)
    datasets = [Dataset.load(Path(folder)) for folder in data]
    if not datasets:
        raise UserError("no data set given", "--data", "Give --data FOLDER [FOLDER ...]")
    if not seeds or len(set(seeds)) < len(seeds):
        raise UserError("give each seed once", "--seeds", "Such as: 0 1 2")
    if len({dataset.folder.resolve().name for dataset in datasets}) < len(datasets):
        raise UserError("two data sets have the same name", "--data", "Rename the folder of one")
    if not shared.seconds:
        _require_one_estimator(variants, shared)
    planned = [(d, variant) for d in datasets for variant in variants]
    searches = [_search(result, d, variant, shared, seeds, out) for d, variant in planned]
    for (dataset, variant), search in zip(planned, searches, strict=True):
        _Search(dataset, variant, shared, search, result, out, console).run()
    print_rates(searches, console)
    return result


def found_defaults(result: Row) -> dict[str, dict[SceneKind, MethodDefaults]]:
    """The best rates and estimators of a file, by method and kind of scene.

    Searches of other unknowns of the same method and kind belong together; the estimator is that of
    the first.

    Raises:
        ValueError: an unknown was searched twice for a method and a kind of scene.
    """
    found: dict[str, dict[SceneKind, MethodDefaults]] = {}
    for search in result["searches"]:
        best, kinds = search["best"], found.setdefault(search["method"], {})
        if best is None:
            continue
        before = kinds.get(search["kind"], MethodDefaults())
        if before.factors.keys() & best["factors"].keys():
            raise ValueError(f"{search['method']} was searched in two scenes: {search['kind']}")
        estimator = before.estimator or (best["estimator"] if search["follows_paths"] else None)
        kinds[search["kind"]] = MethodDefaults({**before.factors, **best["factors"]}, estimator)
    return {method: kinds for method, kinds in found.items() if kinds}


def settled(trials: Sequence[Row], best: Row) -> Row:
    """What a method takes of a search: only what is better by more than the seeds differ.

    Ties keep the published estimator of methods that follow paths, and the fields' own rates. The
    rule is the same for all methods.

    Args:
        trials: of the search, the one of the fields' own rates first.
        best: the one of them that `best_trial` found.
    """
    same = (row for row in trials if row["factors"] == best["factors"])
    published = next((row for row in same if row["estimator"] == PUBLISHED), best)
    chosen = best if beats(_per_seed(best), _per_seed(published)) else published
    return chosen if beats(_per_seed(chosen), _per_seed(trials[0])) else trials[0]


def _per_seed(trial: Row) -> list[float]:
    """Scores of a trial, one for each seed."""
    scores = [fit["score"] for fit in trial["per_seed"]]
    return [LEAST if score is None else score for score in scores]


@final
class _Search:
    """One method on one data set."""

    def __init__(
        self,
        dataset: Dataset,
        variant: MethodVariant,
        shared: FitConfig,
        record: Row,
        result: Row,
        out: Path,
        console: Console,
    ) -> None:
        self._dataset = dataset
        self._config = variant.settings(shared)
        self._record = record
        self._result = result
        self._out = out
        self._console = console
        self._name = f"{dataset.folder.name}, {variant.name}"

    def run(self) -> None:
        """Make the trials that are missing, and note the best one."""
        config, record = self._config, self._record
        self._complete(record["untrained"], lambda fit: {}, "untrained")
        # What photographs tell least of comes first.
        materials = [name for name in config.unknowns if name in QUANTITIES]
        lights = [name for name in config.unknowns if name not in QUANTITIES]
        if config.seconds and record["best"] is None:
            variants = [replace(config, estimator=name) for name in _estimators(config)]
            compile_kernels(self._dataset.folder, variants)
        best = best_trial([*reversed(materials), *lights], _estimators(config), self._score)
        found = self._row(best)
        if "error" in found:
            raise UserError(found["error"], self._name)
        taken = settled(record["trials"], found)
        record["best"] = {key: taken[key] for key in ("factors", "estimator", "score")}
        self._write()

    def _score(self, trial: Trial) -> float:
        factors = ", ".join(f"{name} x {by:g}" for name, by in trial.factors.items())
        found = self._row(trial)
        self._complete(found, _learned, f"{factors}, {trial.estimator}", trial)
        return LEAST if found["score"] is None else found["score"]

    def _row(self, trial: Trial) -> Row:
        """The trial's line of the record."""
        same = {"factors": trial.factors, "estimator": trial.estimator}
        for row in self._record["trials"]:
            if same.items() <= row.items():
                return row
        self._record["trials"].append(same | {"score": None, "per_seed": []})
        return self._record["trials"][-1]

    def _complete(
        self, row: Row, learn: Callable[[FreshFit], Row], what: str, trial: Trial | None = None
    ) -> None:
        """Make the fits of a line for the seeds that it lacks, and average them."""
        seeds = self._record["seeds"]
        missing = [seed for seed in seeds if seed not in {f["seed"] for f in row["per_seed"]}]
        for seed in missing:
            if "error" in row:
                break
            row["per_seed"].append({"seed": seed} | self._fitted(seed, learn, trial))
            row.update(_mean(row["per_seed"]))
            self._write()
        if missing:
            self._say(what, row)

    def _fitted(self, seed: int, learn: Callable[[FreshFit], Row], trial: Trial | None) -> Row:
        """A fit with the settings of a trial, scored."""
        config = replace(self._config, seed=seed)
        if trial is not None:
            config = replace(config, rate_factors=trial.factors, estimator=trial.estimator)
        try:
            fit = begin_fit(self._dataset, config)
            effort = learn(fit)
            return _scores(fit, self._dataset) | effort
        except UserError as error:
            if trial is None:
                raise
            return {"score": None, "error": str(error)}
        finally:
            gc.collect()
            dr.flush_malloc_cache()

    def _write(self) -> None:
        write_json(self._out, self._result, allow_nan=False)

    def _say(self, what: str, row: Row) -> None:
        values = [f"{k} {'—' if v is None else f'{v:.2f}'}" for k, v in row.items() if _is_score(k)]
        text = row.get("error") or ", ".join(values)
        line = f"{self._name}: {what}: {text}"
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def _mean(fits: Sequence[Row]) -> Row:
    """Means of the scores over seeds, or the error of the fit that failed."""
    for fit in fits:
        if "error" in fit:
            return {"score": None, "error": fit["error"]}
    means: Row = {}
    for key in filter(_is_score, fits[0]):
        values = [fit[key] for fit in fits]
        means[key] = None if None in values else sum(values) / len(values)
    return means


def _is_score(key: str) -> bool:
    return key == "score" or key.endswith(("_psnr", "_db"))


def _read(out: Path) -> Row:
    """The record so far."""
    if not out.exists():
        return {"format": FORMAT, "definitions": DEFINITIONS, "searches": []}
    result = read_object(out)
    check_format(result, FORMAT, out)
    if not isinstance(result.get("searches"), list):
        raise UserError("no record of searches", out, "Give another --out")
    return result


def _search(
    result: Row,
    dataset: Dataset,
    variant: MethodVariant,
    shared: FitConfig,
    seeds: Sequence[int],
    out: Path,
) -> Row:
    """The search of a method on a data set in the record; a new one if there is none."""
    config = with_defaults(variant.settings(shared), dataset)
    settings = tomllib.loads(to_toml(config))
    for key in ("rate_factors", "estimator", "seed"):
        del settings[key]
    camera = dataset.train[0].camera
    described: Row = {
        "method": variant.name,
        "data": dataset.folder.name,
        "kind": dataset.kind,
        "unknown": config.unknown,
        "views": len(dataset.train),
        "heldout": len(dataset.heldout),
        "resolution": [camera.width, camera.height],
        "follows_paths": config.follows_paths,
        "settings": settings,
    }
    same = ("method", "data", "unknown")
    for search in result["searches"]:
        if all(search[key] == described[key] for key in same):
            other = [key for key, value in described.items() if search[key] != value]
            if "settings" in other:
                other += [k for k, v in settings.items() if search["settings"].get(k) != v]
            if other:
                what = f"the search of {variant.name} in this file differs in {', '.join(other)}"
                raise UserError(what, out, "Give another --out")
            if set(seeds) < set(search["seeds"]):
                what = f"the search of {variant.name} in this file has more seeds"
                raise UserError(what, out, f"Give --seeds {' '.join(map(str, search['seeds']))}")
            search["seeds"] = list(dict.fromkeys([*search["seeds"], *seeds]))
            return search
    search = described | {"seeds": list(seeds), "untrained": {"per_seed": []}, "trials": []}
    search["best"] = None
    result["searches"].append(search)
    return search


def _require_one_estimator(variants: Sequence[MethodVariant], shared: FitConfig) -> None:
    """Refuse to choose between estimators by fits of equal steps: two passes would trace more."""
    for variant in variants:
        if len(_estimators(variant.settings(shared))) > 1:
            what = f"estimators of {variant.name} are compared at equal time"
            other = f"{variant.method}:{shared.representation}:split-halves"
            raise UserError(what, "--steps", f"Give --seconds, or one estimator, such as {other}")


def _estimators(config: FitConfig) -> list[Estimator]:
    """The estimators to choose from, the published one first."""
    if config.estimator != "auto":
        return ["split-halves" if config.halves else "two-pass"]
    return [PUBLISHED, "split-halves"] if config.follows_paths else ["split-halves"]


def _learned(fit: FreshFit) -> Row:
    """Take the steps of a fit; how many, and how long they took."""
    steps, seconds = _learn(fit)
    return {"steps": steps, "seconds": seconds, "machine": machine()}


def _learn(fit: FreshFit) -> tuple[int, float]:
    """Take the steps of a fit; their number, and seconds."""
    config, step, spent = fit.config, 0, 0.0
    start = time.perf_counter()
    while (spent < config.seconds) if config.seconds else (step < config.steps):
        done = spent / config.seconds if config.seconds else step / config.steps
        fit.step(fit.state, step, learning_rates(config, step, done))
        step += 1
        if step % TIME_EVERY == 0 or step == config.steps:
            dr.sync_thread()
            spent = time.perf_counter() - start
    return step, round(spent, 2)


def _scores(fit: FreshFit, dataset: Dataset) -> Row:
    """How near the unknowns are to the truth, in dB, and `score`, the mean of that.

    Raises:
        UserError: there is no truth to compare with.
    """
    problem, values = fit.problem, {}
    fit.state.publish(problem)
    if problem.materials is not None:
        score = Score(problem, dataset.heldout).measure(SPP)
        values |= {key: value for key, value in score.items() if key != "views"}
    if problem.environment is not None:
        truth = true_environment(dataset.folder)
        found = problem.environment.to_latlong(ROWS)
        values["relight_psnr"] = None if truth is None else relight_psnr(found, truth)
    if problem.emission is not None:
        rows = recovered_emitters(problem, dataset.folder)
        errors = [row.emission_error for row in rows if row.emission_error is not None]
        error = max(float(np.mean(errors)), 1e-6) if errors else None
        values["emission_db"] = None if error is None else -20 * math.log10(error)
    known = [value for value in values.values() if value is not None]
    if not known:
        what = "has no held-out view with true materials, and no true light, to judge by"
        raise UserError(what, dataset.folder, "Capture it with `unbake capture`")
    return values | {"score": sum(known) / len(known)}
