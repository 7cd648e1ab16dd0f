"""A method with its representation of materials and its estimator, as a comparison runs it."""

from __future__ import annotations

import typing
from dataclasses import dataclass, replace
from typing import final

from ..config import Estimator, FitConfig, with_method
from ..errors import UserError, require_name
from ..fields.registry import representations
from ..transport.methods import METHODS


@final
@dataclass(frozen=True)
class MethodVariant:
    """A method, its representation of materials and its estimator.

    Args:
        method: name of the method.
        representation: representation of materials; None takes that of the shared settings.
        estimator: estimator of gradients; None takes that of the shared settings.
    """

    method: str
    representation: str | None = None
    estimator: Estimator | None = None

    @staticmethod
    def of(text: str) -> MethodVariant:
        """Read `METHOD`, `METHOD:REPRESENTATION` or `METHOD:REPRESENTATION:ESTIMATOR`.

        Raises:
            UserError: there is no such method, representation or estimator.
        """
        choices = {
            "method": tuple(METHODS),
            "representation": representations(),
            "estimator": typing.get_args(Estimator),
        }
        words = text.split(":")
        if len(words) > len(choices):
            raise UserError(f"{text!r} has too many parts", "--methods", "METHOD:REPRESENTATION")
        chosen: dict[str, typing.Any] = dict(zip(choices, words, strict=False))
        for what, word in chosen.items():
            require_name(word, choices[what], what, "--methods")
        return MethodVariant(**chosen)

    @property
    def name(self) -> str:
        """Name of its run: `ours`, `prb-bitmap`."""
        return "-".join(filter(None, (self.method, self.representation, self.estimator)))

    def settings(self, shared: FitConfig) -> FitConfig:
        """The shared settings with this method; see `with_method`."""
        own = with_method(shared, self.method)
        representation = self.representation or shared.representation
        return replace(
            own, representation=representation, estimator=self.estimator or own.estimator
        )
