"""Learning rates and estimators of methods, found by fits with several of each.

The file of results is the record: it is written after each trial, and the trials that it holds are
not repeated. Several ranks share the searches; those of other ranks than the first stand in files
beside it until all have ended.
"""

from __future__ import annotations

import gc
import glob
import json
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

from .. import backend, json_checks
from ..config import ChosenEstimator, FitConfig, to_toml
from ..config.fit import OWN_FINAL_RATE, OWN_WARM_UP
from ..config.method_defaults import MethodDefaults
from ..dataset.fingerprint import fingerprint
from ..dataset.lighting import ROWS, true_environment
from ..dataset.scene_kind import SceneKind
from ..dataset.views import Dataset
from ..errors import UserError
from ..evaluation.lighting import recovered_emitters, relight_psnr
from ..formats import check_format
from ..io import read_object, write_json
from ..machine import machine
from ..memory import lack_told
from ..quantities import ALIGNED, QUANTITIES
from ..ranks import Agreed, Ranks
from ..training.defaults import own_warm_up, with_defaults
from ..training.fresh_fit import FreshFit, begin_fit, compile_kernels
from ..training.same_on_ranks import what_ranks_share
from ..training.schedule import learning_rates
from ..training.validation import Score
from .method_variant import MethodVariant
from .rate_search import LEAST, MARGIN, STEP, Trial, beats, best_trial
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
PUBLISHED: ChosenEstimator = "two-pass"
#: Steps between looks at the clock, which wait for the machine.
TIME_EVERY = 4

DEFINITIONS = {
    "factors": "multiples of the learning rates of the fields, by unknown",
    "score": "mean of the numbers in dB of a trial: PSNRs of materials over all held-out views "
    "(of albedo once aligned, where photographs leave its scale open), "
    f"PSNR of balls that are relit by the environment, -20 log10 of the relative error of lights; "
    f"{SPP} samples a pixel; mean over the seeds",
    "best": f"from the fields' own rates, one unknown after the other is moved by factors of "
    f"{STEP} for as long as the score grows by {MARGIN} dB or more; then the other estimator "
    "needs as much; and once again if anything moved. Of the trial that is found, the estimator "
    "and then the rates are taken if they are better than the published estimator and the fields' "
    "own rates by more than the standard deviation over seeds of the difference, seed by seed",
    "final_learning_rate": "factor that all rates reach at the end, where it is searched too",
    "warm_up": "steps over which the unknowns' rates rise, where they are searched too",
    "seconds": "of the steps, whose kernels were compiled before",
}

#: Settings that can be searched beside the rates, after them.
SCHEDULE = ("final_learning_rate", "warm_up")
#: What tells the trials of a search apart.
TRIED = ("factors", "estimator", *SCHEDULE)
#: What tells the searches of a record apart.
SEARCHED = ("method", "data", "unknown")

_FITS = json_checks.list_of(
    json_checks.object_with(seed=json_checks.count, score=json_checks.score)
)
_TRIAL = json_checks.object_with(
    estimator=json_checks.text, score=json_checks.score, per_seed=_FITS
)
_BEST = json_checks.object_with(
    factors=json_checks.object_of(json_checks.number),
    estimator=json_checks.text,
    score=json_checks.score,
)
_SEARCH = json_checks.object_with(
    **dict.fromkeys(SEARCHED, json_checks.text),
    seeds=json_checks.list_of(json_checks.count),
    settings=json_checks.any_object,
    untrained=json_checks.object_with(per_seed=_FITS),
    trials=json_checks.list_of(_TRIAL),
    best=json_checks.or_none(_BEST),
)
_HAS_SEARCHES = json_checks.object_with(searches=json_checks.list_of(_SEARCH))

Row = dict[str, Any]


