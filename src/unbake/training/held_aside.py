"""The error on pixels that no step draws, and what it says of a fit: is it still improving?"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.pixels import HELD_GROUPS, MOST_HELD, CameraRays, PixelBatch
from ..dataset.views import Dataset, View, read_photograph
from ..fields.arrays import from_numpy
from ..fields.camera import CameraModel
from .cameras import Cameras
from .checkpoint import Progress
from .poses import PoseModel, refined_view
from .state import State
from .step import TrainingStep
from .verdicts import WORDS, Trend, in_units_of_noise

#: The error is measured after each quarter of a fit. In between it is after each of so many parts,
#: as long as all of it takes less than this share of the training time.
PARTS, QUARTER = 16, 4
_SHARE = 0.005
#: The last part of a fit, over which a change of the error is told.
LAST = 0.25
#: The least relative change of the error that is told as one, and how many standard errors it is.
_LEAST, _SURE = 0.005, 2.0
#: The same of a rise, and the share of the groups that must rise: errors have heavy tails, so that
#: a few pixels may raise the mean of a fit that improves.
_SURE_OF_RISE, _RISING = 3.0, 0.75
#: A fit of fewer steps has learned next to nothing, and its error is where it was for this reason.
_FEWEST_STEPS = 50
#: And what it has learned first may raise it: no fit of fewer steps knows photographs by heart.
_FEWEST_TO_RISE = 500
#: A plateau is told only where a relative change of this size would have been seen, and none was.
_SEEN = 0.05
#: Keys of a line of the log: the error, and those of groups of the pixels.
ERROR, GROUPS = "held_aside", "held_aside_groups"


class _Probe:
    """Renders the same pixels with the same samples each time, as the steps of a fit see them.

    Args:
        step: of the fit.
        rays: through all views, so that all probes of a fit share one kernel.
        numbers: of the pixels, shape (n,).
        colours: of the pixels in the photographs, linear RGB, shape (n, 3 or more).
        config: of the fit.
    """

    def __init__(
        self,
        step: TrainingStep,
        rays: CameraRays,
        numbers: np.ndarray,
        colours: np.ndarray,
        config: FitConfig,
    ) -> None:
        self._step, self.rays = step, rays
        self.target = colours[:, :3].astype(np.float64)
        # Passes have as many pixels as a step: they take no more memory, and are compiled once.
        passes, size = math.ceil(len(numbers) / config.pixels), config.pixels
        filled = np.resize(np.arange(len(numbers)), passes * size).reshape(passes, size)
        self._passes = [PixelBatch.of(numbers[part], colours[part, :3]) for part in filled]
        seeds = np.random.SeedSequence([config.seed, len(numbers)])
        self._seeds = [int(seed) for seed in seeds.generate_state(passes)]

    def halves(self, state: State) -> np.ndarray:
        """Two independent estimates of each pixel, linear RGB, shape (n, 2, 3)."""
        found = [
            self._step.probe(state, self.rays, pixels, seed)
            for pixels, seed in zip(self._passes, self._seeds, strict=True)
        ]
        return np.concatenate(found)[: len(self.target)].astype(np.float64)


def _squared_errors(
    halves: np.ndarray, target: np.ndarray, clipped: np.ndarray | None = None
) -> np.ndarray:
    """Squared errors without the noise of the rendering, shape (n, 3); single ones may be < 0.

    Args:
        halves: two independent estimates of each pixel, shape (n, 2, 3).
        target: the photograph, shape (n, 3).
        clipped: channels of which only a shortfall counts, shape (n, 3); None: no channel.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        first, second = (half - target for half in np.moveaxis(halves, 1, 0))
        if clipped is not None:
            first, second = (np.where(clipped & (x > 0), 0, x) for x in (first, second))
        return first * second


@final
class HeldAside:
    """Measures the error on the pixels that are held aside.

    It is the photometric one, without the noise of the rendering: what is left in the end is the
    noise of the photographs and what the fields cannot explain. With the same samples each time,
    two errors differ by what was learned.

    Args:
        step: of the fit.
        rays: through the training views and maybe others after them.
        held: the pixels that are held aside.
        config: of the fit.
        camera: what is fitted of the cameras.
        exposures: of the training views, as the data set tells; None: 1.
    """

    def __init__(
        self,
        step: TrainingStep,
        rays: CameraRays,
        held: PixelBatch,
        config: FitConfig,
        *,
        camera: CameraModel | None = None,
        exposures: np.ndarray | None = None,
    ) -> None:
        numbers, colours = held.read()
        self._probe = _Probe(step, rays, numbers, colours, config)
        self._clipped, self._epsilon = held.read_clipped(), step.epsilon
        smoothed = config.loss_reference == "smoothed"
        self._reference = colours[:, 3:].astype(np.float64) if smoothed else self._probe.target
        self._camera = camera
        if camera is not None:
            pixel = from_numpy(mi.UInt32, numbers)
            view = rays.view_of(pixel)
            self._views, self._radius2 = np.array(view), np.array(rays.radius2(pixel, view))
            told = np.ones(camera.views) if exposures is None else exposures
            self._told = told[self._views, None].astype(np.float64)

    def measure(self, state: State) -> dict[str, Any]:
        """The error now, as numbers of a line of the log: its mean, and those of 16 groups.

        Pixels without a finite estimate are left out, as steps skip them. Where a group has no
        other, nothing is told.
        """
        halves, camera = self._probe.halves(state), self._camera
        target, reference, gain = self._probe.target, self._reference, 1.0
        if camera is not None:
            camera.assign(dict(state.phi.items()))
            gain = camera.gains()[self._views] * camera.falloff(self._radius2)[:, None]
            halves = halves * gain[:, None]
            target, reference = (
                camera.light(light * self._told) / self._told for light in (target, reference)
            )
        weight = 1 / (reference**2 + self._epsilon * np.square(gain))
        errors = (_squared_errors(halves, target, self._clipped) * weight).mean(-1)
        # Pixels are in the order of views: every 16th is in a group, so that each has all views.
        errors = errors.reshape(-1, HELD_GROUPS)
        known = np.isfinite(errors)
        if not known.any(0).all():
            return {}
        groups = errors.mean(0, where=known)
        mean = float(errors.mean(where=known))
        return {ERROR: mean, GROUPS: [round(float(e), 7) for e in groups]}


