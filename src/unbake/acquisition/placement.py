"""Automatic placement of cameras that cover a scene: all over a room, or around an object.

The paper places the cameras of its rooms by hand "to cover the entire scene" and samples those of
its objects on the hemisphere around them. Paper: Sec. 6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import final

import mitsuba as mi
import numpy as np

from unbake.dataset.camera import LookAt
from unbake.errors import UserError
from unbake.scene import free_space

from .coverage import is_room, object_box, sphere_around

# Sampling of candidate views: positions and surface points, directions and rays of each view.
_POSITIONS = 240
_POINTS = 3000
_AZIMUTHS = 12
_PITCHES = (-60.0, -28.0, 0.0, 28.0, 60.0)
_GRID = 8
_VIEWERS = 16
_OVEREXPOSED = 30.0

# One close view at normal incidence takes two thirds of a surface's value, 1 - exp(-1.1).
_VALUE = 1.1
#: How many times as many cameras as are wanted spirals around an object have, at most.
_DENSEST = 16
#: Cameras around an object of which the lowest third tells whether it has a front.
_AROUND = 96
#: Thickness of a backdrop that has one, in parts of its width: more than, and less than.
_FLAT, _THICK = 1e-5, 0.4
#: Surface points that tell what these cameras see, and cameras that are tested at once.
_SEEN, _EYES = 500, 1024
_REMEDY = "Give a camera file instead"


@final
@dataclass(frozen=True, eq=False)
class _Candidates:
    """Possible views.

    Args:
        eye: positions, (n, 3).
        forward: directions, (n, 3).
        depth: median depths, (n,).
        value: what a view is worth for each surface point, (n, points) float32 in [0, 1].
    """

    eye: np.ndarray
    forward: np.ndarray
    depth: np.ndarray
    value: np.ndarray

    def take(self, chosen: np.ndarray) -> _Candidates:
        return _Candidates(
            self.eye[chosen], self.forward[chosen], self.depth[chosen], self.value[chosen]
        )


def place(
    scene: mi.Scene, views: int, held_out: int, *, seed: int = 0, up: np.ndarray | None = None
) -> list[tuple[str, LookAt]]:
    """Cameras of `place_room` or `place_object`, by `is_room`."""
    placed = place_room if is_room(scene) else place_object
    return placed(scene, views, held_out, seed=seed, up=up)


def place_room(
    scene: mi.Scene,
    views: int,
    held_out: int,
    *,
    fov: float = 75.0,
    seed: int = 0,
    up: np.ndarray | None = None,
) -> list[tuple[str, LookAt]]:
    """Cameras inside a room that together cover its surfaces.

    Candidates stand in free space (`free_space.free_positions`) and look all around, up and down;
    those too close to a surface are dropped. Training views are chosen greedily: a surface point
    counts by the cosine of its angle and by pixels per area, and less with each view that already
    sees it. Points far darker or brighter than what the scene's sensors see have down to a quarter
    of the weight; small shapes have more than their area. Held-out views see, from other positions,
    surfaces that training views see.

    Args:
        scene: the room.
        views: number of training views.
        held_out: number of held-out views.
        fov: horizontal (and vertical) field of view in degrees.
        seed: of all random choices; the same seed gives the same cameras.
        up: signed coordinate axis (3,); None: `free_space.up_axis`.

    Returns:
        (split, placement) pairs, training views first.

    Raises:
        UserError: the scene has no free space to stand in, or too little for that many views.
    """
    _check_counts(views, held_out)
    diagonal = free_space.extent(scene)[2]
    up = free_space.up_axis(scene) if up is None else up
    positions = free_space.free_positions(scene, _POSITIONS, seed)
    if len(positions) == 0:
        raise UserError("no free space for a camera in the scene", remedy=_REMEDY)
    points = free_space.sample_surface(scene, _POINTS, seed, power=0.5)
    if not len(points.position):
        raise UserError(
            "no surface has a material to fit, for which views are chosen", remedy=_REMEDY
        )
    seen = free_space.visibility(scene, positions, points)
    candidates = _candidates(scene, positions, points, seen, up, fov, seed)
    if len(candidates.eye) < views + held_out:
        raise UserError(f"no room for {views + held_out} cameras in the scene", remedy=_REMEDY)
    weights = _importance(scene, positions, points, seen, seed)
    train = _greedy(candidates, views, weights, [], diagonal)
    trained = 1 - np.prod(1 - candidates.value[train], axis=0, dtype=np.float64)
    tests = _greedy(candidates, held_out, weights * trained, train, diagonal)
    chosen = [("train", i) for i in train] + [("heldout", i) for i in tests]
    return [(split, _look_at(candidates, i, up, fov)) for split, i in chosen]


def place_object(
    scene: mi.Scene,
    views: int,
    held_out: int,
    *,
    fov: float = 40.0,
    seed: int = 0,
    up: np.ndarray | None = None,
) -> list[tuple[str, LookAt]]:
    """Cameras on the upper hemisphere around an object, looking at its centre.

    Positions form a Fibonacci spiral, from which held-out views are taken at regular intervals.
    All have the same distance, at which the object just fits into the square images. A level
    ground plane that is larger than everything else does not count as part of the object.

    Cameras that would see little but backs of what the scene's own sensors see, such as those
    behind a backdrop, are left out: the others come from a denser spiral. Open vessels keep all.

    Args:
        scene: the object.
        views: number of training views.
        held_out: number of held-out views.
        fov: horizontal field of view in degrees.
        seed: turns the cameras around the up axis; the same seed gives the same cameras.
        up: signed coordinate axis (3,); None: `free_space.up_axis`.

    Returns:
        (split, placement) pairs, training views first.

    Raises:
        UserError: no views are asked for, or the scene is empty.

    Paper: Sec. 6.
    """
    _check_counts(views, held_out)
    up = free_space.up_axis(scene) if up is None else up
    low, high = object_box(scene)
    centre, radius = sphere_around(low, high)
    count = views + held_out
    # Of a large floor nearly all points would lie far away from the object.
    points = free_space.sample_surface(scene, _POINTS, 0, within=(low, high))
    farthest = radius * math.hypot(1, 1 / _reach(fov))
    outward = _outward(scene, points, centre, farthest, up, count, seed)
    distance = _fitting_distance(points.position - centre, radius, outward, up, fov)
    eyes = centre + distance * outward
    middle = ((np.arange(held_out) + 0.5) * count / max(held_out, 1)).astype(int)
    tests = set(middle.tolist())
    train = [i for i in range(count) if i not in tests]
    chosen = [("train", i) for i in train] + [("heldout", i) for i in sorted(tests)]
    return [
        (split, LookAt(_triple(eyes[i]), _triple(centre), _triple(up), fov)) for split, i in chosen
    ]


def _candidates(
    scene: mi.Scene,
    positions: np.ndarray,
    points: free_space.SurfacePoints,
    seen: np.ndarray,
    up: np.ndarray,
    fov: float,
    seed: int,
) -> _Candidates:
    """Views in all directions from all positions, without those too close to a surface."""
    eyes, forwards = _all_views(positions, up, np.random.default_rng(seed))
    half = math.tan(math.radians(fov) / 2)
    depths = _view_depths(scene, eyes, forwards, up, half)
    # No interpolation: rays that leave the scene have infinite depth.
    near, median = np.quantile(depths, (0.1, 0.5), axis=1, method="lower")
    usual = np.median(median[np.isfinite(median)]) if np.isfinite(median).any() else 0.0
    kept = np.flatnonzero(np.isfinite(median) & (median > 0.5 * usual) & (near > 0.25 * usual))
    value = np.zeros((len(kept), len(points.position)), dtype=np.float32)
    owner = kept // (len(eyes) // len(positions))
    for index, position in enumerate(positions):
        start, stop = np.searchsorted(owner, (index, index + 1))
        shown = np.flatnonzero(seen[index])
        framed = _framed(points.position[shown] - position, forwards[kept[start:stop]], up, half)
        worth = _worth(position, points.of(shown), usual)
        value[start:stop, shown] = framed * worth
    return _Candidates(eyes[kept], forwards[kept], median[kept], value)


def _framed(offsets: np.ndarray, forwards: np.ndarray, up: np.ndarray, half: float) -> np.ndarray:
    """Whether points at offsets (m, 3) from the eye lie in n square images: (n, m) bool."""
    axes = np.stack([*_axes(forwards, up), half * forwards])
    # einsum: starting the threads of a BLAS product takes longer than this sum of three terms.
    x, y, reach = np.einsum("ani,mi->anm", axes.astype(np.float32), offsets.astype(np.float32))
    return (np.abs(x) < reach) & (np.abs(y) < reach)


def _importance(
    scene: mi.Scene,
    positions: np.ndarray,
    points: free_space.SurfacePoints,
    seen: np.ndarray,
    seed: int,
) -> np.ndarray:
    """Weights of surface points by their outgoing radiance, (n,) in [0.25, 1].

    Points that the scene's own sensors expose well have full weight. Images of dark corners are
    mostly noise, and a bright adjoining room must not outweigh the room itself.
    """
    rng = np.random.default_rng(seed)
    radiance = np.zeros(len(points.position))
    for turn in range(_VIEWERS):
        viewer = positions[np.argmax(seen * rng.random(seen.shape), axis=0)]
        radiance += (
            free_space.outgoing_radiance(scene, viewer, points.position, seed + turn) / _VIEWERS
        )
    shown = free_space.visibility(scene, free_space.sensor_probes(scene, seed)[:32], points).any(
        axis=0
    )
    shown = shown if shown.any() else seen.any(axis=0)
    usual = np.median(radiance[shown]) if shown.any() else 0.0
    if usual == 0:
        return np.ones(len(points.position))
    exposure = radiance / usual
    return 0.25 + 0.75 * exposure / (exposure + 0.5) / (1 + exposure / _OVEREXPOSED)


def _worth(eye: np.ndarray, points: free_space.SurfacePoints, usual: float) -> np.ndarray:
    """The value of an unobstructed view of points, by angle and pixels per area, in [0, 1]."""
    to_eye = eye - points.position
    distance = np.linalg.norm(to_eye, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", to_eye, points.normal)) / distance
    resolution = cosine * np.minimum(1.0, (1.5 * usual / distance) ** 2)
    return (1 - np.exp(-_VALUE * resolution)).astype(np.float32)


def _greedy(
    candidates: _Candidates, count: int, weight: np.ndarray, taken: list[int], diagonal: float
) -> list[int]:
    """Greedy choice of the views that add most value, different from `taken` and each other."""
    remaining = weight.astype(np.float32)
    novelty = np.ones(len(candidates.eye))
    for view in taken:
        novelty *= _difference(candidates, view, diagonal)
    chosen: list[int] = []
    for _ in range(count):
        view = int(np.argmax(novelty * (candidates.value @ remaining)))
        chosen.append(view)
        remaining = remaining * (1 - candidates.value[view])
        novelty *= _difference(candidates, view, diagonal)
        novelty[view] = -1.0
    return chosen


def _difference(candidates: _Candidates, view: int, diagonal: float) -> np.ndarray:
    """Difference of all candidates from one of them, from 0 (the same view) to 1, (n,)."""
    away = np.linalg.norm(candidates.eye - candidates.eye[view], axis=1) / (0.12 * diagonal)
    aligned = np.clip(candidates.forward @ candidates.forward[view], 0.0, 1.0)
    return 1 - np.exp(-(away**2)) * aligned**2


def _all_views(
    positions: np.ndarray, up: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Eyes and forward directions (positions * directions, 3), ordered by position."""
    side, front = _horizon(up)
    azimuth = np.arange(_AZIMUTHS) * 2 * math.pi / _AZIMUTHS
    forwards = []
    for turn in rng.random(len(positions)) * 2 * math.pi / _AZIMUTHS:
        around = np.cos(azimuth + turn)[:, None] * side + np.sin(azimuth + turn)[:, None] * front
        for pitch in np.radians(_PITCHES):
            forwards.append(math.cos(pitch) * around + math.sin(pitch) * up)
    eyes = np.repeat(positions, _AZIMUTHS * len(_PITCHES), axis=0)
    return eyes, np.concatenate(forwards) if forwards else eyes