def bench_rates(
    data: Sequence[Path | str],
    variants: Sequence[MethodVariant],
    shared: FitConfig,
    out: Path | str,
    console: Console,
    seeds: Sequence[int] = (0,),
    *,
    schedule: bool = False,
    clip_negative: bool = False,
    allow_outside: bool = False,
    ranks: Ranks | None = None,
) -> Row:
    """Search the learning rates of methods, and the estimator of those that follow paths.

    A search begins with the fields' own rates; see `best_trial`. Its trials are fits of the length
    that the settings say, one for each seed, scored at their end. The same call goes on after the
    fits that `out` has. A search that fails does not end the others.

    Args:
        data: folders of data sets, each with true materials or light.
        variants: the methods.
        shared: settings of all fits. Factors of rates are not taken from there; an estimator other
            than `auto` is not searched.
        out: JSON file to write; searches of other methods and data sets that it has are kept.
        console: shows progress and a table.
        seeds: of the fits of a trial, whose scores are averaged. More of them may be given later.
        schedule: also search the decay of all rates and the warm-up of the unknowns.
        clip_negative: set negative pixels to zero.
        allow_outside: read files of data sets and scenes that lie outside of their folders.
        ranks: of MPI, which share the searches among them and all call this; None: this process is
            alone.

    Returns:
        The content of the file. Other ranks than the first return nothing.

    Raises:
        UserError: a data set cannot be used or has no truth to judge by, or the file has the same
            search with other settings; of searches that failed, the first one's error.
    """
    out, ranks = Path(out), ranks or Ranks()
    if not ranks.leads:
        console = Console(quiet=True)
    result, planned = ranks.together(
        lambda: _planned(data, variants, shared, out, seeds, schedule, allow_outside)
    )
    if ranks.size > 1:
        records = [record for _, _, record in planned]
        told = [{key: record[key] for key in ("method", "settings", "seeds")} for record in records]
        datasets = {dataset.folder.name: dataset for dataset, _, _ in planned}
        files = {name: fingerprint(dataset) for name, dataset in datasets.items()}
        ranks.require_same(what_ranks_share(json.dumps(told), files))
        backend.share_cores(ranks.here)
    # Before any rank writes its own part of the record, that of the last call is in the file.
    ranks.together(lambda: _take_parts(result, out) if ranks.leads else None)

    mine = ranks.mine(range(len(planned)))
    own = [[number, planned[number][2]] for number in mine]
    part = result if ranks.leads else {**result, "searches": [record for _, record in own]}
    errors: list[list[Any]] = []
    with ranks.apart():
        for number in mine:
            dataset, config, record = planned[number]
            file = _part_of(out, ranks.rank)
            try:
                with lack_told():
                    search = _Search(
                        dataset, config, record, part, file, console, schedule, clip_negative
                    )
                    search.run()
            except UserError as error:
                errors.append([number, *error.parts])
        every = ranks.gather({"records": own, "errors": errors})
    for number, record in (row for one in every for row in one["records"]):
        planned[number][2].update(record)
    failed = [UserError(*parts) for _, *parts in sorted(e for one in every for e in one["errors"])]
    for error in failed:
        console.print(f"error: {error}", style="red", markup=False, soft_wrap=True)
    if ranks.leads:
        _take_parts(result, out)
        if done := [record for _, _, record in planned if record["best"]]:
            print_rates(done, console)
    if failed:
        raise Agreed.of(failed[0])
    return result if ranks.leads else {}


def _planned(
    data: Sequence[Path | str],
    variants: Sequence[MethodVariant],
    shared: FitConfig,
    out: Path,
    seeds: Sequence[int],
    schedule: bool,
    allow_outside: bool,
) -> tuple[Row, list[tuple[Dataset, FitConfig, Row]]]:
    """The record so far, and data, settings and record of each search that is asked for.

    Raises:
        UserError: see `bench_rates`.
    """
    result = _read(out)
    datasets = [Dataset.load(Path(folder), allow_outside=allow_outside) for folder in data]
    if not datasets:
        raise UserError("no data set given", "--data", "Give --data FOLDER [FOLDER ...]")
    if not seeds or len(set(seeds)) < len(seeds):
        raise UserError("a seed is given twice", "--seeds", "Give each once, such as: 0 1 2")
    if len({dataset.folder.resolve().name for dataset in datasets}) < len(datasets):
        raise UserError("two data sets have the same name", "--data", "Rename the folder of one")
    if not shared.seconds:
        _require_one_estimator(variants, shared)
    planned = []
    for dataset in datasets:
        for variant in variants:
            # Whatever is the default of a method by now: a search begins with what all have.
            config = _with_own_schedule(variant.settings(shared))
            record = _search(result, dataset, variant.name, config, seeds, out, schedule)
            planned.append((dataset, config, record))
    return result, planned


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
        factors, own = {**before.factors, **best["factors"]}, [best.get(key) for key in SCHEDULE]
        kinds[search["kind"]] = MethodDefaults(factors, estimator, *own)
    return {method: kinds for method, kinds in found.items() if kinds}