@final
class ErrorCurve:
    """When a fit measures the error on held-aside pixels, and what came out so far.

    Args:
        aside: measures it; None: nothing is measured.
        config: of the fit.
        before: the log of the steps before, of a resumed fit.
        progress: of the fit, with at least one step to come.
    """

    def __init__(
        self,
        aside: HeldAside | None,
        config: FitConfig,
        before: Sequence[dict[str, Any]],
        progress: Progress,
    ) -> None:
        self._aside = aside
        self._by = "seconds" if config.seconds else "step"
        self._materials = config.learns_materials
        self._total = config.seconds or config.steps or 1
        self._lines: list[Mapping[str, Any]] = list(before)
        self._next = self._after(progress)
        self._cost = self._spent = 0.0

    def due(self, progress: Progress) -> bool:
        """Whether it is time to measure."""
        if self._aside is None or self._after(progress) <= self._next:
            return False
        if self._next % QUARTER == 0 or self._spent + self._cost <= _SHARE * progress.seconds:
            return True
        self._next += 1
        return False

    def measure(self, state: State, entry: dict[str, Any], progress: Progress) -> None:
        """Measure, and add the numbers to a line of the log."""
        if self._aside is None:
            return
        start = time.perf_counter()
        entry |= self._aside.measure(state)
        self._cost = time.perf_counter() - start
        self._spent += self._cost
        self._lines.append(entry)
        self._next = self._after(progress)

    def told(self) -> list[str]:
        """What it says of a fit that has ended, if it says anything; lines for a terminal."""
        found = convergence(self._lines, self._by)
        return [] if found is None else found.told(materials=self._materials).splitlines()

    def _after(self, progress: Progress) -> int:
        """The number of the part that begins now, from 1."""
        return math.floor(PARTS * getattr(progress, self._by) / self._total) + 1


