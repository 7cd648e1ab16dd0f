"""Which pixels of which views a step trains on, and the camera rays through them (Sec. 5.4)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias, final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UserError
from ..fields.arrays import from_numpy, read_small
from .camera import Camera
from .decoding import stretch
from .photographs import Photographs

#: Pixels that are held aside, at least (or none are) and at most: enough to see an error change by
#: one percent, few enough to be rendered in the time of some steps.
FEWEST_HELD, MOST_HELD = 64, 4096
#: Their number is a multiple of this, so that they can be parted into equal groups.
HELD_GROUPS = 16
#: Tells their random numbers from those of steps, which start at the same seed.
_HELD = 0x48454C44
#: Numbers of pixels that are looked at at once: places in arrays take 64 bits each.
_AT_ONCE = 1 << 16


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
    lens: mi.Float  # fl_x, fl_y, cx, cy of each view
    pose: mi.Float  # upper three rows of `to_world` of each view

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
            lens=from_numpy(mi.Float, np.array(lens)),
            pose=from_numpy(mi.Float, np.array([c.to_world[:3, :4] for c in cameras])),
        )

    def through(self, pixel: mi.UInt32, offset: mi.Point2f) -> mi.Ray3f:
        """World space rays through pixels.

        Args:
            pixel: numbers of pixels.
            offset: position inside the pixel, [0,1]², from its top left corner.
        """
        view = self.view_of(pixel)
        n = dr.width(pixel)
        pixel = pixel - dr.gather(mi.UInt32, self._first, view)
        # Lanes that only fill up a vector divide as well, by the zero that they gather.
        width = dr.maximum(dr.gather(mi.UInt32, self._width, view), 1)
        fx, fy, cx, cy = dr.gather(mi.ArrayXf, self.lens, view, shape=(4, n))
        m = dr.gather(mi.ArrayXf, self.pose, view, shape=(12, n))
        x = (mi.Float(pixel % width) + offset.x - cx) / fx
        y = (mi.Float(pixel // width) + offset.y - cy) / fy
        local = dr.normalize(mi.Vector3f(x, -y, -1))
        rows = [mi.Vector3f(m[4 * r], m[4 * r + 1], m[4 * r + 2]) for r in range(3)]
        direction = mi.Vector3f([dr.dot(row, local) for row in rows])
        return mi.Ray3f(mi.Point3f(m[3], m[7], m[11]), direction)

    def project(self, pixel: mi.UInt32, point: mi.Point3f) -> mi.Point2f:
        """Where points lie in the images of pixels, in pixels from the top left corner.

        Args:
            pixel: numbers of pixels, each of a view.
            point: world space, in front of the view's camera.
        """
        view = self.view_of(pixel)
        fx, fy, cx, cy = (read_small(self.lens, 4 * view + i) for i in range(4))
        m = [read_small(self.pose, 12 * view + i) for i in range(12)]
        offset = point - mi.Point3f(m[3], m[7], m[11])
        columns = [mi.Vector3f(m[i], m[4 + i], m[8 + i]) for i in range(3)]
        x, y, z = (dr.dot(column, offset) for column in columns)
        return mi.Point2f(cx - fx * x / z, cy + fy * y / z)

    def radius2(self, pixel: mi.UInt32, view: mi.UInt32) -> mi.Float:
        """Squared distances of the centres of pixels from the principal point.

        They are relative to half of the image's diagonal: 1 is about that of a corner.

        Args:
            view: of each pixel.
        """
        first = dr.gather(mi.UInt32, self._first, view)
        width = dr.maximum(dr.gather(mi.UInt32, self._width, view), 1)
        height = (dr.gather(mi.UInt32, self._first, view + 1) - first) // width
        _, _, cx, cy = dr.gather(mi.ArrayXf, self.lens, view, shape=(4, dr.width(pixel)))
        column, row = self.place_of(pixel, view)
        x, y = mi.Float(column) + 0.5 - cx, mi.Float(row) + 0.5 - cy
        half = dr.square(mi.Float(width)) + dr.square(mi.Float(height))
        return 4 * (dr.square(x) + dr.square(y)) / dr.maximum(half, 1)

    def place_of(self, pixel: mi.UInt32, view: mi.UInt32) -> tuple[mi.UInt32, mi.UInt32]:
        """Columns and rows of pixels in their views.

        Args:
            view: of each pixel.
        """
        place = pixel - dr.gather(mi.UInt32, self._first, view)
        width = dr.maximum(dr.gather(mi.UInt32, self._width, view), 1)
        return place % width, place // width

    def view_of(self, pixel: mi.UInt32) -> mi.UInt32:
        """The views of pixels, from 0."""
        view = mi.UInt32(
            dr.binary_search(0, self.views, lambda i: dr.gather(mi.UInt32, self._first, i) <= pixel)
        )
        view -= 1
        return view


@dataclass
class PixelBatch:
    """Pixels by number, with their colours in the photographs; a PyTree."""

    count: int
    smoothed: bool  # whether blurred photographs are with them
    clipped: bool  # whether the radiance from which on photographs are clipped is with them
    slopes: bool  # whether slopes of the photographs are with them
    _packed: mi.UInt32  # numbers, then bits of colours: one array, so that a step copies one

    @staticmethod
    def of(
        numbers: np.ndarray,
        colours: np.ndarray,
        limits: np.ndarray | None = None,
        slopes: np.ndarray | None = None,
    ) -> PixelBatch:
        """Pixels by number.

        Args:
            numbers: shape (n,).
            colours: rows of `Photographs.table`.
            limits: radiance from which on the photograph of each is clipped, float32, shape (n,);
                None: none is.
            slopes: of the photographs across and down, linear RGB a pixel, shape (n, 6); None: not
                asked for.
        """
        known = [part for part in (colours, limits, slopes) if part is not None]
        columns = np.column_stack(known).astype(np.float32, copy=False)
        packed = np.empty((1 + columns.shape[1], len(numbers)), np.uint32)
        packed[0] = numbers
        packed[1:] = np.ascontiguousarray(columns.T).view(np.uint32)
        return PixelBatch(
            len(numbers),
            colours.shape[1] > 3,
            limits is not None,
            slopes is not None,
            from_numpy(mi.UInt32, packed),
        )

    def batch(self, rays: CameraRays, sampler: mi.Sampler, spp: int) -> RayBatch:
        """Jittered camera rays through the pixels (box filter), and their colours.

        Args:
            sampler: seeded for `spp` lanes a pixel.
        """
        number = self._row(0, dr.arange(mi.UInt32, self.count * spp) // spp)
        ray = rays.through(number, sampler.next_2d())
        pixel = dr.arange(mi.UInt32, self.count)
        columns = self._colours
        rgb = [self._float(i, pixel) for i in range(columns)]
        target = mi.Color3f(rgb[:3])
        clipped = target >= self._float(columns, pixel) if self.clipped else None
        smoothed = mi.Color3f(rgb[3:]) if self.smoothed else None
        slopes = None
        if self.slopes:
            found = [self._float(columns + self.clipped + i, pixel) for i in range(6)]
            slopes = mi.Color3f(found[:3]), mi.Color3f(found[3:])
        return RayBatch(target, smoothed, ray, clipped, slopes)

    def numbers(self) -> mi.UInt32:
        """The numbers of the pixels, one lane a pixel."""
        return self._row(0, dr.arange(mi.UInt32, self.count))

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Back to NumPy: the numbers, shape (n,), and the rows of `Photographs.table`."""
        packed = np.array(self._packed).reshape(-1, self.count)
        return packed[0], packed[1 : 1 + self._colours].view(np.float32).T

    def read_clipped(self) -> np.ndarray | None:
        """Which channels are clipped, shape (n, 3) bool, in NumPy; None where none can be."""
        if not self.clipped:
            return None
        _, colours = self.read()
        limits = np.array(self._packed).reshape(-1, self.count)[1 + self._colours]
        limits = limits.view(np.float32)
        return colours[:, :3] >= limits[:, None]

    @property
    def _colours(self) -> int:
        """Rows of colours behind that of numbers: of the photograph, and of the smoothed one."""
        return 6 if self.smoothed else 3

    def _float(self, column: int, pixel: mi.UInt32) -> mi.Float:
        return dr.reinterpret_array(mi.Float, self._row(1 + column, pixel))

    def _row(self, row: int, pixel: mi.UInt32) -> mi.UInt32:
        return dr.gather(mi.UInt32, self._packed, pixel + row * self.count)


