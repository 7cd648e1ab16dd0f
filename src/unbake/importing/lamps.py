"""Lamps of a room, found where photographs show surfaces that are too bright to reflect (ours).

A surface that reflects is at most as bright as the light that falls on it: B, the mean radiance of
what it faces, weighted by the cosine. Photographs show that radiance, too: what a point faces is
other surface that some of them see. Where a triangle would have to reflect more than there is, it
shines by itself. Highlights move with the camera: a triangle is as bright as most photographs of it
say.

Clipped photographs only tell that lamps have at least some radiance. All of it is then multiplied
by one factor, by which the median albedo of everything else becomes `ALBEDO`.

Where photographs do not show what lights a room, such as spots, all that they light seems to shine.
Then much of everything else would have to reflect more than there is, too, and no lamp is found.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import final

import mitsuba as mi
import numpy as np

from ..dataset.spread import evenly, places
from ..dataset.views import View, read_photograph
from ..fields.pieces import connected
from ..progress import Paced
from ..scene import free_space
from ..scene.triangles import mesh_of, numbered
from .meshes import Part
from .progress import EVERY

#: Photographs that are looked at, and pixels of all of them.
_PHOTOGRAPHS, _PIXELS = 64, 1 << 21
#: Triangles in cells of so many pixels, in the middle of what is seen, are told of together.
_WIDE = 4.0
#: A triangle is as bright as this share of its pixels are at most.
_QUANTILE = 0.25
#: How many times as bright as the median of all pixels a triangle is that light is drawn from.
_BRIGHT = 4.0
#: Points that are asked what falls on them, of bright triangles and of all others.
_POINTS, _OTHERS = 1 << 14, 1 << 12
#: Directions from each of them, and points of bright triangles.
_DIRECTIONS, _DRAWN = 64, 64
#: A triangle that would need this albedo, at least, shines; and one that is clipped, and would need
#: more than so much of it.
_TOO_BRIGHT, _TOO_BRIGHT_CLIPPED = 1.5, 1.05
#: The albedo that most surfaces of a room are taken to have about.
ALBEDO = 0.5
#: Where more than this share of other points would need such an albedo, light comes from what
#: photographs do not show.
_UNEXPLAINED, _BEYOND = 0.2, 1.25
#: How often the factor of clipped lamps, and which those are, are found from each other.
_ROUNDS = 8
#: Pixels that must show a lamp, in how many photographs; and lamps that are told apart.
_SHOWN, _VIEWS, _MOST = 16, 2, 64
#: Rays start so far from a surface, as a share of the size of the mesh.
_OFFSET = 1e-5


@final
@dataclass(frozen=True, eq=False)
class Lamp:
    """Triangles of a part that shine.

    Args:
        part: the number of the part.
        faces: the numbers of its triangles.
        radiance: linear RGB.
        turned: whether photographs see the backs of these triangles.
        clipped: whether photographs only tell that it has at least some radiance.
    """

    part: int
    faces: np.ndarray
    radiance: tuple[float, float, float]
    turned: bool
    clipped: bool


def find_lamps(
    parts: Sequence[Part], views: Sequence[View], tell: Callable[[str], None]
) -> list[Lamp]:
    """Find what shines, brightest first.

    Args:
        parts: of the mesh, in the frame of the cameras.
        views: whose photographs are looked at.
        tell: called about once in a while.

    Raises:
        UserError: a photograph cannot be read.
    """
    surface = _Surface.of(parts)
    seen = _seen(surface, views, tell)
    if seen is None:
        return []
    lamps = _lamps(surface, seen, *_shining(surface, seen))
    if len(lamps) > _MOST:
        tell(f"lamps: {len(lamps) - _MOST} dim ones are left out, with {_MOST} brighter ones")
    return lamps[:_MOST]


def with_lamps(parts: Sequence[Part], lamps: Sequence[Lamp]) -> tuple[list[Part], list[Part]]:
    """The parts without what shines, and lamps as parts of their own, in their order."""
    own, taken = [], [np.zeros(len(part.faces), bool) for part in parts]
    names = {part.name for part in parts}
    for lamp in lamps:
        part = parts[lamp.part]
        name = _unique(f"{part.name}-lamp", names)
        names.add(name)
        taken[lamp.part][lamp.faces] = True
        own.append(replace(_cut(part, lamp.faces, turned=lamp.turned), name=name))
    rest = [
        _cut(part, np.flatnonzero(~of_lamps)) if of_lamps.any() else part
        for part, of_lamps in zip(parts, taken, strict=True)
        if not of_lamps.all()
    ]
    return rest, own


def _unique(name: str, names: set[str]) -> str:
    number, found = 1, name
    while found in names:
        number += 1
        found = f"{name}-{number}"
    return found


def _cut(part: Part, faces: np.ndarray, *, turned: bool = False) -> Part:
    """Some triangles of a part, turned around if asked."""
    kept, numbers = np.unique(part.faces[faces], return_inverse=True)
    numbers = numbers.reshape(-1, 3)[:, :: -1 if turned else 1]
    normals = None if part.normals is None else part.normals[kept] * (-1 if turned else 1)
    uv = None if part.uv is None else part.uv[kept]
    return replace(part, positions=part.positions[kept], faces=numbers, normals=normals, uv=uv)


# --------------------------------------------------------------------------------- what there is


@dataclass(frozen=True, eq=False)
class _Surface:
    """All triangles of a mesh, as one."""

    scene: mi.Scene
    corners: np.ndarray  # (m, 3, 3)
    normals: np.ndarray  # (m, 3), of unit length; zero where a triangle has no area
    areas: np.ndarray  # (m,)
    part: np.ndarray  # (m,) the number of its part
    first: np.ndarray  # (parts,) the number of the first triangle of each
    offset: float

    def patches(self, size: float) -> np.ndarray:
        """Groups of small triangles of one part that are in one cell of that size, (m,)."""
        cell = np.floor(self.corners.mean(1) / size).astype(np.int64)
        alone = np.where(np.ptp(self.corners, axis=1).max(1) > size, np.arange(len(cell)), -1)
        return numbered(*cell.T, self.part, alone)[1]

    @staticmethod
    def of(parts: Sequence[Part]) -> _Surface:
        positions = np.concatenate([part.positions for part in parts])
        starts = np.cumsum([0] + [len(part.positions) for part in parts])
        faces = np.concatenate([p.faces + s for p, s in zip(parts, starts[:-1], strict=True)])
        counts = [len(part.faces) for part in parts]
        corners = positions[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        twice = np.linalg.norm(across, axis=1)
        return _Surface(
            mi.load_dict({"type": "scene", "mesh": mesh_of(positions, faces)}),
            corners,
            across / np.maximum(twice, 1e-300)[:, None],
            twice / 2,
            np.repeat(np.arange(len(parts)), counts),
            np.cumsum([0, *counts[:-1]]),
            _OFFSET * float(np.ptp(positions, axis=0).max()),
        )

    def hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What rays (n, 3) hit: numbers of triangles, -1 for none, and points, (n, 3)."""
        ray = free_space.as_ray(origins, directions)
        hit = self.scene.ray_intersect_preliminary(ray)
        distance = np.array(hit.t, np.float64)
        face = np.where(np.isfinite(distance), np.array(hit.prim_index, np.int64), -1)
        distance = np.where(face >= 0, distance, 0)
        return face, origins + distance[:, None] * directions


