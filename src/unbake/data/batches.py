"""Which pixels of which views a step trains on, and the camera rays through them (Sec. 5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.network import from_numpy
from .camera import Camera


@dataclass
class CameraRays:
    """Camera rays through the pixels of several views.

    Pixels of all views are numbered row by row, view after view. An object of this class is a
    PyTree: it can be handed to frozen functions.
    """

    views: int
    pixels: int
    _first: mi.UInt32  # number of each view's first pixel, and of all pixels
    _width: mi.UInt32  # of each view
    _lens: mi.Float  # fl_x, fl_y, cx, cy of each view
    _pose: mi.Float  # upper three rows of `to_world` of each view

    @staticmethod
    def of(cameras: Sequence[Camera]) -> CameraRays:
        """The rays of these cameras."""
        sizes = [c.width * c.height for c in cameras]
        lens = [[c.fl_x, c.fl_y, c.cx, c.cy] for c in cameras]
        return CameraRays(
            views=len(cameras),
            pixels=sum(sizes),
            # One entry more than there are views: the search below looks there too.
            _first=from_numpy(mi.UInt32, np.cumsum([0, *sizes])),
            _width=from_numpy(mi.UInt32, np.array([c.width for c in cameras])),
            _lens=from_numpy(mi.Float, np.array(lens)),
            _pose=from_numpy(mi.Float, np.array([c.to_world[:3, :4] for c in cameras])),
        )

    def through(self, pixel: mi.UInt32, offset: mi.Point2f) -> mi.Ray3f:
        """World space rays through pixels.

        Args:
            pixel: numbers of pixels.
            offset: position inside the pixel, [0,1]², from its top left corner.
        """
        view = mi.UInt32(
            dr.binary_search(0, self.views, lambda i: dr.gather(mi.UInt32, self._first, i) <= pixel)
        )
        view -= 1
        n = dr.width(pixel)
        pixel = pixel - dr.gather(mi.UInt32, self._first, view)
        # Lanes that only fill up a vector divide as well, by the zero that they gather.
        width = dr.maximum(dr.gather(mi.UInt32, self._width, view), 1)
        fx, fy, cx, cy = dr.gather(mi.ArrayXf, self._lens, view, shape=(4, n))
        m = dr.gather(mi.ArrayXf, self._pose, view, shape=(12, n))
        x = (mi.Float(pixel % width) + offset.x - cx) / fx
        y = (mi.Float(pixel // width) + offset.y - cy) / fy
        local = dr.normalize(mi.Vector3f(x, -y, -1))
        rows = [mi.Vector3f(m[4 * r], m[4 * r + 1], m[4 * r + 2]) for r in range(3)]
        direction = mi.Vector3f([dr.dot(row, local) for row in rows])
        return mi.Ray3f(mi.Point3f(m[3], m[7], m[11]), direction)


@dataclass
class Batch:
    """Pixels and the camera rays of their samples."""

    target: mi.Color3f  # photographs, linear RGB, one lane a pixel
    smoothed: mi.Color3f  # the same from photographs blurred over 5 x 5 pixels
    ray: mi.Ray3f  # `spp` consecutive lanes a pixel, world space


@dataclass
class PixelSource:
    """All training pixels in one flat array, to draw batches from; a PyTree.

    Random pixels over all views rather than one crop of one view a step (Sec. 5.4): neighbouring
    pixels tell much the same, so that scattered ones learn faster at equal cost.
    """

    rays: CameraRays
    _rgb: mi.Float  # linear RGB of all pixels
    _smoothed: mi.Float  # the same, blurred
    _chosen: mi.UInt32  # numbers of the pixels that batches are drawn from
    _count: mi.UInt32  # of the chosen pixels, one lane

    @staticmethod
    def of(
        cameras: Sequence[Camera], rgb: np.ndarray, alpha: np.ndarray, *, foreground_only: bool
    ) -> PixelSource:
        """The pixels of these views.

        Where the background is hidden, background pixels say nothing about the scene and only
        foreground pixels are drawn (the paper: at least half of them).

        Args:
            cameras: one a view.
            rgb: linear RGB of all views' pixels, row by row, view after view, shape (pixels, 3).
            alpha: coverage of the same pixels, shape (pixels,).
            foreground_only: draw only pixels with alpha > 0.

        Paper: Sec. 5.4.
        """
        chosen = np.flatnonzero(alpha > 0) if foreground_only else np.arange(len(alpha))
        return PixelSource(
            rays=CameraRays.of(cameras),
            _rgb=from_numpy(mi.Float, rgb),
            _smoothed=from_numpy(mi.Float, _blurred(cameras, rgb)),
            _chosen=from_numpy(mi.UInt32, chosen),
            _count=dr.opaque(mi.UInt32, len(chosen)),
        )

    def draw(self, seed: mi.UInt32, sampler: mi.Sampler, pixels: int, spp: int) -> Batch:
        """Draw random pixels and jittered camera rays through them (box filter).

        Args:
            seed: decides which pixels, one lane.
            sampler: seeded for `pixels * spp` lanes.
        """
        slot = dr.arange(mi.UInt32, pixels)
        pixel = self._pixel(slot, seed)
        every_sample = self._pixel(dr.arange(mi.UInt32, pixels * spp) // spp, seed)
        ray = self.rays.through(every_sample, sampler.next_2d())
        target = dr.gather(mi.Color3f, self._rgb, pixel)
        return Batch(target, dr.gather(mi.Color3f, self._smoothed, pixel), ray)

    def _pixel(self, slot: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
        # 32 random bits times the count, upper half: uniform even over hundreds of millions.
        # Of neighbouring slots, the usual 4 rounds draw some pixels far more often than others.
        bits, _ = mi.sample_tea_32(slot, seed, rounds=8)
        return dr.gather(mi.UInt32, self._chosen, dr.mul_hi(bits, self._count))


def _blurred(cameras: Sequence[Camera], rgb: np.ndarray, radius: int = 2) -> np.ndarray:
    """Each view's image, every pixel the mean of the (2 radius + 1)² pixels around it."""
    parts, first = [], 0
    for camera in cameras:
        count = camera.width * camera.height
        image = rgb[first : first + count].reshape(camera.height, camera.width, 3)
        first += count
        padded = np.pad(image, ((radius, radius), (radius, radius), (0, 0)), mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * radius + 1,) * 2, (0, 1))
        parts.append(windows.mean((-2, -1), dtype=np.float32).reshape(count, 3))
    return np.concatenate(parts)
