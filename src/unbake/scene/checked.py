"""A scene that is made of what it says, and all that is wrong with it at once."""

from __future__ import annotations

import mitsuba as mi

from ..errors import UserError, collected
from . import edit, emitters
from .parse import ParsedScene
from .values import attribute_faults, value_faults


def checked_scene(parsed: ParsedScene, *, lit: bool) -> tuple[mi.Scene | None, list[UserError]]:
    """Make a scene with opaque BSDFs turned into `principled`, its shapes apart.

    Args:
        parsed: cannot be used again.
        lit: whether it needs a light of its own.

    Returns:
        The scene, None where Mitsuba cannot make it; and what is wrong: properties, numbers and
        pictures that no surface and no light has, values that meshes lack, nothing to fit, no
        light.
    """
    _, faults = edit.turned_principled(parsed)
    faults += value_faults(parsed)
    try:
        scene = parsed.instantiate(merge=False)
    except UserError as error:
        # Mitsuba tells of the same in its own words, if anything was wrong before.
        return None, faults or [error]
    faults += attribute_faults(scene, parsed.path)
    with collected(faults):
        edit.require_optimized(scene, parsed.path)
    if lit:
        with collected(faults):
            emitters.require_emitters(scene, parsed.path)
    return scene, faults
