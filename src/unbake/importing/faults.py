"""What is wrong with an input, collected so that all of it is told at once."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import final

from ..errors import UserError, named, printable


@final
class ImportFaults(UserError):
    """All that is wrong with an input.

    Args:
        where: the input.
        faults: each one a line.
    """

    def __init__(self, where: object, faults: tuple[str, ...]) -> None:
        self.faults = faults
        self.count = "one fault" if len(faults) == 1 else f"{len(faults)} faults"
        super().__init__(
            f"{self.count}: {'; '.join(faults)}", where, "Correct them and import again"
        )


@final
class Faults:
    """Collects faults; equal ones of several files become one line."""

    def __init__(self) -> None:
        self._places: dict[tuple[str, str | None], list[str]] = {}

    def __bool__(self) -> bool:
        return bool(self._places)

    def add(self, what: str, place: object = None, remedy: str | None = None) -> None:
        """Add a fault.

        Args:
            what: is wrong, as a sentence without full stop.
            place: a file or an entry that it was found in.
            remedy: what the user can do about it.
        """
        places = self._places.setdefault((what, remedy), [])
        places.extend([] if place is None else [printable(place)])

    def remedy(self, what: str, remedy: str) -> None:
        """Tell the remedy of a fault that was added without one."""
        self._places = {
            (told, remedy if (told, known) == (what, None) else known): places
            for (told, known), places in self._places.items()
        }

    def extend(self, others: Faults) -> None:
        """Add all of these."""
        for fault, places in others._places.items():
            self._places.setdefault(fault, []).extend(places)

    @contextlib.contextmanager
    def collected(self, place: object = None) -> Iterator[None]:
        """Turn a `UserError` of the block into a fault; the block ends there.

        Args:
            place: told instead of where the error was found.
        """
        try:
            yield
        except UserError as error:
            self.add(error.what, place if place is not None else error.where, error.remedy)

    def require_none(self, where: Path) -> None:
        """Raise `ImportFaults` where there are any.

        Args:
            where: the input.
        """
        if self._places:
            raise ImportFaults(where, tuple(map(_told, self._places.items())))


def _told(fault: tuple[tuple[str, str | None], list[str]]) -> str:
    (what, remedy), places = fault
    told = f"{what}: {named(places)}" if places else what
    return told if remedy is None else f"{told}. {remedy}"