def settled(trials: Sequence[Row], best: Row) -> Row:
    """What a method takes of a search: only what is better by more than the seeds differ.

    Ties keep the published estimator of methods that follow paths, and the fields' own rates. The
    rule is the same for all methods.

    Args:
        trials: of the search, the one of the fields' own rates first.
        best: the one of them that `best_trial` found.
    """
    wanted = {key: best[key] for key in TRIED if key in best} | {"estimator": PUBLISHED}
    published = next((row for row in trials if wanted.items() <= row.items()), best)
    chosen = best if _is_better(best, published) else published
    return chosen if _is_better(chosen, trials[0]) else trials[0]


def _is_better(trial: Row, other: Row) -> bool:
    """Whether a trial beats another one, seed by seed."""
    first, second = _per_seed(trial), _per_seed(other)
    shared = sorted(first.keys() & second.keys())
    return bool(shared) and beats([first[s] for s in shared], [second[s] for s in shared])


def _per_seed(trial: Row) -> dict[int, float]:
    """Scores of a trial, by seed."""
    scores = {fit["seed"]: fit["score"] for fit in trial["per_seed"]}
    return {seed: LEAST if score is None else score for seed, score in scores.items()}


@final
class _Search:
    """One method on one data set."""

    def __init__(
        self,
        dataset: Dataset,
        config: FitConfig,
        record: Row,
        result: Row,
        out: Path,
        console: Console,
        schedule: bool,
        clip_negative: bool,
    ) -> None:
        self._dataset = dataset
        self._name = f"{record['data']}, {record['method']}"
        self._config = config
        self._record = record
        self._result = result
        self._out = out
        self._console = console
        self._schedule = SCHEDULE if schedule else ()
        self._clip_negative = clip_negative

    def run(self) -> None:
        """Make the trials that are missing or failed before, and note the best one."""
        config, record = self._config, self._record
        for row in record["trials"]:
            if row.pop("error", None) is not None:
                row["per_seed"] = [fit for fit in row["per_seed"] if "error" not in fit]
        self._complete(record["untrained"], lambda fit: {}, "untrained")
        # What photographs tell least of comes first.
        materials = [name for name in config.unknowns if name in QUANTITIES]
        lights = [name for name in config.unknowns if name not in QUANTITIES]
        if config.seconds and (record["best"] is None or any(map(self._missing, record["trials"]))):
            variants = [replace(config, estimator=name) for name in _estimators(config)]
            compile_kernels(self._dataset, variants, clip_negative=self._clip_negative)
        searched = [*reversed(materials), *lights, *self._schedule]
        estimators = _estimators(config)
        best = best_trial(searched, estimators, self._score)
        found = self._row(best)
        if "error" in found:
            raise UserError(found["error"], self._name)
        own = self._row(Trial(tuple(searched), (0,) * len(searched), estimators[0]))
        # A file of an earlier version may have trials with another estimator.
        known = [t for t in record["trials"] if t["estimator"] in estimators and t is not own]
        taken = settled([own, *known], found)
        record["best"] = {key: taken[key] for key in (*TRIED, "score") if key in taken}
        self._write()

    def _missing(self, row: Row) -> list[int]:
        """The seeds of which a line of the record has no fit."""
        made = {fit["seed"] for fit in row["per_seed"]}
        return [seed for seed in self._record["seeds"] if seed not in made]

    def _score(self, trial: Trial) -> float:
        found = self._row(trial)
        told = [f"{name} x {by:g}" for name, by in found["factors"].items()]
        told += [f"{key} {found[key]:g}" for key in self._schedule]
        self._complete(found, _learned, ", ".join([*told, trial.estimator]), trial)
        return LEAST if found["score"] is None else found["score"]

    def _row(self, trial: Trial) -> Row:
        """The trial's line of the record."""
        same = _tried(trial, self._config)
        for row in self._record["trials"]:
            if same.items() <= row.items():
                return row
        self._record["trials"].append(same | {"score": None, "per_seed": []})
        return self._record["trials"][-1]

    def _complete(
        self, row: Row, learn: Callable[[FreshFit], Row], what: str, trial: Trial | None = None
    ) -> None:
        """Make the fits of a line for the seeds that it lacks, and average them."""
        missing = self._missing(row)
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
            tried = _tried(trial, config)
            config = replace(config, rate_factors=tried.pop("factors"), **tried)
        try:
            fit = begin_fit(self._dataset, config, clip_negative=self._clip_negative)
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


