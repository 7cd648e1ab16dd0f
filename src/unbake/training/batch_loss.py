"""The loss of a method on a batch of pixels, and its gradients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.pixels import CameraRays, PixelBatch, PixelSource, RayBatch
from ..fields.arrays import from_numpy
from ..fields.camera import CameraModel
from ..fields.materials import carrying
from ..transport.loss import RelativeL2, pixel_means
from ..transport.methods import PHOTOMETRIC
from ..transport.path_sample import SampleSubset
from ..transport.samplers import SamplerContext, make_sampler
from .outliers import Blocks
from .poses import PoseUnits
from .problem import Problem
from .regularizers import has_terms, regularization_terms
from .state import State

#: Camera samples, at most, of the batch that a path sampler plans with.
_PLANNED_PATHS = 1 << 15


@final
@dataclass
class Inputs:
    """What differs from batch to batch, the argument of a frozen function; a PyTree."""

    scene: mi.Scene
    rays: CameraRays
    pixels: PixelBatch
    sampler: mi.Sampler  # of all camera samples
    second: mi.Sampler  # of those that L_θ learns from, if these are fewer
    single: mi.Sampler  # of one camera sample a pixel, for regularizers
    seed: mi.UInt32
    exposures: mi.Float | None = None  # of the views, as the data set has them, if they are read
    units: PoseUnits | None = None  # of corrections of poses, if there are any
    blocks: Blocks | None = None  # of pixels that lose their weight together, if they are to
    anchor: mi.Float | None = None  # weight of the deviation of the mean albedo; None: the first


@final
class BatchLoss:
    """The loss of a method on batches of pixels of a problem.

    Args:
        problem: what is learned.
        pixels: to draw batches from.
        config: of the method and the batch; of several ranks, with this one's share of it.
        rank: number of the process, which has random numbers of its own.

    Raises:
        ValueError: the loss needs smoothed photographs, and there are none.

    Paper: Eq. 11, Eq. 14, Sec. 4, 5.4, 6.
    """

    def __init__(
        self, problem: Problem, pixels: PixelSource, config: FitConfig, rank: int = 0
    ) -> None:
        smoothed = config.loss_reference == "smoothed"
        if smoothed and not pixels.photographs.smoothed:
            raise ValueError("the loss is relative to smoothed photographs, which were not made")
        self._problem, self._config, self._rank = problem, config, rank
        self.pixels = pixels
        self.epsilon = config.epsilon(pixels.photographs.level)
        self.path_sampler = make_sampler(_context(problem, config))
        self._exposures = None
        if problem.camera is not None and problem.camera.has_response:
            exposures = pixels.exposures
            self._exposures = from_numpy(
                mi.Float, np.ones(problem.camera.views) if exposures is None else exposures
            )
        self._units = None if problem.poses is None else problem.poses.units
        self._sampler = mi.load_dict({"type": "independent"})
        self._second = mi.load_dict({"type": "independent"})
        self._single = mi.load_dict({"type": "independent"})
        self._probed = mi.load_dict({"type": "independent"})

    @property
    def recordable(self) -> bool:
        """Whether `dr.freeze` can record what is computed here."""
        recordable = all(field.recordable for field in self._problem.fields())
        return self.path_sampler.can_be_recorded and recordable

    def inputs(self, number: int, probe: int | None = None) -> Inputs:
        """The inputs of the batch of a step.

        Args:
            number: of the step.
            probe: how many pixels of all views stand for its batch, where another one is wanted.
        """
        entropy = [self._config.seed, number]
        entropy += [self._rank] if self._rank else []
        seeds = np.random.SeedSequence(entropy).generate_state(2)
        anchor = self._problem.anchor
        return Inputs(
            scene=self._problem.scene_view.scene,
            rays=self.pixels.rays,
            pixels=self._drawn(int(seeds[0]), probe),
            sampler=self._sampler,
            second=self._second,
            single=self._single,
            seed=dr.opaque(mi.UInt32, int(seeds[1])),
            exposures=self._exposures,
            units=self._units,
            blocks=None if self._problem.outliers is None else self._problem.outliers.blocks,
            anchor=None if anchor is None else dr.opaque(mi.Float, anchor),
        )

    def _drawn(self, seed: int, probe: int | None) -> PixelBatch:
        if probe is None and self._config.pixel_sampling == "one-view-crop":
            return self.pixels.draw_crop(seed, self._config.pixels)
        return self.pixels.draw(seed, probe or self._config.pixels)

    def inputs_of(self, rays: CameraRays, pixels: PixelBatch, seed: int) -> Inputs:
        """The inputs for an image of some pixels, with a sampler of their own.

        Args:
            rays: through the pixels, and maybe others.
            seed: decides the random numbers.
        """
        return Inputs(
            scene=self._problem.scene_view.scene,
            rays=rays,
            pixels=pixels,
            sampler=self._probed,
            second=self._second,
            single=self._single,
            seed=dr.opaque(mi.UInt32, seed),
            units=self._units,
        )

    @carrying()
    def plan(self, state: State) -> None:
        """Let the path sampler decide what it fixes for all steps; to be called once.

        Args:
            state: of the unknowns and L_θ.
        """
        config, path_sampler = self._config, self.path_sampler
        with dr.suspend_grad(), path_sampler.prepared():
            inputs = self.inputs(0, min(config.pixels, max(1, _PLANNED_PATHS // config.spp)))
            state.publish(self._problem)
            batch = self._batch(inputs, self._rays(inputs))
            path_sampler.plan(inputs.scene, batch.ray, inputs.sampler)

    @carrying()
    def backward(self, inputs: Inputs, state: State) -> dict[str, mi.Float]:
        """The loss terms on a batch; their gradients are accumulated in the state."""
        config, path_sampler = self._config, self.path_sampler
        scene, sampler = inputs.scene, inputs.sampler
        state.publish(self._problem)
        placed = self.placed(inputs)
        rays = inputs.rays if self._problem.poses is None else dr.detach(placed)
        batch = self._batch(inputs, rays)
        with path_sampler.prepared():
            primal = None
            if config.two_passes:
                with dr.suspend_grad():
                    again = inputs.pixels.batch(rays, sampler, config.spp)
                    image = path_sampler.image(scene, again.ray, sampler)
                    primal = pixel_means(image, config.spp)
            target, loss, roots = self.compared(inputs, batch, placed)
            subset = _subset(config, inputs)
            terms = path_sampler.terms(scene, batch.ray, target, sampler, subset, loss, primal)
            terms |= self._regularization(inputs, batch.ray, terms.get(PHOTOMETRIC))
            poses = self._problem.poses
            if poses is not None:
                sigma, count = config.camera.pose_sigma, self.pixels.photographs.count
                terms["pose_prior"] = poses.prior(sigma, terms.get(PHOTOMETRIC), count)
            outliers = self._problem.outliers
            if outliers is not None and roots is not None and PHOTOMETRIC in terms:
                terms["outliers"] = outliers.cost(roots, terms[PHOTOMETRIC])
            total = sum(terms.values())
            dr.backward(total if state.scale is None else total * state.scale)
        return terms

    @carrying()
    def image(self, inputs: Inputs, state: State, each: int | None = None) -> mi.Color3f:
        """The pixels as a step sees them, without gradients.

        Args:
            inputs: of a batch.
            state: of the unknowns and L_θ.
            each: of how many samples each value is the mean; None: of all of a pixel.

        Returns:
            Linear RGB, `spp / each` lanes a pixel.
        """
        with dr.suspend_grad(), self.path_sampler.prepared():
            state.publish(self._problem)
            batch = self._batch(inputs, self._rays(inputs))
            image = self.path_sampler.image(inputs.scene, batch.ray, inputs.sampler)
            means = pixel_means(image, each or self._config.spp)
            dr.eval(means)
        return means

    def _batch(self, inputs: Inputs, rays: CameraRays) -> RayBatch:
        """The camera samples, with random numbers that start anew."""
        spp = self._config.spp
        inputs.sampler.seed(inputs.seed, inputs.pixels.count * spp)
        return inputs.pixels.batch(rays, inputs.sampler, spp)

    def placed(self, inputs: Inputs) -> CameraRays:
        """The camera rays, by what is known of the cameras by now.

        They pass gradients to corrections of poses where there are any.
        """
        poses, units = self._problem.poses, inputs.units
        return inputs.rays if poses is None else poses.placed(inputs.rays, units)

    def _rays(self, inputs: Inputs) -> CameraRays:
        return dr.detach(self.placed(inputs))

    def compared(
        self, inputs: Inputs, batch: RayBatch, placed: CameraRays
    ) -> tuple[mi.Color3f, RelativeL2, mi.Float | None]:
        """What pixels are compared with, by what is known of the cameras by now, and how.

        Args:
            placed: camera rays of all pixels, which may pass gradients to corrections of poses.

        Returns:
            The photographs as light, linear RGB, one lane a pixel; the loss; and the roots of what
            errors are multiplied by, where outliers are to be found.
        """
        config, problem, pixels = self._config, self._problem, inputs.pixels
        smoothed = config.loss_reference == "smoothed"
        reference, target = batch.smoothed if smoothed else None, batch.target
        if problem.poses is not None:
            target = problem.poses.target(inputs.scene, placed, pixels, batch)
        gain = None
        if problem.camera is not None:
            target, reference, gain = self._through_camera(
                problem.camera, inputs, target, reference
            )
        roots, trust = None, None
        if problem.outliers is not None:
            roots = problem.outliers.roots(inputs.rays, pixels.numbers(), inputs.blocks)
            trust = dr.square(roots)
        pairs = config.chosen_estimator == "all-pairs"
        loss = RelativeL2(self.epsilon, reference, batch.clipped, gain, trust, pairs)
        return target, loss, roots

    def _regularization(
        self, inputs: Inputs, ray: mi.Ray3f, photometric: mi.Float | None
    ) -> dict[str, mi.Float]:
        """The regularizers, at the first camera sample of each pixel."""
        problem, config = self._problem, self._config
        if not has_terms(problem, config):
            return {}
        chosen = _first_samples(inputs.pixels.count, config.spp, 1)
        inputs.single.seed(inputs.seed + 2, inputs.pixels.count)
        ray = dr.gather(mi.Ray3f, ray, chosen)
        return regularization_terms(
            problem, config, inputs.scene, ray, inputs.single, photometric, inputs.anchor
        )

    def _through_camera(
        self,
        camera: CameraModel,
        inputs: Inputs,
        target: mi.Color3f,
        reference: mi.Color3f | None,
    ) -> tuple[mi.Color3f, mi.Color3f | None, mi.Color3f]:
        """Photographs as light, what errors are relative to, and gains of renderings."""
        numbers = inputs.pixels.numbers()
        view = inputs.rays.view_of(numbers)
        gain = camera.gain(view, inputs.rays.radius2(numbers, view))
        if camera.has_response:
            assert inputs.exposures is not None
            # The response is of the photograph, before it was divided by its exposure.
            exposure = dr.gather(mi.Float, inputs.exposures, view)
            target = camera.exposed(target * exposure) / exposure
            if reference is not None:
                reference = dr.detach(camera.exposed(reference * exposure) / exposure)
        return target, reference, gain


def _context(problem: Problem, config: FitConfig) -> SamplerContext:
    """The inputs of the method's path sampler."""
    return SamplerContext(
        method=config.chosen_method,
        scene_view=problem.scene_view,
        radiance=problem.radiance,
        hide_emitters=problem.hide_emitters,
        spp=config.spp,
        bounces=config.chosen_bounces,
        max_depth=config.path.chosen_depth,
        rr_depth=config.path.rr_depth,
        planned_gain=config.path.planned_gain or 1.0,
        read_by_scene=problem.read_by_scene,
        guide=problem.guide,
    )


def _subset(config: FitConfig, inputs: Inputs) -> SampleSubset | None:
    """The first camera samples of each pixel, if L_θ learns from these alone."""
    each = config.radiance_samples
    if each == config.spp:
        return None
    inputs.second.seed(inputs.seed + 1, inputs.pixels.count * each)
    return SampleSubset(_first_samples(inputs.pixels.count, config.spp, each), inputs.second)


def _first_samples(pixels: int, spp: int, each: int) -> mi.UInt32:
    """The lanes of the first `each` of `spp` camera samples of pixels."""
    lane = dr.arange(mi.UInt32, pixels * each)
    chosen = lane // each * spp + lane % each
    # Evaluated, because a replayed kernel takes its size from arrays in memory that it reads.
    dr.eval(chosen)
    return chosen
