"""How a data set is rendered. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..config.flag import Flag
from ..errors import require

#: Pixels of the training views, chosen at random, and samples of each, that measure how much light
#: paths carry by their depth.
LIGHT_PIXELS, LIGHT_SAMPLES = 16384, 16


@dataclass(frozen=True)
class CaptureSettings:
    """How a data set is rendered.

    Raises:
        UserError: a number is too small.
    """

    #: Without a camera file.
    views: Annotated[int, Flag("Views to learn from. Cameras are placed automatically")] = 24
    #: Without a camera file.
    held_out: Annotated[int, Flag("Further views that are kept apart, to judge results by")] = 4
    #: Unless the camera file has its own.
    resolution: Annotated[int, Flag("Width and height of the images in pixels")] = 128
    #: Camera samples a pixel, stratified.
    spp: Annotated[int, Flag("Samples per pixel: more mean less noise, and more time")] = 100
    #: Paths cut short would be fitted as darker materials.
    max_depth: Annotated[
        int, Flag("Longest light path; too short a limit looks like darker materials")
    ] = 64
    rr_depth: int = 8  #: bounces before Russian roulette
    seed: Annotated[int, Flag("Seed of all random numbers")] = 0

    def __post_init__(self) -> None:
        least = {"held_out": 0, "resolution": 2, "seed": 0}
        for name, value in vars(self).items():
            smallest = least.get(name, 1)
            require(value >= smallest, name, f"{smallest} or more", value)
