"""How a setting is given on the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Flag:
    """Gives a field of settings an option on the command line, by its annotation:

        steps: Annotated[int, Flag("Length in training steps")] = 2400

    Args:
        help: what the option does, without full stop and without its default, which is added.
        name: of the option, where it is not the field's.
        metavar: what stands for a value; None: what its type suggests.
        choices: gives the values by name and what each means; they are listed after the help.
        tell_default: whether the help tells the default.
    """  # noqa: D415 (the summary ends in an example)

    help: str
    name: str | None = None
    metavar: str | None = None
    choices: Callable[[], Mapping[str, str]] | None = None
    tell_default: bool = True
