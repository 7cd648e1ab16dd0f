"""The photographs of a fit, decoded once: in memory, or where they are many, in a mapped file.

With several processes each holds some views (`shares.py`). Those are decoded by each for itself
where they go to memory. The file has all views, and each looks at the part with its own ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from typing import Any, final

import numpy as np

from ..errors import UserError
from ..memory import require_memory
from ..progress import silent
from ..ranks import Ranks
from .camera import Camera
from .decoded_file import Unwritable, expect_random, in_file
from .decoding import COLUMNS, WITH_BLURRED, Decoded, Plan, Totals, fill_rows, joined
from .hot_pixels import HotPixels
from .image_files import PIXEL_BYTES
from .noise_at_black import found_noise
from .shares import Share
from .spread import places
from .views import Dataset, SensorNoise, leaves_out

#: Photographs of a process that take more than this, in bytes, are not held in memory but in a file
#: of the data set's folder, of which the system keeps in memory what it has room for.
IN_MEMORY = 512 << 20
#: Pixels are numbered in 32 bits.
MOST_PIXELS = (1 << 32) - 1
#: Of the median, what a pixel adds to the level of photographs at most: lamps have far more.
LAMP = 10.0
#: Pixels, at most, that tell the level.
_LEVEL_PIXELS = 1 << 16


@final
@dataclass(frozen=True, eq=False)
class Photographs:
    """Linear RGB of the pixels of several views, row by row and view after view.

    With several processes, each may hold some of the views. Pixels are numbered over all views, and
    so are the places of those to train on among them.

    Args:
        table: float32, shape (pixels, 3): radiance, which is the image divided by its exposure; or
            (pixels, 6): radiance, and the radiance that errors are relative to, which is blurred
            over 5 x 5 pixels and knows the noise. Of the views that this process holds.
        chosen: numbers of the pixels to train on, of the same views; None: all. Where the
            background is hidden, background pixels say nothing about the scene and only those with
            alpha > 0 are taken (the paper: at least half of them). Pixels that are masked are never
            taken.
        mean: mean radiance of the pixels to train on, of all views.
        hot_pixels: pixels that were too bright and are not as in the images, by view, of all views.
        noise: that was clipped at black, found and corrected where nobody tells it; None: none was.
        share: what this process holds; None: all.
        masked: whether pixels are masked, and not only background.
        level: mean radiance of the same pixels where no pixel has more than `LAMP` times the
            median of lit ones. A lamp in view, a few pixels, may be most of the mean. That is the
            level of lamps then, and not of what they light.

    Paper: Sec. 5.4.
    """

    table: np.ndarray
    chosen: np.ndarray | None
    mean: float
    hot_pixels: tuple[HotPixels, ...] = ()
    noise: SensorNoise | None = None
    share: Share | None = None
    masked: bool = False
    level: float = 0.0

    @property
    def count(self) -> int:
        """Number of pixels to train on, of all views."""
        if self.share is not None:
            return int(self.share.first_places[-1])
        return len(self.table if self.chosen is None else self.chosen)

    @property
    def pixels(self) -> range:
        """Numbers of the pixels that this process holds."""
        if self.share is None:
            return range(len(self.table))
        return self.share.own(self.share.first_pixels)

    @property
    def places(self) -> range:
        """Places of the pixels that this process holds among those to train on."""
        return range(self.count) if self.share is None else self.share.own(self.share.first_places)

    @property
    def smoothed(self) -> bool:
        """Whether there is a blurred copy."""
        return self.table.shape[1] == WITH_BLURRED

    def own_numbers(self, places: np.ndarray) -> np.ndarray:
        """Numbers of pixels by their places among those to train on, of those that it holds."""
        return places if self.chosen is None else self.chosen[places - self.places.start]

    def own_rows(self, numbers: np.ndarray) -> np.ndarray:
        """Rows of the table of pixels that this process holds, shape (n, columns)."""
        return self.table[numbers - self.pixels.start]

    def numbers(self, places: np.ndarray) -> np.ndarray:
        """Numbers of pixels of any view, by their places; all processes ask for the same."""
        if self.share is None:
            return self.own_numbers(places)
        return self.share.looked_up(places, self.share.first_places, self.own_numbers)

    def own_counts(self, numbers: np.ndarray) -> np.ndarray:
        """Whether pixels that this process holds are among those to train on, (n,) bool."""
        if self.chosen is None or not len(self.chosen):
            return np.full(len(numbers), self.chosen is None)
        # Numbers of another type would be compared with a copy of all that are chosen.
        numbers = numbers.astype(self.chosen.dtype)
        places = np.searchsorted(self.chosen, numbers)
        return self.chosen[np.minimum(places, len(self.chosen) - 1)] == numbers

    def counts(self, numbers: np.ndarray) -> np.ndarray:
        """The same of pixels of any view; all processes ask for the same."""
        if self.share is None or self.chosen is None:
            return self.own_counts(numbers)
        return self.share.looked_up(numbers, self.share.first_pixels, self.own_counts)

    def radiance(self, numbers: np.ndarray) -> np.ndarray:
        """Linear RGB of pixels of any view, shape (n, 3); all processes ask for the same."""
        start = self.pixels.start

        def look(own: np.ndarray) -> np.ndarray:
            return self.table[own - start, :3]

        if self.share is None:
            return look(numbers)
        return self.share.looked_up(numbers, self.share.first_pixels, look)

    def joined(self, work: Callable[[], np.ndarray]) -> np.ndarray:
        """What each process tells of the pixels that it holds, in their order; see `Ranks`."""
        return work() if self.share is None else self.share.ranks.joined(work)

    def expect_random(self) -> None:
        """Tell the system, of pixels in a file, that they will be drawn at random from now on."""
        for array in (self.table, self.chosen):
            if array is not None:
                expect_random(array)

    @property
    def bytes(self) -> int:
        """Memory that the pixels take, unless they lie in a file."""
        held = [a for a in (self.table, self.chosen) if a is not None]
        return sum(a.nbytes for a in held if not isinstance(a, np.memmap))

    @staticmethod
    def of(
        cameras: Sequence[Camera],
        rgb: np.ndarray,
        alpha: np.ndarray,
        *,
        foreground_only: bool,
        smoothed: bool = True,
    ) -> Photographs:
        """Photographs that are in memory already.

        Args:
            cameras: one a view.
            rgb: linear RGB of all views' pixels, row by row, view after view, shape (pixels, 3).
            alpha: coverage of the same pixels, shape (pixels,).
            foreground_only: train only on pixels with alpha > 0.
            smoothed: keep a blurred copy, too.
        """
        table = np.empty((len(rgb), WITH_BLURRED if smoothed else COLUMNS), np.float32)
        bounds = np.cumsum([0, *(camera.width * camera.height for camera in cameras)])
        made = []
        for camera, start, stop in zip(cameras, bounds, bounds[1:], strict=False):
            counted = (alpha[start:stop] > 0) | (not foreground_only)
            image = camera, rgb[start:stop], counted, None
            made.append(fill_rows(table[start:stop], image, foreground_only, int(start)))
        return _with_level(_made(Decoded(table, *joined(made, foreground_only))))

    @staticmethod
    def load(
        dataset: Dataset,
        clip_negative: bool,
        *,
        smoothed: bool = True,
        ranks: Ranks | None = None,
        tell: Callable[[str], None] = silent,
    ) -> Photographs:
        """The training views of a data set.

        Every image is read once, also over many fits; but for some that are looked at for noise.

        Args:
            clip_negative: take negative pixels as zero.
            smoothed: keep a blurred copy, too, which doubles the memory.
            ranks: processes that deal the views among them and all call this, no more than there
                are views; None: this one holds all.
            tell: called with lines of progress where decoding takes long.

        Raises:
            UserError: an image is bad, or there are too many for memory and the data set's folder
                cannot be written to.
        """
        ranks = ranks or Ranks()
        first = ranks.rank == 0
        noise = ranks.together(
            lambda: found_noise(dataset, clip_negative) if first else None, math.inf
        )
        # All read photographs alike: by what the first one found.
        known = ranks.gather(None if noise is None else asdict(noise))[0]
        if known is not None:
            noise = SensorNoise(**known)
            views = [replace(v, noise=v.noise or noise) for v in dataset.views]
            dataset = replace(dataset, views=tuple(views))
        plan = Plan.of(dataset, clip_negative, WITH_BLURRED if smoothed else COLUMNS, ranks.size)
        found = ranks.together(lambda: _loaded(plan, ranks.rank, ranks.here, tell), math.inf)
        masked = any(leaves_out(view) for view in dataset.train)
        if ranks.size == 1:
            return _with_level(replace(_made(found, noise), masked=masked))
        every = [Totals(**own) for own in ranks.gather(asdict(found.totals))]
        counts = np.concatenate([totals.counts for totals in every])
        share = Share(ranks, plan.first_views, np.array(plan.sizes), counts)
        return _with_level(replace(_made(found, noise, every, share), masked=masked))


def _loaded(plan: Plan, rank: int, here: int, tell: Callable[[str], None]) -> Decoded:
    """The views of a process.

    Args:
        rank: its number.
        here: processes on this machine.
        tell: called with lines of progress.
    """
    views, folder = plan.dataset.train, plan.dataset.folder
    remedy, count = "Use fewer views, or smaller images", sum(plan.sizes)
    if count > MOST_PIXELS:
        what = f"the training views have {count:,} pixels, more than {MOST_PIXELS:,}"
        raise UserError(what, folder, remedy)
    first = np.cumsum([0, *plan.sizes])[plan.first_views]
    most = int(np.diff(first).max())
    bounds = (plan.first_views, first)
    own, pixels = (slice(*each[rank : rank + 2].tolist()) for each in bounds)
    table_bytes = 4 * plan.columns * most
    unwritable = None

    def require(held: int) -> None:
        """Memory for what stays, and for the largest view beside it."""
        need = here * (PIXEL_BYTES * max(plan.sizes) + held)
        require_memory(need, "the photographs need", remedy, folder)

    def decode(*args: Any, **more: Any) -> tuple[np.ndarray | None, Totals]:
        require(0)  # which nobody needs who finds the file
        return plan.decode_into(*args, **more, tell=tell)

    if table_bytes > IN_MEMORY:
        try:
            decoded = in_file(plan, decode, tell)
            return decoded.part(own, pixels, {view.name for view in views[own]})
        except Unwritable as error:
            unwritable = error.why
    # Numbers of pixels to train on are joined from those of the views.
    held = table_bytes + 8 * most * plan.chooses
    try:
        # What was to lie in a file leaves as much to the fit as it takes.
        require(held if unwritable is None else 2 * held)
    except UserError as error:
        raise unwritable or error from None
    table = np.empty((pixels.stop - pixels.start, plan.columns), np.float32)
    found = plan.decode_into(table, views[own], pixels.start, processes=here, held=held, tell=tell)
    return Decoded(table, *found)


def _made(
    decoded: Decoded,
    noise: SensorNoise | None = None,
    every: Sequence[Totals] | None = None,
    share: Share | None = None,
) -> Photographs:
    """Decoded photographs: all of them, or a share.

    Args:
        noise: that was found.
        every: totals of the views of each process; None: this one holds all.
        share: what it holds.
    """
    every = every or [decoded.totals]
    # One after the other, so that the mean is the same however views are dealt
    total = reduce(add, (value for totals in every for value in totals.sums), 0.0)
    count = sum(sum(totals.counts) for totals in every)
    hot_pixels = tuple(HotPixels(**found) for totals in every for found in totals.hot_pixels)
    mean = total / max(3 * count, 1)
    return Photographs(decoded.table, decoded.chosen, mean, hot_pixels, noise, share)


def _with_level(photographs: Photographs) -> Photographs:
    """The same with their level; all processes that hold some call this together."""
    level, chosen = photographs.mean, places(photographs.count, _LEVEL_PIXELS)
    values = photographs.radiance(photographs.numbers(chosen)).mean(axis=1, dtype=np.float64)
    lit = values[values > 0]
    if len(lit) and lit.max() > (most := LAMP * np.median(lit)):
        level = float(np.minimum(values, most).mean())
    return replace(photographs, level=level if level > 0 else photographs.mean)