@dataclass
class RayBatch:
    """Pixels and the camera rays of their samples."""

    target: mi.Color3f  # photographs, linear RGB, one lane a pixel
    smoothed: mi.Color3f | None  # the same from photographs blurred over 5 x 5 pixels, if kept
    ray: mi.Ray3f  # `spp` consecutive lanes a pixel, world space
    clipped: mi.Bool | None = None  # channels that say "at least that much", as a colour has them
    slopes: tuple[mi.Color3f, mi.Color3f] | None = None  # of `target`, a pixel across and down


@final
@dataclass(frozen=True, eq=False)
class _Places:
    """Places in a picture, row by row: a bit for each that there could be.

    Args:
        bits: of each row.
        ends: how many places there are up to the end of each row.
    """

    bits: np.ndarray
    ends: np.ndarray

    @staticmethod
    def of(inside: np.ndarray) -> _Places:
        """The places that are true, (rows, columns) bool."""
        return _Places(np.packbits(inside, axis=1), np.cumsum(inside.sum(axis=1)))

    def __len__(self) -> int:
        return int(self.ends[-1])

    def __getitem__(self, number: int) -> tuple[int, int]:
        """The row and the column of a place."""
        row = int(np.searchsorted(self.ends, number, "right"))
        columns = np.flatnonzero(np.unpackbits(self.bits[row]))
        return row, int(columns[number - int(self.ends[row])])  # counted from the last one


