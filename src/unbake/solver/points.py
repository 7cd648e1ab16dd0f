"""Points on all surfaces by area, and directions over the hemisphere: x and ω of Eq. 4."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.arrays import from_numpy
from ..fields.domain import Domain
from ..fields.shapes import placed_shapes, registry_number
from ..scene.free_space import surface_area

#: Points that are drawn from. They lie closer than the cells of L_θ's grid and than pixels.
POINTS = 1 << 20
#: How far from its point a ray starts, as a fraction of the extent of the scene.
_NEAR = 1e-4
#: Rays that tell whether a side of a shape scatters light.
_TRIED = 64


@dataclass(frozen=True)
class _Side:
    """A side of a shape, where it is placed."""

    shape: mi.Shape
    pose: np.ndarray  # (3, 4), of the instance
    sign: float  # 1: front, -1: back
    area: float
    count: int  # of points on it


@dataclass
class SurfacePoints:
    """Points on the sides of surfaces that scatter light; a PyTree for frozen functions.

    A side counts where the BSDF scatters any light that arrives there: both sides of two-sided
    surfaces, the front of others, and none of a black light. Mirrors, glass and cut-outs count,
    too: a ray at one goes on to the first surface that is not specular, as those of cameras do.

    Paper: Eq. 4.
    """

    count: int
    near: float  #: distance from which a point is looked at, in world units
    _position: mi.Float  # x, y, z of each point, world space
    _normal: mi.Float  # the same: unit normals on the side that counts

    @staticmethod
    def of(scene: mi.Scene, seed: int = 0, count: int = POINTS) -> SurfacePoints:
        """Random points of a scene, by area. Instances count as if they kept angles.

        Args:
            scene: the scene.
            seed: of the points.
            count: about how many.

        Raises:
            UserError: nothing in the scene scatters light.
        """
        near = _NEAR * Domain.of(scene.bbox()).extent
        sides = _sides(scene)
        if sides:
            scatters = _scattering(scene, sides, near)
            sides = [side for side, good in zip(sides, scatters, strict=True) if good]
        if not sides:
            raise UserError("nothing in the scene scatters light", None, "Give shapes a material")
        whole = sum(side.area for side in sides)
        # At least a point a side: a small one has a little more than its share.
        each = [max(1, round(count * side.area / whole)) for side in sides]
        return _drawn(
            [replace(side, count=n) for side, n in zip(sides, each, strict=True)], near, seed
        )

    def rays(self, sampler: mi.Sampler) -> mi.Ray3f:
        """Rays that look at random points from very near, back along directions ω.

        Where another surface is in the way, in a corner, it is met in the place of the point.

        Args:
            sampler: seeded; it is advanced.

        Paper: Eq. 4.
        """
        drawn = mi.UInt32(sampler.next_1d() * self.count)
        return self.rays_at(dr.minimum(drawn, self.count - 1), sampler)

    def rays_at(self, number: mi.UInt32, sampler: mi.Sampler) -> mi.Ray3f:
        """The same at points of these numbers."""
        p = dr.gather(mi.Point3f, self._position, number)
        n = dr.gather(mi.Vector3f, self._normal, number)
        d = mi.Frame3f(n).to_world(mi.warp.square_to_uniform_hemisphere(sampler.next_2d()))
        return mi.Ray3f(p + self.near * d, -d)


def _sides(scene: mi.Scene) -> list[_Side]:
    """Both sides of all shapes with a material and an area."""
    sides = []
    for placed in placed_shapes(scene):
        pose = np.eye(4) if placed.to_world is None else placed.to_world
        area = surface_area(placed.shape)
        area *= abs(np.linalg.det(pose[:3, :3])) ** (2 / 3)
        if placed.shape.bsdf() is not None and np.isfinite(area) and area > 0:
            sides += [_Side(placed.shape, pose[:3], sign, area, _TRIED) for sign in (1.0, -1.0)]
    return sides


def _drawn(sides: Sequence[_Side], near: float, seed: int) -> SurfacePoints:
    """Random points on these sides, one side after the other."""
    positions, normals = [], []
    rng = np.random.default_rng(seed)
    for side in sides:
        found = side.shape.sample_position(0.0, mi.Point2f(*_uniform(rng, side.count)))
        shape = (3, side.count)
        p = np.broadcast_to(np.array(found.p, np.float64).reshape(3, -1), shape)
        n = np.broadcast_to(np.array(found.n, np.float64).reshape(3, -1), shape)
        linear = side.pose[:, :3]
        positions.append((linear @ p + side.pose[:, 3:]).T)
        n = (np.linalg.inv(linear).T @ n).T
        normals.append(side.sign * n / np.linalg.norm(n, axis=1, keepdims=True))
    return SurfacePoints(
        count=sum(side.count for side in sides),
        near=near,
        _position=from_numpy(mi.Float, np.concatenate(positions)),
        _normal=from_numpy(mi.Float, np.concatenate(normals)),
    )


def _uniform(rng: np.random.Generator, count: int) -> list[mi.Float]:
    return [from_numpy(mi.Float, rng.random(count, dtype=np.float32)) for _ in range(2)]


def _scattering(scene: mi.Scene, sides: Sequence[_Side], near: float) -> list[bool]:
    """Which sides scatter light, as a few rays at each tell."""
    points = _drawn(sides, near, 0)
    numbers = np.repeat([registry_number(side.shape) for side in sides], _TRIED)
    shape = dr.reinterpret_array(mi.ShapePtr, from_numpy(mi.UInt32, numbers))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, points.count)
    with dr.suspend_grad():
        ray = points.rays_at(dr.arange(mi.UInt32, points.count), sampler)
        si = scene.ray_intersect(ray)
        met = si.is_valid() & (si.shape == shape)
        context, u = mi.BSDFContext(), sampler.next_1d()
        _, weight = si.bsdf().sample(context, si, u, sampler.next_2d(), met)
        scattered = dr.select(met & (dr.max(weight) > 0), mi.Float(1), 0)
        return (np.array(dr.block_sum(scattered, _TRIED)) > 0).tolist()
