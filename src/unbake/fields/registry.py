"""The representations that a field can have, by name. Needs neither Mitsuba nor Dr.Jit.

A representation from outside the package needs one call and is then a name like any other, in
`FitConfig(representation=...)`, in settings files and on the command line:

    register_representation(Representation("mine", "my own", MySettings(), make=make_mine))
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import require_name
from .settings import (
    LEAK,
    BitmapConfig,
    DenseGridConfig,
    FieldSettings,
    GridConfig,
    NetworkConfig,
    TriPlaneConfig,
)

if TYPE_CHECKING:
    from .field import Field, FieldSpec

Maker = Callable[[Any, "FieldSpec"], "Field"]


@dataclass(frozen=True)
class Representation:
    """A way to represent a function on surfaces.

    Args:
        name: in settings and on the command line.
        title: on pages.
        settings: those of a quantity whose row in the table `QUANTITIES` does not say otherwise: a
            frozen dataclass with a `learning_rate`, whose `__post_init__` checks its values.
        make: makes a fresh field of settings and a `FieldSpec`: a function, or "module:function",
            which is imported when the first field is made.
        radiance: settings of the radiance field; None: it cannot be represented so.
        unwrapped: the field is in texture coordinates, apart for each material.
        size: the key of the settings, dotted, that decides how much memory a field takes; told
            where it takes too much.
    """

    name: str
    title: str
    settings: FieldSettings
    make: Maker | str
    radiance: FieldSettings | None = None
    unwrapped: bool = False
    size: str | None = None

    def field(self, settings: FieldSettings, spec: FieldSpec) -> Field:
        """A fresh field."""
        make = self.make
        if isinstance(make, str):
            module, _, function = make.partition(":")
            make = getattr(importlib.import_module(module), function)
        return make(settings, spec)


_REPRESENTATIONS: dict[str, Representation] = {}


def register_representation(representation: Representation) -> None:
    """Make a representation known by its name.

    Raises:
        ValueError: another one has the name, or it is no bare key of TOML.
        TypeError: the settings are not a dataclass with a learning rate.
    """
    name = representation.name
    if _REPRESENTATIONS.get(name, representation) != representation:
        raise ValueError(f"there is a representation named {name!r} already")
    if not name.replace("-", "").replace("_", "").isalnum() or not name.isascii():
        raise ValueError(f"{name!r} is not a name: letters, digits, - and _ only")
    for settings in (representation.settings, representation.radiance):
        if settings is None:
            continue
        if not dataclasses.is_dataclass(settings) or isinstance(settings, type):
            raise TypeError(
                f"settings of {name!r} are {settings!r}, not an instance of a dataclass"
            )
        if not isinstance(getattr(settings, "learning_rate", None), float):
            raise TypeError(f"settings of {name!r} have no learning_rate, a float")
    _REPRESENTATIONS[name] = representation


def representation(name: str) -> Representation:
    """The representation of this name.

    Raises:
        UserError: there is none.
    """
    require_name(name, _REPRESENTATIONS, "representation")
    return _REPRESENTATIONS[name]


def representations(*, radiance: bool = False) -> tuple[str, ...]:
    """The names of all representations, or of those that the radiance field can have."""
    return tuple(
        name for name, r in _REPRESENTATIONS.items() if r.radiance is not None or not radiance
    )


register_representation(
    Representation(
        "neural",
        "network",
        NetworkConfig(),
        make="unbake.fields.network:Network",
        radiance=NetworkConfig(GridConfig(footprints=2.0), leak=LEAK),
        size="grid.table_log2",
    )
)
register_representation(
    Representation(
        "grid",
        "3D grid",
        DenseGridConfig(),
        make="unbake.fields.grid:DenseGrid",
        radiance=DenseGridConfig(),
        size="cells",
    )
)
register_representation(
    Representation(
        "bitmap",
        "bitmaps",
        BitmapConfig(),
        make="unbake.fields.bitmap:Bitmaps",
        unwrapped=True,
        size="resolution",
    )
)
register_representation(
    Representation(
        "triplane",
        "tri-plane",
        TriPlaneConfig(),
        make="unbake.fields.triplane:TriPlane",
        radiance=TriPlaneConfig(hidden=2, leak=LEAK),
        size="base_resolution",
    )
)