@final
class HeldOutPhotographs:
    """Measures how well photographs of held-out views are explained, where no truth is known.

    Args:
        step: of the fit.
        rays: through the training views, and the held-out views after them.
        dataset: of the fit, with held-out views.
        config: of the fit.
        clip_negative: take negative pixels of the photographs as zero.
        camera: what is fitted of the cameras.
        poses: what is fitted of where they stood; held-out views have refined intrinsics.

    Raises:
        UserError: a photograph cannot be read.
    """

    def __init__(
        self,
        step: TrainingStep,
        rays: CameraRays,
        dataset: Dataset,
        config: FitConfig,
        *,
        clip_negative: bool,
        camera: CameraModel | None = None,
        poses: PoseModel | None = None,
    ) -> None:
        self._camera, self._cameras = camera, Cameras(camera, dataset.train)
        self._poses, self._train = poses, dataset.train
        self._views: list[tuple[View, np.ndarray]] = []  # with the numbers of pixels in it
        start = sum(view.camera.width * view.camera.height for view in dataset.train)
        each = max(MOST_HELD // len(dataset.heldout), 1)
        rng, numbers, colours = np.random.default_rng(config.seed), [], []
        for view in dataset.heldout:
            pixels = read_photograph(view, clip_negative).reshape(-1, 4)
            seen = np.flatnonzero(pixels[:, 3] >= 1)
            chosen = seen[rng.permutation(len(seen))[:each]]
            numbers.append(start + chosen)
            colours.append(pixels[chosen, :3])
            self._views.append((view, chosen))
            start += len(pixels)
        found = np.concatenate(numbers).astype(np.uint32)
        pixels = np.concatenate(colours)
        self._probe = _Probe(step, rays, found, pixels, config) if len(found) else None

    def measure(self, state: State) -> dict[str, Any] | None:
        """The PSNR of their pictures in dB, clipped to [0,1]; None where no pixel is in the scene.

        Pixels without a finite estimate are left out, as steps skip them.
        Pictures are as photographs show them, times their exposure and clipped where these are.
        Pictures are as a step sees them, with L_θ after the first bounces, without their noise.
        """
        if self._probe is None:
            return None
        views = [view for view, _ in self._views]
        if self._poses is not None:
            self._poses.assign(dict(state.phi.items()))
            views = [refined_view(self._poses, self._train, view) for view in views]
            # Steps correct the cameras of training views themselves
            self._probe.rays = CameraRays.of([v.camera for v in (*self._train, *views)])
        halves, target = self._probe.halves(state), self._probe.target
        if self._camera is not None:
            self._camera.assign(dict(state.phi.items()))
        errors, start = [], 0
        for view, (_, numbers) in zip(views, self._views, strict=True):
            part = slice(start, start + len(numbers))
            start = part.stop
            shown = self._shown(view, numbers, halves[part], target[part]).clip(max=1)
            compared = view.readable(target[part]).clip(max=1)
            errors.append(_squared_errors(shown, compared))
        found = np.concatenate(errors)
        known = np.isfinite(found)
        error = float(found.mean(where=known)) if known.any() else 0.0
        if not 0 < error < math.inf:
            return None
        return {"split": "heldout", "render_psnr": -10 * math.log10(error)}

    def _shown(
        self, view: View, numbers: np.ndarray, halves: np.ndarray, photograph: np.ndarray
    ) -> np.ndarray:
        """Estimates of pixels as the photograph would show them, shape (n, 2, 3)."""
        cameras, dimmed = self._cameras, self._cameras.dimmed(view, halves, numbers)
        gain = cameras.gain(view, dimmed.mean(1), photograph)
        return cameras.photographed(view, dimmed, gain)


@final
@dataclass(frozen=True)
class Convergence:
    """What the error on held-aside pixels says of a fit that has ended."""

    trend: Trend
    error: float  #: at the end
    before: float  #: when the last quarter began
    change: (
        float  #: relative, or in standard errors where `before` is not above 0; below 0: it fell
    )
    noise: float  #: standard error of the change, in the same unit
    share: float  #: of the fit, over which the change is told

    def told(self, *, materials: bool = True) -> str:
        """Two lines for a terminal: what happened, and what can be done.

        Args:
            materials: whether any are unknown.
        """
        may_gain = "; materials may still gain" if materials else ""
        verb = "rose" if self.change > 0 else "fell"
        part = "the last quarter" if abs(self.share - LAST) < 0.05 else f"the last {self.share:.0%}"
        sizes = f"{verb} {100 * abs(self.change):.1f} ± {100 * self.noise:.1f} %"
        sizes = in_units_of_noise(self.change, self.noise) or sizes
        advice = {
            "improving": "a longer fit may be better: --quality high",
            "plateau": f"a longer fit explains photographs no better{may_gain}",
            "rising": "more views would help, or a shorter fit",
            "unclear": "held-out views of a longer fit would show whether it is better",
        }[self.trend]
        return f"held-aside pixels: {WORDS[self.trend]}; error {sizes} in {part}\n  {advice}"


def convergence(log: Sequence[Mapping[str, Any]], by: str = "step") -> Convergence | None:
    """What the errors in a log say of the fit; None where they, or its steps, are too few.

    Args:
        log: lines of the log.
        by: what the length of the fit is counted in, `step` or `seconds`.
    """
    lines = [line for line in log if _measured(line, by)]
    if len(lines) < 2:
        return None
    end = lines[-1]
    last = end[by]
    # Of the lines at least a quarter before the end the last one; marks are a step or so late.
    earlier = [line for line in lines if line[by] <= (1 - LAST + 1 / (4 * PARTS)) * last]
    if not earlier or last <= 0:
        return None
    start = earlier[-1]
    before, error = start[ERROR], end[ERROR]
    rises = np.subtract(end[GROUPS], start[GROUPS])
    sigma = float(rises.std(ddof=1) / math.sqrt(len(rises)))
    # Errors have no bias: that of a good fit may be below 0, and changes are told by their noise.
    unit = before if before > 0 else sigma
    if not unit > 0:
        return None
    change, noise = (error - before) / unit, sigma / unit
    still = max(change, _SURE * noise) <= _SEEN and end.get("step", _FEWEST_STEPS) >= _FEWEST_STEPS
    trend: Trend = "plateau" if still else "unclear"
    if -change > max(_LEAST, _SURE * noise):
        trend = "improving"
    elif change > max(_LEAST, _SURE_OF_RISE * noise) and (rises > 0).mean() >= _RISING:
        if end.get("step", _FEWEST_TO_RISE) < _FEWEST_TO_RISE:
            return None
        trend = "rising"
    return Convergence(trend, error, before, change, noise, 1 - start[by] / last)


def _measured(line: Mapping[str, Any], by: str) -> bool:
    numbers = [line.get(by), line.get(ERROR)]
    groups = line.get(GROUPS)
    if not isinstance(groups, list) or len(groups) != HELD_GROUPS:
        return False
    return all(isinstance(x, int | float) and math.isfinite(x) for x in (*numbers, *groups))
