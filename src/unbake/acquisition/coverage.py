"""What cameras see of a scene: whether it is a room, and how much of its surface they show."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat

import mitsuba as mi
import numpy as np

from unbake.dataset.camera import Camera, spread_rays
from unbake.errors import UserError
from unbake.scene import free_space
from unbake.scene.sight import Sight
from unbake.transport.optimized import one_sided_shapes

#: Positions from which the reachable surface is seen.
_FREE_POSITIONS = 512
#: Rays along an edge of an image that look for backs; from this share of them on it is told.
_BACKS, BLACK = 16, 0.01
BLACK_BACKS = "of the pixels see backs of one-sided materials, which are black"
TURN_THEM = "Put these materials into 'twosided', or flip the normals of the shapes"
#: Cameras whose space is probed, at most.
_PROBING = 64


def is_room(scene: mi.Scene, cameras: Sequence[Camera] = ()) -> bool:
    """Whether the scene encloses its cameras (a room) or they stand around it (an object).

    A room has surfaces in 75 % of all directions, on average over the space that the cameras see;
    without cameras, over the part of the bounding box outside closed objects that light reaches.

    Args:
        scene: shapes tell its ground from what stands on it: merged meshes may hide it.
        cameras: that take the photographs; without any, the scene's own sensors stand for them.
    """
    told = bool(cameras or scene.sensors())
    if cameras:
        probes = _probes(scene, cameras, 0)
    elif told:
        probes = free_space.sensor_probes(scene, 0)
    else:
        low, high, _ = free_space.extent(scene)
        probes = low + (high - low) * np.random.default_rng(0).random((64, 3))
    probes = probes[~free_space.inside_geometry(scene, probes)]
    if len(probes) == 0:
        return False
    enclosed = free_space.enclosure(scene, probes)
    if not told and scene.emitters() and enclosed.mean() >= free_space.ROOM_ENCLOSURE:
        enclosed = enclosed[free_space.is_lit(scene, probes)]
    return bool(len(enclosed) and enclosed.mean() >= free_space.ROOM_ENCLOSURE)


def _probes(scene: mi.Scene, cameras: Sequence[Camera], seed: int) -> np.ndarray:
    """Positions in the space that cameras see, (n, 3); as `free_space.sensor_probes`."""
    rng, found = np.random.default_rng(seed), []
    step = -(-len(cameras) // _PROBING)
    for camera in cameras[::step]:
        x, y = rng.random((2, free_space.PROBES))
        rays = camera.rays(camera.width * x, camera.height * y)
        found.append(free_space.probes_along(scene, *rays, rng))
    return np.concatenate(found)


def coverage(
    scene: mi.Scene, cameras: Sequence[Camera], samples: int = 20000, *, own: bool = False
) -> float:
    """The fraction of the reachable surface area that at least one camera sees, in [0, 1].

    Only surfaces whose material is optimized count (no emitters, mirrors or glass), and around an
    object only those of the object, without a ground that is larger than all else. A point is
    reachable if a given camera sees it, or one of 512 other positions: in a room, positions in free
    space (`free_space.free_positions`); around an object, positions on the sphere of twice its
    radius, including below it. Backs of walls and insides of furniture are not reachable. Holes of
    cut-outs are no surface and hide nothing, nor do lamps around an object, whose photographs do
    not show them.

    Args:
        scene: the scene.
        cameras: the training views.
        samples: number of surface points tested, uniform by area.
        own: the scene's own sensors tell whether it is a room, and not these cameras.
    """
    room = is_room(scene, () if own else cameras)
    counts = _counts(scene, cameras, samples, () if own else cameras, room, hidden=not room)
    return float((counts > 0).sum() / max(len(counts), 1))


def black_share(scene: mi.Scene, cameras: Sequence[Camera]) -> float:
    """The share of the pixels of all cameras that see backs of one-sided materials, from 0 to 1.

    They are black. Materials that are known do not count.
    """
    hits = free_space.trace(scene, *spread_rays(cameras, _BACKS))
    return float((hits.back & np.isin(hits.shape, list(one_sided_shapes(scene)))).mean())


def view_counts(
    scene: mi.Scene,
    cameras: Sequence[Camera],
    samples: int = 4000,
    *,
    counted: Iterable[np.ndarray | None] | None = None,
    hide_emitters: bool,
) -> np.ndarray:
    """The number of cameras that see points of the reachable surface, (points,).

    Args:
        scene: the scene.
        cameras: the training views.
        samples: number of surface points tested, uniform by area; those that are reachable, as in
            `coverage`, are counted.
        counted: which pixels of each camera count, row by row, bool, (pixels,) each or None: all;
            what the others show is not seen.
        hide_emitters: whether photographs do not show lamps.
    """
    room = is_room(scene, cameras)
    return _counts(scene, cameras, samples, cameras, room, counted=counted, hidden=hide_emitters)


def _counts(
    scene: mi.Scene,
    cameras: Sequence[Camera],
    samples: int,
    telling: Sequence[Camera],
    room: bool,
    *,
    counted: Iterable[np.ndarray | None] | None = None,
    hidden: bool,
) -> np.ndarray:
    """The number of cameras that see points of the reachable surface, (points,).

    Args:
        telling: cameras that tell where one may stand in a room; none: the scene's own sensors.
        counted: as in `view_counts`.
        hidden: whether photographs do not show lamps.
    """
    sight = Sight.of(scene, hide_emitters=hidden)
    points = _counted(scene, samples, room)
    counts = np.zeros(len(points.position), dtype=int)
    masks = repeat(None, len(cameras)) if counted is None else counted
    for camera, mask in zip(cameras, masks, strict=True):
        pixel = camera.pixel_of(points.position)
        framed = np.flatnonzero(pixel >= 0)
        framed = framed if mask is None else framed[mask[pixel[framed]]]
        part = points.of(framed)
        counts[framed] += free_space.visibility(scene, camera.origin[None], part, sight)[0]
    return counts[_reachable(scene, points, counts > 0, telling, room, sight)]


def _counted(scene: mi.Scene, samples: int, room: bool) -> free_space.SurfacePoints:
    """Points on the surface of a room, or of an object without its ground if that leaves any."""
    within = None if room else object_box(scene)
    points = free_space.sample_surface(scene, samples, 1, within=within)
    if within is not None and not len(points.position):
        points = free_space.sample_surface(scene, samples, 1)
    return points.of(np.flatnonzero(~free_space.cut_out(scene, points)))


def _reachable(
    scene: mi.Scene,
    points: free_space.SurfacePoints,
    seen: np.ndarray,
    cameras: Sequence[Camera],
    room: bool,
    sight: Sight,
) -> np.ndarray:
    """Points that were seen, or that one of the standpoints sees."""
    reachable = seen.copy()
    positions = _standpoints(scene, cameras, room)
    # Most points are seen from the first few positions: the others are tested from ever more.
    first, count = 0, 1
    while first < len(positions) and not reachable.all():
        hidden = np.flatnonzero(~reachable)
        block = positions[first : first + count]
        shown = free_space.visibility(scene, block, points.of(hidden), sight)
        reachable[hidden] = shown.any(axis=0)
        first, count = first + len(block), min(2 * count, 32)
    return reachable


def _standpoints(scene: mi.Scene, cameras: Sequence[Camera], room: bool) -> np.ndarray:
    if room:
        probes = _probes(scene, cameras, 1) if cameras else None
        return free_space.free_positions(scene, _FREE_POSITIONS, 1, probes)
    centre, radius = sphere_around(*object_box(scene))
    return centre + 2 * radius * free_space.sphere_directions(_FREE_POSITIONS)


def object_box(scene: mi.Scene) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper corner (3,) of the scene without its ground and its lamps."""
    low, high, diagonal = free_space.extent(scene, lamps=False)
    if not np.isfinite(diagonal):
        raise UserError("the scene has no shapes", remedy="Give a scene with geometry")
    return low, high


def sphere_around(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of the sphere around a box."""
    return 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-9)
