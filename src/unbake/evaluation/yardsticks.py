"""What to measure recovered materials by: the ceiling of their fields, and what needs no learning.

    ceiling     the same fields, trained on the true maps of the training views (`truth_fit.py`)
    constant    the mean of those maps, everywhere
    untrained   the fields before their first step

A result is worth what it adds to the last two, and lacks what is left to the first.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ..config import FitConfig
from ..dataset.data_folder import DataFolder
from ..dataset.fingerprint import truth_fingerprint
from ..dataset.ground_truth import GroundTruth
from ..dataset.views import Dataset, View
from ..errors import UserError
from ..imaging.metrics import mean_psnr
from ..io import read_object, write_json
from ..quantities import QUANTITIES
from ..training.problem import Problem
from ..training.truth_fit import TruthFit, known_quantities, true_means
from ..training.validation import MaterialBuffers, psnr_keys
from .settings import EvaluationSettings

#: PSNRs over the held-out views, in dB, by keys such as `albedo_psnr`.
Scores = dict[str, float | None]
#: The recovered and the true materials of a view; None where they are not known.
Seen = tuple[MaterialBuffers | None, GroundTruth | None]

#: Steps of the fields on the true maps.
STEPS = 2400
#: The yardsticks that need no training.
_UNLEARNED = ("constant", "untrained")
_SCORES_OF = {"constant": "a constant scores", "untrained": "untrained fields"}
#: Where a constant has so many dB, there is one true value, which no result can beat.
_ONE_VALUE = 50.0
#: Changes where ceilings that were kept are no longer those that would be measured.
_FORMAT = 1

DEFINITIONS = {
    "yardsticks": "PSNRs of held-out views, measured as those of the result. ceiling: the same "
    "fields trained on the true maps of the training views, without rendering: what they can "
    "represent and these views show (null: not measured). constant: the mean of those maps, "
    "everywhere. untrained: the fields before their first step",
}


@dataclass(frozen=True)
class Yardsticks:
    """PSNRs over the held-out views to measure a result by, in dB.

    Args:
        ceiling: None where it was not measured.
        constant: None for a quantity that no training view has a true map of.
        untrained: None for a quantity that no held-out view has a true map of.
    """

    ceiling: Scores | None
    constant: Scores
    untrained: Scores


def seen_materials(problem: Problem, view: View, spp: int) -> MaterialBuffers:
    """The present values of the fields in a view, as an evaluation measures them."""
    # Another seed than that of the true maps, whose noise at edges would be the same.
    (seen,) = MaterialBuffers.of(problem, [view], spp, seed=2)
    return seen


def find_yardsticks(dataset: Dataset, config: FitConfig, heldout: Sequence[Seen]) -> Yardsticks:
    """What to measure a result by, without training anything.

    Args:
        config: settings of the run.
        heldout: the materials of its held-out views. Of the recovered ones only the coverage is
            read.

    Raises:
        UserError: a true map cannot be read.
    """
    means = true_means(dataset, config.quantities)
    initial = {name: np.array([QUANTITIES[name].initial]) for name in config.quantities}
    return Yardsticks(
        find_ceiling(dataset, config),
        _constant_scores(config.quantities, means, heldout),
        _constant_scores(config.quantities, initial, heldout),
    )


def can_have_ceiling(dataset: Dataset, config: FitConfig) -> bool:
    """Whether materials are unknown and both training and held-out views have true maps."""
    return config.learns_materials and bool(
        set(known_quantities(dataset, config.quantities)) & _scored(dataset)
    )


def find_ceiling(dataset: Dataset, config: FitConfig) -> Scores | None:
    """The ceiling of these fields on these maps that was measured before, if there is one.

    Raises:
        UserError: a file of the data set cannot be read.
    """
    folder = DataFolder(dataset.folder, dataset.allow_outside)
    if not any(folder.cache.glob(folder.ceiling("*").name)):
        return None
    key = _key(dataset, config, STEPS)
    try:
        stored = read_object(folder.ceiling(_digest(key)))
    except UserError:
        return None
    scores = stored.get("heldout")
    names = psnr_keys(config.quantities)
    if stored.get("key") != key or not isinstance(scores, dict) or list(scores) != names:
        return None
    return scores if all(map(_is_score, scores.values())) else None


def measure_ceiling(
    dataset: Dataset,
    config: FitConfig,
    *,
    steps: int | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Train the fields on the true maps, score them on the held-out views, and keep the ceiling.

    It is kept in the cache of the data set, where evaluations find it. One measured with other
    `steps` is not found there.

    Args:
        dataset: has true maps.
        config: says the fields; see `TruthFit`.
        steps: length of the training; None: that of the ceilings that evaluations show.
        tell: called with lines of progress.

    Returns:
        `train_views` and `heldout_views`, `steps`, `seconds` of training, and `yardsticks`.

    Raises:
        UserError: there are no true maps of training and of held-out views, or the materials are
            not unknown.

    Paper: Sec. 5.3.
    """
    # Ceilings of all seeds are about the same: one is kept for all.
    config, steps = replace(config, seed=0), STEPS if steps is None else steps
    fit = TruthFit(dataset, config)
    if not can_have_ceiling(dataset, config):
        what = f"no held-out view has true maps of {' or '.join(fit.maps.names)}"
        remedy = "A ceiling is scored on them: unbake capture SCENE --out DATA makes them"
        raise UserError(what, dataset.folder, remedy)
    trained, views = ", ".join(fit.maps.names), len(fit.maps.views)
    tell(f"training {trained} on the true maps of {views} training views, {steps} steps")
    start = time.perf_counter()
    fit.train(steps)
    seconds = time.perf_counter() - start
    settings, names = EvaluationSettings(), config.quantities
    pairs: list[Seen] = []
    for view in dataset.heldout:
        truth = GroundTruth.of(view, names)
        pairs.append((seen_materials(fit.problem, view, settings.material_spp), truth))
    scores = _means(names, [seen.psnr(truth) for seen, truth in pairs if seen and truth])
    scores |= dict.fromkeys(psnr_keys(set(names) - set(fit.maps.names)))
    _keep(dataset, config, steps, scores, tell)
    return {
        "train_views": views,
        "heldout_views": sum(truth is not None for _, truth in pairs),
        "steps": steps,
        "seconds": seconds,
        "yardsticks": asdict(replace(find_yardsticks(dataset, config, pairs), ceiling=scores)),
    }


