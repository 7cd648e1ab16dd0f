"""Views at low resolution, with the surfaces that their pixels see: what checks of data look at."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..imaging.pictures import block_means
from ..scene import free_space
from .camera import Camera

#: Pixels along the longer side of a small view, at most.
LONGEST_SIDE = 64
#: Rays that are traced at once: few calls, for each takes long where a scene has many shapes.
_RAYS = 1 << 18


@dataclass(frozen=True, eq=False)
class SmallView:
    """A view at low resolution.

    Args:
        name: of the view.
        camera: of the small picture.
        rgb: mean linear radiance of blocks of pixels, (height, width, 3).
        alpha: mean coverage of the same blocks, (height, width); 1 where the background is visible.
        clipped: share of the pixels of the same blocks that are clipped, (height, width).
        of_mesh: whether alpha is where the mesh is seen from this pose, as masks are that import
            has drawn; its edges then tell nothing of the pose.
    """

    name: str
    camera: Camera
    rgb: np.ndarray
    alpha: np.ndarray
    clipped: np.ndarray
    of_mesh: bool = False


@dataclass(frozen=True, eq=False)
class Seen:
    """What pixels see, (n,) each: the first surface through their centres.

    Args:
        position: (n, 3) in world space; NaN where nothing is seen.
        normal: (n, 3) unit shading normals, turned towards the camera.
        distance: from the camera, world units; infinite where nothing is seen.
        emits: whether the surface emits light.
    """

    position: np.ndarray
    normal: np.ndarray
    distance: np.ndarray
    emits: np.ndarray

    def of(self, part: slice) -> Seen:
        """The same of some pixels."""
        fields = (self.position, self.normal, self.distance, self.emits)
        return Seen(*(values[part] for values in fields))


class Sized(Protocol):
    """What tells the pixels of a picture, such as a camera."""

    @property
    def width(self) -> int:
        """Pixels along a row."""
        ...

    @property
    def height(self) -> int:
        """Pixels along a column."""
        ...


def small_view(
    name: str,
    camera: Camera,
    rgb: np.ndarray,
    alpha: np.ndarray | None,
    longest: int = LONGEST_SIDE,
    limit: float = math.inf,
) -> SmallView:
    """A view averaged over the smallest square blocks that make it fit; a remainder is cut.

    Args:
        camera: of the whole picture.
        rgb: linear, row by row, (pixels, 3).
        alpha: coverage, (pixels,); None where the background is visible.
        longest: pixels along the longer side, at most.
        limit: from which on a channel is clipped.
    """
    small, block = small_camera(camera, longest), block_of(camera, longest)
    pixels = rgb.reshape(camera.height, camera.width, -1)[..., :3]
    covered, clipped = np.ones((small.height, small.width)), np.zeros((small.height, small.width))
    if alpha is not None:
        covered = block_means(alpha.reshape(pixels.shape[:2]), block)
    if math.isfinite(limit):
        clipped = block_means(np.asarray((pixels >= limit).any(axis=-1), np.float32), block)
    return SmallView(name, small, block_means(pixels, block), covered, clipped)


def small_camera(camera: Camera, longest: int = LONGEST_SIDE) -> Camera:
    """The camera of the small view."""
    return in_blocks(camera, block_of(camera, longest))


def in_blocks(camera: Camera, block: int) -> Camera:
    """The camera of a picture whose pixels are means of squares of so many along an edge.

    A remainder at the right and at the bottom is cut.
    """
    return replace(
        camera,
        fl_x=camera.fl_x / block,
        fl_y=camera.fl_y / block,
        cx=camera.cx / block,
        cy=camera.cy / block,
        width=camera.width // block,
        height=camera.height // block,
    )


def block_of(picture: Sized, longest: int = LONGEST_SIDE) -> int:
    """Pixels along an edge of the blocks that become pixels of a small view."""
    block = -(-max(picture.height, picture.width) // longest)
    return min(block, picture.height, picture.width)  # a picture of one line keeps it


def pixel_rays(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions through the centres of all pixels, row by row, camera by camera."""
    directions = [view_rays(camera) @ camera.to_world[:3, :3].T for camera in cameras]
    origins = [np.broadcast_to(c.origin, d.shape) for c, d in zip(cameras, directions, strict=True)]
    return np.concatenate(origins), np.concatenate(directions)


def view_rays(camera: Camera) -> np.ndarray:
    """Directions through the centres of all pixels in the camera's own axes, (pixels, 3)."""
    inside = camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.width, camera.height
    return _view_rays(*inside)


@lru_cache(maxsize=32)  # many poses of the same few cameras are tried
def _view_rays(
    fl_x: float, fl_y: float, cx: float, cy: float, width: int, height: int
) -> np.ndarray:
    row, column = np.divmod(np.arange(width * height), width)
    camera = Camera(np.eye(4), fl_x, fl_y, cx, cy, width, height)
    return camera.rays(column + 0.5, row + 0.5)[1]


def seen_by(scene: mi.Scene, cameras: Sequence[Camera]) -> list[Seen]:
    """The surfaces that the pixels of cameras see, row by row."""
    every = seen_along(scene, *pixel_rays(cameras))
    first = np.cumsum([0, *(c.width * c.height for c in cameras)])
    return [every.of(slice(a, b)) for a, b in pairwise(first.tolist())]


def seen_along(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> Seen:
    """The first surfaces along rays, (n, 3) each, with unit directions."""
    parts = [
        _seen(scene, origins[i : i + _RAYS], directions[i : i + _RAYS])
        for i in range(0, len(origins), _RAYS)
    ]
    return Seen(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _seen(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    hit = scene.ray_intersect(free_space.as_ray(origins, directions))
    valid = hit.is_valid()
    normal = hit.sh_frame.n
    emits = valid & hit.shape.is_emitter()
    dr.eval(hit.t, normal, valid, emits)
    found = np.array(valid)
    distance = np.where(found, np.array(hit.t, dtype=np.float64), np.inf)
    towards = free_space.as_rows(normal)
    towards = np.where(((towards * directions).sum(1) > 0)[:, None], -towards, towards)
    reach = np.where(found, distance, 0)[:, None]
    position = np.where(found[:, None], origins + reach * directions, np.nan)
    return position, np.where(found[:, None], towards, 0.0), distance, np.array(emits)
