"""What the numbers of a run look like: the lines of its log, and its evaluation.

Both files may come from elsewhere, or be damaged; what is read from them is checked here, so that
nothing that reads them need to expect a text in the place of a number.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..json_checks import (
    Check,
    any_object,
    count,
    finite,
    list_of,
    number,
    object_of,
    object_with,
    or_none,
    score,
    text,
)


def wrong_in_log(line: Any) -> str | None:
    """What is wrong with a line of the log; None if nothing is.

    Further keys may hold anything: terms of methods that are not known here are numbers.
    """
    if not isinstance(line, dict):
        return "is not a JSON object"
    too_large = (key for key, value in line.items() if type(value) is int and not finite(value))
    return next((f"`{key}` is too large" for key in too_large), None) or _wrong(line, _LOG)


def wrong_in_metrics(metrics: Mapping[str, Any]) -> str | None:
    """What is wrong with the numbers of an evaluation; None if nothing is. Keys may be missing."""
    return _wrong(metrics, _METRICS)


def _wrong(found: Mapping[str, Any], checks: Mapping[str, Check]) -> str | None:
    for key, check in checks.items():
        if key in found and not check(found[key]):
            return f"`{key}` is of the wrong type"
    return None


_NUMBERS = list_of(score)
_SCORES = object_of(score)
_YARDSTICKS = object_with(ceiling=or_none(_SCORES), constant=_SCORES, untrained=_SCORES)


def _camera(value: Any) -> bool:
    checks = {
        "unknown": list_of(text),
        "anchor": text,
        "moved_pixels": number,
        "intrinsics": list_of(object_of(number)),
        "images": list_of(
            object_of(number, name=text, split=text, transform_matrix=list_of(_NUMBERS))
        ),
        "white_balance": object_of(number),
        "vignetting": object_of(number),
        "response": object_of(list_of(number)),
    }
    return isinstance(value, dict) and all(
        check(value[key]) for key, check in checks.items() if key in value
    )


_OUTLIERS = object_with(
    share=number, images=list_of(object_with(name=text, share=number)), shown=list_of(text)
)

_LOG: Mapping[str, Check] = {
    **dict.fromkeys(("step", "seconds", "samples", "skipped"), count),
    **dict.fromkeys(("samples_per_second", "memory_mb", "learning_rate"), number),
    "held_aside": score,
    "held_aside_groups": _NUMBERS,
    "note": text,
    "score": _SCORES,
    "validation": object_of(score, split=text, emission=object_of(_NUMBERS)),
}

_METRICS: Mapping[str, Check] = {
    **dict.fromkeys(("steps", "samples", "seconds", "bounces"), count),
    **dict.fromkeys(("method", "data", "unknown", "estimator", "prior"), text),
    **dict.fromkeys(("representation", "radiance"), or_none(text)),
    **dict.fromkeys(("quantities", "data_changed"), list_of(text)),
    **dict.fromkeys(("heldout", "train"), or_none(_SCORES)),
    "yardsticks": _YARDSTICKS,
    "convergence": or_none(object_of(score, trend=text)),
    "warm_start": or_none(object_of(text, steps=count, scale=count)),
    "display_exposure": score,
    "per_view": list_of(object_of(score, name=text, split=text)),
    "environment": or_none(_SCORES),
    "emission": or_none(
        list_of(object_of(score, name=text, strength=or_none(_NUMBERS), truth=or_none(_NUMBERS)))
    ),
    "albedo_scale": or_none(_NUMBERS),
    "camera": or_none(_camera),
    "outliers": or_none(_OUTLIERS),
    "definitions": or_none(object_of(text)),
    **dict.fromkeys(("render", "evaluation"), or_none(any_object)),
    "rate_factors": or_none(_SCORES),
}
