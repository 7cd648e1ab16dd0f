"""How the radiance of a known scene is learned. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from ..config.fit import DEEPEST, dimmed
from ..config.flag import Flag
from ..errors import UserError, require_ranges
from ..fields.settings import LEAK, GridConfig, NetworkConfig, require_no_pieces

#: Samples of a pixel are all in flight at once; see `transport/render.py`.
MOST_SAMPLES = 1 << 20
#: Bounces of all points of a step are in flight at once.
MOST_BOUNCES = 1 << 22


def _network() -> NetworkConfig:
    """The network of L_θ; the sizes of its hash grid are chosen from the pictures."""
    return NetworkConfig(grid=GridConfig(levels=0, table_log2=0), leak=LEAK)


#: Mean radiance from which on scenes are bright, in other units than most.
_BRIGHT = 1.0


def epsilon_at(epsilon: float, level: float) -> float:
    """What is added to squared radiance, where a scene is dim or bright.

    It follows the square of the level in dim scenes (`dimmed`) and above 1, so that nothing depends
    on the unit of light there.

    Args:
        epsilon: for scenes between these.
        level: mean radiance, linear RGB.
    """
    return dimmed(epsilon, level) * max(level / _BRIGHT, 1.0) ** 2


@dataclass(frozen=True)
class SolveSettings:
    """How the radiance of a known scene is learned, and how it is measured.

    Raises:
        UserError: a value has the wrong type or range, or the numbers do not fit each other.
    """

    #: Not counted where `seconds` is given.
    steps: Annotated[int, Flag("Length in steps, unless --seconds is given")] = 2400
    #: Time for measurements is not counted. 0: `steps` counts.
    seconds: Annotated[
        float, Flag("Length in seconds of training; with it, --steps does not count")
    ] = 0.0
    #: N of Eq. 4.
    batch: Annotated[int, Flag("Surface points per step")] = 8192
    #: M. Their mean is the right-hand side.
    samples: Annotated[int, Flag("Samples of the right-hand side per point")] = 2
    #: The square is then the product of two residuals, each of half of the samples: its
    #: expectation is free of their variance.
    attach_rhs: Annotated[
        bool, Flag("Let gradients pass through the right-hand side too; else it is a constant")
    ] = False
    seed: Annotated[int, Flag("Seed of all random numbers")] = 0
    #: Without a camera file.
    views: Annotated[
        int,
        Flag(
            "Pictures to render. Cameras are placed automatically, or are those of the built-in "
            "scene; --from takes the held-out views instead"
        ),
    ] = 4
    #: Of the cameras of a file, too: their horizontal fields of view stay.
    resolution: Annotated[int, Flag("Width and height of the pictures in pixels")] = 64
    spp: Annotated[
        int, Flag("Samples per pixel of both sides, where they are measured on the way")
    ] = 64
    #: With fewer, the right-hand side would be judged by the noise of its bounces.
    final_spp: Annotated[
        int, Flag("Samples per pixel of the pictures of both sides, in the end")
    ] = 1024
    reference_spp: Annotated[
        int, Flag("Samples per pixel of the path traced reference, an even number; 0: none")
    ] = 256
    max_depth: Annotated[int, Flag("Longest light path of the reference")] = 64
    rr_depth: int = 8  #: bounces of the reference before Russian roulette
    max_specular: int = 8  #: longest chain of specular interactions
    #: Added to the squared radiance that residuals are relative to; see `epsilon_at`.
    epsilon: float = 0.01
    #: The last learning rate, as a fraction of the first.
    final_learning_rate: float = 0.03
    radiance: NetworkConfig = field(default_factory=_network)

    def __post_init__(self) -> None:
        require_ranges(
            self,
            {
                "steps": (1, 10**9),
                "seconds": (0, 1e9),
                "batch": (1, MOST_BOUNCES),
                "samples": (1, MOST_BOUNCES),
                "seed": (0, (1 << 31) - 1),
                "views": (1, 10_000),
                "resolution": (2, 16_384),
                **dict.fromkeys(("spp", "final_spp"), (1, MOST_SAMPLES)),
                "reference_spp": (0, MOST_SAMPLES),
                "max_depth": (1, DEEPEST),
                "rr_depth": (1, DEEPEST),
                "max_specular": (0, DEEPEST),
                "epsilon": (1e-9, 1e9),
                "final_learning_rate": (1e-6, 1),
            },
        )
        require_no_pieces(self.radiance, "radiance")
        if self.batch * self.samples > MOST_BOUNCES:
            what = f"{self.batch} points of {self.samples} samples are too many for a step"
            raise UserError(what, "--batch", f"Their product is at most {MOST_BOUNCES}")
        if self.attach_rhs and self.samples % 2:
            what = "needs an even number of samples, in two halves"
            raise UserError(what, "--attach-rhs", "Give an even --samples")
        if self.reference_spp % 2:
            raise UserError("must be even, for two halves", "--reference-spp")
