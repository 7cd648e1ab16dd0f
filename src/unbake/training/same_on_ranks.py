"""What all processes of a fit must have alike, or their steps would not fit together."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import mitsuba as mi

from ..ranks import Ranks
from ..version import VERSION
from .checkpoint import state_digest
from .state import State


def what_ranks_share(settings: str, files: Mapping[str, Any]) -> dict[str, str]:
    """Version, settings and data set, for `Ranks.require_same`.

    Args:
        settings: as text.
        files: the data set's fingerprint.
    """
    return {
        "version": f"{VERSION}, Mitsuba {mi.__version__}, {mi.variant()}",
        "settings": settings,
        "data set": json.dumps(files, sort_keys=True),
    }


def require_same_state(state: State, ranks: Ranks) -> None:
    """Check that the states of all ranks are equal, bit for bit."""
    if ranks.size > 1:
        ranks.require_same({"state": state_digest(state)})