def _view_depths(
    scene: mi.Scene, eyes: np.ndarray, forwards: np.ndarray, up: np.ndarray, half: float
) -> np.ndarray:
    """Distances along a grid of view rays, (n, rays); infinite where a ray leaves the scene."""
    right, above = _axes(forwards, up)
    film = (2 * (np.arange(_GRID) + 0.5) / _GRID - 1) * half
    x, y = (a.ravel() for a in np.meshgrid(film, film))
    rays = (
        forwards[:, None] + x[None, :, None] * right[:, None] + y[None, :, None] * above[:, None]
    ).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance = free_space.trace(scene, np.repeat(eyes, len(x), axis=0), rays).distance
    return distance.reshape(len(eyes), len(x))


def _axes(forwards: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The right and the upward image axis (n, 3) of cameras that look along `forwards`."""
    right = np.cross(forwards, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return right, np.cross(right, forwards)


def _outward(
    scene: mi.Scene,
    points: free_space.SurfacePoints,
    centre: np.ndarray,
    distance: float,
    up: np.ndarray,
    count: int,
    seed: int,
) -> np.ndarray:
    """Directions (count, 3) from the centre of an object to cameras, lower ones first.

    They are those of a spiral, or evenly spread ones of a denser spiral where cameras of the first
    one would stand behind things (`_sees_fronts`). An open vessel hides its inside from all that
    look level at it: it has no front, and is seen from all around.
    """
    density = 1
    while density <= _DENSEST:
        spiral = _spiral(density * count, up, seed)
        chosen = np.flatnonzero(_sees_fronts(scene, centre + distance * spiral, points))
        if len(chosen) >= count:
            if density > 1:
                around = centre + distance * _spiral(_AROUND, up, seed)
                if not _sees_fronts(scene, around, points)[: _AROUND // 3].any():
                    break
            return spiral[chosen[((np.arange(count) + 0.5) * len(chosen) / count).astype(int)]]
        density *= 2
    return _spiral(count, up, seed)


def _spiral(count: int, up: np.ndarray, seed: int) -> np.ndarray:
    """Directions (count, 3) of a Fibonacci spiral on the upper hemisphere."""
    # Views from the horizon show least; at the pole the up direction is degenerate.
    height = 0.08 + 0.87 * (np.arange(count) + 0.5) / count
    turn = 2 * math.pi * np.random.default_rng(seed).random()
    angle = turn + np.arange(count) * math.pi * (3 - math.sqrt(5))
    side, front = _horizon(up)
    level = np.sqrt(1 - height**2)[:, None]
    around = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * front
    return level * around + height[:, None] * up


def _sees_fronts(scene: mi.Scene, eyes: np.ndarray, points: free_space.SurfacePoints) -> np.ndarray:
    """Whether eyes (n, 3) see more than the backs of what the scene's own sensors see: (n,) bool.

    What stands behind a backdrop sees little else. Without sensors, all do.
    """
    sensors = free_space.sensor_eyes(scene)
    points = points.of(np.arange(0, len(points.position), len(points.position) // _SEEN or 1))
    if not len(sensors) or not len(points.position):
        return np.ones(len(eyes), dtype=bool)
    wanted, normal = _seen_sides(scene, sensors, points), points.normal.copy()
    for own, front in _backdrops(points, sensors):
        wanted[own], normal[own] = 1, front
    planes = replace(points, normal=normal)
    shares = []
    for block in np.array_split(eyes, -(-len(eyes) // _EYES)):
        shown = free_space.visibility(scene, block, points)
        back = shown & (_sides(block, planes) * wanted < 0)
        shares.append([back.mean(axis=1), (shown & ~back).mean(axis=1)])
    backs, others = np.concatenate(shares, axis=1)
    return (backs <= others) | (others >= 0.5 * others.max())


def _seen_sides(
    scene: mi.Scene, sensors: np.ndarray, points: free_space.SurfacePoints
) -> np.ndarray:
    """The side of points that sensors (n, 3) see: 1 in front, -1 behind, else 0, (points,).

    It is 0, too, on shapes whose both sides they see: a cup is no wall before which things stand.
    """
    shown, side = free_space.visibility(scene, sensors, points), _sides(sensors, points)
    front, back = ((shown & (sign * side > 0)).any(axis=0).astype(int) for sign in (1, -1))
    fronts, backs = (np.bincount(points.surface, weights=seen) for seen in (front, back))
    both = np.minimum(fronts, backs) > 0.1 * (fronts + backs)
    return np.where(both[points.surface], 0, front - back)


def _backdrops(
    points: free_space.SurfacePoints, sensors: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Shapes that are thick, and are walls before which things stand all the same.

    Each is the only one as wide and as high as all that there is, and what stands before it, where
    the sensors (n, 3) are, is deeper than it is. Of its far side sensors see nothing.

    Returns:
        For each one which points (m,) are its own, and the direction (3,) to what is before it.
    """
    found = []
    shapes = [points.surface == surface for surface in np.unique(points.surface)]
    for own in shapes:
        if own.sum() < 3 or own.all():
            continue
        middle = points.position[own].mean(axis=0)
        axes = np.linalg.svd(points.position[own] - middle, full_matrices=False)[2]
        along, eyes = (points.position - middle) @ axes.T, (sensors - middle) @ axes.T
        size, whole = np.ptp(along[own], axis=0), np.ptp(along, axis=0)
        spanning = [(np.ptp(along[shape], axis=0) > 0.9 * whole)[:2].all() for shape in shapes]
        if sum(spanning) != 1 or (size[:2] <= 0.9 * whole[:2]).any():
            continue
        if not _FLAT < size[2] / size[0] < _THICK:
            continue
        for sign in (1, -1):
            face, others = (sign * along[own, 2]).max(), sign * along[~own, 2]
            before = (others > face).mean() > 0.9 and others.max() - face > size[2]
            if before and (sign * eyes[:, 2] > face).all():
                found.append((own, sign * axes[2]))
    return found


def _sides(eyes: np.ndarray, points: free_space.SurfacePoints) -> np.ndarray:
    """On which side of points (m) eyes (n, 3) are: 1 in front, -1 behind, (n, m)."""
    return np.sign(eyes @ points.normal.T - (points.position * points.normal).sum(axis=1))


def _fitting_distance(
    points: np.ndarray, radius: float, outward: np.ndarray, up: np.ndarray, fov: float
) -> float:
    """The distance from the centre at which all points (m, 3) fit into all images with a margin."""
    if len(points) == 0:
        return radius / math.sin(math.radians(fov) / 2)
    right, above = _axes(-outward, up)
    sides = np.maximum(np.abs(right @ points.T), np.abs(above @ points.T))
    return float((sides / _reach(fov) + outward @ points.T).max())


def _reach(fov: float) -> float:
    """How far from the axis of an image things may be, in their depth, to lie within a margin."""
    return 0.92 * math.tan(math.radians(fov) / 2)


def _horizon(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (3,) which span the plane perpendicular to the up axis."""
    side = np.roll(np.abs(up), 1)
    return side, np.cross(up, side)


def _look_at(candidates: _Candidates, view: int, up: np.ndarray, fov: float) -> LookAt:
    eye = candidates.eye[view]
    target = eye + candidates.depth[view] * candidates.forward[view]
    return LookAt(_triple(eye), _triple(target), _triple(up), fov)


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))


def _check_counts(views: int, held_out: int) -> None:
    if views < 1 or held_out < 0:
        raise UserError(
            f"{views} training and {held_out} held-out views are asked for",
            remedy="At least one training view is needed",
        )
