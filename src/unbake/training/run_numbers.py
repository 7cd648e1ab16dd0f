"""What the numbers of a run look like: the lines of its log, and its evaluation.

Both files may come from elsewhere, or be damaged; what is read from them is checked here, so that
nothing that reads them need to expect a text in the place of a number.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

Check = Callable[[Any], bool]


def wrong_in_log(line: Any) -> str | None:
    """What is wrong with a line of the log; None if nothing is.

    Further keys may hold anything: terms of methods that are not known here are numbers.
    """
    if not isinstance(line, dict):
        return "is not a JSON object"
    too_large = (key for key, value in line.items() if type(value) is int and not _finite(value))
    return next((f"`{key}` is too large" for key in too_large), None) or _wrong(line, _LOG)


def wrong_in_metrics(metrics: Mapping[str, Any]) -> str | None:
    """What is wrong with the numbers of an evaluation; None if nothing is. Keys may be missing."""
    return _wrong(metrics, _METRICS)


def _wrong(found: Mapping[str, Any], checks: Mapping[str, Check]) -> str | None:
    for key, check in checks.items():
        if key in found and not check(found[key]):
            return f"`{key}` is of the wrong type"
    return None


# ---------------------------------------------------------------------------------- kinds of values


def _finite(value: Any) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _count(value: Any) -> bool:
    return _number(value) and _finite(value) and value >= 0


def _score(value: Any) -> bool:
    return value is None or (_number(value) and _finite(value))


def _text(value: Any) -> bool:
    return isinstance(value, str)


def _or_none(check: Check) -> Check:
    return lambda value: value is None or check(value)


def _list_of(check: Check) -> Check:
    return lambda value: isinstance(value, list) and all(check(item) for item in value)


def _object_of(check: Check, **others: Check) -> Check:
    """An object whose values all are of a kind, but for those of the keys given."""
    return lambda value: (
        isinstance(value, dict) and all(others.get(key, check)(item) for key, item in value.items())
    )


def _object(value: Any) -> bool:
    return isinstance(value, dict)


_NUMBERS = _list_of(_score)
_SCORES = _object_of(_score)
_YARDSTICKS = {"ceiling": _or_none(_SCORES), "constant": _SCORES, "untrained": _SCORES}


def _yardsticks(value: Any) -> bool:
    return isinstance(value, dict) and all(
        key in value and check(value[key]) for key, check in _YARDSTICKS.items()
    )


def _camera(value: Any) -> bool:
    checks = {
        "unknown": _list_of(_text),
        "anchor": _text,
        "moved_pixels": _number,
        "intrinsics": _list_of(_object_of(_number)),
        "images": _list_of(
            _object_of(_number, name=_text, split=_text, transform_matrix=_list_of(_NUMBERS))
        ),
        "white_balance": _object_of(_number),
        "vignetting": _object_of(_number),
        "response": _object_of(_list_of(_number)),
    }
    return isinstance(value, dict) and all(
        check(value[key]) for key, check in checks.items() if key in value
    )


def _outliers(value: Any) -> bool:
    checks = {
        "share": _number,
        "images": _list_of(
            lambda row: (
                isinstance(row, dict) and _text(row.get("name")) and _number(row.get("share"))
            )
        ),
        "shown": _list_of(_text),
    }
    return isinstance(value, dict) and all(
        key in value and check(value[key]) for key, check in checks.items()
    )


_LOG: Mapping[str, Check] = {
    **dict.fromkeys(("step", "seconds", "samples", "skipped"), _count),
    **dict.fromkeys(("samples_per_second", "memory_mb", "learning_rate"), _number),
    "held_aside": _score,
    "held_aside_groups": _NUMBERS,
    "note": _text,
    "score": _SCORES,
    "validation": _object_of(_score, split=_text, emission=_object_of(_NUMBERS)),
}

_METRICS: Mapping[str, Check] = {
    **dict.fromkeys(("steps", "samples", "seconds", "bounces"), _count),
    **dict.fromkeys(("method", "data", "unknown", "estimator", "prior"), _text),
    **dict.fromkeys(("representation", "radiance"), _or_none(_text)),
    **dict.fromkeys(("quantities", "data_changed"), _list_of(_text)),
    **dict.fromkeys(("heldout", "train"), _or_none(_SCORES)),
    "yardsticks": _yardsticks,
    "convergence": _or_none(_object_of(_score, trend=_text)),
    "warm_start": _or_none(_object_of(_text, steps=_count, scale=_count)),
    "display_exposure": _score,
    "per_view": _list_of(_object_of(_score, name=_text, split=_text)),
    "environment": _or_none(_SCORES),
    "emission": _or_none(
        _list_of(
            _object_of(_score, name=_text, strength=_or_none(_NUMBERS), truth=_or_none(_NUMBERS))
        )
    ),
    "albedo_scale": _or_none(_NUMBERS),
    "camera": _or_none(_camera),
    "outliers": _or_none(_outliers),
    "definitions": _or_none(_object_of(_text)),
    **dict.fromkeys(("render", "evaluation"), _or_none(_object)),
    "rate_factors": _or_none(_SCORES),
}
