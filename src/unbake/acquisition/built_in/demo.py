"""`demo`: a warm room, 4 x 3 x 2.8 m, whose lamps are hidden: nearly all its light is indirect.

The lamp lies in a bowl that hangs above the table and shines upwards. Only the ceiling and the tops
of the walls see it; all else is lit by what those reflect.
"""

from __future__ import annotations

from pathlib import Path

from . import demo_paint as paint
from .cameras import Camera, camera, scattered
from .meshes import Mesh, ball, box, cylinder, lathe, merge, quad, rotate_z
from .writer import SceneWriter

WIDTH, DEPTH, HEIGHT = 4.0, 3.0, 2.8
FOV = 70.0
MAX_DEPTH = 16
SLIT = 2e-3
GLOW = (17.0, 15.8, 13.8)
# Centre and height of the rim of the lamp's bowl; no camera stands higher, so none sees the lamp.
LAMP = (2.15, 1.5, 1.66)


def write(folder: Path) -> Path:
    """Write the room with its furniture and its lamps."""
    scene = SceneWriter(folder, cameras(1, 0)[0], max_depth=MAX_DEPTH)
    _room(scene)
    _lamp(scene)
    _table(scene)
    _shelf(scene)
    _cabinet(scene)
    _seats(scene)
    _on_the_walls(scene)
    return scene.save()


def _room(scene: SceneWriter) -> None:
    w, d, h = (WIDTH, 0, 0), (0, DEPTH, 0), (0, 0, HEIGHT)
    back_d, back_w = (0, -DEPTH, 0), (-WIDTH, 0, 0)
    sides = {
        "floor": (quad_01((0, 0, 0), w, d), paint.floor(WIDTH, DEPTH)),
        "ceiling": (quad_01((0, DEPTH, HEIGHT), w, back_d), paint.ceiling(WIDTH, DEPTH)),
        "back_wall": (quad_01((0, DEPTH, 0), w, h), paint.plaster(WIDTH, HEIGHT)),
        "front_wall": (quad_01((WIDTH, 0, 0), back_w, h), paint.dotted(WIDTH, HEIGHT)),
        "left_wall": (quad_01((0, 0, 0), d, h), paint.striped(DEPTH, HEIGHT)),
        "right_wall": (quad_01((WIDTH, DEPTH, 0), back_d, h), paint.tiles(DEPTH, HEIGHT)),
    }
    for name, (mesh, maps) in sides.items():
        scene.mesh(name, mesh, scene.painted(name, *maps))


def quad_01(corner, u, v) -> Mesh:
    """A wall whose UVs span [0, 1] and which overlaps its neighbours a little."""
    return quad(corner, u, v, overlap=SLIT, unit_uv=True)


def _lamp(scene: SceneWriter) -> None:
    x, y, rim = LAMP
    # Upwards along the outside; the lamp itself is a lid that closes the bowl.
    bowl = [(0.0, -0.2), (0.12, -0.19), (0.28, -0.13), (0.4, -0.03), (0.42, 0.0)]
    brass = scene.painted("bowl", *paint.banded((0.8, 0.56, 0.26), (0.74, 0.66, 0.5), 0.3, 0.6))
    scene.mesh("bowl", lathe((x, y, rim), bowl), brass)
    lid = lathe((x, y, rim), [(0.42, 0.0), (0.0, 0.0)])
    scene.mesh("lamp", lid, scene.diffuse("lamp", 0.0), emission=GLOW)


def _table(scene: SceneWriter) -> None:
    x0, y0, x1, y1, top = 1.55, 1.15, 2.75, 1.85, 0.74
    wood = scene.painted("table_wood", *paint.wood())
    legs = [
        box((x, y, 0), (x + 0.08, y + 0.08, top - 0.05), omit=("-z", "+z"))
        for x in (x0 + 0.06, x1 - 0.14)
        for y in (y0 + 0.06, y1 - 0.14)
    ]
    scene.mesh("table", merge(box((x0, y0, top - 0.05), (x1, y1, top)), *legs), wood)
    outline = [(0.0, 0.0), (0.075, 0.0), (0.13, 0.08), (0.15, 0.16), (0.12, 0.27), (0.065, 0.35)]
    outline += [(0.06, 0.4), (0.085, 0.45), (0.085, 0.45), (0.07, 0.45), (0.045, 0.38), (0.0, 0.36)]
    vase = scene.painted("vase", *paint.glazed((0.08, 0.3, 0.38), (0.75, 0.62, 0.38)))
    scene.mesh("vase", lathe((2.4, 1.55, top), outline[1:]), vase)
    dish = [(0.08, 0.0), (0.2, 0.07), (0.2, 0.07), (0.08, 0.02), (0.0, 0.02)]
    clay = scene.painted("clay", *paint.banded((0.7, 0.36, 0.22), (0.82, 0.66, 0.5), 0.4, 0.75))
    scene.mesh("dish", lathe((1.85, 1.45, top), dish), clay)
    orange = scene.plain("orange", (0.85, 0.42, 0.08), 0.45)
    scene.mesh("orange", ball((1.84, 1.44, top + 0.1), 0.075), orange)


