"""How a recovered scene is rendered and measured. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from ..config.fit import DEEPEST
from ..config.flag import Flag
from ..errors import require_ranges

#: Samples of a pixel are all in flight at once; see `transport/render.py`.
MOST_SAMPLES = 1 << 20


@dataclass(frozen=True)
class EvaluationSettings:
    """How the recovered scene is rendered.

    Raises:
        UserError: a number is out of range.
    """

    #: Camera samples a pixel.
    spp: Annotated[int, Flag("Samples per pixel: more mean less noise, and more time")] = 64
    #: Bounces, plus one; specular ones are not counted.
    max_depth: Annotated[int, Flag("Longest light path")] = 48
    rr_depth: int = 5  #: bounces before Russian roulette
    #: All held-out views are rendered.
    train_views: Annotated[
        int, Flag("How many of the views learned from to render, beside all held-out ones")
    ] = 4
    material_spp: int = 16  #: camera samples a pixel of the pictures of materials
    #: As always if the fit did.
    clip_negative: Annotated[
        bool,
        Flag("Take negative pixels of photographs as zero, as in a fit with this option"),
    ] = False
    truth: Annotated[
        bool,
        Flag("Render captured scenes with their true materials too: what noise alone leaves"),
    ] = False

    def __post_init__(self) -> None:
        samples = dict.fromkeys(("spp", "material_spp"), (1, MOST_SAMPLES))
        depths = dict.fromkeys(("max_depth", "rr_depth"), (1, DEEPEST))
        require_ranges(self, samples | depths | {"train_views": (0, 10**6)})
