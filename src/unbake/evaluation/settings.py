"""How a recovered scene is rendered and measured. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ..config.fit import DEEPEST
from ..config.flag import Flag
from ..errors import require_ranges

#: Of `render.json`.
RENDER_FORMAT = 1
#: Samples of a pixel are all in flight at once; see `transport/render.py`.
MOST_SAMPLES = 1 << 20
#: Pixels along an edge of a picture, and pictures of a turntable.
LARGEST_PICTURE, MOST_PICTURES = 16_384, 10_000


@dataclass(frozen=True)
class EvaluationSettings:
    """How the recovered scene is rendered.

    Raises:
        UserError: a value has the wrong type, or a number is out of range.
    """

    #: Camera samples a pixel.
    spp: Annotated[int, Flag("Samples per pixel: more mean less noise, and more time")] = 64
    #: Bounces, plus one; specular ones are not counted.
    max_depth: Annotated[int, Flag("Longest light path")] = 48
    rr_depth: int = 5  #: first bounce that Russian roulette may take away
    #: All held-out views are rendered.
    train_views: Annotated[int, Flag("Training views to render, besides all held-out ones")] = 4
    material_spp: int = 16  #: camera samples a pixel of the pictures of materials
    #: As always if the fit did.
    clip_negative: Annotated[
        bool,
        Flag("Take negative pixels of photographs as zero, as in a fit with this option"),
    ] = False
    truth: Annotated[
        bool,
        Flag("Also render the true materials of a captured scene, whose errors are noise alone"),
    ] = False

    def __post_init__(self) -> None:
        samples = dict.fromkeys(("spp", "material_spp"), (1, MOST_SAMPLES))
        depths = dict.fromkeys(("max_depth", "rr_depth"), (1, DEEPEST))
        require_ranges(self, samples | depths | {"train_views": (0, 10**6)})


@dataclass(frozen=True)
class RenderSettings:
    """How new pictures of a recovered scene are rendered and shown.

    Raises:
        UserError: a value has the wrong type, or a number is out of range.
    """

    #: Without a camera file and without a turntable.
    views: Annotated[
        Literal["heldout", "train", "all"], Flag("Views of the data set to render")
    ] = "heldout"
    #: Pixels; None: as the photographs, or in the proportions of the other.
    width: int | None = None
    height: int | None = None
    #: Camera samples a pixel.
    spp: Annotated[int, Flag("Samples per pixel: more mean less noise, and more time")] = 128
    max_depth: Annotated[int, Flag("Longest light path")] = 48
    rr_depth: int = 5  #: first bounce that Russian roulette may take away
    seed: Annotated[int, Flag("Seed of all random numbers")] = 1
    #: Stops; of PNG files alone.
    exposure: Annotated[float, Flag("Stops by which PNG files are brighter than the values")] = 0.0
    denoise: Annotated[bool, Flag("Denoise pictures with OptiX, which needs an NVIDIA GPU")] = False
    material_spp: int = 16  #: camera samples a pixel of the masks of scores

    def __post_init__(self) -> None:
        require_ranges(
            self,
            {
                "width": (1, LARGEST_PICTURE),
                "height": (1, LARGEST_PICTURE),
                "spp": (1, MOST_SAMPLES),
                "max_depth": (1, DEEPEST),
                "rr_depth": (1, DEEPEST),
                "seed": (0, 2**32 - 1),
                "exposure": (-100, 100),
                "material_spp": (1, MOST_SAMPLES),
            },
        )