def _shelf(scene: SceneWriter) -> None:
    x, y0, y1, top = 0.3, 0.35, 1.45, 1.35
    boards = [box((0, y, 0), (x, y + 0.04, top), omit=("-x", "-z")) for y in (y0, y1 - 0.04)]
    inner = ("-x", "-y", "+y")
    for z in (0.1, 0.5, 0.9, top - 0.04):
        boards.append(box((0, y0 + 0.04, z), (x, y1 - 0.04, z + 0.04), omit=inner))
    scene.mesh("shelf", merge(*boards), scene.painted("shelf_wood", *paint.pale_wood()))
    # (first y, last y, shelf, height): blocks of books, boxes and one gap on every shelf.
    red, blue, cream = (0.62, 0.16, 0.1), (0.12, 0.26, 0.45), (0.82, 0.74, 0.56)
    rows = {
        "books_red": (red, 0.35, ((0.42, 0.66, 0.94, 0.3), (1.05, 1.28, 0.54, 0.27))),
        "books_blue": (blue, 0.6, ((0.68, 0.84, 0.94, 0.24), (0.45, 0.75, 0.14, 0.28))),
        "books_cream": (cream, 0.8, ((0.5, 0.78, 0.54, 0.22), (0.9, 1.3, 0.14, 0.3))),
    }
    for name, (colour, roughness, blocks) in rows.items():
        books = [box((0.02, a, z), (0.24, b, z + t), omit=("-z",)) for a, b, z, t in blocks]
        maps = paint.spines(colour, roughness)
        scene.mesh(name, merge(*books), scene.painted(name, *maps))
    pot = scene.painted("pot", *paint.banded((0.3, 0.5, 0.3), (0.8, 0.8, 0.6), 0.3, 0.7))
    outline = [(0.07, 0.0), (0.11, 0.1), (0.1, 0.2), (0.06, 0.24), (0.0, 0.24)]
    scene.mesh("pot", lathe((0.15, 1.15, top), outline), pot)


def _cabinet(scene: SceneWriter) -> None:
    body = box((3.55, 1.35, 0), (WIDTH, 2.65, 0.7), omit=("+x", "-z"))
    scene.mesh("cabinet", body, scene.painted("cabinet", *paint.cabinet()))
    globe = scene.painted("globe", *paint.glazed((0.6, 0.12, 0.08), (0.78, 0.55, 0.3)))
    scene.mesh("globe", ball((3.77, 2.2, 0.9), 0.2), globe)
    crate = rotate_z(box((3.66, 1.55, 0.7), (3.9, 1.79, 0.94), omit=("-z",)), 20, (3.78, 1.67, 0))
    scene.mesh("crate", crate, scene.painted("crate", *paint.checked()))


def _seats(scene: SceneWriter) -> None:
    stool = [(0.19, 0.0), (0.1, 0.22), (0.19, 0.42), (0.21, 0.46), (0.21, 0.46), (0.0, 0.46)]
    felt = scene.painted("stool", *paint.banded((0.75, 0.62, 0.4), (0.5, 0.2, 0.12), 0.55, 0.9))
    scene.mesh("stool", lathe((1.25, 0.62, 0), stool), felt)
    pouf = [(0.3, 0.0), (0.37, 0.08), (0.39, 0.18), (0.36, 0.3), (0.25, 0.37), (0.0, 0.39)]
    wedges = scene.painted("pouf", *paint.wedges((0.2, 0.42, 0.4), (0.84, 0.7, 0.42)))
    scene.mesh("pouf", lathe((0.65, 2.35, 0), pouf), wedges)
    drum = scene.painted("drum", *paint.banded((0.82, 0.78, 0.66), (0.24, 0.36, 0.5), 0.35, 0.8))
    scene.mesh("drum", cylinder((2.75, 0.4, 0), 0.2, 0.5), drum)


