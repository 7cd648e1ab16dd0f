"""Why a step was skipped: which term, parameter, view and pixel is not finite."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .state import State
from .step import TrainingStep


def diagnose(step: TrainingStep, state: State, number: int, views: Sequence[str]) -> str:
    """What is not finite in a step, in a few words.

    The step is taken again without being recorded, and without changing the state. The state may be
    some steps older than the one in which the step was skipped. Processes all call this together:
    each knows its share of the pixels, and the first one that finds something is believed by all.

    Args:
        number: of the step.
        views: names of the training views.

    Raises:
        Agreed: it failed on some process.
    """
    ranks = step.ranks
    ranks.announce()  # some may compile for longer than a step takes
    causes = ranks.gather(ranks.together(lambda: _cause(step, state, number, views)))
    return next(filter(None, causes), "the loss was not finite, and is by now")


def _cause(step: TrainingStep, state: State, number: int, views: Sequence[str]) -> str:
    """What is not finite in the share of this process; empty if all is."""
    replay = step.replay(state, number)
    found = []
    terms = [term for term, value in replay.terms.items() if not np.isfinite(value)]
    if terms:
        found.append(f"{_listed(terms)} not finite")
    if replay.broken:
        found.append(f"nor the gradients of {', '.join(replay.broken)}" if terms else "")
    bad = ~np.isfinite(replay.errors).all(-1)
    if bad.any():
        pixel = int(np.flatnonzero(bad)[0])
        view, x, y = step.place(int(replay.numbers[pixel]))
        image, photograph = (
            " ".join(f"{c:.3g}" for c in values[pixel])
            for values in (replay.image, replay.photograph)
        )
        many = f" and {int(bad.sum()) - 1} more" if bad.sum() > 1 else ""
        where = f"view {views[view]}, pixel ({x}, {y}){many}"
        found.append(f"{where}: rendered {image}, photographed {photograph}")
    return "; ".join(filter(None, found))


def _listed(terms: list[str]) -> str:
    if len(terms) == 1:
        return f"the term {terms[0]} is"
    return f"the terms {', '.join(terms[:-1])} and {terms[-1]} are"
