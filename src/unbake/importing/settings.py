"""How a source becomes a data set. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ..config.flag import Flag
from ..errors import require_ranges

#: As of cameras (`LONGEST_SIDE`).
_MOST = 1 << 16


@dataclass(frozen=True)
class ImportSettings:
    """How a source becomes a data set.

    Raises:
        UserError: a number is out of range.
    """

    #: By the order of names, from the first; views of one pose are one.
    holdout: Annotated[
        int,
        Flag("Hold out every Nth view where the source has no splits; 0 holds out none"),
    ] = 8
    background: Annotated[
        Literal["auto", "visible", "hidden"],
        Flag(
            "Background of the photographs: visible (the environment that lights the mesh), hidden "
            "(ignored, by alpha or where the mesh is not seen) or auto (hidden if all photographs "
            "have alpha, and any is transparent)"
        ),
    ] = "auto"
    keep_applied_transform: Annotated[
        bool,
        Flag("Leave nerfstudio's cameras in the frame of their file, instead of that of COLMAP"),
    ] = False
    mesh_y_up: Annotated[
        bool,
        Flag(
            "Turn the mesh from y up to z up, the world of Blender's cameras: glTF files, and OBJ "
            "files as Blender writes them, have y up. Exports of unbake are turned back without it"
        ),
    ] = False
    mesh_scale: Annotated[
        float,
        Flag("Multiply the mesh by this number, where it is in another unit than the cameras"),
    ] = 1.0
    longest: Annotated[
        int,
        Flag(
            "Make photographs smaller, so that no edge has more pixels than this: squares of "
            "pixels become one each, by the mean of their light; 0 leaves them as they are"
        ),
    ] = 0
    lamps: Annotated[
        Literal["auto", "found", "none"],
        Flag(
            "Lamps, where the light is unknown: found (surfaces that are too bright to reflect; a "
            "fit finds their strength), none, or auto (found where all cameras stand inside the "
            "mesh)"
        ),
    ] = "auto"
    leave_out_missing: Annotated[
        bool,
        Flag("Go on without photographs that the source names and that do not exist"),
    ] = False

    def __post_init__(self) -> None:
        ranges = {"holdout": (0, 10**6), "mesh_scale": (1e-9, 1e9), "longest": (0, _MOST)}
        require_ranges(self, ranges)