def _on_the_walls(scene: SceneWriter) -> None:
    frame = scene.painted("frames", *paint.wood())
    scene.mesh("mirror_frame", _frame((0.95, 0.95), (2.0, 1.9), DEPTH), frame)
    glass = quad((1.0, DEPTH - 0.02, 1.0), (0.95, 0, 0), (0, 0, 0.85), unit_uv=True)
    scene.mesh("mirror", glass, scene.mirror("mirror"))
    scene.mesh("picture_frame", _frame((2.45, 1.1), (3.4, 1.85), DEPTH), frame)
    canvas = quad((2.5, DEPTH - 0.02, 1.15), (0.85, 0, 0), (0, 0, 0.65), unit_uv=True)
    scene.mesh("picture", canvas, scene.painted("picture", *paint.picture(0.85, 0.65)))


def _frame(low: tuple[float, float], high: tuple[float, float], wall: float) -> Mesh:
    """Four slats, 6 cm wide, before the wall y = `wall`; `low` and `high` are (x, z)."""
    (x0, z0), (x1, z1), s, front = low, high, 0.06, wall - 0.04
    return merge(
        box((x0, front, z0), (x1, wall, z0 + s), omit=("+y",)),
        box((x0, front, z1 - s), (x1, wall, z1), omit=("+y",)),
        box((x0, front, z0 + s), (x0 + s, wall, z1 - s), omit=("+y", "-z", "+z")),
        box((x1 - s, front, z0 + s), (x1, wall, z1 - s), omit=("+y", "-z", "+z")),
    )


# (origin, target), ordered so that every beginning of the list already sees most of the room.
TRAIN = (
    ((0.35, 0.3, 1.6), (3.0, 2.4, 0.8)),
    ((3.7, 2.5, 1.6), (0.8, 0.5, 0.7)),
    ((3.2, 0.9, 1.55), (1.0, 2.9, 1.1)),
    ((0.4, 2.5, 1.6), (3.2, 0.4, 0.9)),
    ((2.0, 0.3, 1.3), (2.0, 3.0, 1.25)),
    ((2.1, 2.45, 1.5), (2.2, 0.0, 1.0)),
    ((1.0, 1.6, 1), (3.5, 1.6, 2.4)),
    ((3.1, 1.6, 1.1), (0.3, 1.3, 2.4)),
    ((0.6, 1.75, 1.6), (4.0, 2.0, 0.7)),
    ((2.9, 1.1, 1.5), (0.0, 0.95, 0.8)),
    ((1.2, 2.4, 1.6), (2.9, 0.5, 0.0)),
    ((3.0, 0.35, 1.6), (0.9, 2.3, 0.0)),
    ((0.45, 0.25, 0.35), (2.6, 1.7, 0.5)),
    ((3.3, 2.75, 0.4), (1.2, 0.9, 0.4)),
    ((3.3, 0.9, 0.4), (1.2, 2.2, 0.5)),
    ((1.2, 2.6, 0.35), (2.6, 0.6, 0.5)),
    ((3.6, 0.4, 1.2), (1.5, 2.2, 2.4)),
    ((0.4, 2.6, 1.2), (2.4, 0.9, 2.4)),
    ((0.9, 0.9, 1.6), (0.2, 2.7, 0.3)),
    ((2.6, 2.3, 1.3), (3.9, 1.2, 0.4)),
    ((1.9, 0.8, 1.3), (0.0, 0.9, 0.5)),
    ((3.1, 1.95, 1.6), (3.6, 0.2, 0.9)),
    ((0.25, 1.8, 1.6), (2.0, 1.5, 0.0)),
    ((3.75, 1.1, 1.6), (1.9, 1.4, 0.2)),
)
HELD_OUT = (
    ((0.4, 0.9, 1.6), (3.4, 2.2, 0.9)),
    ((3.5, 1.9, 1.6), (0.6, 1.2, 0.9)),
    ((2.7, 0.7, 1.4), (1.4, 3.0, 1.0)),
    ((1.2, 2.2, 1.3), (2.6, 0.0, 1.1)),
    ((2.0, 0.5, 1.6), (2.4, 2.6, 0.3)),
    ((3.0, 2.3, 0.9), (0.6, 1.0, 1.6)),
)
# Above the furniture, beside the vase and the lamp, lower than its rim.
FREE = ((0.4, 0.3, 1.4), (1.5, 2.7, 1.6))


def cameras(views: int, held_out: int) -> list[Camera]:
    """Hand-placed cameras; past 24 (held out: 6) low-discrepancy ones from the free upper room."""
    train = [_place(TRAIN, i, 2 * i + 1, "train") for i in range(views)]
    return train + [_place(HELD_OUT, i, 2 * i + 2, "heldout") for i in range(held_out)]


def _place(placed: tuple, index: int, extra: int, split: str) -> Camera:
    if index < len(placed):
        origin, target = placed[index]
    else:
        origin, target = scattered(extra, FREE, ((0, 0, 0), (WIDTH, DEPTH, HEIGHT)))
    return camera(origin, target, FOV, split)
