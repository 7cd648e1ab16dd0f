"""Roughness by search: variable projection eliminates albedo, which steps would wait for (ours).

A little more roughness and a little less albedo explain photographs almost equally well. Where
roughness is wrong, albedo has adapted to it: the gradient that is left is small beside a step's
noise, and gradient steps move the two only slowly, together.

Reflected light is linear in albedo. So the best albedo for a given roughness is known without steps
(variable projection, Golub and Pereyra 1973). A few times in a fit, many samples of some pixels are
taken as functions of roughness (`transport/by_roughness.py`). Albedo has a factor in each group of
pixels that are near, of one piece of surface and of one colour; the best factor is found for each
roughness. What is left is the photometric loss of each pixel as a curve over roughness. The field
of roughness then descends on these curves. No light is transported meanwhile, and the curves have
far less noise than a step.

What the field shares between points descends, its numbers of pieces and of colours: noise of the
photographs is the same for all samples, and a network would learn it. Of most numbers photographs
tell little, too. So the most probable ones are sought: squared errors are in units of their
variance, which the pixels themselves tell, by how bright they are, and numbers of one piece, or of
like colours, are expected to differ as little as the settings say. Each piece then varies as much
as is to be expected of it (`piece_variation.py`), and moves to the roughness that is
(`piece_levels.py`). The first search is of an L_θ and an albedo that are not there yet: from the
second one on, the mean of what they find is kept, and albedo varies as is to be expected, too.

After the first search steps leave roughness alone, and before it they move it slowly: what noise
does to it differs within a piece, and a search starts from there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig, RoughnessSearchConfig
from ..errors import UserError
from ..fields.arrays import from_numpy, shaped_like
from ..fields.field import Field, holding
from ..memory import lacks_memory
from ..ranks import Ranks
from ..transport.by_roughness import PLACE, row_type
from .checkpoint import Progress
from .gradients import flat_gradients, set_gradients
from .piece_levels import with_expected_levels
from .piece_places import expected_places
from .piece_variation import expected_albedo, with_all_variation, with_expected_variation
from .problem import Problem
from .roughness_curves import NODES, Curves, in_range, points, precision, roughness_of
from .search_samples import SearchSamples
from .seen_pieces import SeenPieces, differ_by_place
from .state import State
from .step import TrainingStep, without_garbage_collection

#: Camera samples that are traced at once.
_AT_ONCE = 1 << 18
#: Fewer pixels tell nothing: a fit of some dozen steps does not search.
_FEWEST = 1 << 12
#: Samples of a pixel, where there are more of them than photographs have pixels for, are so many
#: times as many, at most.
_MOST_REPEATS = 4
#: Tells the random numbers of searches from those of steps, which start at the same seed.
_SEED = 0x524F5547
#: The rate that is left at the end of a descent.
_FINAL_RATE = 0.05


class RoughnessSearch:
    """The searches of a fit.

    Args:
        problem: what is learned.
        config: of the fit.
        step: of the same fit.
        ranks: that sample an equal share each.
    """

    def __init__(
        self, problem: Problem, config: FitConfig, step: TrainingStep, ranks: Ranks
    ) -> None:
        self._problem, self._config, self._step, self._ranks = problem, config, step, ranks
        self._samples = SearchSamples(problem, step)
        search, materials = config.roughness_search, problem.materials
        self._field = None
        if materials is not None and problem.radiance is not None:
            field = materials.get("roughness")
            self._field = field if field is not None and field.shared() else None
        # A single search is the last one; there is none where there is nothing to search.
        times = 0 if self._field is None else search.times
        self._places = np.sort(np.linspace(search.last, search.first, times))
        self.made = 0  # for how many of the places roughness was searched
        self.searched = 0  # how often it was

    def passed(self, done: float) -> int:
        """How many places of searches lie before a fraction of the fit, or at it."""
        return int((self._places <= done).sum())

    def seconds_left(self, progress: Progress, seconds: float) -> float:
        """How long the searches that are to come will take, about, of a fit of so many seconds."""
        left, rest = len(self._places) - self.made, seconds - progress.searching
        if left <= 0 or rest <= 0:
            return 0.0
        if progress.last_search:  # they are about equally large
            fitting = int(max(seconds - progress.seconds, 0) / progress.last_search)
            return min(left, fitting) * progress.last_search
        steps = progress.seconds - progress.searching
        done = steps / rest * (1 + left * self._config.roughness_search.share)
        size = self._size(progress.step, done)
        if size is None:
            return 0.0
        # As long as steps with as many samples.
        return left * size[0] * size[1] * progress.seconds / max(progress.samples, 1)

    def due(self, done: float) -> bool:
        """Whether a search is to be made after a fraction of the fit.

        Those that were missed, as a fit was made shorter, are made up for by one.
        """
        return self.made < self.passed(done)

    def rates(self, rates: dict[str, float], step: int, done: float) -> dict[str, float]:
        """The learning rates of a step, after a fraction of the fit."""
        if not len(self._places) or not self._size(step, done):
            return rates
        search = self._config.roughness_search
        factor = search.rate_between if self.searched else search.rate_before
        return rates | {"roughness": rates["roughness"] * factor}

    def _size(self, step: int, done: float) -> tuple[int, int] | None:
        """Pixels that a search has after a step and a fraction of the fit, and samples of each.

        None: there is no search.

        The noise of a photograph is the same whenever its pixel is drawn. So there are no more
        pixels than photographs have, and more samples of each instead.
        """
        if not done:
            return None
        search, of_steps = self._config.roughness_search, self._config.samples_per_step
        wanted = round(search.share * step / done * of_steps / search.spp)
        if wanted < _FEWEST:
            return None
        wanted = min(wanted, search.pixels)
        pixels = min(wanted, self._step.pixels.photographs.count)
        repeats = min(wanted // pixels, _MOST_REPEATS)
        return pixels, search.spp * 2 ** (repeats.bit_length() - 1)

    def search_if_due(self, done: float, state: State, number: int) -> int:
        """Search, if that is due, and leave in the state what was found.

        Args:
            done: fraction of the fit.
            number: of the step; with the settings' seed it decides all random numbers.

        Returns:
            How many camera samples were traced, by all ranks.

        Raises:
            UserError: there is no memory for it.
        """
        size = self._size(number, done) if self.due(done) else None
        if size is None:
            return 0
        pixels, spp = size
        try:
            with without_garbage_collection():
                passed = self.passed(done)
                # The first one is of an L_θ that is not there yet.
                part = 1 / max(1, self.searched)
                # Steps recover little of what is taken away from albedo too early.
                settled = self.searched > 0 or passed == len(self._places)
                each = -(-pixels // self._ranks.size)
                samples = self._search(state, number, (each, spp), part, settled)
                self.made, self.searched = passed, self.searched + 1
                return samples
        except (RuntimeError, MemoryError) as error:
            if not lacks_memory(error):
                raise
            what = f"no memory for a search of roughness with {pixels} pixels"
            remedy = "Go on with --resume, without this search, or start another run with fewer"
            raise UserError(what, "roughness_search.pixels", remedy) from None

    def _search(
        self, state: State, number: int, size: tuple[int, int], part: float, settled: bool
    ) -> int:
        """The search after a step.

        Args:
            size: pixels of this rank, and samples of each.
            part: fraction of the way to move from the current values to those found.
            settled: whether the variation of albedo within pieces is shrunk, too.
        """
        search, materials, field = (
            self._config.roughness_search,
            self._problem.materials,
            self._field,
        )
        assert materials is not None and field is not None
        self._step.unite(state)
        self._ranks.announce()  # it takes longer than a step
        pixels, spp = size
        most = max(1, _AT_ONCE // spp)
        batches = -(-pixels // most)
        each = -(-pixels // batches)
        entropy = [self._config.seed, _SEED, number, self._ranks.rank]
        words = np.random.SeedSequence(entropy).generate_state(2 * batches + 2).tolist()
        *seeds, of_places = zip(words[::2], words[1::2], strict=True)

        def sample() -> np.ndarray:
            parts = [self._samples.by_roughness(state, pair, each, spp, NODES) for pair in seeds]
            return _as_bytes(np.concatenate(parts))

        def look() -> np.ndarray:
            return _as_bytes(self._samples.places(state, of_places, min(pixels, _AT_ONCE)))

        rows = self._ranks.joined(sample).reshape(-1).view(row_type(len(NODES)))
        shown = self._ranks.joined(look).reshape(-1).view(PLACE)
        if len(rows):
            shown = shown if len(shown) else rows
            albedo = "albedo" in materials
            present = roughness_of(field, points(rows, albedo)).numpy()
            rows["weight"] *= precision(rows, present)
            ranks = self._ranks if len(rows) >= self._ranks.size else Ranks()
            curves = Curves.of(rows, search.cells, search.colours, albedo, ranks, shown)
            own = self._config.material_settings["roughness"].learning_rate
            found = searched(field, curves, search, search.rate * own, ranks, rows)
            before = {key: dr.detach(state.phi[f"roughness.{key}"]) for key in found}
            found = averaged(field, curves, (before, found), part, ranks)
            found = _as_first(found, self._ranks)
            changed = {f"roughness.{key}": x for key, x in found.items()}
            if settled and search.pixels_as_one and albedo:
                with holding(field, found):
                    now = roughness_of(field, points(rows, albedo)).numpy()
                told = expected_albedo(materials["albedo"], rows, now, search, shown)
                changed |= {f"albedo.{key}": x for key, x in _as_first(told, self._ranks).items()}
            state.replace(changed)
        state.publish(self._problem)
        return batches * each * spp * self._ranks.size


def _as_first(arrays: dict[str, Any], ranks: Ranks) -> dict[str, Any]:
    """What rank 0 has found: sums of many threads differ in their last bits."""
    if ranks.size == 1:
        return arrays
    return {
        key: shaped_like(from_numpy(mi.Float, ranks.as_first(x.numpy())), x)
        for key, x in arrays.items()
    }


def _as_bytes(rows: np.ndarray) -> np.ndarray:
    """An array of some type as bytes, shape (n, bytes)."""
    return rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize)


def searched(
    field: Field,
    curves: Curves,
    settings: RoughnessSearchConfig,
    rate: float,
    ranks: Ranks | None = None,
    rows: np.ndarray | None = None,
) -> dict[str, Any]:
    """What a search finds: where a field descends to, with pieces as they are to be expected.

    Args:
        field, curves, settings, rate, ranks: as of `descend`; the field stays as it is.
        rows: of `row_type`, of all ranks, whose curves these are; None: nothing differs from place
            to place.

    Returns:
        As of `descend`, and what differs from place to place; where anything does, the descent was
        made once more beside it.
    """
    first = with_all_variation(field, curves, ranks)

    def descended(start: dict[str, Any]) -> dict[str, Any]:
        with holding(field, start):
            found = start | descend(field, curves, settings, rate, ranks)
        if settings.pixels_as_one:
            found = with_expected_variation(field, curves, found, settings, ranks)
        return found

    found = descended(first)
    if not settings.pixels_as_one:
        return found
    if rows is not None:
        albedo, every = curves.point.albedo is not None, ranks or Ranks()
        every.announce()  # it takes longer than a step
        places = expected_places(field, rows, found, settings, albedo=albedo)
        places = _as_first(places, every)  # all go the same way
        if differ_by_place(places):
            # Colours have taken up what they could of the places.
            found = descended(first | places)
    return with_expected_levels(field, curves, found, settings, ranks)


def averaged(
    field: Field,
    curves: Curves,
    both: tuple[dict[str, Any], dict[str, Any]],
    part: float,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Numbers that points share, between those of before and those that were found.

    Outputs are products of some of them: the level of each piece is put where both levels have it.

    Args:
        field: of roughness, with numbers of pieces.
        curves: of the pieces that were searched.
        both: the numbers of before, and those that were found.
        part: fraction of the way to move from those of before to those that were found.
        ranks: that have a part of the curves each; None: there is one.
    """
    before, found = both
    if part == 1:
        return found
    mixed = {key: dr.lerp(before[key], found[key], part) for key in found}
    seen = [SeenPieces(field, curves.point, curves.pieces, x, ranks) for x in (*both, mixed)]
    first, last, now = (each.middles(curves.shown)[0] for each in seen)
    return mixed | seen[-1].raised(first + part * (last - first) - now)


