"""A radiance field L_θ for a scene whose materials are held, trained by the radiometric prior."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..dataset.pixels import CameraRays
from ..fields.arrays import from_numpy, shaped_like
from ..fields.domain import Domain
from ..fields.radiance import RadianceField, make_radiance
from ..io import write_arrays
from ..training.step import without_garbage_collection
from ..transport.loss import RelativeL2
from ..transport.methods import EXTRA, PRIOR, Attached
from ..transport.objective import objective, requirements
from ..transport.path_sample import trace
from ..transport.path_tracer import path_traced
from ..transport.vertex import SceneView

#: The terms of `ours` that train L_θ, without the one that compares it with photographs.
TERMS = {PRIOR: Attached(lhs=True), EXTRA: Attached(lhs=True)}


@final
@dataclass(frozen=True)
class CacheTraining:
    """How L_θ is trained while materials are held.

    Args:
        steps: training steps.
        lanes: camera rays of a step.
        rate: Adam's learning rate, which decays exponentially over the steps.
        final_rate: factor of the rate at the end.
        epsilon: of the relative norm of the residual.
    """

    steps: int
    lanes: int
    rate: float
    final_rate: float = 0.05
    epsilon: float = 0.01


def fresh_radiance(
    scene_view: SceneView, rays: CameraRays, config: FitConfig, seed: int
) -> RadianceField:
    """An untrained L_θ, as bright as what the cameras see.

    Args:
        scene_view: the scene.
        rays: of the cameras.
        config: settings of a fit, of which those of L_θ count.
        seed: of its initial parameters.
    """
    ray = _random_rays(rays, _sampler(seed, 4096), 4096)
    seen = path_traced(scene_view, ray, seed, max_depth=64, rr_depth=5, hide_emitters=False)
    return make_radiance(
        config.radiance_representation,
        config.radiance_settings,
        Domain.of(scene_view.scene.bbox()),
        scale=float(np.mean(np.array(seen))),
        seed=seed,
        half=config.half_precision,
    )


def train(
    scene_view: SceneView,
    radiance: RadianceField,
    rays: CameraRays,
    training: CacheTraining,
    *,
    seed: int,
) -> float:
    """Train L_θ to satisfy the rendering equation at x₁ and x₂ of camera rays.

    No photograph is read, so that L_θ belongs to the materials that the scene has.

    Args:
        scene_view: the scene, with the materials that are held.
        radiance: L_θ; it has the trained parameters afterwards.
        rays: of the cameras. Each pixel of each view is as likely as any other.
        training: its settings.
        seed: of all random numbers.

    Returns:
        The mean residual at x₁ and x₂ over the last tenth of the steps.

    Paper: Eq. 10, Sec. 4.2.
    """
    needed = requirements(TERMS)
    θ = mi.ad.Adam(training.rate, radiance.parameters(), mask_updates=True)

    def step(scene: mi.Scene, rays: CameraRays, sampler: mi.Sampler, number: mi.UInt32, θ) -> tuple:
        radiance.assign(dict(θ.items()))
        sampler.seed(number, training.lanes)
        ray = _random_rays(rays, sampler, training.lanes)
        sample = trace(scene_view.with_scene(scene), radiance, ray, sampler, needed)
        nothing = dr.zeros(mi.Color3f, training.lanes)
        terms = objective(TERMS, sample, nothing, RelativeL2(training.epsilon))
        total = terms[PRIOR] + terms[EXTRA]
        dr.backward(total)
        θ.step(active=dr.isfinite(total), eval=False)
        dr.eval(θ, total)
        return (total,)

    frozen = dr.freeze(step)
    sampler = mi.load_dict({"type": "independent"})
    losses = []
    with without_garbage_collection():
        for number in range(training.steps):
            rate = training.rate * training.final_rate ** (number / training.steps)
            θ.set_learning_rate({key: dr.opaque(mi.Float, rate) for key in θ})
            (word,) = np.random.SeedSequence([seed, number]).generate_state(1)
            (loss,) = frozen(scene_view.scene, rays, sampler, dr.opaque(mi.UInt32, int(word)), θ)
            if number >= min(0.9 * training.steps, training.steps - 1):
                losses.append(loss)
    radiance.assign({key: dr.detach(value) for key, value in θ.items()})
    return float(np.mean([np.array(loss) for loss in losses]))


def save_radiance(file: Path, radiance: RadianceField) -> None:
    """Write the parameters of L_θ, complete or not at all."""
    arrays = {key: value.numpy() for key, value in radiance.parameters().items()}
    write_arrays(file, {"scale": np.array(radiance.scale), **arrays})


def load_radiance(file: Path, scene_view: SceneView, config: FitConfig) -> RadianceField:
    """L_θ with the parameters of a file, for a scene of the same size."""
    with np.load(file) as arrays:
        radiance = make_radiance(
            config.radiance_representation,
            config.radiance_settings,
            Domain.of(scene_view.scene.bbox()),
            scale=float(arrays["scale"]),
            seed=0,
            half=config.half_precision,
        )
        parameters = {
            key: shaped_like(from_numpy(mi.Float, arrays[key]), value)
            for key, value in radiance.parameters().items()
        }
    radiance.assign(parameters)
    return radiance


def _random_rays(rays: CameraRays, sampler: mi.Sampler, lanes: int) -> mi.Ray3f:
    pixel = mi.UInt32(sampler.next_1d() * rays.pixels)
    ray = rays.through(dr.minimum(pixel, rays.pixels - 1), sampler.next_2d())
    dr.eval(ray)
    return ray


def _sampler(seed: int, lanes: int) -> mi.Sampler:
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, lanes)
    return sampler
