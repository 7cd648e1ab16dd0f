"""Positions where a camera can stand in a scene, and the visibility of surfaces from them.

Positions, normals and directions are (n, 3) float64 arrays in world space.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.shapes import placed_shapes, registry_number
from ..transport.emitter_sampling import has_cut_outs
from ..transport.optimized import has_optimized_material, one_sided_shapes
from ..transport.render import path_integrator
from .sight import OPAQUE, Sight, is_hole

# Fractions of the diagonal of `extent`.
CLEARANCE = 0.03
CONTACT = 1e-3
SMALL_OBJECT = 0.15
_RAY_OFFSET = 1e-4
#: Thickness of flat shapes, as a fraction of their largest extent.
_FLAT = 0.01
#: Upward directions, axis and sign, as they are likely: of most scenes, of Blender, of COLMAP.
_WAYS_UP = ((1, 1.0), (2, 1.0), (1, -1.0), (2, -1.0), (0, 1.0), (0, -1.0))
#: Up to which sine above or below the horizon a camera looks level, and from which on up.
_LEVEL, _UPWARDS = 0.01, 0.1

# A room may have windows or lack a wall: the open front of a box takes a sixth of the directions.
ROOM_ENCLOSURE = 0.75

_DIRECTIONS = 64
#: View rays of a camera that tell what space it sees.
PROBES = 64
#: View rays along an edge of a picture that tell whether a camera sees anything.
_GRID = 8
_CHUNK = 1 << 20
# Segments whose visibility is tested at once: few are slow, and many take memory.
_SEGMENTS = 1 << 16


@final
@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of rays."""

    distance: np.ndarray  #: (n,) world units, infinite where nothing was hit
    back: np.ndarray  #: (n,) bool: a back face, by the geometric normal
    black: np.ndarray  #: (n,) bool: a back face of a BSDF that has none, which reflects nothing
    shape: np.ndarray  #: (n,) number of the shape in Dr.Jit's registry; 0 where nothing was hit


@final
@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on surfaces whose material is optimized."""

    position: np.ndarray  #: (n, 3)
    normal: np.ndarray  #: (n, 3), unit vectors
    surface: np.ndarray  #: (n,) which shape, or instance of one, has them: numbers from 0

    def of(self, chosen: np.ndarray) -> SurfacePoints:
        """Some of them, by their numbers."""
        return SurfacePoints(self.position[chosen], self.normal[chosen], self.surface[chosen])


def bounds(scene: mi.Scene) -> tuple[np.ndarray, np.ndarray, float]:
    """Lower corner, upper corner (3,) and diagonal of the scene's bounding box, world units."""
    box = scene.bbox()
    low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
    return low.ravel(), high.ravel(), float(np.linalg.norm(high - low))


def extent(scene: mi.Scene, *, lamps: bool = True) -> tuple[np.ndarray, np.ndarray, float]:
    """The same of the scene without its ground: a level plane that is larger than all else.

    Distances that must suit a scene are fractions of this diagonal: a house on a lawn has rooms as
    large as without.

    Args:
        scene: of which all is infinite where it has no shapes.
        lamps: shapes that emit light count, unless there are no others.
    """
    shapes = scene.shapes()
    kept = shapes if lamps else [shape for shape in shapes if not shape.is_emitter()]
    if not kept:
        return bounds(scene)
    corners = _corners(kept)
    extents = np.ptp(corners, axis=1)
    level = extents[:, _level_axis(scene)] < _FLAT * extents.max(axis=1)
    rest = corners[~level]
    if len(rest):
        size = np.ptp(rest.reshape(-1, 3), axis=0).max()
        smaller = corners[extents.max(axis=1) < 1.5 * size]
        corners = smaller if len(smaller) else corners
    if not len(corners) or (len(corners) == len(shapes)):
        return bounds(scene)
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    return low, high, float(np.linalg.norm(high - low))


