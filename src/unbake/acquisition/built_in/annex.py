"""`annex`: a room lit only by what comes through a half-open door from a colourful one behind it.

Training cameras stand in the first room, x < 3.2 m, and hardly see the second, where the only lamp
is. Held-out cameras stand in the first and in the second room by turns.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from . import annex_paint, demo_paint
from .cameras import Camera, camera, scattered
from .meshes import Mesh, ball, box, cylinder, lathe, merge, quad, rotate_z
from .writer import SceneWriter

# The rooms are 3.2 m and 2.5 m long, with a wall of 10 cm between them.
WALL, BACK, END = 3.2, 3.3, 5.8
DEPTH, HEIGHT = 3.0, 2.6
#: The opening: from and to along the wall, and its height.
DOOR = (1.55, 2.65, 2.1)
OPEN = 75.0  # degrees
FOV = 70.0
MAX_DEPTH = 32
SLIT = 2e-3
GLOW = (60.0, 58.0, 54.0)


def write(folder: Path) -> Path:
    """Write both rooms, the door between them, their furniture and the lamp."""
    scene = SceneWriter(folder, cameras(1, 0)[0], max_depth=MAX_DEPTH)
    _first_room(scene)
    _second_room(scene)
    _door(scene)
    _first_furniture(scene)
    _second_furniture(scene)
    # The lamp hangs beside the door: little of its light reaches the first room directly.
    panel = quad((3.5, 1.15, HEIGHT - 0.01), (0.7, 0, 0), (0, -0.8, 0), unit_uv=True)
    scene.mesh("lamp", panel, scene.diffuse("lamp", 0.0), emission=GLOW)
    return scene.save()


def _first_room(scene: SceneWriter) -> None:
    d, h, back_d = (0, DEPTH, 0), (0, 0, HEIGHT), (0, -DEPTH, 0)
    w, back_w = (WALL, 0, 0), (-WALL, 0, 0)
    # The floor reaches to the middle of the doorway.
    whole, sill = (3.25, 0, 0), 3.25
    sides = {
        "floor": (_wall((0, 0, 0), whole, d), annex_paint.planks(sill, DEPTH)),
        "ceiling": (_wall((0, DEPTH, HEIGHT), w, back_d), annex_paint.white(WALL, DEPTH)),
        "north": (_wall((0, DEPTH, 0), w, h), annex_paint.plaster(WALL, HEIGHT)),
        "south": (_wall((WALL, 0, 0), back_w, h), annex_paint.spotted(WALL, HEIGHT)),
        "west": (_wall((0, 0, 0), d, h), annex_paint.striped(DEPTH, HEIGHT)),
        "partition": (_pierced(WALL, -1), annex_paint.panelling(DEPTH, HEIGHT)),
    }
    for name, (mesh, maps) in sides.items():
        scene.mesh(name, mesh, scene.painted(name, *maps))


def _second_room(scene: SceneWriter) -> None:
    d, h, length = (0, DEPTH, 0), (0, 0, HEIGHT), END - BACK
    w, back_w, back_d = (length, 0, 0), (-length, 0, 0), (0, -DEPTH, 0)
    sill = END - 3.25
    sides = {
        "far_floor": (_wall((3.25, 0, 0), (sill, 0, 0), d), annex_paint.lozenges(sill, DEPTH)),
        "far_ceiling": (_wall((BACK, DEPTH, HEIGHT), w, back_d), annex_paint.sky(length, DEPTH)),
        "far_north": (_wall((BACK, DEPTH, 0), w, h), annex_paint.waves(length, HEIGHT)),
        "far_south": (_wall((END, 0, 0), back_w, h), annex_paint.bands(length, HEIGHT)),
        "far_east": (_wall((END, DEPTH, 0), back_d, h), annex_paint.mosaic(DEPTH, HEIGHT)),
        "far_partition": (_pierced(BACK, 1), annex_paint.discs(DEPTH, HEIGHT)),
    }
    for name, (mesh, maps) in sides.items():
        scene.mesh(name, mesh, scene.painted(name, *maps))


def _wall(corner, u, v) -> Mesh:
    """A wall whose UVs span [0, 1] and which overlaps its neighbours a little."""
    return quad(corner, u, v, overlap=SLIT, unit_uv=True)


def _pierced(x: float, facing: int) -> Mesh:
    """The wall at this x with the opening in it; its UVs span the whole wall."""
    (y0, y1, top), e = DOOR, SLIT
    # No overlap at the opening, where it would be seen from behind.
    whole = (-e, HEIGHT + e)
    parts = [((-e, y0), whole), ((y1, DEPTH + e), whole), ((y0, y1), (top, HEIGHT + e))]
    meshes = []
    for (low, high), (bottom, upper) in parts:
        across, up = (0, high - low, 0), (0, 0, upper - bottom)
        if facing > 0:
            piece = quad((x, low, bottom), across, up)
        else:
            piece = quad((x, high, bottom), (0, low - high, 0), up)
        y, z = piece.positions[:, 1], piece.positions[:, 2]
        uv = np.stack([(y if facing > 0 else DEPTH - y) / DEPTH, z / HEIGHT], axis=1)
        meshes.append(Mesh(piece.positions, uv, piece.faces))
    return merge(*meshes)


def _door(scene: SceneWriter) -> None:
    y0, y1, top = DOOR
    across, up = BACK - WALL, (0, 0, top + SLIT)
    frame = merge(
        quad((BACK, y0, -SLIT), (-across, 0, 0), up),
        quad((WALL, y1, -SLIT), (across, 0, 0), up),
        quad((WALL, y1, top), (across, 0, 0), (0, y0 - y1, 0)),
    )
    scene.mesh("frame", frame, scene.painted("frame", *demo_paint.pale_wood()))
    # The leaf turns about the south post, into the first room.
    hinge = (WALL - 0.03, y0 + 0.03, 0)
    leaf = box((WALL - 0.05, y0 + 0.03, 0.01), (WALL - 0.01, y1 - 0.01, top - 0.01))
    door = scene.painted("door", *annex_paint.door(y1 - y0, top))
    scene.mesh("door", rotate_z(leaf, OPEN, hinge), door)


def _first_furniture(scene: SceneWriter) -> None:
    wood = scene.painted("wood", *demo_paint.wood())
    legs = [
        box((x, y, 0), (x + 0.07, y + 0.07, 0.4), omit=("-z", "+z"))
        for x in (0.25, 1.08)
        for y in (2.2, 2.58)
    ]
    scene.mesh("bench", merge(box((0.2, 2.15, 0.4), (1.2, 2.7, 0.46)), *legs), wood)
    vase = [(0.09, 0.0), (0.15, 0.12), (0.14, 0.24), (0.06, 0.36), (0.09, 0.42), (0.0, 0.42)]
    glaze = scene.painted("vase", *demo_paint.glazed((0.1, 0.34, 0.42), (0.76, 0.62, 0.36)))
    scene.mesh("vase", lathe((0.5, 2.42, 0.46), vase), glaze)
    clay = scene.painted("clay", *demo_paint.banded((0.7, 0.36, 0.22), (0.8, 0.66, 0.5), 0.4, 0.7))
    scene.mesh("orb", ball((0.95, 2.42, 0.62), 0.16), clay)
    pouf = [(0.26, 0.0), (0.33, 0.08), (0.34, 0.18), (0.3, 0.3), (0.2, 0.36), (0.0, 0.38)]
    wedges = scene.painted("pouf", *demo_paint.wedges((0.2, 0.42, 0.4), (0.84, 0.7, 0.42)))
    scene.mesh("pouf", lathe((1.95, 2.5, 0), pouf), wedges)
    crate = rotate_z(box((2.55, 0.35, 0), (2.95, 0.75, 0.4), omit=("-z",)), 15, (2.75, 0.55, 0))
    scene.mesh("crate", crate, scene.painted("crate", *demo_paint.checked()))
    drum = scene.painted("drum", *demo_paint.banded((0.8, 0.76, 0.64), (0.26, 0.36, 0.5), 0.4, 0.8))
    scene.mesh("drum", cylinder((0.45, 0.4, 0), 0.2, 0.5), drum)


def _second_furniture(scene: SceneWriter) -> None:
    stand = box((4.9, 2.1, 0), (5.4, 2.6, 0.7), omit=("-z",))
    scene.mesh("stand", stand, scene.painted("stand", *demo_paint.cabinet()))
    globe = scene.painted("globe", *demo_paint.glazed((0.1, 0.16, 0.5), (0.84, 0.7, 0.2)))
    scene.mesh("globe", ball((5.15, 2.35, 0.92), 0.22), globe)
    stool = [(0.19, 0.0), (0.1, 0.22), (0.19, 0.42), (0.21, 0.46), (0.21, 0.46), (0.0, 0.46)]
    felt = scene.painted("felt", *demo_paint.banded((0.8, 0.2, 0.5), (0.86, 0.6, 0.16), 0.5, 0.8))
    scene.mesh("stool", lathe((4.55, 1.0, 0), stool), felt)


# (origin, target), in the south of the first room, from where the leaf hides the opening.
TRAIN = (
    ((0.4, 0.6, 1.5), (2.4, 2.9, 0.9)),
    ((2.7, 0.9, 1.6), (0.4, 2.4, 0.7)),
    ((1.6, 0.35, 1.4), (2.2, 3.0, 1.0)),
    ((2.4, 1.3, 1.3), (0.2, 0.3, 0.8)),
    ((1.0, 1.7, 1.5), (2.9, 0.3, 0.6)),
    ((0.6, 1.2, 1.2), (3.2, 1.2, 1.4)),
    ((1.8, 1.5, 1.1), (0.4, 2.6, 2.4)),
    ((1.3, 1.0, 1.7), (1.6, 2.6, 0.0)),
    ((2.2, 0.5, 1.2), (2.4, 2.4, 2.5)),
    ((1.5, 1.8, 1.6), (0.2, 1.4, 0.5)),
)
HELD_OUT = (
    ((0.5, 0.9, 1.6), (2.6, 2.5, 0.8)),
    ((2.3, 1.1, 1.5), (0.6, 2.8, 0.8)),
    ((1.2, 0.5, 1.3), (2.9, 1.6, 1.0)),
    ((1.9, 1.6, 1.4), (0.3, 0.5, 1.0)),
)
FAR = (
    ((3.75, 2.6, 1.5), (5.6, 1.0, 0.9)),
    ((5.4, 0.6, 1.5), (4.2, 2.9, 0.9)),
    ((5.3, 1.5, 1.6), (3.3, 0.6, 0.9)),
    ((4.4, 1.9, 1.2), (5.4, 0.2, 0.8)),
)
FREE = ((0.4, 0.3, 1.1), (2.4, 1.6, 1.7))
FAR_FREE = ((3.7, 0.4, 1.3), (5.4, 2.0, 1.7))


def cameras(views: int, held_out: int) -> list[Camera]:
    """Hand-placed cameras, further ones by low discrepancy.

    Held-out cameras number 0, 2, 4, … stand in the first room, the others in the second.
    """
    rooms = ((0, 0, 0), (WALL, DEPTH, HEIGHT)), ((BACK, 0, 0), (END, DEPTH, HEIGHT))
    placed = [_place(TRAIN, i, 2 * i + 1, FREE, rooms[0], "train") for i in range(views)]
    for i in range(held_out):
        lists, free = ((HELD_OUT, FREE), (FAR, FAR_FREE))[i % 2]
        placed.append(_place(lists, i // 2, 2 * i + 2, free, rooms[i % 2], "heldout"))
    return placed


def _place(placed: tuple, index: int, extra: int, free: tuple, room: tuple, split: str) -> Camera:
    if index < len(placed):
        origin, target = placed[index]
    else:
        origin, target = scattered(extra, free, room)
    return camera(origin, target, FOV, split)
