"""Learning rates and estimators of methods: what `unbake bench rates` found better.

The table repeats `benchmarks/results/rates.json`, where the scores of all trials are; a test
compares the two. What is better by no more than the seeds differ is not taken. The table holds for
the preset `cpu`; factors of materials hold for neural fields alone, with which they were found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from ..dataset.scene_kind import SceneKind
from .fit import ChosenEstimator


@dataclass(frozen=True)
class MethodDefaults:
    """What a method uses where the settings do not say.

    Args:
        factors: by unknown, multiples of the learning rate of its field; 1 where absent.
        estimator: of gradients; None: all pairs, or two passes for methods that follow paths. Where
            pairs are not independent, split halves take the place of all pairs.
        final_learning_rate: factor that all rates reach at the end; None: that of all methods.
        warm_up: steps over which the unknowns' rates rise; None: those of all methods with L_θ, and
            none without it.
    """

    factors: Mapping[str, float] = field(default_factory=dict)
    estimator: ChosenEstimator | None = None
    final_learning_rate: float | None = None
    warm_up: int | None = None


#: By method and kind of scene. Ours is not listed: it keeps the fields' own rates, although its
#: search found better ones for rooms.
METHOD_DEFAULTS: Mapping[str, Mapping[SceneKind, MethodDefaults]] = {
    "prb": {
        "room": MethodDefaults({"roughness": 1.0, "albedo": 2.5}, "two-pass", 0.3125, 0),
        "object": MethodDefaults({"roughness": 1.0, "albedo": 1.0}, "two-pass", 0.05, 0),
    },
    "no-prior": {
        "room": MethodDefaults({"roughness": 1.0, "albedo": 1.0}),
        "object": MethodDefaults({"roughness": 1.0, "albedo": 1.0}),
    },
    "direct": {
        "room": MethodDefaults({"roughness": 1.0, "albedo": 1.0}),
        "object": MethodDefaults({"roughness": 0.16, "albedo": 1.0}),
    },
}

#: Methods without a search of their own: the method whose defaults they have, whose gradient has
#: the same expectation.
SAME_AS: Mapping[str, str] = {"ad-pt": "prb"}


def method_defaults(method: str, kind: SceneKind) -> MethodDefaults:
    """What a method uses in a kind of scene where the settings do not say."""
    return METHOD_DEFAULTS.get(SAME_AS.get(method, method), {}).get(kind, MethodDefaults())


def as_json() -> dict[str, Any]:
    """The table, for records of results that depend on it."""
    return {
        method: {str(kind): asdict(found) for kind, found in kinds.items()}
        for method, kinds in METHOD_DEFAULTS.items()
    }
