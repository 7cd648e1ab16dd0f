"""Path samplers: how a method follows light, to the pixels of a step and its loss terms.

A sampler of your own is a factory given to `register_sampler`, and named by a `Method`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import MappingProxyType
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ..errors import UserError, require_name
from ..fields.guide import LightGuide
from ..fields.radiance import RadianceField
from .loss import RelativeL2
from .methods import BOUNCES, KEPT_PATHS, PATH_REPLAY, PHOTOMETRIC, Method
from .objective import objective, requirements
from .operator import transported
from .path_sample import PathSample, Requirements, SampleSubset, rhs, trace
from .prb import light_through_holes, materials_along_paths, path_radiance, path_replay
from .vertex import SceneView, rays_behind_area_emitters
from .wavefront import PathLimits, Plan, path_light, plan_widths

#: Name of the guide's loss among the terms.
GUIDE = "guide"
#: The arrays that the scene's textures and emitters read, by name.
Arrays = dict[str, mi.Float | mi.TensorXf]


@dataclass(frozen=True)
class SamplerContext:
    """The inputs of a path sampler.

    Args:
        method: the method, whose terms the sampler computes.
        scene_view: the scene, with fields in the place of unknown materials.
        radiance: L_θ; None where no term reads it.
        hide_emitters: whether cameras see neither environment nor area emitters.
        spp: camera samples a pixel.
        bounces: k, after which the image takes L_θ.
        max_depth: longest path in bounces, plus one, of methods that follow paths to their end.
        rr_depth: where roulette begins; see `PathLimits` and `path_replay` for how each counts.
        planned_gain: factor by which surfaces may come to reflect more than in the first batch.
        read_by_scene: returns the current arrays that the scene's textures and emitters read.
        guide: path guiding, mixed with BSDF sampling; None: BSDF sampling alone.
    """

    method: Method
    scene_view: SceneView
    radiance: RadianceField | None
    hide_emitters: bool
    spp: int
    bounces: int
    max_depth: int
    rr_depth: int
    planned_gain: float
    read_by_scene: Callable[[], Arrays]
    guide: LightGuide | None = None


class PathSampler(Protocol):
    """The interface between a training step and a way to follow light.

    `scene` is the handle to use: a frozen function brings its own. `ray` has `spp` consecutive
    lanes a pixel, and `sampler` is seeded for as many.
    """

    #: Whether all paths are kept in memory, so that a step may need more than there is.
    keeps_paths: bool
    #: Whether `dr.freeze` can record a step.
    can_be_recorded: bool

    def prepared(self) -> AbstractContextManager:
        """A context around the other calls and backpropagation."""
        ...

    def plan(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> None:
        """Decide, from some camera samples, all that a recording fixes.

        It is called once, before the first step, if `keeps_paths` is set.
        """
        ...

    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Linear RGB radiance of camera samples."""
        ...

    def terms(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        target: mi.Color3f,
        sampler: mi.Sampler,
        subset: SampleSubset | None,
        loss: RelativeL2,
        primal: mi.Color3f | None,
    ) -> dict[str, mi.Float]:
        """The terms of the objective; see `objective`.

        Args:
            target: the photographs' pixels, linear RGB, one lane a pixel.
            subset: the samples that L_θ learns from; None: all.
        """
        ...