def told_yardsticks(scores: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """Lines that say how far a result is from its ceiling, and what needs no learning.

    Args:
        scores: PSNRs of the result over the held-out views.
        found: the `yardsticks` of its evaluation.
    """
    lines = []
    for name in QUANTITIES:
        (key,) = psnr_keys([name])
        result = scores.get(key)
        known = {kind: (found[kind] or {}).get(key) for kind in ("ceiling", *_UNLEARNED)}
        rest = [(kind, known[kind]) for kind in _UNLEARNED if known[kind] is not None]
        if result is None or not any(value is not None for value in known.values()):
            continue
        top = known["ceiling"]
        if f"{key}_aligned" in scores:  # photographs leave its scale open
            every = ", ".join(f"{kind} {x:.2f}" for kind, x in known.items() if x is not None)
            lines.append(f"{name} at its true scale: {every} dB")
            continue
        if top is None:
            told = ", ".join(f"{_SCORES_OF[kind]} {value:.2f} dB" for kind, value in rest)
            lines.append(f"{name}: {told}")
        else:
            side = "below" if result <= top else "above"
            told = ", ".join(f"{kind} {value:.2f}" for kind, value in rest)
            line = f"{name} {abs(top - result):.2f} dB {side} its ceiling, {top:.2f}"
            lines.append(f"{line} ({told})" if told else line)
        constant = known["constant"]
        if constant is not None and result < constant < _ONE_VALUE:
            worse = f"{constant - result:.2f} dB worse"
            lines.append(f"{name} is {worse} than the mean of the truth everywhere")
    return lines


def _scored(dataset: Dataset) -> set[str]:
    """The quantities that some held-out view has a true map of."""
    return {name for view in dataset.heldout for name in view.truth}


def _constant_scores(
    names: Sequence[str], values: Mapping[str, np.ndarray], pairs: Sequence[Seen]
) -> Scores:
    """The scores of the same values everywhere, shape (channels,) or (1,); None without values."""
    rows = []
    for seen, truth in pairs:
        if seen is None or truth is None:
            continue
        everywhere = {
            name: np.broadcast_to(values[name], true.shape)
            for name, true in truth.values.items()
            if name in values
        }
        rows.append(replace(seen, values=everywhere).psnr(truth))
    return _means(names, rows)


def _means(names: Sequence[str], rows: Sequence[Mapping[str, float | None]]) -> Scores:
    return {key: mean_psnr(row.get(key) for row in rows) for key in psnr_keys(names)}


def _key(dataset: Dataset, config: FitConfig, steps: int) -> dict[str, Any]:
    """What a ceiling depends on."""
    fields = {name: asdict(field) for name, field in config.material_settings.items()}
    key = {
        "format": _FORMAT,
        "steps": steps,
        "representation": config.representation,
        "fields": fields,
        "data": truth_fingerprint(dataset, config.quantities),
    }
    return json.loads(json.dumps(key))  # as it is read back


def _digest(key: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]


def _keep(
    dataset: Dataset, config: FitConfig, steps: int, scores: Scores, tell: Callable[[str], None]
) -> None:
    folder = DataFolder(dataset.folder, dataset.allow_outside)
    key = _key(dataset, config, steps)
    try:
        folder.require_own_cache()
        write_json(folder.ceiling(_digest(key)), {"key": key, "heldout": scores}, allow_nan=False)
    except UserError as error:
        tell(f"warning: the ceiling is not kept, and evaluations will not show it: {error}")


def _is_score(value: object) -> bool:
    return value is None or (isinstance(value, float) and math.isfinite(value))