@dataclass(frozen=True, eq=False)
class _Seen:
    """Pixels that show the mesh, (n,) each, and what they tell of its m triangles.

    Small triangles are told of by the pixels of their patch.
    """

    face: np.ndarray
    view: np.ndarray
    point: np.ndarray  # (n, 3)
    to_camera: np.ndarray  # (n, 3), unit vectors
    rgb: np.ndarray  # (n, 3) radiance
    clipped: np.ndarray  # (n,) bool: in its brightest channel
    patch: np.ndarray  # (m,) the number of its patch
    low: (
        np.ndarray
    )  # (m, 3) radiance that most of its pixels have at least; NaN where none shows it
    middle: np.ndarray  # (m, 3) that of its median pixel; NaN where none shows it
    at_limit: np.ndarray  # (m,) bool: most of its pixels are clipped
    count: np.ndarray  # (m,) pixels


def _seen(surface: _Surface, views: Sequence[View], tell: Callable[[str], None]) -> _Seen | None:
    """What photographs show of the mesh; None where they show none of it."""
    views = evenly(views, _PHOTOGRAPHS)
    each = max(1, _PIXELS // len(views))
    columns: list[tuple[np.ndarray, ...]] = []
    told = Paced(tell, EVERY)
    for number, view in enumerate(views):
        told(f"looked for lamps in {number} of {len(views)} photographs")
        pixels = read_photograph(view).reshape(-1, 4)
        chosen = np.flatnonzero(pixels[:, 3] >= 1)
        if not len(chosen):
            continue
        chosen = chosen[places(len(chosen), each)]
        row, column = np.divmod(chosen, view.camera.width)
        origins, directions = view.camera.rays(column + 0.5, row + 0.5)
        face, point = surface.hits(origins, directions)
        hit = face >= 0
        rgb = pixels[chosen[hit], :3] / np.float32(view.exposure)
        whose, clipped = np.full(len(rgb), number), rgb.max(1) >= view.limit
        wide = np.linalg.norm(point[hit] - origins[hit], axis=1) / view.camera.fl_x
        columns.append((face[hit], whose, point[hit], -directions[hit], rgb, clipped, wide))
    if not sum(len(column[0]) for column in columns):
        return None
    face, whose, point, to_camera, rgb, clipped, wide = (
        np.concatenate(c) for c in zip(*columns, strict=True)
    )
    patch = surface.patches(_WIDE * float(np.median(wide)))
    own, most = patch[face], patch.max() + 1
    count = np.bincount(own, minlength=most)
    order = np.lexsort((rgb.max(1), own))
    starts, known = np.cumsum(count) - count, np.flatnonzero(count)

    def quantile(share: float) -> np.ndarray:
        found = np.full((most, 3), np.nan)
        found[known] = rgb[order[starts[known] + (share * (count[known] - 1)).astype(int)]]
        return found[patch]

    at_limit = np.bincount(own, clipped, most) > 0.5 * count
    values = (quantile(_QUANTILE), quantile(0.5), at_limit[patch], count[patch])
    return _Seen(face, whose, point, to_camera, rgb, clipped, patch, *values)


# ------------------------------------------------------------------------------------ what shines


def _shining(surface: _Surface, seen: _Seen) -> tuple[np.ndarray, float]:
    """Which triangles shine, (m,) bool, and by how much more than clipped photographs show."""
    brightest = seen.rgb.max(1)
    level = float(np.median(brightest[brightest > 0])) if brightest.any() else 0.0
    bright = np.nan_to_num(seen.low.max(1)) > _BRIGHT * level
    bright |= seen.at_limit
    if not bright.any() or bright[seen.face].all():
        return np.zeros_like(bright), 1.0
    rng = np.random.default_rng(0)
    asked = _points(seen, bright, rng)
    of_bright = bright[seen.face[asked]]
    shining, factor, needed = bright.copy(), 1.0, np.zeros(0)
    dim, lit, drawn = _falling(surface, seen, bright, asked, rng)
    faces = seen.face[asked]
    least = np.where(seen.at_limit, _TOO_BRIGHT_CLIPPED, _TOO_BRIGHT)
    for _ in range(_ROUNDS):
        # What no longer shines still reflects what photographs show.
        bound = (shining & seen.at_limit)[drawn]
        sure, clipped = dim + (lit * ~bound).sum(1), (lit * bound).sum(1)
        factor = 1.0
        others = ~shining[faces] & ~seen.clipped[asked]
        if clipped.any() and others.any():
            factor = _factor(seen.rgb[asked][others].max(1), sure[others], clipped[others])
        falls = np.maximum(sure + factor * clipped, 1e-6 * level)
        needed = seen.rgb[asked][others].max(1) / falls[others]
        own = seen.patch[faces[of_bright]]
        sums = np.bincount(own, falls[of_bright], seen.patch.max() + 1)
        count = np.bincount(own, minlength=len(sums))
        falling = (sums / np.maximum(count, 1))[seen.patch]
        found = shining & (count > 0)[seen.patch] & (seen.low.max(1) > least * falling)
        if (found == shining).all():
            break
        shining = found
    if not len(needed) or (needed > _BEYOND).mean() > _UNEXPLAINED:
        return np.zeros_like(shining), 1.0
    return shining, factor


def _points(seen: _Seen, bright: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Numbers of pixels to ask what falls on them: of each bright triangle some, and of others."""
    own = np.flatnonzero(bright[seen.face])
    rest = np.flatnonzero(~bright[seen.face])
    rng.shuffle(own)
    # The first pixels of each patch come first.
    patch = seen.patch[seen.face[own]]
    order = np.argsort(patch, kind="stable")
    starts = np.r_[True, np.diff(patch[order]) != 0]
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    own = own[order[np.argsort(rank, kind="stable")]][:_POINTS]
    others = rng.choice(rest, min(_OTHERS, len(rest)), replace=False)
    return np.concatenate([own, others])


def _falling(
    surface: _Surface,
    seen: _Seen,
    bright: np.ndarray,
    asked: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What falls on points, over π, in their brightest channel.

    What is bright is drawn by its area and radiance, all else by directions.

    Returns:
        What is not bright brings, (n,); what each sample of what is brings, (n, samples), and the
        triangles that it is of.
    """
    channel = seen.rgb[asked].argmax(1)
    normal = surface.normals[seen.face[asked]]
    normal = normal * np.sign(np.einsum("ij,ij->i", normal, seen.to_camera[asked]))[:, None]
    origin = seen.point[asked] + surface.offset * normal
    others = np.flatnonzero(~bright & (seen.count > 0))
    unknown = np.median(seen.middle[others], axis=0) if len(others) else np.zeros(3)
    radiance = np.where(np.isnan(seen.middle), unknown, seen.middle)
    dim, count = np.zeros(len(asked)), len(asked)
    for _ in range(_DIRECTIONS):
        direction = _cosine(normal, rng)
        face, _ = surface.hits(origin, direction)
        met = (face >= 0) & ~bright[face]
        dim += np.where(met, radiance[face, channel], 0)
    dim /= _DIRECTIONS
    numbers = np.flatnonzero(bright)
    power = surface.areas[numbers] * radiance[numbers].max(1)
    chance = power / power.sum()
    lit, of_face = np.zeros((count, _DRAWN)), np.zeros((count, _DRAWN), int)
    for number in range(_DRAWN):
        drawn = rng.choice(len(numbers), count, p=chance)
        of_face[:, number] = face = numbers[drawn]
        end = _on_triangles(surface.corners[face], rng)
        way = end - origin
        distance = np.maximum(np.linalg.norm(way, axis=1), 1e-12)
        way /= distance[:, None]
        cosine = np.maximum(np.einsum("ij,ij->i", way, normal), 0)
        other = np.abs(np.einsum("ij,ij->i", way, surface.normals[face]))
        ray = free_space.as_ray(origin, way)
        ray.maxt = mi.Float((distance - 2 * surface.offset).astype(np.float32))
        free = ~np.array(surface.scene.ray_test(ray)) & (
            seen.patch[face] != seen.patch[seen.face[asked]]
        )
        form = cosine * other * surface.areas[face] / (np.pi * distance**2 * chance[drawn])
        value = np.where(free, radiance[face, channel] * form, 0)
        # Of points that touch what shines, single samples would be as large as one likes.
        value = np.minimum(value, _DRAWN * radiance[face, channel])
        lit[:, number] = value / _DRAWN
    return dim, lit, of_face


def _factor(radiance: np.ndarray, sure: np.ndarray, clipped: np.ndarray) -> float:
    """By how much clipped lamps are brighter, so that the median albedo is `ALBEDO`; 1 or more."""
    low, high = 0.0, 30.0  # of its binary logarithm
    for _ in range(40):
        middle = 0.5 * (low + high)
        falls = np.maximum(sure + 2**middle * clipped, 1e-30)
        low, high = (middle, high) if np.median(radiance / falls) > ALBEDO else (low, middle)
    return float(2**low)


def _cosine(normal: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random directions around normals (n, 3), by the cosine."""
    sphere = rng.normal(size=normal.shape)
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    found = normal * (1 + 1e-6) + sphere
    return found / np.linalg.norm(found, axis=1)[:, None]


def _on_triangles(corners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A random point of each triangle (n, 3, 3)."""
    a, b = np.sqrt(rng.random(len(corners))), rng.random(len(corners))
    weights = np.stack([1 - a, a * (1 - b), a * b], 1)
    return np.einsum("ij,ijk->ik", weights, corners)


# ------------------------------------------------------------------------------------------ lamps


def _lamps(surface: _Surface, seen: _Seen, shining: np.ndarray, factor: float) -> list[Lamp]:
    """Connected triangles that shine, in one part each, brightest power first."""
    found = np.flatnonzero(shining)
    if not len(found):
        return []
    label = np.full(len(shining), -1)
    label[found] = _connected(surface, found)
    pixels = np.flatnonzero(shining[seen.face])
    own = label[seen.face[pixels]]
    count = label.max() + 1
    pairs = np.unique(np.stack([own, seen.view[pixels]], 1), axis=0)
    enough = np.bincount(own, minlength=count) >= _SHOWN
    enough &= np.bincount(pairs[:, 0], minlength=count) >= _VIEWS
    lamps = []
    by_label, by_pixel = _groups(label[found]), _groups(own)
    for number in np.flatnonzero(enough):
        lamp, area = _lamp(surface, seen, found[by_label[number]], pixels[by_pixel[number]], factor)
        lamps.append((max(lamp.radiance) * area, lamp))
    lamps.sort(key=lambda row: -row[0])
    return [lamp for _, lamp in lamps]


def _connected(surface: _Surface, found: np.ndarray) -> np.ndarray:
    """Numbers of groups of triangles of one part that share corners, one for each of `found`."""
    corner = surface.corners[found].reshape(-1, 3)
    place = numbered(*np.round(corner / max(surface.offset, 1e-30)).T)[1]
    keys = place * (surface.part.max() + 1) + np.repeat(surface.part[found], 3)
    names, keys = np.unique(keys, return_inverse=True)
    own = np.repeat(np.arange(len(found)), 3)
    return connected(len(found) + len(names), own, keys.ravel() + len(found))[: len(found)]


def _groups(label: np.ndarray) -> list[np.ndarray]:
    """The places of each number from 0 on."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.cumsum(np.bincount(label))[:-1])


def _lamp(
    surface: _Surface, seen: _Seen, faces: np.ndarray, pixels: np.ndarray, factor: float
) -> tuple[Lamp, float]:
    """A lamp of some triangles, as pixels show it, and its area."""
    # Pixels at its edge show what is behind it, too.
    bright = seen.rgb[pixels].max(1)
    radiance = np.median(seen.rgb[pixels[bright >= np.median(bright)]], axis=0)
    clipped = bool(seen.clipped[pixels].mean() > 0.5)
    red, green, blue = (float(x) for x in radiance * (factor if clipped else 1))
    facing = np.einsum("ij,ij->i", surface.normals[seen.face[pixels]], seen.to_camera[pixels])
    turned, part = bool((facing < 0).mean() > 0.5), int(surface.part[faces[0]])
    lamp = Lamp(part, faces - surface.first[part], (red, green, blue), turned, clipped)
    return lamp, float(surface.areas[faces].sum())
