"""What the photographs and the masks of a source hold, decoded."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from PIL import Image

from ..dataset.camera import LONGEST_SIDE
from ..dataset.image_files import PIXEL_BYTES, counted_in, read_radiance
from ..errors import UserError, named
from ..imaging.coded import decode, read_codes
from ..imaging.profiles import linear_srgb, profile_name, read_profile
from ..memory import require_memory
from .faults import Faults
from .progress import each_photograph
from .raw import CLIPPED as CLIPPED_RAW
from .raw import raw_told, read_raw
from .source import Shot, image_header, same_shape

_AGAIN = "Write it again, or copy it again"
#: Codes at and above this share of the largest one are taken for clipped: 250 of 255.
CLIPPED_CODE = 250 / 255
#: A linear value below zero by more than this is a colour that sRGB lacks, and the share of pixels
#: with one from which on it is told.
_BEYOND, _OFTEN = 0.01, 0.01


@dataclass(frozen=True)
class Pictures:
    """What the pixels of photographs say: names of those with an alpha channel, and so on.

    Args:
        with_alpha: have an alpha channel.
        transparent: have pixels whose alpha is less than 1.
        empty: have pixels whose alpha is 0, and no mask.
        grey: have one channel of colour.
        negative: have negative radiance.
        profiles: the names of colour profiles that are not those of sRGB.
        beyond: have such a profile, and colours that sRGB lacks.
    """

    with_alpha: set[str] = field(default_factory=set)
    transparent: set[str] = field(default_factory=set)
    empty: set[str] = field(default_factory=set)
    grey: set[str] = field(default_factory=set)
    negative: set[str] = field(default_factory=set)
    profiles: dict[str, str] = field(default_factory=dict)
    beyond: set[str] = field(default_factory=set)

    def told(self) -> list[str]:
        """What was changed of the colours, for people."""
        count = Counter(self.profiles.values())
        told = [
            f"colours: photographs with the profile {name}, converted to sRGB: {n}"
            for name, n in sorted(count.items())
        ]
        if self.beyond:
            told.append(f"colours that sRGB lacks are cut off in {named(sorted(self.beyond))}")
        return told

    def add(self, shot: Shot, pixels: np.ndarray) -> None:
        """Take a photograph into account: (H, W, 4)."""
        if (pixels[..., 3] < 1).any():
            self.transparent.add(shot.name)
        if shot.mask is None and (pixels[..., 3] <= 0).any():
            self.empty.add(shot.name)
        profile = _profile(shot)
        if profile is not None:
            self.profiles[shot.name] = profile_name(profile)
            if (pixels[..., :3] < -_BEYOND).any(axis=2).mean() > _OFTEN:
                self.beyond.add(shot.name)
        elif (pixels < 0).any():
            self.negative.add(shot.name)
        channels = image_header(shot.image).channels
        if shot.name in self.transparent or channels in (2, 4):
            self.with_alpha.add(shot.name)
        if channels <= 2:
            self.grey.add(shot.name)

    def extend(self, others: Pictures) -> None:
        """Take what is known of other photographs into account."""
        for each in fields(self):
            getattr(self, each.name).update(getattr(others, each.name))

    def background(self, wanted: str, names: Collection[str]) -> str:
        """The background of the data set, "visible" or "hidden".

        Args:
            wanted: the same, or "auto".
            names: of all photographs.
        """
        if wanted != "auto":
            return wanted
        # Screenshots and pictures of some converters have an alpha of 1 everywhere.
        return "hidden" if self.transparent and self.with_alpha == set(names) else "visible"

    def warnings(
        self, names: Collection[str], background: str, blank: Sequence[str]
    ) -> Iterator[str]:
        """What may be fitted for something else than it is, or not at all, for people.

        Args:
            names: of all photographs.
            background: of the data set, "visible" or "hidden".
            blank: photographs of which no pixel counts.
        """
        if self.grey and len(self.grey) < len(names):
            yield (
                "warning: photographs without colours are among others, and a fit takes their grey "
                f"for the colour: {named(sorted(self.grey))}. Remove them"
            )
        if self.empty and background == "visible":
            opaque = sorted(set(names) - self.transparent)
            others = f", beside opaque ones ({named(opaque)})" if opaque else ""
            which = "the opaque ones" if opaque else "their alpha"
            yield (
                "warning: photographs have pixels of alpha 0, fitted as a black background: "
                f"{named(sorted(self.empty))}{others}. Give --background hidden or --masks FOLDER, "
                f"or remove {which}"
            )
        if blank:
            yield (
                f"warning: masks leave no pixel of {len(blank)} photographs: {named(blank)}. They "
                "are black where pixels do not count"
            )
        if self.negative:
            few = ", ".join(sorted(self.negative)[:3])
            yield f"{len(self.negative)} photographs have negative pixels, taken as zero: {few}"


def check_cameras(shots: Sequence[Shot], faults: Faults) -> None:
    """Add cameras that are none, and images that are too long, to the faults."""
    for shot in shots:
        if max(shot.size) > LONGEST_SIDE:
            faults.add(f"the image has over {LONGEST_SIDE} pixels along an edge", shot.name)
            continue
        with faults.collected(shot.name):
            shot.lens.camera(shot.to_world)


def check_pictures(shots: Sequence[Shot], faults: Faults, tell: Callable[[str], None]) -> Pictures:
    """Decode all photographs and masks once, and add those that cannot be read to the faults.

    Those that are too long, as `check_cameras` tells, are left out.

    Args:
        shots: the photographs.
        faults: to add to.
        tell: called where it takes long.
    """
    found = Pictures()
    shots = [shot for shot in shots if max(shot.size) <= LONGEST_SIDE]
    for own, wrong in each_photograph(_looked_at, ((s,) for s in shots), shots, "read", tell):
        found.extend(own)
        faults.extend(wrong)
    return found


def _looked_at(shot: Shot) -> tuple[Pictures, Faults]:
    """What the pixels of one photograph say, and what is wrong with it and its mask."""
    found, faults = Pictures(), Faults()
    with faults.collected(shot.name):
        found.add(shot, pixels_of(shot))
    if shot.mask is not None:
        with faults.collected(shot.mask):
            header = image_header(shot.mask)
            if not same_shape((header.width, header.height), shot.size):
                raise UserError("the mask has another size than its image")
            mask_of(shot)
    return found, faults


def pixels_of(shot: Shot) -> np.ndarray:
    """The photograph, (H, W, 4) float32: linear, alpha premultiplied; maybe negative."""
    need = PIXEL_BYTES * shot.lens.width * shot.lens.height
    require_memory(need, "the image needs", "Use a smaller image", shot.name)
    if shot.coded:
        codes, profile = read_codes(shot.image), _profile(shot)
        pixels = decode(codes)
        if profile is not None and codes.shape[2] >= 3:
            pixels[..., :3] = linear_srgb(codes[..., :3], profile) * pixels[..., 3:]
        return pixels
    if shot.raw:
        linear = read_raw(shot.image, shot.balance, shot.size)
        return np.concatenate([linear, np.ones_like(linear[..., :1])], 2)
    pixels = read_radiance(shot.image, shot.lens.width, shot.lens.height)
    return pixels.reshape(shot.lens.height, shot.lens.width, 4)


def mask_of(shot: Shot) -> np.ndarray | None:
    """Which pixels count, (H, W) bool; None: all do."""
    mask = None if shot.mask is None else _of_size(counted_in(shot.mask, _AGAIN), shot.size)
    told = raw_told(shot.image, shot.balance, shot.size) if shot.raw else _told(shot)
    if told is None or told.all():
        return mask
    return told if mask is None else mask & told


def _of_size(mask: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A mask for an image that was made smaller or larger: a pixel counts if all of it does."""
    if mask.shape == size[::-1]:
        return mask
    share = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).resize(
        size, Image.Resampling.BOX
    )
    return np.equal(np.asarray(share), 255)


