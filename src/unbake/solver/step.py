"""One step towards the radiance that solves the rendering equation, recorded once and replayed."""

from __future__ import annotations

import gc
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..fields.materials import carrying
from ..fields.radiance import RadianceField
from ..training.problem import Parameters, Problem
from ..training.step import drop_broken_gradients, without_garbage_collection
from ..transport.loss import pixel_means
from ..transport.operator import attach_albedo, attach_material, bounce, transported
from ..transport.path_sample import reflected_radiance
from ..transport.prior import residual_norm
from ..transport.vertex import SceneView, find_vertex
from .points import SurfacePoints
from .settings import SolveSettings, epsilon_at


@dataclass
class Inputs:
    """The arguments of a frozen step; a PyTree."""

    scene: mi.Scene
    points: SurfacePoints
    sampler: mi.Sampler  # of points
    bounces: mi.Sampler  # of their samples of the right-hand side
    seed: mi.UInt32
    recovered: Parameters  # of fields of materials and lights


class SolverStep:
    """A step of Adam on the residual at random points and directions.

    The right-hand side is a constant (semi-gradients) unless the settings attach it. The step is
    traced each time where a field cannot be recorded.

    Args:
        problem: whose fields materials or lights are; None: they are the scene's own.

    Paper: Eq. 3, Eq. 4, Sec. 3.1.
    """

    def __init__(
        self,
        scene_view: SceneView,
        radiance: RadianceField,
        points: SurfacePoints,
        settings: SolveSettings,
        problem: Problem | None = None,
    ) -> None:
        # Dr.Jit 1.5 aborts if objects of an earlier fit are freed while this one is recorded.
        gc.collect()
        self._scene_view = scene_view
        self._radiance = radiance
        self._points = points
        self._settings = settings
        self._problem = problem
        self._samplers = [mi.load_dict({"type": "independent"}) for _ in range(2)]
        self._epsilon = epsilon_at(settings.epsilon, radiance.scale)
        fields = [radiance.function, *([] if problem is None else problem.fields())]
        recordable = all(field.recordable for field in fields)
        self._frozen = dr.freeze(self._step) if recordable else None

    def __call__(
        self,
        optimizer: mi.ad.Adam,
        number: int,
        rate: float,
        recovered: Parameters | None = None,
    ) -> dict[str, mi.Float]:
        """Take a step.

        Args:
            optimizer: owns θ.
            number: of the step; with the seed of the settings it decides all random numbers.
            rate: Adam's learning rate.
            recovered: the arrays of the problem's fields, if there is one.

        Returns:
            `residual`, the relative squared residual, and `skipped`, 1 if it was not finite.
        """
        # An array for each parameter: a changed Python number would be traced anew.
        optimizer.set_learning_rate({key: dr.opaque(mi.Float, rate) for key in optimizer})
        step = self._step if self._frozen is None else self._frozen
        with without_garbage_collection():
            return step(self.inputs(number, recovered), optimizer)

    def inputs(self, number: int, recovered: Parameters | None = None) -> Inputs:
        """The arguments of a step."""
        seed = np.random.SeedSequence([self._settings.seed, number]).generate_state(1)[0]
        return Inputs(
            scene=self._scene_view.scene,
            points=self._points,
            sampler=self._samplers[0],
            bounces=self._samplers[1],
            seed=dr.opaque(mi.UInt32, int(seed)),
            recovered=recovered or {},
        )

    def recordings(self) -> int:
        """How often the step was traced to be replayed; 0 if it is traced each time."""
        return 0 if self._frozen is None else self._frozen.n_recordings

    def _step(self, inputs: Inputs, optimizer: mi.ad.Adam) -> dict[str, mi.Float]:
        self._radiance.assign(dict(optimizer.items()))
        loss = self.loss(inputs)
        dr.backward(loss)
        finite = dr.isfinite(loss)
        drop_broken_gradients(optimizer)
        optimizer.step(active=finite, eval=False)
        terms = {"residual": loss, "skipped": dr.select(finite, mi.Float(0), mi.Float(1))}
        dr.eval(optimizer, terms)
        return terms

    @carrying()
    def loss(self, inputs: Inputs) -> mi.Float:
        """The relative squared residual at the points of a step, with gradients to θ."""
        if self._problem is not None:
            self._problem.assign(inputs.recovered)
        settings, samples = self._settings, self._settings.samples
        lanes = settings.batch * samples
        inputs.sampler.seed(inputs.seed, settings.batch)
        inputs.bounces.seed(inputs.seed + 1, lanes)
        scene_view = self._scene_view.with_scene(inputs.scene)
        with dr.suspend_grad():
            ray = inputs.points.rays(inputs.sampler)
            dr.eval(ray)
            x = find_vertex(scene_view, ray, mi.Bool(True), inputs.sampler)
            x = attach_material(scene_view, x)
            # Evaluated, because a replayed kernel takes its size from arrays that it reads.
            lane = dr.arange(mi.UInt32, lanes) // samples
            dr.eval(lane)
            step = bounce(scene_view, x.gathered(lane), inputs.bounces)
            end = attach_albedo(scene_view, step.next)
        if settings.attach_rhs:
            left, incoming = reflected_radiance(self._radiance, x, end)
        else:
            (left,) = reflected_radiance(self._radiance, x)
            with dr.suspend_grad():
                (incoming,) = reflected_radiance(self._radiance, end)
        right = transported(step, incoming)
        if not settings.attach_rhs:
            right = pixel_means(right, samples)
            residual = dr.select(x.valid, left - right, 0)
            return residual_norm(residual, left, self._epsilon)
        halves = pixel_means(right, samples // 2)
        even = 2 * dr.arange(mi.UInt32, settings.batch)
        first, second = (
            dr.select(x.valid, left - dr.gather(mi.Color3f, halves, even + half), 0)
            for half in (0, 1)
        )
        return residual_norm(first, left, self._epsilon, second)