#: Places of pixels along an axis of their images, how many there are, and the step of numbers.
_Axis: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray | int]


@final
@dataclass(frozen=True, eq=False)
class PixelSource:
    """All training pixels, to draw batches from.

    They are drawn on the host, where photographs that are larger than memory can stay on disk.

    Args:
        rays: through the pixels of all views.
        photographs: of the same views.
        held: places among the pixels to train on that are never drawn, in rising order, shape
            (n,); None: all are drawn.
        limits: radiance from which on each view is clipped, float32, shape (views,); None: none is.
        exposures: of each view, by which its photograph was divided, shape (views,); None: 1.
        slopes: whether batches have the slopes of the photographs.
    """

    rays: CameraRays
    photographs: Photographs
    held: np.ndarray | None = None
    limits: np.ndarray | None = None
    exposures: np.ndarray | None = None
    slopes: bool = False

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

    def holding_aside(self, share: float, seed: int) -> PixelSource:
        """The same pixels without some random ones, which are then never drawn (ours).

        What these tell of a fit was not learned by heart. Fewer than `FEWEST_HELD` tell nothing, so
        that none are held aside then.

        Args:
            share: of the pixels to train on, [0,1); at most `MOST_HELD` are taken.
            seed: decides which.
        """
        count = min(int(share * self.photographs.count), MOST_HELD) // HELD_GROUPS * HELD_GROUPS
        if count < FEWEST_HELD:
            return self
        rng = np.random.default_rng([seed, _HELD])
        places = rng.choice(self.photographs.count, count, replace=False, shuffle=False)
        return replace(self, held=np.sort(places))

    def at_level(self, level: float) -> PixelSource:
        """The same pixels where the photographs have the level that a run has begun with."""
        return replace(self, photographs=replace(self.photographs, level=level))

    def held_aside(self) -> PixelBatch | None:
        """The pixels that are never drawn, of all views; None if there are none.

        All processes ask for them together, and each tells those that it holds.
        """
        if self.held is None:
            return None
        found, slopes = self.photographs, None
        own = found.own_numbers(self._own_held)
        numbers = found.joined(lambda: own)
        colours = found.joined(lambda: found.own_rows(own))
        if self.slopes:
            slopes = found.joined(lambda: self._slopes(own))
        return self._batch(numbers, colours, slopes)

    def weight(self, *, crops: bool) -> float:
        """What the loss of a batch of this process is multiplied by, where others draw theirs.

        The mean over processes then is that over all pixels; see `Share.weight`.

        Args:
            crops: whether batches are drawn by `draw_crop`.
        """
        share, held = self.photographs.share, np.arange(0) if self.held is None else self.held
        return 1.0 if share is None else share.weight(held, crops=crops)

    def draw(self, seed: int, count: int) -> PixelBatch:
        """Draw random pixels of all views that this process holds, each as likely as any other.

        That is ours. Neighbouring pixels tell much the same, so that scattered ones learn faster at
        equal cost than those of `draw_crop`.
        """
        found = self.photographs
        left = len(found.places) - len(self._before_held)
        if not left:  # whatever is drawn has no weight
            return self.of_numbers(np.full(count, found.pixels.start))
        places = np.random.default_rng(seed).integers(0, left, count)
        # Places are among those left: each moves on by the number of held ones before it.
        places += np.searchsorted(self._before_held, places, "right")
        return self.of_numbers(found.own_numbers(found.places.start + places))

    def draw_crop(self, seed: int, count: int) -> PixelBatch:
        """Draw a crop of one random view that this process holds, with all its pixels.

        It is a square, or a rectangle along the longer edge of the view; see `crop_edges`. Each
        view is as likely as any other, and so is each place in it. Pixels that are masked or held
        aside are replaced by others of the crop, or of all views if there are no others. Where the
        background is hidden, at least half of the crop are foreground pixels; in a view that has no
        such place, it is one of those with the most of them, and a view without any is never drawn.

        Args:
            count: pixels of the crop; see `require_crops`.

        Paper: Sec. 5.4.
        """
        rng = np.random.default_rng(seed)
        views = self._seen_views
        if not len(views):
            return self.draw(seed, count)
        view = int(views[rng.integers(len(views))])
        first, width, height = self._layout[view]
        rows, columns = _crop_in(width, height, count)
        across = width - columns + 1
        places = self._places(view, count)
        if places is None:
            top, left = divmod(int(rng.integers(across * (height - rows + 1))), across)
        else:
            top, left = places[int(rng.integers(len(places)))]
        row, column = np.divmod(np.arange(count), columns)
        numbers = first + (top + row) * width + left + column
        out = np.zeros(count, bool)
        if self.photographs.masked:
            out |= ~self.photographs.own_counts(numbers)
        if self.held is not None:
            out |= np.isin(numbers, self.photographs.own_numbers(self._own_held))
        if out.all():
            return self.draw(seed, count)
        if out.any():
            numbers[out] = rng.choice(numbers[~out], int(out.sum()))
        return self.of_numbers(numbers)

    def place(self, number: int) -> tuple[int, int, int]:
        """The view of a pixel, from 0, and its column and row in it."""
        view = max(i for i, (first, *_) in enumerate(self._layout) if first <= number)
        first, width, _ = self._layout[view]
        row, column = divmod(number - first, width)
        return view, column, row

    def require_crops(self, count: int, ranks: int = 1) -> None:
        """Raise a `UserError` if there are no crops of that many pixels in all views.

        Args:
            count: pixels of a crop.
            ranks: how many processes each draw one for a batch.
        """
        each = "" if ranks == 1 else f" of each of {ranks} processes"
        remedy = "or --pixel-sampling all-views; with --resume, as many processes as before"
        edges = crop_edges(count)
        if edges is None:
            what = f"a crop{each} cannot have {count} pixels: no edge would be half of the other"
            raise UserError(
                f"{what} or more", remedy=f"Use --batch {ranks * largest_crop(count)}, {remedy}"
            )

        def fits(pixels: int) -> bool:
            return all(
                rows <= height and columns <= width
                for _, width, height in self._layout
                for rows, columns in [_crop_in(width, height, pixels)]
            )

        if not fits(count):
            fewer = next(n for n in range(count, 0, -1) if crop_edges(n) and fits(n))
            what = f"a crop{each} of {edges[0]} x {edges[1]} pixels is larger than a photograph"
            raise UserError(what, remedy=f"Use --batch {ranks * fewer}, {remedy}")

    @cached_property
    def _own_held(self) -> np.ndarray:
        """Places that are held aside, of those that this process holds."""
        held = np.arange(0) if self.held is None else self.held
        own = self.photographs.places
        return held[slice(*np.searchsorted(held, (own.start, own.stop)))]

    @cached_property
    def _before_held(self) -> np.ndarray:
        """How many of its places that are left lie before each one that is held aside."""
        held = self._own_held - self.photographs.places.start
        return held - np.arange(len(held))

    def of_numbers(self, numbers: np.ndarray) -> PixelBatch:
        """The pixels with these numbers, which are of those that this process holds."""
        slopes = self._slopes(numbers) if self.slopes else None
        return self._batch(numbers, self.photographs.own_rows(numbers), slopes)

    def _batch(
        self, numbers: np.ndarray, colours: np.ndarray, slopes: np.ndarray | None
    ) -> PixelBatch:
        return PixelBatch.of(numbers, colours, self.limits_of(numbers), slopes)

    def _slopes(self, numbers: np.ndarray) -> np.ndarray:
        """How photographs change across and down, linear RGB a pixel, shape (n, 6).

        They are half the differences of both neighbours, which have no noise of the pixel itself,
        averaged with those of the pixels on both sides (Sobel's weights) where these are known; 0
        beside pixels that do not count and at the edges of the image.
        """
        view = self.views_of(numbers)
        first, width, height = np.array(self._layout)[view].T
        row, column = np.divmod(np.asarray(numbers, np.int64) - first, width)
        axes = (column, width, 1), (row, height, width)
        found = np.empty((len(numbers), 6), np.float32)
        for axis, (along, beside) in enumerate([axes, axes[::-1]]):
            slopes, known = zip(
                *(self._differences(numbers, along, beside, aside) for aside in (0, -1, 1)),
                strict=True,
            )
            sides = (known[1] & known[2])[:, None]
            mean = np.where(sides, (2 * slopes[0] + slopes[1] + slopes[2]) / 4, slopes[0])
            found[:, 3 * axis : 3 * axis + 3] = np.where(known[0][:, None], mean, 0)
        return found

    def _differences(
        self, numbers: np.ndarray, along: _Axis, beside: _Axis, aside: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Half the differences of neighbours, linear RGB, and whether these are there and count.

        Args:
            numbers: of pixels.
            along, beside: the axis of the neighbours, and the other one.
            aside: of the neighbours, in pixels.
        """
        (place, size, step), (other, sizes, stride) = along, beside
        inside = (0 < place) & (place < size - 1)
        inside &= (0 <= other + aside) & (other + aside < sizes)
        before, after = (numbers + np.where(inside, aside * stride + s * step, 0) for s in (-1, 1))
        if self._counted is not None:
            inside &= self._counts(before) & self._counts(after)
        pair = (self.photographs.own_rows(side)[:, :3] for side in (after, before))
        return 0.5 * np.subtract(*pair), inside

    @cached_property
    def _counted(self) -> np.ndarray | None:
        """Whether the pixels that this process holds count, eight a byte; None: all do."""
        found = self.photographs
        if found.chosen is None:
            return None
        # A byte has pixels of one part only.
        parts, start = [], found.pixels.start
        for first in range(0, len(found.pixels), _AT_ONCE):
            counted = np.zeros(min(_AT_ONCE, len(found.pixels) - first), bool)
            here = stretch(found.chosen, start + first, start + first + len(counted))
            counted[found.chosen[here] - np.uint32(start + first)] = True
            parts.append(np.packbits(counted))
        return np.concatenate(parts) if parts else np.zeros(0, np.uint8)

    def _counts(self, numbers: np.ndarray) -> np.ndarray:
        """Whether pixels that this process holds count, where not all do, (n,) bool."""
        assert self._counted is not None
        place = numbers - self.photographs.pixels.start
        return (self._counted[place >> 3] >> (7 - (place & 7)).astype(np.uint8) & 1).astype(bool)

    def limits_of(self, numbers: np.ndarray) -> np.ndarray | None:
        """Radiance from which on pixels are clipped, (n,); None where none is."""
        return None if self.limits is None else self.limits[self.views_of(numbers)]

    def views_of(self, numbers: np.ndarray) -> np.ndarray:
        """The views of pixels, from 0."""
        first = [first for first, *_ in self._layout]
        return np.searchsorted(first, numbers, "right") - 1

    @cached_property
    def _layout(self) -> list[tuple[int, int, int]]:
        """The number of the first pixel, the width and the height of each view."""
        first, width = np.array(self.rays._first, int), np.array(self.rays._width, int)
        sizes = np.diff(first) // width
        return list(zip(first[:-1].tolist(), width.tolist(), sizes.tolist(), strict=True))

    @cached_property
    def _seen_views(self) -> np.ndarray:
        """The views with pixels to train on, of those that this process holds."""
        found = self.photographs
        if found.chosen is None:
            first, last = self.views_of(np.array([found.pixels.start, found.pixels.stop - 1]))
            return np.arange(first, last + 1)
        ends = np.array(self.rays._first).astype(found.chosen.dtype)
        return np.flatnonzero(np.diff(np.searchsorted(found.chosen, ends)))

    @cached_property
    def _found(self) -> dict[tuple[int, int], _Places]:
        return {}

    def _places(self, view: int, pixels: int) -> _Places | None:
        """Where a crop of a view may lie; None: anywhere."""
        chosen = self.photographs.chosen
        if chosen is None:
            return None
        if (view, pixels) not in self._found:
            first, width, height = self._layout[view]
            rows, columns = _crop_in(width, height, pixels)
            own = chosen[stretch(chosen, first, first + width * height)]
            mask = np.zeros((height + 1, width + 1), np.int64)
            inner = np.zeros(height * width, np.int64)
            inner[own.astype(int) - first] = 1
            mask[1:, 1:] = inner.reshape(height, width)
            sums = mask.cumsum(0).cumsum(1)
            count = sums[rows:, columns:] - sums[:-rows, columns:] - sums[rows:, :-columns]
            count += sums[:-rows, :-columns]
            least = min((pixels + 1) // 2, count.max())
            self._found[view, pixels] = _Places.of(count >= least)
        return self._found[view, pixels]


def crop_edges(count: int) -> tuple[int, int] | None:
    """The shorter and the longer edge of a crop of so many pixels, as near to each other as can be.

    None where the longer one would be more than twice the shorter one.
    """
    short = next(edge for edge in range(math.isqrt(count), 0, -1) if count % edge == 0)
    return (short, count // short) if count <= 2 * short**2 else None


def largest_crop(count: int) -> int:
    """The most pixels that a crop can have, of so many."""
    return next(pixels for pixels in range(count, 0, -1) if crop_edges(pixels))


def _crop_in(width: int, height: int, count: int) -> tuple[int, int]:
    """Rows and columns of a crop of a view of that size."""
    edges = crop_edges(count)
    if edges is None:
        raise ValueError(f"there are no crops of {count} pixels")
    short, long = edges
    return (short, long) if width >= height else (long, short)
