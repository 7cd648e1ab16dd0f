"""What is unknown of the cameras. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ..errors import require_ranges
from .flag import Flag

Exposures = Literal["known", "per-image"]
WhiteBalance = Literal["known", "common", "per-image"]
Vignetting = Literal["known", "radial"]
Response = Literal["known", "monotone"]
Refinement = Literal["given", "refined"]


@dataclass(frozen=True)
class CameraConfig:
    """What is unknown of the cameras that took the photographs (ours).

    `known` is as the data set tells: `exposure` of its frames, and else a linear camera without
    vignetting and with one white balance. See `fields/camera.py`, and `training/poses.py`.
    """

    exposure: Annotated[
        Exposures,
        Flag(
            "Exposures: known, as the data set tells, or per-image, where each is fitted but that "
            "of the first training view",
            name="exposures",
        ),
    ] = "known"
    white_balance: Annotated[
        WhiteBalance,
        Flag(
            "Gains of red and blue relative to green: known, one pair that is common to all "
            "photographs, or per-image, relative to the first training view"
        ),
    ] = "known"
    vignetting: Annotated[
        Vignetting,
        Flag("How photographs darken to their edges: known, or radial, a fitted polynomial"),
    ] = "known"
    response: Annotated[
        Response,
        Flag(
            "Response of the camera: known (photographs are linear once decoded, JPEG and PNG by "
            "the sRGB curve), or monotone, a curve for each channel between the values 0 and 1"
        ),
    ] = "known"
    poses: Annotated[
        Refinement,
        Flag(
            "Where cameras stood: given, as the data set tells, or refined, where each training "
            "view gets a small correction"
        ),
    ] = "given"
    intrinsics: Annotated[
        Refinement,
        Flag(
            "Focal lengths and principal points: given, as the data set tells, or refined, by "
            "corrections that views of the same intrinsics share"
        ),
    ] = "given"
    pose_sigma: Annotated[
        float,
        Flag("Uncertainty of what is refined: standard deviation of its corrections in pixels"),
    ] = 1.0
    learning_rate: float = 0.005  #: Adam; of logs of gains, and of coefficients
    pose_learning_rate: float = 0.05  #: Adam; of corrections of poses and intrinsics, in pixels

    def __post_init__(self) -> None:
        require_ranges(
            self,
            {
                "learning_rate": (0, 1e3),
                "pose_learning_rate": (0, 1e3),
                "pose_sigma": (1e-3, 1e3),
            },
        )

    @property
    def unknowns(self) -> tuple[str, ...]:
        """What is unknown, each with parameters of its own."""
        return self.of_light + self.of_places

    @property
    def of_light(self) -> tuple[str, ...]:
        """What is unknown of how cameras turn light into photographs."""
        names = ("exposure", "white_balance", "vignetting", "response")
        return tuple(name for name in names if getattr(self, name) != "known")

    @property
    def of_places(self) -> tuple[str, ...]:
        """What is unknown of where cameras stood and looked."""
        return tuple(name for name in ("poses", "intrinsics") if getattr(self, name) != "given")
