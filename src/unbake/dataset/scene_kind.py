"""The kinds of scenes, which methods have learning rates for. Needs neither Mitsuba nor Dr.Jit."""

from __future__ import annotations

from typing import Literal

#: room: cameras see surfaces everywhere, and light is reflected many times; object: photographs
#: have a hidden background, and most light comes straight from the environment.
SceneKind = Literal["room", "object"]


def scene_kind(background: str) -> SceneKind:
    """The kind of scene that a data set shows, by what its photographs show behind the scene.

    Args:
        background: of the data set: "visible" or "hidden".
    """
    return "object" if background == "hidden" else "room"
