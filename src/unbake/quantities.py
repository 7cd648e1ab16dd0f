"""Quantities: the parameters of Mitsuba's `principled` that can be unknown on surfaces.

A quantity is a row of the table `QUANTITIES`, and all that the package does with materials follows
from it: fields and their settings, textures, truth images, scores, pages. Needs neither Mitsuba nor
Dr.Jit.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal

from .errors import UserError, require_name


@dataclass(frozen=True)
class Quantity:
    """A parameter of a surface's BSDF.

    Args:
        name: in settings, file names, scores and on the command line.
        title: on pages and in tables.
        channels: 3 (linear RGB) or 1.
        slot: the parameter of `principled`.
        lower: least value.
        upper: greatest value.
        initial: value of an untrained field, strictly between the bounds.
        default: what `principled` takes where a scene does not say.
        display: how pictures show it: a colour through the sRGB curve, or data without one.
        comes_back: whether a least slope in gradients brings it back from far beyond a bound
            (`FitConfig.least_slope`). Not for what searches move: they seek the most probable
            numbers, for which they need the true slope.
        settings: by representation, what differs from that representation's own settings, as nested
            tables of the settings file.
    """

    name: str
    title: str
    channels: Literal[1, 3]
    slot: str
    lower: float
    upper: float
    initial: float
    default: float
    display: Literal["colour", "data"]
    comes_back: bool = False
    settings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


#: In the order in which they are listed, seeded and carried along. New ones go to the end.
QUANTITIES: Mapping[str, Quantity] = MappingProxyType(
    {
        quantity.name: quantity
        for quantity in (
            Quantity(
                name="albedo",
                title="Albedo",
                channels=3,
                slot="base_color",
                lower=0.0,
                upper=1.0,
                initial=0.5,
                default=0.5,
                display="colour",
                comes_back=True,
                settings={
                    "neural": {
                        "hidden": 1,
                        "learning_rate": 0.015,
                        "pieces": {
                            "most": 4096,
                            "brightnesses": 1,
                            "gain": 1.0,
                            "network": 1.0,
                            "variation": True,
                            "learned": False,
                        },
                    },
                    "grid": {"cells": 64, "learning_rate": 0.1},
                    "triplane": {"learning_rate": 0.06},
                    "bitmap": {"resolution": 128, "learning_rate": 0.15},
                },
            ),
            # Photographs tell far less of roughness than of albedo, so that its fields are coarser.
            Quantity(
                name="roughness",
                title="Roughness",
                channels=1,
                slot="roughness",
                lower=0.02,  # below it, the microfacet density overflows single precision
                upper=1.0,
                initial=0.51,
                default=0.5,
                display="data",
                settings={
                    "neural": {
                        "grid": {"footprints": 8.0},
                        "width": 16,
                        "hidden": 1,
                        "learning_rate": 0.004,
                        "pieces": {
                            "most": 4096,
                            "colours": 6,
                            "own_colours": 4,
                            "places": 4,
                            "variation": True,
                        },
                    },
                    "grid": {"cells": 16, "learning_rate": 0.025},
                    "triplane": {"base_resolution": 8, "width": 16, "learning_rate": 0.004},
                    "bitmap": {"resolution": 32, "learning_rate": 0.04},
                },
            ),
            # Most surfaces are no metals; halfway between, a surface is like neither.
            Quantity(
                name="metallic",
                title="Metallic",
                channels=1,
                slot="metallic",
                lower=0.0,
                upper=1.0,
                initial=0.1,
                default=0.0,
                display="data",
                settings={
                    "neural": {
                        "grid": {"footprints": 8.0},
                        "width": 16,
                        "hidden": 1,
                        "learning_rate": 0.004,
                    },
                    "grid": {"cells": 16, "learning_rate": 0.025},
                    "triplane": {"base_resolution": 8, "width": 16, "learning_rate": 0.004},
                    "bitmap": {"resolution": 32, "learning_rate": 0.04},
                },
            ),
        )
    }
)

DEFAULT_QUANTITIES = ("albedo", "roughness")
#: The score of albedo after alignment, where photographs leave its scale open.
ALIGNED = "albedo_psnr_aligned"

#: Numbers a surface point can carry to its BSDF, in two vectors of Mitsuba's interaction.
CARRIED = 6


def quantity(name: str) -> Quantity:
    """The quantity of this name.

    Raises:
        UserError: there is none.
    """
    require_name(name, QUANTITIES, "quantity")
    return QUANTITIES[name]


def in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Names of quantities in the order of the table.

    Raises:
        UserError: a quantity is unknown or named twice, or there is none, or there are more numbers
            than a surface point can carry.
    """
    given = [quantity(name).name for name in names]
    if not given:
        raise UserError("no quantity named", remedy=f"There are {', '.join(QUANTITIES)}")
    if len(set(given)) < len(given):
        raise UserError(f"a quantity is named twice: {', '.join(given)}")
    numbers = sum(QUANTITIES[name].channels for name in given)
    if numbers > CARRIED:
        raise UserError(
            f"{', '.join(given)} are {numbers} numbers a point, and {CARRIED} are the most",
            remedy="Name fewer quantities",
        )
    return tuple(name for name in QUANTITIES if name in given)


def channels_of(names: Iterable[str]) -> dict[str, slice]:
    """Where each quantity's channels stand when all are written one after the other."""
    chosen, first, found = set(names), 0, {}
    for name, row in QUANTITIES.items():
        if name in chosen:
            found[name] = slice(first, first + row.channels)
            first += row.channels
    return found