def _with_own_schedule(config: FitConfig) -> FitConfig:
    """Settings whose decay and warm-up, where they are left open, are those of all methods."""
    final, warm_up = config.final_learning_rate, config.warm_up
    return replace(
        config,
        final_learning_rate=OWN_FINAL_RATE if final is None else final,
        warm_up=own_warm_up(config) if warm_up is None else warm_up,
    )


def _tried(trial: Trial, config: FitConfig) -> Row:
    """What a trial sets: keys of `TRIED`, those of the schedule where it is searched.

    Rates that grow during a fit are not tried. A method without a warm-up begins with that of the
    others.
    """
    factors = trial.factors
    powers = dict(zip(trial.unknowns, trial.powers, strict=True))
    found: Row = {"factors": {k: v for k, v in factors.items() if k not in SCHEDULE}}
    found["estimator"] = trial.estimator
    if "final_learning_rate" in factors:
        end = (config.final_learning_rate or OWN_FINAL_RATE) * factors["final_learning_rate"]
        found["final_learning_rate"] = min(1.0, float(f"{end:.6g}"))
    if "warm_up" in factors:
        own, power = config.warm_up, powers["warm_up"]
        first = OWN_WARM_UP * STEP ** (power - 1) if power > 0 else 0
        found["warm_up"] = round(own * factors["warm_up"] if own else first)
    return found


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
    return key in ("score", ALIGNED) or key.endswith(("_psnr", "_db"))


def _read(out: Path) -> Row:
    """The record so far, with what other ranks than the first found before they were stopped."""
    result: Row = {"format": FORMAT, "definitions": DEFINITIONS, "searches": []}
    if out.exists():
        result = _read_record(out)
    for part in _parts(out):
        for search in _read_record(part)["searches"]:
            same = [old for old in result["searches"] if _key(old) == _key(search)]
            if not same:
                result["searches"].append(search)
            elif _fits(search) > _fits(same[0]):
                same[0].clear()
                same[0].update(search)
    return result


def _read_record(file: Path) -> Row:
    result = read_object(file)
    check_format(result, FORMAT, file)
    if not _HAS_SEARCHES(result):
        raise UserError("no record of searches", file, "Give another --out")
    return result


def _key(search: Row) -> tuple[Any, ...]:
    """What tells a search from the others of a record."""
    return tuple(search[key] for key in SEARCHED)


def _has_plain_scores(search: Row) -> bool:
    """Whether fits were judged by albedo as it is, as earlier versions did everywhere."""
    fits = [fit for row in (search["untrained"], *search["trials"]) for fit in row["per_seed"]]
    return any("albedo_psnr" in fit and ALIGNED not in fit for fit in fits)


def _fits(search: Row) -> int:
    """How many fits a search has made."""
    return sum(len(row["per_seed"]) for row in (search["untrained"], *search["trials"]))