def _told(shot: Shot) -> np.ndarray | None:
    """As `raw_told`, of a photograph whose colours are mixed to those of sRGB; None: all pixels."""
    if _profile(shot) is None:
        return None
    codes = read_codes(shot.image)[..., :3]
    clipped = codes >= CLIPPED_CODE * np.iinfo(codes.dtype).max
    return np.logical_or(clipped.all(2), ~clipped.any(2))


def _profile(shot: Shot) -> bytes | None:
    """The colour profile of a photograph, unless it is that of sRGB."""
    return read_profile(shot.image) if shot.coded else None


def clipped_from(shot: Shot) -> float | None:
    """The decoded value from which on a photograph is taken for clipped; None of radiance."""
    if shot.raw:
        return CLIPPED_RAW
    if not shot.coded:
        return None
    profile = _profile(shot)
    if profile is None:
        code = np.full((1, 1, 1), round(CLIPPED_CODE * 255), np.uint8)
        return round(float(decode(code)[0, 0, 0]), 6)
    # The least that any mixture of clipped colours can be.
    codes = np.array([round(CLIPPED_CODE * 255), 255], np.uint8)
    mixtures = np.stack(np.meshgrid(codes, codes, codes), -1).reshape(1, -1, 3)
    return round(float(linear_srgb(mixtures, profile).min()), 6)
