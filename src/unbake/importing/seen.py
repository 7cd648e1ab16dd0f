"""What cameras see of the mesh."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera, spread_rays
from ..dataset.small_views import in_blocks
from ..scene import free_space
from .photographs import pixels_of
from .source import Shot
from .views import all_of

#: Rays a view, along each edge, that tell how much of a photograph sees the mesh.
_RAYS = 64
#: A share of the opaque pixels of a photograph: alpha leaves more than the mesh in where more of
#: them do not see it.
_STRAY = 0.05


def shares_seen(scene: mi.Scene, cameras: Sequence[Camera]) -> np.ndarray:
    """The share of each camera's pixels that see the mesh, (cameras,)."""
    return np.array([_hits(scene, *spread_rays([c], _RAYS)).mean() for c in cameras])


def on_mesh(scene: mi.Scene, shot: Shot, block: int) -> np.ndarray:
    """Which pixels of a view see nothing but the mesh, by their four corners: (H, W) bool.

    Args:
        scene: with the mesh.
        shot: the photograph.
        block: edge of the squares of its pixels that become one of the view.
    """
    camera = in_blocks(shot.lens.camera(shot.to_world), block)
    x, y = np.meshgrid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0))
    hit = _hits(scene, *camera.rays(x.ravel(), y.ravel())).reshape(x.shape)
    return hit[:-1, :-1] & hit[:-1, 1:] & hit[1:, :-1] & hit[1:, 1:]


def on_mesh_if_stray(scene: mi.Scene, shot: Shot, block: int) -> np.ndarray | None:
    """As `on_mesh`, of a photograph whose alpha leaves in much that is no mesh; None: it does not.

    Alpha may cut out a tripod alone, and leave the room in.
    """
    seen, opaque = on_mesh(scene, shot, block), _opaque(shot, block)
    return seen if (opaque & ~seen).sum() > _STRAY * opaque.sum() else None


def _opaque(shot: Shot, block: int) -> np.ndarray:
    """Which pixels of a view have an alpha of 1, (H, W) bool."""
    alpha = pixels_of(shot)[..., 3:]
    if not shot.lens.straight:
        alpha = shot.lens.straightened(alpha, shot.lens.camera(shot.to_world).fl_x)
    return all_of(alpha[..., 0] >= 1, block)


def _hits(scene: mi.Scene, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Whether rays (n, 3) hit something, (n,) bool."""
    return np.isfinite(free_space.trace(scene, origins, directions).distance)