def up_axis(scene: mi.Scene) -> np.ndarray:
    """The scene's up direction (3,), a signed coordinate axis; y without a sensor.

    Of the axes perpendicular to the x axis of the first camera, the one nearest to its y axis. Two
    are perpendicular where the x axis is a coordinate axis, too. A camera that would look level or
    up then may as well look down, steeply or straight: where there is a ground decides.
    """
    up, sensors = np.zeros(3), _with_rays(scene)
    if not sensors:
        up[1] = 1.0
        return up
    camera = next(filter(_is_camera, sensors), sensors[0])
    right, above, ahead = _matrix(camera)[:3, :3].T
    # The y axis of a camera that looks straight down does not tell up from down.
    signs = np.copysign(1.0, np.where(np.abs(above) > 1e-3, above, -ahead))
    level = np.abs(right) < 0.17
    axis = int(np.argmax(np.abs(above) + level))
    slope = signs[axis] * ahead[axis]
    if level.sum() == 2 and (abs(slope) < _LEVEL or slope > _UPWARDS):
        other = int(np.argmax(level & (np.arange(3) != axis)))
        if _has_ground(scene, other, signs[other]) and not _has_ground(scene, axis, signs[axis]):
            axis = other
    up[axis] = signs[axis]
    return up


def _level_axis(scene: mi.Scene) -> int:
    """The axis that a ground is perpendicular to.

    Imported scenes have no sensor, and many have z up: there it is the one along which all stands
    on something flat, y first.
    """
    way = _way_of_ground(scene)
    return int(np.argmax(np.abs(up_axis(scene)))) if way is None else way[0]


def up_of_ground(scene: mi.Scene) -> str | None:
    """The axis, such as +z, that is up if all stands on a ground, where no sensor tells it.

    None: a sensor does, it is +y, or there is no ground.
    """
    way = _way_of_ground(scene)
    if way is None or way == (1, 1.0):
        return None
    axis, sign = way
    return f"{'+' if sign > 0 else '-'}{'xyz'[axis]}"


def _way_of_ground(scene: mi.Scene) -> tuple[int, float] | None:
    """Up by a ground, axis and sign, the likeliest first; None where a sensor tells, or none."""
    if _with_rays(scene):
        return None
    ways = (way for way in _WAYS_UP if _has_ground(scene, *way))
    return next(ways, None)


def _has_ground(scene: mi.Scene, axis: int, sign: float) -> bool:
    """Whether all that is not a lamp stands on a flat shape, up being an axis of this sign."""
    corners = _corners(shape for shape in scene.shapes() if not shape.is_emitter())
    if not len(corners):
        return False
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    extents, size = np.ptp(corners, axis=1), high - low
    flat = extents[:, axis] < _FLAT * extents.max(axis=1)
    wide = (np.delete(extents, axis, 1) > 0.9 * np.delete(size, axis)).all(axis=1)
    rise = corners[:, 1, axis] - low[axis] if sign > 0 else high[axis] - corners[:, 0, axis]
    return bool((flat & wide & (rise < 0.2 * size[axis])).any())


def _corners(shapes: Iterable[mi.Shape]) -> np.ndarray:
    """Lower and upper corners of shapes, (n, 2, 3), of those that are finite."""
    found = [(*box.min, *box.max) for box in (shape.bbox() for shape in shapes)]
    corners = np.array(found, dtype=np.float64).reshape(-1, 2, 3)
    return corners[np.isfinite(corners).all(axis=(1, 2))]


def _with_rays(scene: mi.Scene) -> list[mi.Sensor]:
    """The scene's sensors but for those of surfaces, which have no rays that could be asked for."""
    return [sensor for sensor in scene.sensors() if sensor.get_shape() is None]


def _is_camera(sensor: mi.Sensor) -> bool:
    """Whether a sensor is a perspective camera: the pose of others may say nothing."""
    return "x_fov" in mi.traverse(sensor)


def sphere_directions(count: int) -> np.ndarray:
    """`count` unit vectors spread evenly over the sphere (Fibonacci lattice), (count, 3)."""
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    phi = index * math.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)


