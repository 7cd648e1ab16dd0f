"""Random pixels of the photographs, sampled for searches of roughness (ours)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..dataset.pixels import PixelBatch
from ..fields.materials import carrying
from ..transport.by_roughness import PLACE, by_roughness, meet_one_piece, places, stratified
from .batch_loss import Inputs
from .problem import Problem
from .state import State
from .step import TrainingStep

#: Camera samples that look whether a pixel shows one piece of surface.
_LOOKS = 4
#: How often pixels are drawn, at most, for those that do.
_DRAWS = 16


@final
class SearchSamples:
    """Samples of what photographs show, with materials and cameras as they are by now.

    Args:
        problem: what is learned.
        step: of the same fit. It has the pixels to draw from, which may be those of some views
            where there are several ranks, and says what they are compared with.
    """

    def __init__(self, problem: Problem, step: TrainingStep) -> None:
        self._problem, self._loss, self._pixels = problem, step.batch_loss, step.pixels
        self._weight = step.pixels.weight(crops=False)  # of this rank's pixels among all

    @carrying()
    def by_roughness(
        self, state: State, seeds: Sequence[int], count: int, spp: int, nodes: Sequence[float]
    ) -> np.ndarray:
        """Some random pixels as functions of the roughness of what they see.

        Args:
            seeds: the first decides pixels, the second their samples.
            count: of pixels.
            spp: camera samples of each.
            nodes: values of roughness.

        Returns:
            Those of the pixels that can be told so, and whose numbers are finite, as rows of
            `by_roughness.row_type`.
        """
        problem, sampler = self._problem, stratified(spp)
        assert problem.radiance is not None
        of_pixels, of_samples = map(int, seeds)
        with dr.suspend_grad():
            state.publish(problem)
            inputs = self._loss.inputs(0, 1)  # one pixel, which is not used
            pixels = self._of_one_piece(inputs, of_pixels, count)
            inputs = replace(inputs, pixels=pixels)
            sampler.seed(dr.opaque(mi.UInt32, of_samples), count * spp)
            placed = self._loss.placed(inputs)
            batch = pixels.batch(placed, sampler, spp)
            target, loss, _ = self._loss.compared(inputs, batch, placed)
            weight = loss.weight(target) * (1 if loss.trust is None else loss.trust)
            if batch.clipped is not None:
                weight = dr.select(batch.clipped, 0, weight)
            chosen, rows = by_roughness(
                problem.scene_view,
                problem.radiance,
                problem.guide,
                batch.ray,
                sampler,
                spp,
                nodes,
                hide_emitters=problem.hide_emitters,
            )
            rows["target"] = np.array(target).T[chosen]
            rows["weight"] = self._weight * np.array(weight).T[chosen]
            rows["gain"] = 1 if loss.gain is None else np.array(loss.gain).T[chosen]
        numbers = rows.view(np.float32).reshape(len(rows), rows.dtype.itemsize // 4)
        return rows[np.isfinite(numbers).all(1)]

    @carrying()
    def places(self, state: State, seeds: Sequence[int], count: int) -> np.ndarray:
        """What some random pixels show, those that `by_roughness` cannot tell included.

        Args:
            seeds: as of `by_roughness`.
            count: of pixels, where processes have equally many each.

        Returns:
            Those that show a material, as an array of `by_roughness.PLACE`.
        """
        problem, sampler = self._problem, stratified(1)
        count = round(self._weight * count)
        if not count:  # this process has no pixels
            return np.zeros(0, PLACE)
        of_pixels, of_samples = map(int, seeds)
        with dr.suspend_grad():
            state.publish(problem)
            pixels = self._pixels.draw(of_pixels, count)
            sampler.seed(dr.opaque(mi.UInt32, of_samples), count)
            placed = self._loss.placed(self._loss.inputs(0, 1))
            ray = pixels.batch(placed, sampler, 1).ray
            return places(problem.scene_view, ray, sampler, hide_emitters=problem.hide_emitters)

    def _of_one_piece(self, inputs: Inputs, seed: int, count: int) -> PixelBatch:
        """Some random pixels that `by_roughness` can tell, as far as a few samples show.

        Where there are few of them in many draws, the others are any pixels.
        """
        problem, sampler, placed = self._problem, stratified(_LOOKS), self._loss.placed(inputs)
        seeds = np.random.SeedSequence(seed).generate_state(2 * _DRAWS).tolist()
        found, last, left = [], np.zeros(0, np.int64), count
        for of_pixels, of_samples in zip(seeds[::2], seeds[1::2], strict=True):
            pixels = self._pixels.draw(of_pixels, count)
            sampler.seed(dr.opaque(mi.UInt32, of_samples), count * _LOOKS)
            ray = pixels.batch(placed, sampler, _LOOKS).ray
            good = meet_one_piece(
                problem.scene_view, ray, sampler, _LOOKS, hide_emitters=problem.hide_emitters
            )
            last = pixels.read()[0].astype(np.int64)
            found.append(last[good][:left])
            left -= len(found[-1])
            if not left:
                break
        return self._pixels.of_numbers(np.concatenate([*found, last[:left]]))
