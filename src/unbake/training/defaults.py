"""The settings of a new fit: what they leave to the method is filled in."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

from ..config import FitConfig, Unknown
from ..config.fit import (
    BOUNCES_OF_OBJECTS,
    FORGETFUL_BETA2,
    GAIN_OF_ROOMS,
    LEAST_SLOPE,
    OWN_BETA2,
    OWN_FINAL_RATE,
    OWN_WARM_UP,
)
from ..config.method_defaults import MethodDefaults, method_defaults
from ..dataset.scene_kind import SceneKind
from ..dataset.views import Dataset
from ..errors import require_kind
from ..quantities import QUANTITIES
from ..scene.emitters import ENVIRONMENTS, lights_besides
from ..scene.parse import parse
from ..transport.methods import METHODS
from ..transport.objective import has_radiance
from .grid_sizes import with_grid_sizes
from .path_depth import with_path_depth

Number = TypeVar("Number", int, float)


def with_defaults(config: FitConfig, dataset: Dataset) -> FitConfig:
    """The settings of a new fit, with what they leave to the method and to the data set.

    Raises:
        UserError: the settings are no `FitConfig`, the method has a term that does not exist, or
            the scene cannot be loaded.
    """
    require_kind(config, FitConfig, "config", 'unbake.preset("cpu")')
    return with_method_defaults(with_data_defaults(config, dataset), dataset.kind)


def with_data_defaults(config: FitConfig, dataset: Dataset) -> FitConfig:
    """The settings with what they leave to the data set, whatever the method.

    Raises:
        UserError: the scene cannot be loaded.
    """
    config = with_unknown(config, dataset)
    return with_grid_sizes(with_path_depth(config, dataset), dataset)


def with_unknown(config: FitConfig, dataset: Dataset) -> FitConfig:
    """The settings with what is unknown, as the data set says of its light, if they leave it open.

    Args:
        config: settings as a user gives them; others than `unknown = "auto"` are returned as is.
        dataset: of the fit.
    """
    if config.unknown != "auto":
        return config
    return replace(config, unknown=_unknown_of(dataset))


def _unknown_of(dataset: Dataset) -> Unknown:
    """What is unknown in a data set: materials, and whatever light there is if its is unknown.

    Raises:
        UserError: the scene cannot be read.
    """
    if dataset.light == "known":
        return "materials"
    scene = parse(dataset.scene, dataset.root)
    lamps = lights_besides(scene, ENVIRONMENTS)
    if not lamps:
        return "materials+lighting"
    surrounded = lights_besides(scene, ()) > lamps
    return "materials+lighting+emission" if surrounded else "materials+emission"


def told_unknown(given: FitConfig, dataset: Dataset) -> str | None:
    """A line where the data set decides that lighting is unknown; None where it does not.

    Args:
        given: settings before `with_unknown`.
        dataset: of the fit.
    """
    if given.unknown != "auto" or dataset.light == "known":
        return None
    return "the data set says that its light is unknown: it is recovered with the materials"


def with_method_defaults(config: FitConfig, kind: SceneKind) -> FitConfig:
    """The settings with the method's own learning rates, estimator, schedule and bounces.

    Factors of learning rates, an estimator and a schedule that are given stay. Factors of materials
    were found with networks: other representations keep the fields' own rates. A method without L_θ
    has no warm-up unless one is given. A run is started with these settings and its `config.toml`
    has them, so that it goes on with the same ones, whatever a later version finds better.

    Args:
        config: settings as a user gives them; those that are complete already are returned as is.
        kind: of the scene.

    Raises:
        UserError: the method has a term that does not exist.
    """
    # The factors were found with the fields and batches of this preset.
    found = method_defaults(config.method, kind) if config.preset == "cpu" else MethodDefaults()
    known = found.factors
    if config.representation != "neural":
        known = {name: factor for name, factor in known.items() if name not in QUANTITIES}
    factors = {
        name: known.get(name, 1.0) if given is None else given
        for name, given in config.rate_factors.items()
    }
    estimator = config.estimator
    if estimator == "auto":
        estimator = found.estimator or ("two-pass" if config.follows_paths else "all-pairs")
        estimator = config.one_pass if estimator == "all-pairs" else estimator
    return replace(
        config,
        bounces=config.bounces or own_bounces(config, kind),
        path=replace(config.path, planned_gain=config.path.planned_gain or own_gain(kind)),
        rate_factors=factors,
        estimator=estimator,
        final_learning_rate=_first_known(
            config.final_learning_rate, found.final_learning_rate, OWN_FINAL_RATE
        ),
        warm_up=_first_known(config.warm_up, found.warm_up, own_warm_up(config)),
        beta2=config.beta2 or own_beta2(config),
        least_slope=config.least_slope if config.least_slope >= 0 else own_least_slope(config),
    )


def own_bounces(config: FitConfig, kind: SceneKind) -> int:
    """The differentiable bounces of a method where the settings leave them open."""
    takes = METHODS[config.method].takes_bounces
    return BOUNCES_OF_OBJECTS if takes and kind == "object" else 1


def own_gain(kind: SceneKind) -> float:
    """The gain that wavefronts are planned for where the settings leave it open."""
    return GAIN_OF_ROOMS if kind == "room" else 1.0


def own_warm_up(config: FitConfig) -> int:
    """The warm-up of a method for which no other one was found: none without L_θ."""
    return OWN_WARM_UP if has_radiance(config.chosen_method) else 0


def own_beta2(config: FitConfig) -> float:
    """Adam's β₂ for the unknowns of a method where the settings leave it open."""
    return FORGETFUL_BETA2 if has_radiance(config.chosen_method) else OWN_BETA2


def own_least_slope(config: FitConfig) -> float:
    """The least slope of the bounds of albedo where the settings leave it open."""
    return LEAST_SLOPE if has_radiance(config.chosen_method) else 0.0


def _first_known(*values: Number | None) -> Number:
    return next(value for value in values if value is not None)
