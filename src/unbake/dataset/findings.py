"""What is wrong with a data set, in words: what, where and the remedy.

A fit refuses what is an error and tells the others before its first step, and `unbake data check`
tells all of them and more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..errors import UserError, printable
from .agreement import Exposures, TurningLight
from .alignment import Alignment
from .data_folder import TRANSFORMS
from .views import SensorNoise

#: An error: a fit makes no sense. A warning: it will be worse than it could be. A hint: something
#: to know.
Level = Literal["error", "warning", "hint"]
#: What was looked at.
Check = Literal[
    "files",
    "size",
    "scene",
    "media",
    "masks",
    "hot pixels",
    "geometry",
    "units",
    "normals",
    "alignment",
    "exposure",
    "light",
    "clipped",
    "black",
    "noise",
    "blur",
    "coverage",
    "duplicates",
]
#: Stops between the darkest and the brightest exposure from which on it matters.
SPREAD = 0.5
#: Light turns with the cameras if it explains such a share of what differs between views, and so
#: many stops of it.
TURNING, TURNING_STOPS = 0.35, 0.15


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Args:
        level: how bad it is.
        check: the check that found it.
        what: what is wrong, as a sentence without full stop.
        where: views or files; None: the data set as a whole.
        remedy: what to do about it, without full stop.
    """

    level: Level
    check: Check
    what: str
    where: str | None = None
    remedy: str | None = None

    def __str__(self) -> str:
        return str(UserError(self.what, self.where, self.remedy))


def misaligned(found: Alignment | None) -> Finding | None:
    """Whether other poses than those that are given put edges where photographs have them."""
    if found is None or found.best is None:
        return None
    much = f"their edges agree with the photographs' by {found.score:.2f}, without that by"
    if found.elsewhere is not None:
        return _of_others(found, found.elsewhere, found.best)
    if found.focal is not None:
        what = (
            f"focal lengths seem to be wrong: edges of the geometry agree with the photographs' by "
            f"{found.score:.2f}, with focal lengths times {found.focal:.2f} by {found.best:.2f}"
        )
        remedy = (
            f"Multiply 'fl_x' and 'fl_y' by {found.focal:.2f}, if they are of another lens or size "
            "of photographs; or check the size of the mesh"
        )
        # Outlines of a mesh that is too thick agree better with longer lenses, too.
        return Finding("warning", "alignment", what, None, remedy)
    if found.mirrored is not None:
        what = f"photographs seem to be {found.mirrored}: {much} {found.best:.2f}"
        return Finding("error", "alignment", what, None, "Flip them, or write them again")
    assert found.mistake is not None
    seem = "may" if found.plausible else "seem to"
    what = f"poses {seem} be {found.mistake.parts[0].partition(' (')[0]}"
    for part in found.mistake.parts[1:]:
        what += f" and {part.partition(' (')[0]}"
    what += f": {much} {found.best:.2f}"
    if found.unseen:
        what += ". As they are, views see nearly nothing but the ground"
    remedies = [part.partition(" (")[2].removesuffix(")") for part in found.mistake.parts]
    remedy = ", and ".join(remedies)
    if found.plausible:
        page = "see on the page of data check (--out check.html) whether outlines fit"
        remedy = f"{page}; if they do not: {remedy}"
    level: Level = "warning" if found.plausible else "error"
    return Finding(level, "alignment", what, None, f"{remedy[0].upper()}{remedy[1:]}")


def _of_others(found: Alignment, share: float, best: float) -> Finding:
    """What is to be said of photographs that agree better with poses of others.

    Args:
        found: what was found.
        share: of the photographs.
        best: their mean score with the best pose of any.
    """
    what = (
        "poses seem not to belong to the photographs: edges of the geometry agree with "
        f"{100 * share:.0f} % of these better from the pose of another one ({best:.2f} at best, "
        f"{found.score:.2f} from their own)"
    )
    remedy = (
        "Check that each 'file_path' stands beside its own pose, and that mesh and poses are in "
        "one frame and unit; of imports, check --mesh-scale, --mesh-matrix and "
        "--keep-applied-transform"
    )
    return Finding("error", "alignment", what, None, remedy)


def unequal_exposures(found: Exposures, names: Sequence[str]) -> Finding | None:
    """Whether views that see the same surfaces are exposed in different ways."""
    if found.spread < SPREAD:
        return None
    darkest, brightest = int(np.nanargmin(found.stops)), int(np.nanargmax(found.stops))
    what = (
        f"surfaces that views share are up to {found.spread:.1f} stops brighter in one than in "
        f"another ({printable(names[darkest])} the darkest, {printable(names[brightest])} the "
        "brightest)"
    )
    remedy = "Give each frame its true 'exposure', or fit them: --exposures per-image"
    return Finding("warning", "exposure", what, None, remedy)


def light_that_turns(found: TurningLight | None) -> Finding | None:
    """Whether light turned with the cameras, as on a turntable."""
    if found is None or found.explained < TURNING or found.stops < TURNING_STOPS:
        return None
    what = (
        "light and shadow turn with the cameras, as where an object stands on a turntable: that "
        f"explains {100 * found.explained:.0f} % of how surfaces differ between views"
    )
    remedy = "Take the photographs by moving the camera around: the light must stand still"
    return Finding("error", "light", what, None, remedy)


def noise_at_black(found: SensorNoise | None) -> Finding | None:
    """What is to be said of noise that was clipped at black, and that nobody told."""
    if found is None:
        return None
    numbers = f'"noise": {{"shot": {found.shot:.2g}, "read": {found.read:.2g}}}'
    what = (
        "noise was clipped at black, which makes dark surfaces brighter than they are: zeros lie "
        f"at random between values above zero. Fits correct it, as if told {numbers}"
    )
    remedy = f"Tell in {TRANSFORMS} what the sensor's noise is, if you know it"
    return Finding("warning", "noise", what, None, remedy)