def _part_of(out: Path, rank: int) -> Path:
    """The file that a rank writes its searches to until all have ended."""
    return out if rank == 0 else out.with_name(f"{out.name}.process-{rank}")


def _parts(out: Path) -> list[Path]:
    """The files that other ranks than the first left."""
    return sorted(out.parent.glob(f"{glob.escape(out.name)}.process-*"))


def _take_parts(result: Row, out: Path) -> None:
    """Write the record in the place of the files of parts, if there are any."""
    if parts := _parts(out):
        write_json(out, result, allow_nan=False)
    for part in parts:
        part.unlink(missing_ok=True)


def _search(
    result: Row,
    dataset: Dataset,
    name: str,
    config: FitConfig,
    seeds: Sequence[int],
    out: Path,
    schedule: bool,
) -> Row:
    """The search of a method on a data set in the record; a new one if there is none."""
    estimators = _estimators(config)
    config = with_defaults(config, dataset)
    settings = tomllib.loads(to_toml(config))
    for key in ("rate_factors", "estimator", "seed", *(SCHEDULE if schedule else ())):
        del settings[key]
    camera = dataset.train[0].camera
    described: Row = {
        "method": name,
        "data": dataset.folder.resolve().name,
        "kind": dataset.kind,
        "unknown": config.unknown,
        "views": len(dataset.train),
        "heldout": len(dataset.heldout),
        "resolution": [camera.width, camera.height],
        "follows_paths": config.follows_paths,
        "estimators": list(estimators),
        "files": fingerprint(dataset),
        "settings": settings,
    }
    for search in result["searches"]:
        if _key(search) == _key(described):
            # Records of earlier versions lack some keys.
            other = [k for k, value in described.items() if search.get(k, value) != value]
            if "settings" in other:
                both = settings.keys() | search["settings"].keys()
                other += sorted(k for k in both if search["settings"].get(k) != settings.get(k))
            if config.shares_scale and _has_plain_scores(search):
                other.append("scores, which are of albedo before alignment")
            if other:
                what = f"the search of {name} in this file differs in {', '.join(other)}"
                raise UserError(what, out, "Give another --out")
            if set(seeds) < set(search["seeds"]):
                what = f"the search of {name} in this file has more seeds"
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
        estimators = _estimators(variant.settings(shared))
        if len(estimators) > 1:
            what = f"estimators of {variant.name} are compared at equal time"
            other = f"{variant.method}:{shared.representation}:{estimators[-1]}"
            raise UserError(what, "--steps", f"Give --seconds, or one estimator, such as {other}")


def _estimators(config: FitConfig) -> list[ChosenEstimator]:
    """The estimators to choose from, the published one first."""
    if config.estimator != "auto":
        return [config.estimator]
    return [PUBLISHED, config.one_pass] if config.follows_paths else [config.one_pass]


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
        shared = fit.config.shares_scale
        score = Score(problem, dataset.heldout, shares_scale=shared).measure(SPP)
        values |= {key: value for key, value in score.items() if key != "views"}
    if problem.environment is not None:
        truth = true_environment(dataset.folder, allow_outside=dataset.allow_outside)
        found = problem.environment.to_latlong(ROWS)
        values["relight_psnr"] = None if truth is None else relight_psnr(found, truth)
    if problem.emission is not None:
        outside = dataset.allow_outside
        rows = recovered_emitters(problem, dataset.folder, allow_outside=outside)
        errors = [row.emission_error for row in rows if row.emission_error is not None]
        error = max(float(np.mean(errors)), 1e-6) if errors else None
        values["emission_db"] = None if error is None else -20 * math.log10(error)
    judged = [key for key in values if not (key == "albedo_psnr" and ALIGNED in values)]
    known = [values[key] for key in judged if values[key] is not None]
    if not known:
        what = "has no held-out view with true materials, and no true light, to judge by"
        raise UserError(what, dataset.folder, "Capture it with `unbake capture`")
    return values | {"score": sum(known) / len(known)}