class BounceSampler:
    """A few bounces, then L_θ: the method of the paper and its ablations.

    A method of one's own that names this sampler and follows paths to their end has as many bounces
    as the longest path, in all lanes and without Russian roulette; `KeptPathSampler`, of `ad-pt`,
    is faster.
    """

    can_be_recorded = True

    def __init__(self, context: SamplerContext) -> None:
        self._context = context
        self.keeps_paths = context.method.follows_paths
        self._bounces = context.max_depth - 1 if self.keeps_paths else context.bounces
        self._requirements = requirements(context.method.terms, self._bounces)
        # What residuals read beside it is no part of the image.
        end = frozenset({self._bounces + 1} if self._requirements.radiance else ())
        self._of_image = Requirements(self._bounces, constant=end)

    def prepared(self) -> AbstractContextManager:
        """A context without effect."""
        return nullcontext()

    def plan(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> None:
        """Nothing is planned: all lanes are followed to the end."""

    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Radiance of camera samples."""
        sample = self._trace(scene, ray, sampler, None, self._of_image)
        return rhs(sample, sample.radiance[self._bounces], self._bounces)

    def terms(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        target: mi.Color3f,
        sampler: mi.Sampler,
        subset: SampleSubset | None,
        loss: RelativeL2,
        primal: mi.Color3f | None,
    ) -> dict[str, mi.Float]:
        """The terms of the objective."""
        guide, terms = self._context.guide, self._context.method.terms
        sample = self._trace(scene, ray, sampler, subset, self._requirements)
        values = objective(terms, sample, target, loss, primal, self._bounces)
        if guide is not None:
            values[GUIDE] = self._guide_loss(guide, sample, loss.weight(target))
        return values

    def _guide_loss(self, guide: LightGuide, sample: PathSample, weight: mi.Color3f) -> mi.Float:
        """The loss of the guide, by what the first bounces of camera samples found.

        Args:
            weight: of the pixels' squared errors.
        """
        first = sample.bounces[0]
        assert first.choice is not None
        with dr.suspend_grad():
            radiance = sample.radiance[self._bounces]
            for further in reversed(sample.bounces[1 : self._bounces]):
                radiance = transported(further, radiance)
            # Of emission that emitter sampling finds as well, the part that MIS leaves to bounces.
            light = first.next.emitted + first.next.throughput * radiance
            relative = dr.repeat(dr.sqrt(weight), self._context.spp)
            found = dr.mean(first.weight * light * relative)
            dr.eval(found)
        return guide.loss(first.choice, found)

    def _trace(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        sampler: mi.Sampler,
        subset: SampleSubset | None,
        required: Requirements,
    ) -> PathSample:
        c = self._context
        return trace(
            c.scene_view.with_scene(scene),
            c.radiance,
            ray,
            sampler,
            required,
            hide_emitters=c.hide_emitters,
            subset=subset,
            guide=c.guide,
        )


class _WholePathSampler(ABC):
    """Follows paths to their end; serves the photometric term alone.

    Raises:
        UserError: the method has terms that are not of the image alone.
    """

    def __init__(self, context: SamplerContext) -> None:
        self._context, method = context, context.method
        if list(method.terms) != [PHOTOMETRIC]:
            what = f"the method {method.name} has other terms than {PHOTOMETRIC}"
            raise UserError(what, None, f"The sampler {method.sampler} gives the image alone")
        requirements(method.terms)

    @abstractmethod
    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Radiance of camera samples."""

    def terms(
        self,
        scene: mi.Scene,
        ray: mi.Ray3f,
        target: mi.Color3f,
        sampler: mi.Sampler,
        subset: SampleSubset | None,
        loss: RelativeL2,
        primal: mi.Color3f | None,
    ) -> dict[str, mi.Float]:
        """The terms of the objective: the photometric one."""
        image = self.image(scene, ray, sampler)
        return {PHOTOMETRIC: loss.error(image, target, self._context.spp, primal)}


class KeptPathSampler(_WholePathSampler):
    """Paths to their end, all kept in memory: `ad-pt`.

    Mitsuba's `path` would do, but asks textures, and so fields, inside virtual calls and several
    times a vertex. Here fields are asked once, and the wavefront becomes narrower as paths end.
    """

    keeps_paths = True
    can_be_recorded = True

    def __init__(self, context: SamplerContext) -> None:
        super().__init__(context)
        self._limits = PathLimits(context.max_depth, context.rr_depth, context.hide_emitters)
        self._plan: Plan | None = None

    def prepared(self) -> AbstractContextManager:
        """A context without effect."""
        return nullcontext()

    def plan(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> None:
        """Plan how wide the wavefront is at each bounce, once."""
        if self._plan is None:
            c = self._context
            scene_view = c.scene_view.with_scene(scene)
            self._plan = plan_widths(scene_view, ray, sampler, c.spp, self._limits, c.planned_gain)

    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Radiance of camera samples.

        Raises:
            ValueError: nothing was planned.
        """
        if self._plan is None:
            raise ValueError("the widths of the wavefront are to be planned first")
        c = self._context
        scene_view = c.scene_view.with_scene(scene)
        return path_light(scene_view, ray, sampler, c.spp, self._limits, self._plan)


class PathReplaySampler(_WholePathSampler):
    """Paths to their end, by Mitsuba's `prb`.

    Raises:
        UserError: the method has terms that are not of the image alone.
    """

    keeps_paths = False

    def __init__(self, context: SamplerContext) -> None:
        super().__init__(context)
        self._integrator = path_replay(context.max_depth, context.rr_depth, context.hide_emitters)
        materials = context.scene_view.materials
        # Inside Mitsuba's loop, fields are evaluated as they were prepared.
        self.can_be_recorded = all(field.prepare_recordable for field in (materials or {}).values())

    def prepared(self) -> AbstractContextManager:
        """A context in which paths evaluate the material fields."""
        return materials_along_paths(self._context.scene_view.materials)

    def plan(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> None:
        """Nothing is planned: Mitsuba's loop ends with the last path."""

    def image(self, scene: mi.Scene, ray: mi.Ray3f, sampler: mi.Sampler) -> mi.Color3f:
        """Radiance of camera samples."""
        c, seen = self._context, ray
        if c.hide_emitters and c.scene_view.has_area_emitters:
            seen = rays_behind_area_emitters(scene, ray)
        light = path_radiance(self._integrator, scene, sampler, seen, c.read_by_scene())
        if c.hide_emitters and c.scene_view.has_holes:
            light -= light_through_holes(scene, ray, c.max_depth)
        return light


SamplerFactory = Callable[[SamplerContext], PathSampler]

_SAMPLERS: dict[str, SamplerFactory] = {
    BOUNCES: BounceSampler,
    KEPT_PATHS: KeptPathSampler,
    PATH_REPLAY: PathReplaySampler,
}
#: All samplers by name.
SAMPLERS: Mapping[str, SamplerFactory] = MappingProxyType(_SAMPLERS)


def register_sampler(name: str, factory: SamplerFactory) -> None:
    """Add a sampler to the table; methods may name it from then on.

    Raises:
        ValueError: there is another sampler of this name.
    """
    if SAMPLERS.get(name, factory) is not factory:
        raise ValueError(f"there is another sampler named {name}")
    _SAMPLERS[name] = factory


def make_sampler(context: SamplerContext) -> PathSampler:
    """The sampler that a method names.

    Raises:
        UserError: there is no such sampler, or it cannot serve the method's terms.
    """
    name = context.method.sampler
    require_name(name, SAMPLERS, "sampler")
    return SAMPLERS[name](context)
