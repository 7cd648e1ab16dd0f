"""How a data set is rendered. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from ..config.fit import DEEPEST
from ..config.flag import Flag
from ..config.light import Axis
from ..errors import UserError, require_ranges

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
        UserError: a value has the wrong type, or a number is out of range.
    """

    #: Without a camera file.
    views: Annotated[
        int,
        Flag(
            "Views to learn from. Cameras are placed automatically, or are those of the built-in "
            "scene"
        ),
    ] = 24
    #: Without a camera file.
    held_out: Annotated[int, Flag("Further views that are kept apart, to judge results by")] = 4
    #: Of the cameras of a file, too: their horizontal fields of view stay.
    resolution: Annotated[int, Flag("Width and height of the images in pixels")] = 128
    #: Camera samples a pixel, stratified.
    spp: Annotated[int, Flag("Samples per pixel: more mean less noise, and more time")] = 100
    #: Paths cut short would be fitted as darker materials.
    max_depth: Annotated[
        int, Flag("Longest light path; too short a limit looks like darker materials")
    ] = 64
    rr_depth: int = 8  #: bounces before Russian roulette
    seed: Annotated[int, Flag("Seed of all random numbers")] = 0
    #: Without a camera file, and not of built-in scenes.
    up: Annotated[
        Literal["auto", Axis],
        Flag(
            "World axis that is up, where cameras are placed automatically: auto is up by the "
            "scene's own sensor, and +y without one"
        ),
    ] = "auto"
    background: Annotated[
        Literal["auto", "visible", "hidden"],
        Flag(
            "Whether photographs show the environment and lamps: auto hides them around objects, "
            "and shows them in rooms"
        ),
    ] = "auto"

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


#: Names of responses; see `acquisition/degrade.py`.
Response = Literal["srgb", "gamma", "contrast", "lifted"]
#: Formats of degraded photographs.
Format = Literal["exr", "png", "jpeg"]
#: How finely JPEG files hold colour.
Chroma = Literal["half", "full"]


@dataclass(frozen=True)
class DegradeSettings:
    """What a camera does to photographs. The defaults leave everything as it is.

    Raises:
        UserError: a value has the wrong type, or a number is out of range.
    """

    exposure: Annotated[
        float, Flag("Largest random change of exposure, in stops; the first view is unchanged")
    ] = 0.0
    white_balance: Annotated[float, Flag("Largest random change of red against blue, in stops")] = (
        0.0
    )
    #: Cameras give code values, which programs decode by the sRGB curve.
    response: Annotated[
        Response,
        Flag(
            "Response of the camera: srgb (decoded without error), gamma (a power of 1/2.2), "
            "contrast (an S-shaped curve, as phones have) or lifted (midtones brighter than srgb)"
        ),
    ] = "srgb"
    vignetting: Annotated[float, Flag("Share of the light that is lost in the corners")] = 0.0
    electrons: Annotated[
        float, Flag("Electrons per pixel at white, which adds shot noise; 0: no noise")
    ] = 0.0
    read_noise: Annotated[float, Flag("Read noise in electrons; only with --electrons given")] = 0.0
    clip: Annotated[
        float | None,
        Flag(
            "Share of the pixels, before exposures change, that is brighter than white and clipped "
            "(default: 0.01 with a response, noise or 8-bit files, which need a white; otherwise "
            "nothing is clipped)",
            metavar="NUMBER",
            tell_default=False,
        ),
    ] = None
    pose_jitter: Annotated[
        float,
        Flag("Random pose errors: by how many pixels they move the image, root mean square"),
    ] = 0.0
    displace: Annotated[
        float, Flag("Random displacement of meshes, as a fraction of the scene's diagonal")
    ] = 0.0
    #: Small meshes stay as they are: see `acquisition/decimate.py`.
    decimate: Annotated[
        float,
        Flag(
            "Share of their triangles that meshes keep together; dense ones lose more of theirs, "
            "those of fewer than 64 none",
            metavar="SHARE",
        ),
    ] = 1.0
    format: Annotated[
        Format,
        Flag(
            "Format of the photographs: exr, or 8-bit code values of the sRGB curve as png or jpeg"
        ),
    ] = "exr"
    quality: Annotated[int, Flag("Quality of JPEG files, from 1 to 100")] = 92
    chroma: Annotated[
        Chroma,
        Flag(
            "Resolution of colour in JPEG files: half along both edges (4:2:0), as most cameras "
            "write it, or full (4:4:4)"
        ),
    ] = "half"
    tell_exposures: Annotated[
        bool, Flag("Write the true exposures to the frames, as EXIF would have them")
    ] = False
    tell_noise: Annotated[bool, Flag("Write the noise of the sensor to the frames")] = False
    seed: Annotated[int, Flag("Seed of all random numbers")] = 0

    def __post_init__(self) -> None:
        require_ranges(
            self,
            {
                "exposure": (0, 8),
                "white_balance": (0, 4),
                "vignetting": (0, 0.99),
                "electrons": (0, 1e9),
                "read_noise": (0, 1e6),
                "clip": (0, 0.9),
                "pose_jitter": (0, 100),
                "displace": (0, 0.1),
                "decimate": (0, 1),
                "quality": (1, 100),
                "seed": (0, (1 << 31) - 1),
            },
        )
        if self.decimate == 0:
            raise UserError("must be more than 0", "decimate")
        if self.read_noise and not self.electrons:
            raise UserError(
                "needs electrons", "read_noise", "Give electrons at white, such as 10000"
            )
        if self.tell_noise and (not self.electrons or self.response != "srgb"):
            what = "needs noise, and a response that is decoded without an error"
            remedy = "Give electrons at white, such as 10000, and the response srgb"
            raise UserError(what, "tell_noise", remedy)

    @property
    def white(self) -> float | None:
        """Share of the pixels that is clipped; None where there is no white."""
        ends = self.electrons or self.response != "srgb" or self.format != "exr"
        if self.clip is None and ends:
            return 0.01
        return self.clip
