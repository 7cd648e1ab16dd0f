"""From a data set and settings to what is fitted."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import FitConfig
from ..data import scene as scenes
from ..data.batches import PixelSource
from ..data.views import Dataset, check_cameras, load_pixels
from ..errors import UserError
from ..fields.domain import Domain
from ..fields.materials import Materials
from ..fields.radiance import RadianceField
from ..fields.texture import material_textures
from ..transport.objective import METHODS, needs
from ..transport.vertex import World


@dataclass
class Problem:
    """A world with unknown materials, and its radiance field if the method has one."""

    world: World
    materials: Materials
    radiance: RadianceField | None
    see_environment: bool


def make_problem(scene: Path, background: str, config: FitConfig, scale: float) -> Problem:
    """Put fresh fields in the place of a scene's materials.

    Args:
        scene: the Mitsuba scene; its albedo and roughness are ignored.
        background: `visible` or `hidden`.
        scale: radiance of the untrained radiance field.

    Raises:
        UserError: the scene cannot be loaded, has no emitter or nothing to fit.
    """
    parsed = scenes.parse(scene)
    scenes.to_principled(parsed)
    seeds = np.random.SeedSequence(config.seed).generate_state(2)
    materials = Materials(config.albedo, config.roughness, seed=int(seeds[0]))
    scenes.set_textures(parsed, *material_textures(materials))
    loaded = parsed.instantiate()
    scenes.require_emitters(loaded, scene)
    materials.domain = Domain.of(loaded.bbox())

    radiance = None
    if needs(METHODS[config.method]).radiance:
        radiance = RadianceField(
            config.radiance, materials.domain, scale=scale, seed=int(seeds[1])
        )
    world = World.of(loaded, materials, config.transport.max_specular)
    return Problem(world, materials, radiance, see_environment=background == "visible")


def training_pixels(
    dataset: Dataset, *, clip_negative: bool
) -> tuple[PixelSource, float]:
    """The pixels of the training views, and the mean of their radiance.

    Raises:
        UserError: there is no training view, an image is bad, or all pixels are black.
    """
    views = dataset.train
    if not views:
        raise UserError(
            "no training view", dataset.folder, 'Give frames of transforms.json "split": "train"'
        )
    rgb, alpha = load_pixels(views, clip_negative)
    hidden = dataset.background == "hidden"
    if hidden and not (alpha > 0).any():
        raise UserError("no foreground pixel in any training view", dataset.folder)
    mean = float(rgb[alpha > 0].mean() if hidden else rgb.mean())
    if mean <= 0:
        raise UserError("all training images are black", dataset.folder)
    source = PixelSource.of([v.camera for v in views], rgb, alpha, foreground_only=hidden)
    return source, mean


def camera_warnings(dataset: Dataset, scene: mi.Scene) -> list[str]:
    """One line for each camera that seems to stand inside geometry."""
    with dr.suspend_grad():
        inside = check_cameras(scene, {v.name: v.camera for v in dataset.views})
    return [f"{name}: the camera seems to stand inside geometry" for name in inside]
