"""How a data set is rendered. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..config.fit import DEEPEST
from ..config.flag import Flag
from ..errors import require_ranges

#: Pixels of the training views, chosen at random, and samples of each, that measure how much light
#: paths carry by their depth.
LIGHT_PIXELS, LIGHT_SAMPLES = 16384, 16
#: Views of each kind, and pixels along an edge of their images.
MOST_VIEWS, LARGEST_IMAGE = 10_000, 16_384
#: Samples of a pixel are all in flight at once; see `transport/render.py`.
MOST_SAMPLES = 1 << 20


@dataclass(frozen=True)
class CaptureSettings:
    """How a data set is rendered.

    Raises:
        UserError: a number is out of range.
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
        require_ranges(
            self,
            {
                "views": (1, MOST_VIEWS),
                "held_out": (0, MOST_VIEWS),
                "resolution": (2, LARGEST_IMAGE),
                "spp": (1, MOST_SAMPLES),
                "max_depth": (1, DEEPEST),
                "rr_depth": (1, DEEPEST),
                "seed": (0, (1 << 31) - 1),  # of Mitsuba's samplers
            },
        )
