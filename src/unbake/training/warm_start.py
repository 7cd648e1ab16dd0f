"""A fit whose radiance field starts as one that was solved, rather than untrained."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from typing import Any, cast

from ..config import FitConfig, preset
from ..config.tables import flattened
from ..errors import UserError
from ..fields.domain import Domain
from ..fields.settings import FieldSettings
from ..scene.geometry import CHANGED, differing, probe
from ..transport.objective import has_radiance
from .problem import Problem
from .run_folder import WarmStart
from .solved import Solved, read_solved

#: Of the options, for messages.
OPTION = "--radiance-from"
#: Share of rays that end elsewhere from which on the scenes are not the same.
_ANOTHER = 0.2
#: Differences of domains that count as none, as a fraction of their extent.
_SAME_DOMAIN = 1e-3
#: Settings that say nothing about θ: a rate, and what sizes were chosen by.
_FREE = ("learning_rate", "grid.footprints")


def with_solved_field(config: FitConfig, solved: Solved) -> FitConfig:
    """The settings with the solved field's own, so that its parameters fit.

    Settings of L_θ that are those of the preset give way. The learning rate stays the fit's.

    Args:
        config: as a user gives them.
        solved: the field.

    Raises:
        UserError: the method has no L_θ, or the settings ask for another field than this.
    """
    if not has_radiance(config.chosen_method):
        what = f"the method {config.method} has no radiance field"
        raise UserError(what, OPTION, "Leave it out, or choose another --method")
    form = config.radiance_representation
    if form != solved.representation:
        what = f"the solved field is represented as {solved.representation}, that of the fit as "
        remedy = f"Give --radiance {solved.representation}, or solve with another field"
        raise UserError(what + form, solved.folder, remedy)
    given, usual = config.radiance[form], dict(_leaves(preset(config.preset).radiance[form]))
    wanted = dict(_leaves(solved.settings))
    others = [
        f"{key} is {wanted[key]} there and {value} here"
        for key, value in _leaves(given)
        if key not in _FREE and value not in (usual[key], wanted[key])
    ]
    if others:
        what = f"the solved field does not fit the settings [radiance.{form}]: {', '.join(others)}"
        raise UserError(what, solved.folder, "Leave these settings out: those of the field count")
    free = {"learning_rate": given.learning_rate}
    settings = cast(FieldSettings, replace(cast(Any, solved.settings), **free))
    return replace(config, radiance={**config.radiance, form: settings})


def start_radiance(problem: Problem, solved: Solved) -> list[str]:
    """Put the parameters of a solved field in the place of the problem's untrained ones.

    Args:
        problem: its radiance field has the settings and the scale of the solved one.
        solved: the field.

    Returns:
        What is odd about it, for people.

    Raises:
        UserError: it was solved in another scene.
    """
    field = problem.radiance
    assert field is not None
    domain, other = field.domain, solved.radiance.domain
    elsewhere = differing(probe(problem.scene_view.scene), solved.geometry)
    if not _same_domain(domain, other) or elsewhere > _ANOTHER:
        what = (
            f"was solved in another scene ({solved.scene}): that one spans {other.told()}, this "
            f"one {domain.told()}, and {100 * elsewhere:.0f} % of the rays through them end "
            "elsewhere"
        )
        remedy = "Solve the scene of the data set, with any materials and light"
        raise UserError(what, solved.folder, remedy)
    field.assign(solved.radiance.parameters())
    if elsewhere <= CHANGED:
        return []
    return [
        f"{100 * elsewhere:.0f} % of the rays through the scene end elsewhere than in the one that "
        f"{solved.folder} was solved in: is it the same?"
    ]


def warm_start(solved: Solved) -> WarmStart:
    """What the origin of a run tells of the field that it started with."""
    folder = str(solved.folder.resolve())
    return WarmStart(folder, solved.scene, solved.steps, solved.sha256, solved.radiance.scale)


def solved_again(start: WarmStart) -> Solved:
    """The field that a run started with, for one that begins again.

    Raises:
        UserError: it cannot be read, or is another one by now.
    """
    solved = read_solved(start.folder)
    if solved.sha256 != start.sha256:
        what = "is not the solved field any more that the run was to start with"
        raise UserError(what, solved.folder, f"Start another run with {OPTION}")
    return solved


def told_start(solved: Solved, config: FitConfig) -> str:
    """One line for people."""
    numbers = config.radiance_settings
    taken = ", ".join(
        f"{key} {value}"
        for key, value in _leaves(numbers)
        if key in ("grid.levels", "grid.table_log2", "width", "hidden", "cells", "levels")
    )
    return f"L starts as solved in {solved.steps} steps ({solved.folder}); its size: {taken}"


def _same_domain(first: Domain, second: Domain) -> bool:
    near = _SAME_DOMAIN * max(first.extent, second.extent)
    pairs = [*zip(first.centre, second.centre, strict=True), (first.extent, second.extent)]
    return all(abs(a - b) <= near for a, b in pairs)


def _leaves(settings: FieldSettings) -> Iterator[tuple[str, Any]]:
    return flattened(asdict(cast(Any, settings)))
