"""Pinhole cameras: one convention inside, Mitsuba's and nerfstudio's at the borders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import mitsuba as mi
import numpy as np

from unbake.errors import UserError

# OpenGL cameras look along -z with x to the right, Mitsuba's along +z with x to the left.
_FLIP = np.diag([-1.0, 1.0, -1.0, 1.0])
#: Width and height of an image, in pixels.
LONGEST_SIDE = 1 << 16
# In pixels; rays are computed in single precision.
_FOCAL_LENGTHS, _FARTHEST_CENTRE = (1e-3, 1e9), 1e6
# In world units. Squares of distances must be finite in single precision.
_FARTHEST = 1e15
# Text files round rotations to a few digits; a worse matrix is a mistake, not rounding.
_RIGID_TOLERANCE = 1e-3
_SQUARE_TOLERANCE = 1e-4


@final
@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Pixel (i, j), counted from the top left, looks from the last column of `to_world` along
    `to_world[:3, :3] @ ((i + 0.5 - cx) / fl_x, -(j + 0.5 - cy) / fl_y, -1)`.

    Args:
        to_world: (4, 4) float64, camera to world, world units, OpenGL axes (x right, y up, looks
            along -z).
        fl_x: horizontal focal length in pixels.
        fl_y: vertical focal length in pixels.
        cx: principal point in pixels from the left edge.
        cy: principal point in pixels from the top edge.
        width: of the image, in pixels.
        height: of the image, in pixels.

    Raises:
        UserError: the pose is not a finite, right-handed rigid motion, or the image is empty, or a
            number is so large or small that rays cannot be computed in single precision.
    """

    to_world: np.ndarray
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        pose = _rigid(np.array(self.to_world, dtype=np.float64))
        pose.setflags(write=False)
        object.__setattr__(self, "to_world", pose)
        if self.width < 1 or self.height < 1:
            raise UserError(
                f"the image size {self.width} x {self.height} is empty",
                remedy="Width and height are positive pixel counts",
            )
        if max(self.width, self.height) > LONGEST_SIDE:
            raise UserError(
                f"the image size {self.width:.6g} x {self.height:.6g} is too large",
                remedy=f"Width and height are pixel counts up to {LONGEST_SIDE}",
            )
        least, most = _FOCAL_LENGTHS
        if not (least <= self.fl_x <= most and least <= self.fl_y <= most):
            raise UserError(
                f"the focal length ({self.fl_x:g}, {self.fl_y:g}) is out of range",
                remedy=f"It is from {least:g} to {most:g} pixels; check the field of view",
            )
        if not (abs(self.cx) <= _FARTHEST_CENTRE and abs(self.cy) <= _FARTHEST_CENTRE):
            raise UserError(
                f"the principal point ({self.cx:g}, {self.cy:g}) is far outside of the image",
                remedy="cx and cy are in pixels from the top left corner",
            )

    def moved(self, turn: np.ndarray, shift: np.ndarray) -> Camera:
        """The camera turned and shifted in its own axes.

        Args:
            turn: rotation vector of a small turn, radians, (3,).
            shift: world units, (3,).
        """
        x, y, z = turn / 2
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        scale = 2 / (1 + (turn / 2) @ (turn / 2))
        pose = self.to_world.copy()
        pose[:3, 3] += pose[:3, :3] @ shift
        pose[:3, :3] = pose[:3, :3] @ (np.eye(3) + scale * (cross + cross @ cross))
        return replace(self, to_world=pose)

    @classmethod
    def look_at(
        cls,
        origin: Sequence[float] | np.ndarray,
        target: Sequence[float] | np.ndarray,
        up: Sequence[float] | np.ndarray,
        fov_degrees: float,
        width: int,
        height: int,
    ) -> Camera:
        """A camera at `origin` that looks at `target`, with the principal point in the middle.

        Args:
            origin: position of the camera, (3,) in world units.
            target: a point that it looks at, (3,) in world units.
            up: upward direction, (3,), not necessarily perpendicular to the view.
            fov_degrees: horizontal field of view, between 0 and 180 degrees.
            width: of the image, in pixels.
            height: of the image, in pixels.

        Raises:
            UserError: the points coincide, `up` is parallel to the view, or the field of view is
                out of range.
        """
        if not 0 < fov_degrees < 180:
            raise UserError(
                f"the field of view {fov_degrees:g} is not between 0 and 180 degrees",
                remedy="'fov' is the horizontal field of view in degrees",
            )
        position = np.asarray(origin, dtype=np.float64)
        given = np.concatenate([position, np.asarray(target), np.asarray(up)])
        if np.abs(given).max() > _FARTHEST:
            raise UserError(
                f"origin, target or up have entries over {_FARTHEST:g}",
                remedy="They are points in world units, and a direction",
            )
        back = position - np.asarray(target, dtype=np.float64)
        right = np.cross(np.asarray(up, dtype=np.float64), back)
        scale = np.linalg.norm(back) * np.linalg.norm(up)
        if not (scale > 0 and np.linalg.norm(right) > 1e-6 * scale):
            raise UserError(
                "origin, target and up do not define a view",
                remedy="The target must differ from the origin, and up from the view direction",
            )
        back = back / np.linalg.norm(back)
        right = right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        focal = 0.5 * width / math.tan(math.radians(fov_degrees) / 2)
        return cls(pose, focal, focal, width / 2, height / 2, width, height)

    @property
    def origin(self) -> np.ndarray:
        """The centre of projection, (3,) in world units."""
        return self.to_world[:3, 3]

    def rescaled(self, width: int, height: int) -> Camera:
        """The same view with another pixel count.

        The horizontal field of view stays, and so does the shape of the pixels: where the aspect
        ratio changes, rows are added or cut evenly at the top and the bottom.
        """
        scale = width / self.width
        return Camera(
            self.to_world,
            self.fl_x * scale,
            self.fl_y * scale,
            self.cx * scale,
            height / 2 + (self.cy - self.height / 2) * scale,
            width,
            height,
        )

    @property
    def has_square_pixels(self) -> bool:
        """Whether both focal lengths agree, as Mitsuba's camera needs it."""
        return abs(self.fl_x / self.fl_y - 1) <= _SQUARE_TOLERANCE

    def rays(self, px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions, (n, 3) each in world space, through film positions.

        Args:
            px: (n,) in pixels from the left edge; pixel centres are at k + 0.5.
            py: (n,) in pixels from the top edge.
        """
        x, y = (px - self.cx) / self.fl_x, -(py - self.cy) / self.fl_y
        local = np.stack([x, y, -np.ones_like(x)], axis=1)
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        directions = local @ self.to_world[:3, :3].T
        return np.broadcast_to(self.origin, directions.shape), directions

    def project(self, points: np.ndarray) -> np.ndarray:
        """Film positions of points, the inverse of `rays`: (n, 2), NaN where they lie behind.

        They are in pixels from the left and the top edge, pixel centres at k + 0.5, and need not
        be inside of the image.

        Args:
            points: (n, 3) in world space.
        """
        x, y, z = ((points - self.origin) @ self.to_world[:3, :3]).T
        depth = np.where(z < 0, -z, np.nan)
        return np.stack([self.cx + self.fl_x * x / depth, self.cy - self.fl_y * y / depth], axis=1)

    def pixels_from(self, other: Camera, points: np.ndarray) -> float:
        """How far apart this camera and another one see points, root mean square in pixels.

        Points behind a camera are left out; it is 0 where there is no other one.

        Args:
            other: of the same image.
            points: (n, 3) in world space.
        """
        apart = self.project(points) - other.project(points)
        apart = apart[np.isfinite(apart).all(1)]
        return float(np.sqrt((apart**2).sum(1).mean())) if len(apart) else 0.0

    def pixel_of(self, points: np.ndarray) -> np.ndarray:
        """Numbers of the pixels that points project into, whether or not something hides them.

        Args:
            points: (n, 3) in world space.

        Returns:
            (n,) int64: column and row (i, j) have the number j * width + i; −1 is outside.
        """
        column, row = np.floor(self.project(points)).T
        inside = (0 <= column) & (column < self.width) & (0 <= row) & (row < self.height)
        numbers = np.full(len(points), -1, np.int64)
        numbers[inside] = row[inside] * self.width + column[inside]
        return numbers

    def sensor(self, spp: int) -> dict[str, Any]:
        """The Mitsuba `perspective` sensor that renders this camera, as a dictionary.

        The film is float32 RGBA in linear RGB with a box filter.

        Args:
            spp: samples per pixel.

        Raises:
            UserError: fl_x and fl_y differ, which Mitsuba's camera cannot express.
        """
        if not self.has_square_pixels:
            raise UserError(
                f"pixels are not square: fl_x is {self.fl_x:g} and fl_y is {self.fl_y:g}",
                remedy="Resample the image so that both focal lengths agree",
            )
        return {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(self.to_world @ _FLIP),
            "fov": math.degrees(2 * math.atan(0.5 * self.width / self.fl_x)),
            "fov_axis": "x",
            "principal_point_offset_x": 0.5 - self.cx / self.width,
            "principal_point_offset_y": 0.5 - self.cy / self.height,
            # The defaults clip what is nearer than 0.01 world units, which is much of a small scene
            "near_clip": 1e-4,
            "far_clip": 1e6,
            "film": {
                "type": "hdrfilm",
                "width": self.width,
                "height": self.height,
                "pixel_format": "rgba",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": spp},
        }

    @classmethod
    def from_mitsuba(cls, sensor: mi.Sensor) -> Camera:
        """The camera of a Mitsuba `perspective` sensor, its film's crop window included.

        Of a `thinlens`, which has depth of field, it is the camera with the smallest aperture.

        Raises:
            UserError: the sensor is not a perspective camera, or it mirrors the image.
        """
        params = mi.traverse(sensor)
        if "x_fov" not in params:
            raise UserError(
                f"the sensor {sensor.class_name()} is not a perspective camera",
                remedy="Use a scene with a 'perspective' sensor, or give a camera file",
            )
        film = sensor.film()
        width, height = (int(v) for v in film.size())
        crop_width, crop_height = (int(v) for v in film.crop_size())
        left, top = (int(v) for v in film.crop_offset())
        focal = 0.5 * width / math.tan(math.radians(_scalar(params["x_fov"])) / 2)
        middle = [
            _scalar(params[key]) if key in params else 0.0
            for key in ("principal_point_offset_x", "principal_point_offset_y")
        ]
        cx = width * (0.5 - middle[0]) - left
        cy = height * (0.5 - middle[1]) - top
        matrix = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
        return cls(matrix @ _FLIP, focal, focal, cx, cy, crop_width, crop_height)


def spread_rays(cameras: Sequence[Camera], along: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays that are spread evenly over images, the same number in each, camera by camera.

    Args:
        cameras: one at least.
        along: rays along an edge of an image; `along`² are in it.

    Returns:
        Origins and unit directions, (n, 3) each in world space.
    """
    film = (np.arange(along) + 0.5) / along
    x, y = (axis.ravel() for axis in np.meshgrid(film, film))
    rays = [camera.rays(x * camera.width, y * camera.height) for camera in cameras]
    origins, directions = zip(*rays, strict=True)
    return np.concatenate(origins), np.concatenate(directions)


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a unit quaternion (4,), as x, y, z, w."""
    x, y, z, w = quaternion
    across = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
    return np.eye(3) + 2 * w * across + 2 * across @ across


def up_of(cameras: Sequence[Camera]) -> np.ndarray:
    """The upward direction (3,), a unit vector, of photographs that were taken level.

    It is perpendicular to the cameras' horizontal axes, if these differ; else the mean of their
    vertical ones.
    """
    right = np.array([camera.to_world[:3, 0] for camera in cameras])
    mean = np.mean([camera.to_world[:3, 1] for camera in cameras], axis=0)
    values, vectors = np.linalg.eigh(right.T @ right / len(right))
    up = vectors[:, 0]
    # Two horizontal directions and a vertical one that none has.
    if values[1] < 0.05 or values[0] > 0.3 * values[1] or abs(up @ mean) < 0.1:
        up = mean
    length = np.linalg.norm(up)
    up = cameras[0].to_world[:3, 1] if length < 1e-3 else up / length
    return up if up @ mean >= 0 else -up


@final
@dataclass(frozen=True)
class LookAt:
    """Where a camera stands and what it looks at: one entry of a camera file.

    Args:
        origin, target, up: (3,) in world units.
        fov: horizontal field of view in degrees.
    """

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float

    def camera(self, width: int, height: int) -> Camera:
        """The camera with that many pixels; errors as in `Camera.look_at`."""
        return Camera.look_at(self.origin, self.target, self.up, self.fov, width, height)


def _rigid(matrix: np.ndarray) -> np.ndarray:
    """The rigid motion next to `matrix`, or an error where that is far."""
    remedy = "'transform_matrix' is camera to world: a rotation and a position, no scale"
    if matrix.shape != (4, 4):
        raise UserError(f"the pose has shape {matrix.shape}", remedy=remedy)
    if not np.isfinite(matrix).all():
        raise UserError("the pose has NaN or infinite entries", remedy=remedy)
    if np.abs(matrix).max() > _FARTHEST:
        raise UserError(f"the pose has entries over {_FARTHEST:g}", remedy=remedy)
    rotation = matrix[:3, :3]
    determinant = np.linalg.det(rotation)
    if abs(determinant) < 1e-6:
        raise UserError("the pose is singular", remedy=remedy)
    if determinant < 0:
        raise UserError(
            "the pose is left-handed, it mirrors the image",
            remedy="Negate one axis: the convention is x right, y up, looking along -z",
        )
    left, _, right = np.linalg.svd(rotation)
    nearest = left @ right
    if np.abs(nearest - rotation).max() > _RIGID_TOLERANCE:
        raise UserError("the pose is not a rigid motion", remedy=remedy)
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise UserError("the last row of the pose is not 0 0 0 1", remedy=remedy)
    pose = matrix.copy()
    # A matrix that is as good as its number format allows stays as it is, bit for bit.
    if np.abs(nearest - rotation).max() > 1e-12:
        pose[:3, :3] = nearest
    return pose


def _scalar(value: Any) -> float:
    return float(np.asarray(value).ravel()[0])
