"""Which surface points training views saw, and values for those that none saw."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.camera import Camera
from ..dataset.views import fitted_pixels
from ..fields.arrays import from_numpy
from ..scene import free_space
from ..scene.sight import Sight
from ..training.recovered import Recovered

#: How far from a point a ray towards it ends, as a fraction of the diagonal of its extent.
_OFFSET = 2e-4
#: The cosine below which a surface is seen from its edge, where nothing can be read from it.
_GRAZING = 0.02


class Views:
    """What cameras see of a scene's surfaces.

    Points that are seen in mirrors, through glass or in pixels that do not count alone are not
    seen.

    Args:
        scene: what stands in the way.
        cameras: those that a fit learned from.
        counted: tells by the number of a camera which pixels of its image count, (height, width)
            bool, or None where all do. It is asked once, when the camera first sees something.
            None: all pixels of all images count.
        hide_emitters: whether images do not show lamps, which then hide nothing.
    """

    def __init__(
        self,
        scene: mi.Scene,
        cameras: Sequence[Camera],
        counted: Callable[[int], np.ndarray | None] | None = None,
        *,
        hide_emitters: bool = False,
    ) -> None:
        self._scene, self._cameras, self._counted = scene, cameras, counted
        self._sight = Sight.of(scene, hide_emitters=hide_emitters)
        # A bit for each pixel, by camera; None where all count.
        self._bits: dict[int, np.ndarray | None] = {}
        self._offset = free_space.lift(scene, _OFFSET)

    def see(self, p: mi.Point3f, n: mi.Normal3f, two_sided: mi.Bool, active: mi.Bool) -> mi.Bool:
        """Whether any camera sees points.

        Args:
            p: in world space.
            n: unit normals of the surface.
            two_sided: whether the surface can be read from its back as well.
            active: points that count.
        """
        seen = dr.zeros(mi.Bool, dr.width(p))
        dr.eval(p, n, two_sided, active)
        for number in range(len(self._cameras)):
            left = active & ~seen
            if not dr.any(left):
                break
            seen |= self._sees(number, p, n, two_sided, left)
            dr.eval(seen)
        return seen

    def _sees(
        self,
        number: int,
        p: mi.Point3f,
        n: mi.Normal3f,
        two_sided: mi.Bool,
        active: mi.Bool,
    ) -> mi.Bool:
        camera = self._cameras[number]
        # All numbers come as arrays, so that one kernel serves all cameras.
        origin = _opaque(camera.origin)
        right, up, back = (_opaque(camera.to_world[:3, k]) for k in range(3))
        focal, centre, size = (
            mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y))
            for x, y in (
                (camera.fl_x, camera.fl_y),
                (camera.cx, camera.cy),
                (camera.width, camera.height),
            )
        )
        to_point = p - origin
        depth = -dr.dot(to_point, back)
        along = mi.Point2f(dr.dot(to_point, right), -dr.dot(to_point, up))
        film = dr.fma(along / depth, focal, centre)
        inside = (depth > 0) & dr.all((film >= 0) & (film < size))
        distance = dr.norm(to_point)
        d = to_point / distance
        cosine = -dr.dot(d, n)
        facing = dr.select(two_sided, dr.abs(cosine), cosine) > _GRAZING
        tried = active & inside & facing & (distance > self._offset)
        ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(d))
        ray.maxt = dr.maximum(distance - dr.opaque(mi.Float, self._offset), 0)
        free = self._sight.free(self._scene, ray, tried)
        return self._counting(number, film, free)

    def _counting(self, number: int, film: mi.Point2f, seen: mi.Bool) -> mi.Bool:
        """Of the points that a camera sees, those in pixels that count.

        Args:
            number: of the camera.
            film: where the points are in its image, in pixels.
            seen: points that it sees.
        """
        if self._counted is None or (number in self._bits and self._bits[number] is None):
            return seen
        dr.eval(film, seen)
        lanes = np.flatnonzero(np.array(seen))
        if not len(lanes):
            return seen
        if number not in self._bits:
            counted = self._counted(number)
            self._bits[number] = None if counted is None else np.packbits(counted)
        bits = self._bits[number]
        if bits is None:
            return seen
        column, row = (np.array(x)[lanes].astype(np.int64) for x in film)
        pixel = row * self._cameras[number].width + column
        counts = np.zeros(dr.width(seen), np.uint32)
        counts[lanes] = (bits[pixel >> 3] >> (7 - (pixel & 7))) & 1
        return from_numpy(mi.UInt32, counts) > 0


def training_views(recovered: Recovered) -> Views:
    """What the training views of a run see, in pixels that it was fitted to.

    Photographs and masks are read once points are asked for, and only those that may say that a
    pixel does not count.
    """
    dataset = recovered.dataset

    def counted(number: int) -> np.ndarray | None:
        return fitted_pixels(dataset.train[number], dataset.background)

    problem = recovered.problem
    scene, hidden = problem.scene_view.scene, problem.hide_emitters
    return Views(scene, recovered.cameras, counted, hide_emitters=hidden)


def _opaque(vector: np.ndarray) -> mi.Vector3f:
    return mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in vector))


def filled(values: np.ndarray, known: np.ndarray, default: Sequence[float]) -> np.ndarray:
    """Values of texels that are not known, from those around them that are.

    A pyramid of means over known texels; each unknown one takes the finest level that knows
    something of its neighbourhood, interpolated.

    Args:
        values: (n, n, channels) float32, n a power of two.
        known: (n, n) bool.
        default: of each channel, where nothing is known.

    Returns:
        The same array of values, with those that are not known replaced.

    Source: Gortler et al., The Lumigraph (1996), Sec. 3.4: pull and push.
    """
    if not known.any():
        values[:] = np.asarray(default, np.float32)
        return values
    if known.all():
        return values
    np.copyto(values, 0, where=~known[..., None])  # they may be no numbers
    weight = known[..., None].astype(np.float32)
    coarse, sums = _halved(values * weight, weight)
    guess = _doubled(_completed(coarse, sums))
    np.copyto(values, guess, where=~known[..., None])
    return values


def _completed(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """A level of the pyramid, filled from the coarser ones."""
    if len(values) == 1 or (weight > 0).all():
        return values
    coarse = _doubled(_completed(*_halved(values * weight, weight)))
    # What half is known of keeps half of its own value, so that no edge shows.
    share = np.minimum(weight, 1)
    return share * values + (1 - share) * coarse


def _halved(weighted: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means of two by two texels, and how much of them is known, at most 1 texel."""
    total, known = (a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]
                    for a in (weighted, weight))  # fmt: skip
    return total / np.maximum(known, 1e-20), np.minimum(known, 1)


def _doubled(values: np.ndarray) -> np.ndarray:
    """Twice the resolution, bilinear."""
    for axis in (0, 1):
        before = np.concatenate([values.take([0], axis), values], axis).take(
            range(values.shape[axis]), axis
        )
        after = np.concatenate([values, values.take([-1], axis)], axis).take(
            range(1, values.shape[axis] + 1), axis
        )
        pair = np.stack([0.75 * values + 0.25 * before, 0.75 * values + 0.25 * after], axis + 1)
        shape = list(values.shape)
        shape[axis] *= 2
        values = pair.reshape(shape).astype(np.float32)
    return values
