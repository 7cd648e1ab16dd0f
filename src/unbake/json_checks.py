"""Checks of values that were read from JSON: files may come from elsewhere, or be damaged."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

#: Whether a value is what a file should have there.
Check = Callable[[Any], bool]


def finite(value: Any) -> bool:
    """Whether a number is finite, and no larger than any float."""
    try:
        return math.isfinite(value)
    except OverflowError:  # an integer of hundreds of digits
        return False


def number(value: Any) -> bool:
    """A number, finite or not; no integer that is larger than any float."""
    return isinstance(value, float) or (type(value) is int and finite(value))


def count(value: Any) -> bool:
    """A finite number, not negative."""
    return number(value) and finite(value) and value >= 0


def score(value: Any) -> bool:
    """A finite number, or nothing."""
    return value is None or (number(value) and finite(value))


def text(value: Any) -> bool:
    """A text."""
    return isinstance(value, str)


def any_object(value: Any) -> bool:
    """An object, whatever it has."""
    return isinstance(value, dict)


def or_none(check: Check) -> Check:
    """What the check takes, or nothing."""
    return lambda value: value is None or check(value)


def list_of(check: Check) -> Check:
    """A list whose items all are of a kind."""
    return lambda value: isinstance(value, list) and all(check(item) for item in value)


def object_of(check: Check, **others: Check) -> Check:
    """An object whose values all are of a kind, but for those of the keys given."""
    return lambda value: (
        isinstance(value, dict) and all(others.get(key, check)(item) for key, item in value.items())
    )


def object_with(**checks: Check) -> Check:
    """An object that has all these keys; others may hold anything."""
    return lambda value: (
        isinstance(value, dict)
        and all(key in value and check(value[key]) for key, check in checks.items())
    )