def trace(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> Hits:
    """The first surfaces that rays (n, 3) with unit directions hit."""
    parts = [
        _trace(scene, origins[i : i + _CHUNK], directions[i : i + _CHUNK])
        for i in range(0, len(origins), _CHUNK)
    ]
    return Hits(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def unoccluded(
    scene: mi.Scene,
    starts: np.ndarray,
    ends: np.ndarray,
    offset: float | None = None,
    sight: Sight = OPAQUE,
) -> np.ndarray:
    """Whether the segment between two points is free, (n,) bool; glass occludes.

    Args:
        scene: what stands in the way.
        starts, ends: (n, 3).
        offset: how far before its end a segment ends; None: as suits the scene.
        sight: what does not stand in the way.
    """
    offset = lift(scene, _RAY_OFFSET) if offset is None else offset
    free = np.empty(len(starts), dtype=bool)
    for i in range(0, len(starts), _CHUNK):
        start, segment = starts[i : i + _CHUNK], (ends - starts)[i : i + _CHUNK]
        length = np.maximum(np.linalg.norm(segment, axis=1), 1e-12)
        ray = as_ray(start, segment / length[:, None])
        ray.maxt = mi.Float(np.maximum(length - offset, 0.0).astype(np.float32))
        free[i : i + _CHUNK] = np.array(sight.free(scene, ray, mi.Bool(True)))
    return free


def visibility(
    scene: mi.Scene, positions: np.ndarray, points: SurfacePoints, sight: Sight = OPAQUE
) -> np.ndarray:
    """Visibility of surface points (m) from positions (n), from either side: (n, m) bool."""
    offset = lift(scene, _RAY_OFFSET)
    result = np.empty((len(positions), len(points.position)), dtype=bool)
    if not result.size:
        return result
    rows = max(1, _SEGMENTS // len(points.position))
    for row in range(0, len(positions), rows):
        ends = np.repeat(positions[row : row + rows], len(points.position), axis=0)
        count = len(ends) // len(points.position)
        position, normal = (np.tile(a, (count, 1)) for a in (points.position, points.normal))
        side = np.sign(np.einsum("ij,ij->i", ends - position, normal))
        start = position + (offset * side)[:, None] * normal
        result[row : row + rows] = unoccluded(scene, start, ends, offset, sight).reshape(count, -1)
    return result


def outgoing_radiance(
    scene: mi.Scene, eyes: np.ndarray, points: np.ndarray, seed: int, depth: int = 6
) -> np.ndarray:
    """Radiance from `points` to `eyes`, (n,), linear, mean of the channels: one path each.

    Each point must be visible from its eye.
    """
    segment = points - eyes
    length = np.maximum(np.linalg.norm(segment, axis=1, keepdims=True), 1e-12)
    return _incoming_radiance(scene, eyes, segment / length, seed, depth)


def is_lit(scene: mi.Scene, positions: np.ndarray) -> np.ndarray:
    """Whether light arrives at positions (n, 3), straight or from surfaces around: (n,) bool.

    It must come from two of 64 directions: a little may leak through the edges of a closed box.
    """
    rays = _spheres(positions, sphere_directions(_DIRECTIONS))
    light = _incoming_radiance(scene, *rays, seed=0, depth=6)
    return (light.reshape(len(positions), -1) > 0).sum(axis=1) >= 2


def _incoming_radiance(
    scene: mi.Scene, origins: np.ndarray, directions: np.ndarray, seed: int, depth: int
) -> np.ndarray:
    """Radiance along rays (n, 3), towards their origins: (n,), as `outgoing_radiance`."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, len(origins))
    integrator = mi.load_dict({"type": path_integrator(scene), "max_depth": depth})
    ray = mi.RayDifferential3f(as_ray(origins, directions))
    colour, _, _ = integrator.sample(scene, sampler, ray)
    return np.array(colour, dtype=np.float64).mean(axis=0)


def sample_surface(
    scene: mi.Scene,
    count: int,
    seed: int,
    power: float = 1.0,
    within: tuple[np.ndarray, np.ndarray] | None = None,
) -> SurfacePoints:
    """Random points on the surfaces whose material is optimized.

    All other surfaces are left out: see `transport/optimized.py`. The probability of a shape is
    proportional to its area to the given power: 1 samples uniformly by area, less favours small
    shapes. Each instance of a shape is one more shape; where it is stretched along one axis, points
    inside of it are as dense as on the shape before that.

    Args:
        scene: with these surfaces.
        count: number of points; none where there are no such surfaces.
        seed: of all random choices.
        power: of the areas.
        within: lower and upper corner (3,) of a box, outside of which no shape may reach.
    """
    rng = np.random.default_rng(seed)
    surfaces = _surfaces(scene)
    if within is not None:
        slack = 1e-6 * np.linalg.norm(within[1] - within[0])
        low, high = within[0] - slack, within[1] + slack
        surfaces = [s for s in surfaces if (s.corners >= low).all() and (s.corners <= high).all()]
    share = np.array([surface.area for surface in surfaces]) ** power
    if share.sum() == 0:
        return SurfacePoints(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, dtype=int))
    chosen = np.sort(rng.choice(len(surfaces), size=count, p=share / share.sum()))
    uv = mi.Point2f(rng.random((2, count)).astype(np.float32))
    numbers = np.array([surface.number for surface in surfaces], np.uint32)[chosen]
    shapes = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(numbers))
    # A symbolic call asks all shapes there are, and those called `Instance` cannot be sampled.
    with dr.scoped_set_flag(dr.JitFlag.SymbolicCalls, False):
        sampled = shapes.sample_position(0.0, uv)
        position, normal = as_rows(sampled.p), as_rows(sampled.n)
    for i in (i for i in np.unique(chosen) if surfaces[i].instanced):
        here = chosen == i
        position[here] = surfaces[i].moved(position[here])
        turned = surfaces[i].turned(normal[here])
        normal[here] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    return SurfacePoints(position, normal, chosen)


def cut_out(scene: mi.Scene, points: SurfacePoints) -> np.ndarray:
    """Which points lie in holes of cut-outs, and on no surface: (n,) bool."""
    if not len(points.position) or not has_cut_outs(scene):
        return np.zeros(len(points.position), dtype=bool)
    offset = lift(scene, _RAY_OFFSET)
    ray = as_ray(points.position + offset * points.normal, -points.normal)
    ray.maxt = mi.Float(2 * offset)
    hit = scene.ray_intersect(ray)
    return np.array(is_hole(hit, hit.is_valid()))


def inside_geometry(scene: mi.Scene, positions: np.ndarray) -> np.ndarray:
    """Whether positions (n, 3) lie inside an object rather than in a room: (n,) bool.

    Rooms are closed as well, and published ones have normals of either orientation, so neither
    enclosure nor back faces suffice. A position counts as inside if rays in all of 256 directions
    hit something, no chain of free segments through other positions connects it with the space
    that the scene's own sensors see, and one of these holds:

    - nothing is farther away than 15 % of the diagonal of `extent` (the inside of a small object);
    - 75 % of the hits are back faces which reflect nothing (one-sided materials);
    - 75 % of the hits are back faces, and the box around the hits fills less than half of the
      box of `extent` (a larger object: a room with outward normals would fill it). 75 %
      because an object on the floor often has no bottom face.
    """
    result = np.zeros(len(positions), dtype=bool)
    one_sided = list(one_sided_shapes(scene))
    for start in range(0, len(positions), 1024):
        part = slice(start, start + 1024)
        result[part] = _enclosed(scene, positions[part], one_sided)
    probes = sensor_probes(scene, 0)
    if result.any() and len(probes):
        result &= ~_connected(scene, positions, probes, 0)
    return result


def _enclosed(scene: mi.Scene, positions: np.ndarray, one_sided: list[int]) -> np.ndarray:
    """The tests of `inside_geometry` that need one position only.

    Args:
        scene: around the positions, (n, 3).
        one_sided: numbers of the shapes whose backs are black although their BSDFs have one.
    """
    low, high, diagonal = extent(scene)
    directions = sphere_directions(256)
    hits = _trace_spheres(scene, positions, directions)
    enclosed = np.isfinite(hits.distance).all(axis=1)
    distance = np.where(np.isfinite(hits.distance), hits.distance, 0.0)
    reach = np.ptp(distance[..., None] * directions, axis=1)
    # A flat scene has no volume, so its box gets a minimal thickness.
    filled = np.prod(reach / np.maximum(high - low, 1e-6 * diagonal), axis=1)
    small = distance.max(axis=1) < SMALL_OBJECT * diagonal
    black = (hits.black | (hits.back & np.isin(hits.shape, one_sided))).mean(axis=1) >= 0.75
    backs = hits.back.mean(axis=1) >= 0.75
    return enclosed & (small | black | (backs & (filled < 0.5)))


def enclosure(scene: mi.Scene, positions: np.ndarray) -> np.ndarray:
    """The fraction of directions from positions (n, 3) that hit a surface: (n,) in [0, 1].

    A lamp around everything, such as a dome, stands for the sky and is no surface here.
    """
    return _enclosure(scene, _trace_spheres(scene, positions, sphere_directions(_DIRECTIONS)))


def _enclosure(scene: mi.Scene, hits: Hits) -> np.ndarray:
    """The same of hits (n, directions)."""
    met = np.isfinite(hits.distance) & ~np.isin(hits.shape, _skies(scene, hits.shape))
    return met.mean(axis=1)


def _skies(scene: mi.Scene, met: np.ndarray) -> list[int]:
    """The numbers of lamps that are around everything else.

    They take more than half of all directions, or a quarter where all that is no lamp lies in their
    box: a ground takes the lower half. Where there are lamps alone, as in a furnace, none is a sky.

    Args:
        scene: with lamps.
        met: numbers of the shapes that rays in all directions hit.
    """
    shapes = scene.shapes()
    lamps = [shape for shape in shapes if shape.is_emitter()]
    if len(lamps) == len(shapes):
        return []
    skies = []
    for lamp in lamps:
        number = registry_number(lamp)
        taken = np.count_nonzero(met == number) / max(met.size, 1)
        if taken > 0.5 or (taken > 0.25 and _is_around(lamp, *extent(scene, lamps=False)[:2])):
            skies.append(number)
    return skies


def _is_around(shape: mi.Shape, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether the box of a shape holds another one, but for rounding."""
    slack = 1e-3 * np.linalg.norm(high - low)
    return any((a <= low + slack).all() and (high - slack <= b).all() for a, b in _corners([shape]))


def sensor_probes(scene: mi.Scene, seed: int) -> np.ndarray:
    """Positions in the space that the scene's own sensors show, (n, 3).

    They lie on view rays between the entry into the scene's bounding box and the first surface.
    """
    rng = np.random.default_rng(seed)
    probes = [np.empty((0, 3))]
    for sensor in _with_rays(scene):
        film = mi.Point2f(rng.random((2, PROBES)).astype(np.float32))
        probes.append(probes_along(scene, *_view_rays(scene, sensor, film), rng))
    return np.concatenate(probes)


def sensor_eyes(scene: mi.Scene) -> np.ndarray:
    """Where the scene's own sensors stand, (n, 3); perspective cameras alone, if there are any."""
    sensors = _with_rays(scene)
    sensors = sensors[:: max(1, len(sensors) // PROBES)]
    middle = mi.Point2f(0.5)
    found = [np.empty((0, 3))]
    for sensor in list(filter(_is_camera, sensors)) or sensors:
        found.append(_view_rays(scene, sensor, middle)[0])
    return np.concatenate(found)


def _view_rays(
    scene: mi.Scene, sensor: mi.Sensor, film: mi.Point2f
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays of a sensor, (n, 3) each.

    Mitsuba lets them begin at the near plane, by which people cut walls away. If it lies beyond all
    there is, as in scenes in large units, they begin at the camera.
    """
    ray, _ = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
    origins, directions = as_rows(ray.o), as_rows(ray.d)
    if _is_camera(sensor) and _sees_nothing(scene, sensor):
        origins = np.broadcast_to(_matrix(sensor)[:3, 3], directions.shape)
    return origins, directions


def _sees_nothing(scene: mi.Scene, sensor: mi.Sensor) -> bool:
    side = (np.arange(_GRID) + 0.5) / _GRID
    film = np.stack(np.meshgrid(side, side)).reshape(2, -1).astype(np.float32)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(film), mi.Point2f(0.5))
    return not np.isfinite(trace(scene, as_rows(ray.o), as_rows(ray.d)).distance).any()


def probes_along(
    scene: mi.Scene, origins: np.ndarray, directions: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The same on view rays, (n, 3) each, of any camera; one at most on each."""
    low, high, _ = bounds(scene)
    far = trace(scene, origins, directions).distance
    with np.errstate(divide="ignore", invalid="ignore"):
        walls = np.stack([(low - origins) / directions, (high - origins) / directions])
    enter = np.maximum(np.nanmax(walls.min(axis=0), axis=1), 0.0)
    leave = np.minimum(np.nanmin(walls.max(axis=0), axis=1), far)
    # A camera close to the outside of a wall sees no space.
    usable = leave > enter + CONTACT * extent(scene)[2]
    depth = enter + (leave - enter) * rng.random(len(far))
    return (origins + depth[:, None] * directions)[usable]


def free_positions(
    scene: mi.Scene, count: int, seed: int, probes: np.ndarray | None = None
) -> np.ndarray:
    """Up to `count` quasi-random positions in a room where a camera can stand, (n, 3).

    Each is enclosed by surfaces (75 % of all directions), at least 3 % of the diagonal of `extent`
    away from them, and connected with the space that the scene's own sensors see by a chain of free
    segments. This rules out the insides of cupboards and the outside of the room. Without a sensor
    inside the room, all space outside objects counts.

    Args:
        scene: the room.
        count: positions at most.
        seed: of all random choices.
        probes: positions in the space that counts, (n, 3); None: those of the scene's own sensors.
    """
    low, high, diagonal = extent(scene)
    # Candidates in furniture or outside are rejected below, hence four times as many.
    candidates = low + (high - low) * _quasi_random(max(4 * count, 4096), seed)
    hits = _trace_spheres(scene, candidates, sphere_directions(_DIRECTIONS))
    free = hits.distance.min(axis=1) > CLEARANCE * diagonal
    free &= _enclosure(scene, hits) >= ROOM_ENCLOSURE
    candidates = candidates[free]
    probes = sensor_probes(scene, seed) if probes is None else probes
    if len(probes):
        return candidates[_connected(scene, candidates, probes, seed)][:count]
    return candidates[~inside_geometry(scene, candidates)][:count]


def lift(scene: mi.Scene, share: float) -> float:
    """A distance that keeps rays off surfaces: more than coordinates are rounded by.

    Args:
        scene: whose extent it suits.
        share: of the diagonal of `extent`.
    """
    return max(share * extent(scene)[2], 1e-6 * bounds(scene)[2])


def _connected(scene: mi.Scene, positions: np.ndarray, starts: np.ndarray, seed: int) -> np.ndarray:
    """Whether a chain of free segments connects each position with one of `starts`: (n,) bool."""
    rng, offset = np.random.default_rng(seed), lift(scene, _RAY_OFFSET)
    reached = np.zeros(len(positions), dtype=bool)
    idle = 0
    while idle < 2 and not reached.all():
        remaining = np.flatnonzero(~reached)
        # A random subset of all pairs: later rounds find what this one misses.
        sources = np.concatenate([starts, positions[reached]])
        sources = sources[rng.permutation(len(sources))[:64]]
        ends = np.repeat(positions[remaining], len(sources), axis=0)
        free = unoccluded(scene, ends, np.tile(sources, (len(remaining), 1)), offset)
        new = remaining[free.reshape(len(remaining), -1).any(axis=1)]
        reached[new] = True
        idle = 0 if len(new) else idle + 1
    return reached


def _quasi_random(count: int, seed: int) -> np.ndarray:
    """Points of the R3 low-discrepancy sequence with a random offset, (count, 3) in [0, 1)."""
    golden = 1.2207440846057596
    steps = golden ** -np.arange(1.0, 4.0)
    start = np.random.default_rng(seed).random(3)
    return (start + np.arange(count)[:, None] * steps) % 1.0


def _trace_spheres(scene: mi.Scene, positions: np.ndarray, directions: np.ndarray) -> Hits:
    """Hits of all directions from all positions, each field (positions, directions)."""
    hits = trace(scene, *_spheres(positions, directions))
    shape = (len(positions), len(directions))
    found = (hits.distance, hits.back, hits.black, hits.shape)
    return Hits(*(values.reshape(shape) for values in found))


def _spheres(positions: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of rays in all directions from all positions."""
    origins = np.repeat(positions, len(directions), axis=0)
    return origins, np.tile(directions, (len(positions), 1))


def _trace(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    ray = as_ray(origins, directions)
    hit = scene.ray_intersect(ray)
    valid = hit.is_valid()
    back = valid & (dr.dot(hit.n, ray.d) > 0)
    two_sided = mi.has_flag(hit.bsdf().flags(), mi.BSDFFlags.BackSide)
    distance = dr.select(valid, hit.t, dr.inf)
    shape = dr.select(valid, dr.reinterpret_array(mi.UInt32, hit.shape), 0)
    dr.eval(distance, back, two_sided, shape)
    black = np.array(back & ~two_sided)
    return np.array(distance, dtype=np.float64), np.array(back), black, np.array(shape)


def as_ray(origins: np.ndarray, directions: np.ndarray) -> mi.Ray3f:
    """Rays (n, 3) for Mitsuba."""
    o, d = (np.ascontiguousarray(a.T, dtype=np.float32) for a in (origins, directions))
    return mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))


def as_rows(vector: mi.Vector3f) -> np.ndarray:
    """Points or vectors of Mitsuba, (n, 3) float64."""
    return np.array(vector, dtype=np.float64).reshape(3, -1).T


def _matrix(sensor: mi.Sensor) -> np.ndarray:
    return np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A shape as it is placed in a scene."""

    number: int  # in Dr.Jit's registry
    matrix: np.ndarray  # (4, 4), local to world space: of the instance
    corners: np.ndarray  # (2, 3), of the bounding box
    area: float  # zero if its material is not optimized
    instanced: bool

    def sort_key(self) -> tuple[float, ...]:
        """Bounding box and area: a key that does not depend on the order of a scene's shapes."""
        return (*self.corners.ravel().tolist(), self.area)

    def moved(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) in world space."""
        return points @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def turned(self, normals: np.ndarray) -> np.ndarray:
        """Normals (n, 3) in world space; their lengths tell how much areas grow."""
        linear = self.matrix[:3, :3]
        return abs(np.linalg.det(linear)) * normals @ np.linalg.inv(linear)


def _surfaces(scene: mi.Scene) -> list[_Surface]:
    """All shapes as often as they are placed, in an order that is the same in every run.

    Mitsuba 3.9 loads in parallel: the order of a scene's shapes changes from run to run.
    """
    surfaces, normals = [], {}
    for placed in placed_shapes(scene):
        shape, box, area = placed.shape, placed.shape.bbox(), _area(placed.shape)
        corners = np.array([np.array(box.min).ravel(), np.array(box.max).ravel()])
        number = registry_number(shape)
        if placed.to_world is None:
            surfaces.append(_Surface(number, np.eye(4), corners, area, instanced=False))
            continue
        surface = _Surface(number, placed.to_world, corners, area, instanced=True)
        if area and number not in normals:
            uv = mi.Point2f(np.random.default_rng(0).random((2, 256)).astype(np.float32))
            normals[number] = as_rows(shape.sample_position(0.0, uv).n)
        if area:
            area *= float(np.linalg.norm(surface.turned(normals[number]), axis=1).mean())
        ends = surface.moved(
            np.array([corners[(i, j, k), range(3)] for i, j, k in np.ndindex(2, 2, 2)])
        )
        around = np.array([ends.min(0), ends.max(0)])
        surfaces.append(replace(surface, corners=around, area=area))
    return sorted(surfaces, key=_Surface.sort_key)


def _area(shape: mi.Shape) -> float:
    """The shape's own area; zero if its material is not optimized."""
    return surface_area(shape) if has_optimized_material(shape) else 0.0


def surface_area(shape: mi.Shape) -> float:
    """The area of a shape; zero where Mitsuba does not tell it, as of curves."""
    try:
        return float(np.asarray(shape.surface_area()).ravel()[0])
    except RuntimeError:
        return 0.0