def descend(
    field: Field,
    curves: Curves,
    settings: RoughnessSearchConfig,
    rate: float,
    ranks: Ranks | None = None,
) -> dict[str, Any]:
    """Let a field descend on curves by Adam, towards the most probable numbers.

    Args:
        field: of roughness; the same on all ranks.
        curves: of errors in units of their variance.
        settings: how many steps there are, and how like each other numbers are expected to be.
        rate: of the first step.
        ranks: that have a part of the curves each; None: there is one.

    Returns:
        The parameters that moved, which are those that points share.
    """
    ranks = ranks or Ranks()
    first = {key: type(value)(dr.detach(value)) for key, value in field.parameters().items()}
    optimizer = mi.ad.Adam(rate, {key: first[key] for key in field.shared()})
    beside = dr.detach(field.beside_shared(curves.point))
    dr.eval(beside)
    # What is expected of numbers counts once, however pixels are dealt to ranks.
    known = replace(curves.point, piece=curves.known)
    # Both are logarithms of probabilities, times -2. Errors of a pixel are a mean over channels,
    # because most of their noise is the same. The mean over ranks is that over all pixels.
    spreads = {
        "pieces": settings.piece_spread,
        "brightnesses": settings.brightness_spread,
        "colours": settings.colour_spread,
        "own_colours": settings.own_colour_spread,
    }
    weights = {key: dr.opaque(mi.Float, x**-2 / curves.total) for key, x in spreads.items()}
    share = dr.width(curves.losses) // len(NODES) * ranks.size / curves.total
    weights["pixels"] = dr.opaque(mi.Float, share)
    for number in range(settings.steps):
        now = rate * _FINAL_RATE ** (number / settings.steps)
        optimizer.set_learning_rate({key: dr.opaque(mi.Float, now) for key in optimizer})
        field.assign(first | dict(optimizer.items()))
        roughness = in_range(field.with_shared(beside, curves.point))
        loss = weights["pixels"] * dr.mean(curves.at(roughness))
        for key, values in field.deviations(known).items():
            loss += weights[key] * dr.sum(dr.square(values))
        dr.backward(loss)
        if ranks.size > 1:
            own = dr.concat(flat_gradients(optimizer)).numpy()
            set_gradients(optimizer, from_numpy(mi.Float, ranks.mean(own)))
        optimizer.step()
    return {key: dr.detach(value) for key, value in optimizer.items()}
