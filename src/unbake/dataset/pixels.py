"""Which pixels of which views a step trains on, and the camera rays through them (Sec. 5.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.arrays import from_numpy
from .camera import Camera
from .photographs import Photographs


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
class PixelBatch:
    """Pixels by number, with their colours in the photographs; a PyTree."""

    count: int
    smoothed: bool  # whether blurred photographs are with them
    _packed: mi.UInt32  # numbers, then bits of colours: one array, so that a step copies one

    @staticmethod
    def of(numbers: np.ndarray, colours: np.ndarray) -> PixelBatch:
        """Pixels by their numbers, shape (n,), and the rows of `Photographs.table`."""
        packed = np.empty((1 + colours.shape[1], len(numbers)), np.uint32)
        packed[0] = numbers
        packed[1:] = np.ascontiguousarray(colours.T).view(np.uint32)
        return PixelBatch(len(numbers), colours.shape[1] > 3, from_numpy(mi.UInt32, packed))

    def batch(self, rays: CameraRays, sampler: mi.Sampler, spp: int) -> RayBatch:
        """Jittered camera rays through the pixels (box filter), and their colours.

        Args:
            sampler: seeded for `spp` lanes a pixel.
        """
        number = self._row(0, dr.arange(mi.UInt32, self.count * spp) // spp)
        ray = rays.through(number, sampler.next_2d())
        pixel = dr.arange(mi.UInt32, self.count)
        columns = range(6 if self.smoothed else 3)
        rgb = [dr.reinterpret_array(mi.Float, self._row(1 + i, pixel)) for i in columns]
        return RayBatch(mi.Color3f(rgb[:3]), mi.Color3f(rgb[3:]) if self.smoothed else None, ray)

    def _row(self, row: int, pixel: mi.UInt32) -> mi.UInt32:
        return dr.gather(mi.UInt32, self._packed, pixel + row * self.count)


@dataclass
class RayBatch:
    """Pixels and the camera rays of their samples."""

    target: mi.Color3f  # photographs, linear RGB, one lane a pixel
    smoothed: mi.Color3f | None  # the same from photographs blurred over 5 x 5 pixels, if kept
    ray: mi.Ray3f  # `spp` consecutive lanes a pixel, world space


@final
@dataclass(frozen=True, eq=False)
class PixelSource:
    """All training pixels, to draw batches from.

    Random pixels over all views rather than one crop of one view a step (Sec. 5.4): neighbouring
    pixels tell much the same, so that scattered ones learn faster at equal cost. They are drawn on
    the host, where photographs that are larger than memory can stay on disk.

    Args:
        rays: through the pixels of all views.
        photographs: of the same views.
    """

    rays: CameraRays
    photographs: Photographs

    @staticmethod
    def of(
        cameras: Sequence[Camera],
        rgb: np.ndarray,
        alpha: np.ndarray,
        *,
        foreground_only: bool,
        smoothed: bool = True,
    ) -> PixelSource:
        """The pixels of views in memory; see `Photographs.of`."""
        found = Photographs.of(
            cameras, rgb, alpha, foreground_only=foreground_only, smoothed=smoothed
        )
        return PixelSource(CameraRays.of(cameras), found)

    def draw(self, seed: int, count: int) -> PixelBatch:
        """Draw random pixels, each as likely as any other.

        Paper: Sec. 5.4.
        """
        every = self.photographs
        slots = np.random.default_rng(seed).integers(0, every.count, count)
        numbers = slots if every.chosen is None else every.chosen[slots]
        return PixelBatch.of(numbers, every.table[numbers])
