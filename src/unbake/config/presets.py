"""Settings to start from."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, get_args

from ..errors import UserError, require_name
from ..fields.settings import GridConfig, GuideConfig, NetworkConfig
from ..quantities import QUANTITIES
from ..transport.methods import method_named
from .fit import FitConfig, LightingConfig, PresetName, RegularizationConfig
from .roughness_search import RoughnessSearchConfig


def _paper() -> FitConfig:
    """Sec. 5.3, 5.4 and Table 1 (STAIRCASE): resolutions 2^1 … 2^16, table 2^17, Adam 5e-4.

    Of unknown lighting the paper tells the learning rate alone; size and start of the map are those
    of the release, and steps those of materials.
    """
    grid = GridConfig(levels=16, features=2, table_log2=17, base_resolution=2, growth=2.0)
    return FitConfig(
        preset="paper",
        bounces=1,
        steps=18_000,
        pixels=16_384,
        pixel_sampling="one-view-crop",
        held_aside=0.0,
        spp=16,
        radiance_spp=0,
        final_learning_rate=1.0,
        warm_up=0,
        beta2=0.999,
        estimator="two-pass",
        guide=GuideConfig(cells=0),
        loss_reference="photograph",
        loss_epsilon=0.01,
        least_slope=0.0,
        lighting=LightingConfig(
            resolution=128, learning_rate=5e-4, initial_radiance=1.0, coarse_gain=1.0
        ),
        regularization=RegularizationConfig(albedo_smoothness=0.0),
        roughness_search=RoughnessSearchConfig(
            times=0, pixels_as_one=0.0, pixels_at_most=0, rate_before=1.0
        ),
        **_networks(grid),
    )


def _networks(grid: GridConfig) -> dict[str, Any]:
    """All fields as networks over the same hash grid (Sec. 5.3, 5.4)."""
    material = NetworkConfig(grid, width=256, hidden=1, learning_rate=5e-4)
    return {
        "materials": {name: {"neural": material} for name in QUANTITIES},
        "radiance": {"neural": NetworkConfig(grid, width=256, hidden=3, learning_rate=5e-4)},
    }


def _release() -> FitConfig:
    """The settings of the authors' public release: 17 levels, base 2, scale 1.5, table 2^18."""
    grid = GridConfig(levels=17, features=2, table_log2=18, base_resolution=2, growth=1.5)
    return dataclasses.replace(
        _paper(),
        preset="release",
        **_networks(grid),
    )


def _release_lighting() -> FitConfig:
    """The environment map alone, as the authors' public release fits it by default.

    Their map has 256 x 128 pixels of radiance, 1 at the start. Ours is a square of 128² texels, as
    many around the horizon, and holds the logarithm of radiance in several levels: the rate of 1e-3
    is a change of at most 0.1 % a step and level, where theirs is 0.001. The script of
    Fig. 8 is not public.
    """
    release = _release()
    return dataclasses.replace(
        release,
        preset="release-lighting",
        unknown="lighting",
        steps=600,
        pixels=65_536,
        spp=8,
        lighting=dataclasses.replace(release.lighting, learning_rate=1e-3),
    )


#: How many times the steps of a preset a fit of this quality takes.
QUALITIES: Mapping[str, float] = MappingProxyType({"draft": 0.25, "normal": 1.0, "high": 4.0})


def with_quality(config: FitConfig, name: str) -> FitConfig:
    """The settings with a length for this quality, in steps or seconds, whichever they have.

    Batches stay as they are: more samples in a step improve held-out maps less than more steps.

    Args:
        config: settings with the length of `normal`.
        name: of `QUALITIES`.

    Raises:
        UserError: there is no such quality.
    """
    require_name(name, QUALITIES, "quality")
    factor = QUALITIES[name]
    return dataclasses.replace(
        config, steps=math.ceil(factor * config.steps), seconds=factor * config.seconds
    )


def with_method(config: FitConfig, name: str) -> FitConfig:
    """The settings with another method, without what belongs to the method that they name.

    Settings of a run that was started have the rates, the estimator, the schedule and the bounces
    of its method filled in. Another method has its own, which a fit chooses when it starts. What a
    user gives in settings that leave some of it open stays.

    Args:
        config: settings, as a user gives them or of a run.
        name: of the method.

    Raises:
        UserError: there is no such method.
    """
    if name == config.method:
        return config
    method = method_named(name)
    if not method.takes_bounces:
        config = dataclasses.replace(config, bounces=0)
    if not method.takes_prior:
        config = dataclasses.replace(config, prior="extra-bounce")
    if None not in config.rate_factors.values():
        own = preset(config.preset)
        config = dataclasses.replace(
            config,
            bounces=own.bounces,
            rate_factors={},
            estimator="auto",
            final_learning_rate=own.final_learning_rate,
            warm_up=own.warm_up,
            beta2=own.beta2,
            least_slope=own.least_slope,
        )
    return dataclasses.replace(config, method=name)


def preset(name: PresetName) -> FitConfig:
    """The settings of a preset.

    Args:
        name: `cpu` (ours, two cores), `paper` (Sec. 5), `release` (the authors' code), or
            `release-lighting` (the same for an unknown environment map).

    Raises:
        UserError: there is no such preset.
    """
    match name:
        case "cpu":
            return FitConfig()
        case "paper":
            return _paper()
        case "release":
            return _release()
        case "release-lighting":
            return _release_lighting()
    known = ", ".join(get_args(PresetName))
    raise UserError(f"no preset named {name!r}", remedy=f"Presets are {known}")
